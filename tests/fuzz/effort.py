"""How hard to try: the same examples at every run, or `FUZZ=20` times as many, and new ones."""

import os
from typing import Any

from hypothesis import HealthCheck, settings

EFFORT = int(os.environ.get("FUZZ", "1"))


def fuzz(n: int) -> Any:
    """Settings of a hypothesis test with n examples."""
    return settings(
        max_examples=n * EFFORT,
        derandomize=EFFORT == 1,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
