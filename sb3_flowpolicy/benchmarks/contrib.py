"""Gradient updates per second: TQCFlow and CrossQFlow against sb3-contrib's TQC and CrossQ."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable
from typing import Any

from sb3_flowpolicy.benchmarks.timing import Benchmark, Candidate, Work
from sb3_flowpolicy.benchmarks.updates import POLICIES, Shape, prefilled, updates_of

ALGORITHMS = ("TQC", "CrossQ")
SHAPES = (Shape(64, 17, 6), Shape(256, 42, 8))


def benchmarks(quick: bool = False) -> list[Benchmark]:
    """Return one benchmark per algorithm and shape; ``quick``: one shape, not compiled."""
    shapes = SHAPES[:1] if quick else SHAPES
    return [_benchmark(name, shape, not quick) for name in ALGORITHMS for shape in shapes]


def _benchmark(name: str, shape: Shape, compile: bool) -> Benchmark:
    def updates(algorithm: str, policy: str, **kwargs: Any) -> Callable[[], Work]:
        def prepare() -> Work:
            constructor = pkgutil.resolve_name(algorithm)  # needs the extra [contrib]
            sizes = shape.policy_kwargs(policy)
            model = prefilled(constructor, shape, policy=policy, policy_kwargs=sizes, **kwargs)
            return updates_of(model, n_calls=1)  # as sb3-contrib's updates take long

        return prepare

    stock = Candidate(f"sb3-contrib {name}", updates(f"sb3_contrib:{name}", "MlpPolicy"))
    ours = [
        Candidate(
            f"{name}Flow {policy}",
            updates(f"sb3_flowpolicy:{name}Flow", policy, compile=compile),
        )
        for policy in POLICIES
    ]
    return Benchmark(f"{name}, {shape.title}", "updates", [stock, *ours])
