"""The measurement of the guard's cost."""

from __future__ import annotations

from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.benchmarks import trust


def test_every_call_of_the_guard_is_timed() -> None:
    model = trust.trained(SACFlow, chunk=10, compile=False)
    counts = {name: len(times) for name, times in trust.time_calls(model, chunk=10).items()}
    assert counts == {"check_step": 10, "before_updates": 10, "after_updates": 10, "look": 2}
