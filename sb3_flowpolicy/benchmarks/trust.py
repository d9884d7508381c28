"""Cost of the training guard and of each way to choose a deterministic action.

Benchmarks for ``benchmarks.throughput``. The guard's cost is smaller than the noise between turns
on a busy machine. ``python -m sb3_flowpolicy.benchmarks.trust`` therefore times each call of the
guard during training and prints its share of a step.
"""

from __future__ import annotations

import statistics
import time
from functools import cached_property, partial
from typing import Any
from unittest import mock

import numpy as np
import torch as th

import flowpolicy_envs
from sb3_flowpolicy.algorithms import off_policy
from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.benchmarks.learning import ENV_ID, N_SEEDS, zoo_block
from sb3_flowpolicy.benchmarks.timing import Benchmark, Candidate, Work
from sb3_flowpolicy.benchmarks.updates import Unmoved
from sb3_flowpolicy.guard.training_guard import UPDATES_BETWEEN_LOOKS, TrainingGuard
from sb3_flowpolicy.policies.deterministic import MODES
from sb3_flowpolicy.seeds import experience
from sb3_flowpolicy.seeds.batch import SeedBatch

CHUNK, QUICK_CHUNK = 1000, 10
KINDS = ("SACFlow", f"SeedBatch of {N_SEEDS}")
OBS_DIM, ACTION_DIM = 42, 8
BATCH_SIZES = (1, 100)


class _NoGuard:
    """A guard that checks nothing."""

    def restart(self, *_: Any) -> None: ...

    def before_updates(self) -> None: ...

    def after_updates(self, *_: Any) -> None: ...

    def look(self) -> None: ...


def benchmarks(quick: bool = False) -> list[Benchmark]:
    """Return learning with and without the guard, and acting; ``quick`` compiles nothing."""
    flowpolicy_envs.register_envs()
    found = []
    for kind in KINDS[:1] if quick else KINDS:
        # One agent takes both turns: two agents differ by more than the guard costs.
        turns = _Turns(kind, quick)
        candidates = [
            Candidate(f"{kind} without the guard", partial(getattr, turns, "unguarded")),
            Candidate(f"{kind} with the guard", partial(getattr, turns, "guarded")),
        ]
        found.append(Benchmark(f"the guard, learn() on {ENV_ID}, {kind}", "steps", candidates))
    for size in BATCH_SIZES:
        title = f"predict, nets 256-256, obs {OBS_DIM}, D = {ACTION_DIM}, {size} at once"
        modes = [Candidate(mode, partial(_acting, mode, size)) for mode in MODES]
        found.append(Benchmark(title, "calls", modes))
    return found


class _Turns:
    """Chunks of learning of one agent or of a batch of seeds, with and without the guard."""

    def __init__(self, kind: str, quick: bool) -> None:
        self.kind, self.quick = kind, quick
        self.chunk = QUICK_CHUNK if quick else CHUNK

    @cached_property
    def models(self) -> Any:
        block = {**zoo_block("sac_flow", ENV_ID), "compile": not self.quick, "device": "cpu"}
        block |= {"learning_starts": 2 * self.chunk, "random_steps": 2 * self.chunk}
        if self.kind == "SACFlow":
            models: Any = SACFlow(env=ENV_ID, **block)
        else:
            models = SeedBatch(env=ENV_ID, seeds=N_SEEDS, **block)
        return models.learn(3 * self.chunk)

    def guarded(self) -> float:
        self.models.learn(self.chunk, reset_num_timesteps=False)
        return self.chunk * (1 if self.kind == "SACFlow" else N_SEEDS)

    def unguarded(self) -> float:
        with (
            mock.patch.object(self.models, "_guard", _NoGuard()),
            mock.patch.object(off_policy, "check_step", _accept),
            mock.patch.object(experience, "check_experience", _accept),
        ):
            return self.guarded()


def _accept(*_: Any) -> None:
    pass


def _acting(mode: str, size: int) -> Work:
    model = SACFlow(
        "FlowPolicy",
        Unmoved(OBS_DIM, ACTION_DIM),
        buffer_size=1,
        device="cpu",
        policy_kwargs={"net_arch": [256, 256], "deterministic_mode": mode},
    )
    obs = np.random.default_rng(0).uniform(-1, 1, (size, OBS_DIM)).astype(np.float32)

    def act() -> float:
        model.predict(obs, deterministic=True)
        return 1.0

    return act


def main() -> None:
    """Print the guard's share of the time of a step, call by call."""
    th.set_num_threads(1)
    for kind in KINDS:
        turns = _Turns(kind, quick=False)
        turns.guarded()
        seconds = []
        for _ in range(5):
            start = time.process_time()
            turns.guarded()
            seconds.append(time.process_time() - start)
        step = statistics.median(seconds) / turns.chunk
        print(f"{kind}: {step * 1e6:.0f} us of CPU time per step, compiled")
        total = 0.0
        for name, times in _time_calls(turns).items():
            # A chunk begins and ends with a look, a long run has one now and then.
            calls = 1 / UPDATES_BETWEEN_LOOKS if name == "look" else len(times) / turns.chunk
            share = statistics.median(times) * calls / step
            total += share
            print(
                f"  {name:16} median {statistics.median(times) * 1e6:7.1f} us, "
                f"{calls:.4f} per step: {share:.2%}"
            )
        print(f"  together {total:.2%}", flush=True)


def _time_calls(turns: _Turns) -> dict[str, list[float]]:
    """Time the calls of the guard during one chunk; the median ignores preempted calls."""
    found: dict[str, list[float]] = {}

    def timed(owner: Any, name: str) -> Any:
        function = getattr(owner, name)

        def call(*arguments: Any) -> Any:
            before, start = time.perf_counter(), time.perf_counter()
            result = function(*arguments)
            # Without the time that reading the clock takes.
            found.setdefault(name, []).append(time.perf_counter() - start - (start - before))
            return result

        return mock.patch.object(owner, name, call)

    with (
        timed(off_policy, "check_step"),
        timed(experience, "check_experience"),
        timed(TrainingGuard, "before_updates"),
        timed(TrainingGuard, "after_updates"),
        timed(TrainingGuard, "look"),
    ):
        turns.guarded()
    return found


if __name__ == "__main__":
    main()
