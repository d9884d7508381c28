"""What it costs to be careful: the training guard, and the ways to choose an action."""

from __future__ import annotations

from typing import Any
from unittest import mock

import numpy as np

import flowpolicy_envs
from sb3_flowpolicy.benchmarks.timing import Contest, Entrant, Work
from sb3_flowpolicy.benchmarks.updates import Unmoved
from sb3_flowpolicy.benchmarks.zoo_blocks import zoo_block
from sb3_flowpolicy.policies import DistributionPolicy
from sb3_flowpolicy.policies.deterministic import MODES
from sb3_flowpolicy.sac_flow import SACFlow
from sb3_flowpolicy.seed_batch import SeedBatch

ENV_ID = "TunnelDiagonal-v0"
CHUNK, QUICK_CHUNK = 500, 10
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
        entrants = [
            Entrant(
                f"{kind} {'with' if watched else 'without'} the guard",
                lambda kind=kind, watched=watched: _learning(kind, watched, quick),  # type: ignore[misc]
            )
            for watched in (False, True)
        ]
        found.append(Contest(f"the guard, learn() on {ENV_ID}, {kind}", "steps", entrants))
    for size in BATCHES:
        title = f"predict, nets 256-256, obs {OBS_DIM}, D = {ACTION_DIM}, {size} at once"
        modes = [Entrant(mode, lambda mode=mode, size=size: _acting(mode, size)) for mode in MODES]  # type: ignore[misc]
        found.append(Contest(title, "calls", modes))
    return found


def _learning(kind: str, watched: bool, quick: bool) -> Work:
    block = {**zoo_block("sac_flow", ENV_ID), "compile": not quick, "device": "cpu"}
    chunk = QUICK_CHUNK if quick else CHUNK
    block |= {"learning_starts": 2 * chunk, "random_steps": 2 * chunk}
    if kind == "SACFlow":
        models: Any = SACFlow(env=ENV_ID, **block)
        count = 1
    else:
        models = SeedBatch(env=ENV_ID, seeds=N_SEEDS, **block)
        count = N_SEEDS
    if not watched:
        models._guard = _Blind()

    def learn() -> float:
        models.learn(chunk, reset_num_timesteps=False)
        return chunk * count

    def learn_blindly() -> float:
        with (
            mock.patch("sb3_flowpolicy.sac_flow.check_step", _accept),
            mock.patch("sb3_flowpolicy.seed_batch.check_experience", _accept),
        ):
            return learn()

    models.learn(3 * chunk)
    return learn if watched else learn_blindly


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
