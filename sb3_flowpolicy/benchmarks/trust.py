"""What it costs to be careful: the training guard, and the ways to choose an action.

Contests for ``benchmarks.throughput``. With and without the guard differ by less than turns on a
busy machine do; ``python -m sb3_flowpolicy.benchmarks.trust`` therefore times each call of the
guard where it happens, between updates, and prints what share of a step it is.
"""

from __future__ import annotations

import statistics
import time
from functools import cached_property
from typing import Any
from unittest import mock

import numpy as np
import torch as th

import flowpolicy_envs
from sb3_flowpolicy.algorithms import off_policy
from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.benchmarks.timing import Contest, Entrant, Work
from sb3_flowpolicy.benchmarks.updates import Unmoved
from sb3_flowpolicy.benchmarks.zoo_blocks import zoo_block
from sb3_flowpolicy.guard.training_guard import UPDATES_BETWEEN_LOOKS, TrainingGuard
from sb3_flowpolicy.policies import DistributionPolicy
from sb3_flowpolicy.policies.deterministic import MODES
from sb3_flowpolicy.seeds import batch as seed_batch
from sb3_flowpolicy.seeds.batch import SeedBatch

ENV_ID = "TunnelDiagonal-v0"
CHUNK, QUICK_CHUNK = 1000, 10
N_SEEDS = 10
OBS_DIM, ACTION_DIM = 42, 8
BATCHES = (1, 100)


class _Blind:
    """A guard that does not look."""

    def restart(self) -> None: ...

    def before_updates(self) -> None: ...

    def after_updates(self, *_: Any) -> None: ...

    def look(self) -> None: ...


def contests(quick: bool = False) -> list[Contest]:
    """Learning with and without the guard, and acting in each way; ``quick`` compiles nothing."""
    flowpolicy_envs.register_envs()
    kinds = ("SACFlow",) if quick else ("SACFlow", f"SeedBatch of {N_SEEDS}")
    found = []
    for kind in kinds:
        # One agent takes both turns: two would differ by more, if only in where their memory is.
        turns = _Turns(kind, quick)
        entrants = [
            Entrant(f"{kind} without the guard", lambda turns=turns: turns.unwatched),  # type: ignore[misc]
            Entrant(f"{kind} with the guard", lambda turns=turns: turns.watched),  # type: ignore[misc]
        ]
        found.append(Contest(f"the guard, learn() on {ENV_ID}, {kind}", "steps", entrants))
    for size in BATCHES:
        title = f"predict, nets 256-256, obs {OBS_DIM}, D = {ACTION_DIM}, {size} at once"
        modes = [Entrant(mode, lambda mode=mode, size=size: _acting(mode, size)) for mode in MODES]  # type: ignore[misc]
        found.append(Contest(title, "calls", modes))
    return found


class _Turns:
    """Chunks of learning of one agent, or batch of them, with and without its guard."""

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
        self.guard = models._guard
        return models.learn(3 * self.chunk)

    def watched(self) -> float:
        models = self.models
        models._guard = self.guard
        return self._learn()

    def unwatched(self) -> float:
        self.models._guard = _Blind()
        with (
            mock.patch("sb3_flowpolicy.algorithms.off_policy.check_step", _accept),
            mock.patch("sb3_flowpolicy.seeds.batch.check_experience", _accept),
        ):
            return self._learn()

    def _learn(self) -> float:
        self.models.learn(self.chunk, reset_num_timesteps=False)
        return self.chunk * (1 if self.kind == "SACFlow" else N_SEEDS)


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
    assert isinstance(model.policy, DistributionPolicy)
    obs = np.random.default_rng(0).uniform(-1, 1, (size, OBS_DIM)).astype(np.float32)

    def act() -> float:
        model.predict(obs, deterministic=True)
        return 1.0

    return act


def main() -> None:
    """Print the guard's share of the time of a step, call by call."""
    th.set_num_threads(1)
    for kind in ("SACFlow", f"SeedBatch of {N_SEEDS}"):
        turns = _Turns(kind, quick=False)
        turns.watched()
        seconds = []
        for _ in range(5):
            start = time.process_time()
            turns.watched()
            seconds.append(time.process_time() - start)
        step = statistics.median(seconds) / turns.chunk
        print(f"{kind}: {step * 1e6:.0f} us of CPU time per step, compiled")
        total = 0.0
        for name, times in _time_calls(turns).items():
            # A chunk begins and ends with a look; a long run has one now and then.
            often = 1 / UPDATES_BETWEEN_LOOKS if name == "look" else len(times) / turns.chunk
            share = statistics.median(times) * often / step
            total += share
            print(
                f"  {name:16} median {statistics.median(times) * 1e6:7.1f} us, "
                f"{often:.4f} per step: {share:.2%}"
            )
        print(f"  together {total:.2%}", flush=True)


def _time_calls(turns: _Turns) -> dict[str, list[float]]:
    """Time the calls of the guard during one chunk; preempted ones do not move the median."""
    found: dict[str, list[float]] = {}

    def timed(owner: Any, name: str) -> Any:
        function = getattr(owner, name)

        def call(*arguments: Any) -> Any:
            before, start = time.perf_counter(), time.perf_counter()
            result = function(*arguments)
            # Less what it takes to look at the clock.
            found.setdefault(name, []).append(time.perf_counter() - start - (start - before))
            return result

        return mock.patch.object(owner, name, call)

    with (
        timed(off_policy, "check_step"),
        timed(seed_batch, "check_experience"),
        timed(TrainingGuard, "before_updates"),
        timed(TrainingGuard, "after_updates"),
        timed(TrainingGuard, "look"),
    ):
        turns.watched()
    return found


if __name__ == "__main__":
    main()
