"""``python -m sb3_flowpolicy.benchmarks.trust``: cost of the training guard.

The guard costs less than the noise between whole calls of ``learn()``, so each call of the guard
during training is timed on its own.
"""

from __future__ import annotations

import statistics
import time
from contextlib import ExitStack
from functools import partial
from typing import Any
from unittest import mock

import torch as th

from sb3_flowpolicy.algorithms import engine_flow
from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.benchmarks.learning import ENV_ID, N_SEEDS, zoo_block
from sb3_flowpolicy.guard.training_guard import UPDATES_BETWEEN_LOOKS, TrainingGuard
from sb3_flowpolicy.seeds import experience
from sb3_flowpolicy.seeds.batch import SeedBatch

# Steps whose calls are timed.
CHUNK = 1000
# All that the guard does during training.
_CALLS = (
    (engine_flow, "check_step"),
    (experience, "check_experience"),
    (TrainingGuard, "before_updates"),
    (TrainingGuard, "after_updates"),
    (TrainingGuard, "look"),
)


def trained(algorithm: Any, chunk: int = CHUNK, **kwargs: Any) -> Any:
    """Return a SACFlow or SeedBatch after its random steps and the first updates."""
    block = {**zoo_block("sac_flow", ENV_ID), "compile": True, "device": "cpu"}
    block |= {"learning_starts": 2 * chunk, "random_steps": 2 * chunk, **kwargs}
    return algorithm(env=ENV_ID, **block).learn(3 * chunk)


def time_calls(model: Any, chunk: int = CHUNK) -> dict[str, list[float]]:
    """Return the seconds of each call of the guard during ``chunk`` steps, by function."""
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

    with ExitStack() as stack:
        for owner, name in _CALLS:
            stack.enter_context(timed(owner, name))
        model.learn(chunk, reset_num_timesteps=False)
    return found


def main() -> None:
    """Print the guard's share of the time of a step, call by call."""
    th.set_num_threads(1)
    stacked = f"SeedBatch of {N_SEEDS}"
    for kind, algorithm in {"SACFlow": SACFlow, stacked: partial(SeedBatch, seeds=N_SEEDS)}.items():
        model = trained(algorithm)
        seconds = []
        for _ in range(5):
            start = time.process_time()
            model.learn(CHUNK, reset_num_timesteps=False)
            seconds.append(time.process_time() - start)
        step = statistics.median(seconds) / CHUNK
        print(f"{kind}: {step * 1e6:.0f} us of CPU time per step, compiled")
        total = 0.0
        for name, times in time_calls(model).items():
            # A chunk begins and ends with a look, a long run has one now and then.
            calls = 1 / UPDATES_BETWEEN_LOOKS if name == "look" else len(times) / CHUNK
            median = statistics.median(times)  # ignores calls that were preempted
            share = median * calls / step
            total += share
            print(f"  {name:16} {median * 1e6:7.1f} us, {calls:.4f} per step: {share:.2%}")
        print(f"  together {total:.2%}", flush=True)


if __name__ == "__main__":
    main()
