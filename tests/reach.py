"""A small environment with goals, for hindsight experience replay."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

N_STEPS, SPEED, TOLERANCE = 25, 0.2, 0.1


class Reach(gym.Env):
    """A point in the plane that is to be moved to a goal: a small environment for HER."""

    def __init__(self) -> None:
        box = gym.spaces.Box(-1, 1, (2,), np.float32)
        names = ("observation", "achieved_goal", "desired_goal")
        self.observation_space = gym.spaces.Dict(dict.fromkeys(names, box))
        self.action_space = box
        self._point, self._goal = np.zeros((2, 2), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict, dict]:
        """Draw a start and a goal."""
        super().reset(seed=seed)
        self._point, self._goal = self.np_random.uniform(-1, 1, (2, 2)).astype(np.float32)
        return self._obs(), {}

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        """Move the point."""
        self._point = np.clip(self._point + SPEED * action, -1, 1).astype(np.float32)
        reward = float(self.compute_reward(self._point, self._goal, {}))
        return self._obs(), reward, False, False, {}

    def compute_reward(self, achieved: np.ndarray, desired: np.ndarray, info: Any) -> np.ndarray:
        """Return 0 at the goal and -1 elsewhere."""
        distance = np.linalg.norm(achieved - desired, axis=-1)
        return -(distance > TOLERANCE).astype(np.float32)

    def _obs(self) -> dict[str, np.ndarray]:
        return {
            "observation": self._point,
            "achieved_goal": self._point,
            "desired_goal": self._goal,
        }


def make_reach() -> gym.Env:
    """Return a Reach environment with episodes of 25 steps."""
    return gym.wrappers.TimeLimit(Reach(), N_STEPS)
