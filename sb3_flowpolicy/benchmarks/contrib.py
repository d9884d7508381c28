"""Gradient updates per second: TQCFlow against sb3-contrib's TQC."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable
from typing import Any

from sb3_flowpolicy.benchmarks.timing import Benchmark, Candidate, Work
from sb3_flowpolicy.benchmarks.updates import POLICIES, Shape, prefilled, updates_of

SHAPES = (Shape(64, 17, 6), Shape(256, 42, 8))


def benchmarks(quick: bool = False) -> list[Benchmark]:
    """Return one benchmark per shape; ``quick``: the first one, not compiled."""
    return [_benchmark(shape, not quick) for shape in (SHAPES[:1] if quick else SHAPES)]


def _benchmark(shape: Shape, compile: bool) -> Benchmark:
    def updates(name: str, policy: str, **kwargs: Any) -> Callable[[], Work]:
        def prepare() -> Work:
            algorithm = pkgutil.resolve_name(name)  # needs the extra [contrib]
            sizes = shape.policy_kwargs(policy)
            model = prefilled(algorithm, shape, policy=policy, policy_kwargs=sizes, **kwargs)
            return updates_of(model, n_calls=1)  # as sb3-contrib's updates take long

        return prepare

    stock = Candidate("sb3-contrib TQC", updates("sb3_contrib:TQC", "MlpPolicy"))
    ours = [
        Candidate(f"TQCFlow {policy}", updates("sb3_flowpolicy:TQCFlow", policy, compile=compile))
        for policy in POLICIES
    ]
    return Benchmark(f"TQC, {shape.title}", "updates", [stock, *ours])
