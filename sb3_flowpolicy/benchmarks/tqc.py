"""Gradient updates per second: TQCFlow against sb3-contrib's TQC."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sb3_contrib import TQC

from sb3_flowpolicy.algorithms.tqc_flow import TQCFlow
from sb3_flowpolicy.benchmarks.timing import Benchmark, Candidate, Work
from sb3_flowpolicy.benchmarks.updates import POLICIES, Shape, prefilled, updates_of

SHAPES = (Shape(64, 17, 6), Shape(256, 42, 8))


def benchmarks(quick: bool = False) -> list[Benchmark]:
    """Return one benchmark per shape; ``quick``: the first one, not compiled."""
    return [_benchmark(shape, not quick) for shape in (SHAPES[:1] if quick else SHAPES)]


def _benchmark(shape: Shape, compile: bool) -> Benchmark:
    def updates(algorithm: Any, policy: str, **kwargs: Any) -> Callable[[], Work]:
        sizes = shape.policy_kwargs(policy)
        # One call, as sb3-contrib's updates take long.
        return lambda: updates_of(
            prefilled(algorithm, shape, policy=policy, policy_kwargs=sizes, **kwargs), n_calls=1
        )

    stock = Candidate("sb3-contrib TQC", updates(TQC, "MlpPolicy"))
    ours = [Candidate(f"TQCFlow {p}", updates(TQCFlow, p, compile=compile)) for p in POLICIES]
    return Benchmark(f"TQC, {shape.title}", "updates", [stock, *ours])
