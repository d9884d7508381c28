"""Runs that are broken off, and how to compare what becomes of them."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from tests.checkpoint.kill_and_resume import outcome


class BrokenError(Exception):
    """Breaks off a run."""


class BreakAt(BaseCallback):
    """Breaks off a run in the middle of a rollout; counts steps, also across checkpoints."""

    def __init__(self, step: int) -> None:
        super().__init__()
        self.step = step
        self.seen = 0

    def _on_step(self) -> bool:
        self.seen += 1
        if self.num_timesteps >= self.step:
            raise BrokenError
        return True


def differences(one: Any, other: Any) -> list[str]:
    """Name everything that training changes and that differs between two models."""
    left, right = _state(one), _state(other)
    assert left.keys() == right.keys()
    return [name for name, value in left.items() if not th.equal(value, right[name])]


def _state(model: Any) -> dict[str, th.Tensor]:
    if isinstance(model.observation_space, gym.spaces.Dict):
        buffer = model.replay_buffer
        arrays = {f"obs {key}": value for key, value in buffer.observations.items()}
        arrays |= {"actions": buffer.actions, "rewards": buffer.rewards, "dones": buffer.dones}
        found = {name: th.from_numpy(value) for name, value in arrays.items()}
        return found | {f"p {key}": value for key, value in model.policy.state_dict().items()}
    found = outcome(model)
    normalize = model.get_vec_normalize_env()
    if normalize is not None:
        found["mean"] = th.from_numpy(np.asarray(normalize.obs_rms.mean))
        found["returns"] = th.from_numpy(normalize.returns)
    return found
