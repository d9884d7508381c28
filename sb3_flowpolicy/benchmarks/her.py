"""Environment steps per second of ``learn()`` with hindsight experience replay."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3 import SAC, HerReplayBuffer

from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.benchmarks.learning import CHUNK, QUICK_CHUNK, QUICK_START
from sb3_flowpolicy.benchmarks.timing import Benchmark, Candidate, Work
from sb3_flowpolicy.benchmarks.updates import BATCH_SIZE, POLICIES

N_STEPS, SPEED, TOLERANCE = 25, 0.2, 0.1
LEARNING_STARTS = 1000


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


def benchmarks(quick: bool = False) -> list[Benchmark]:
    """Return learning with networks of 64-64; ``quick`` does not compile."""
    stock = Candidate("SB3 SAC", partial(_steps, SAC, "MultiInputPolicy", quick))
    ours = [
        Candidate(
            f"SACFlow {policy}",
            partial(_steps, partial(SACFlow, compile=not quick), f"MultiInput{policy}", quick),
        )
        for policy in POLICIES
    ]
    return [Benchmark("learn() with HER, nets 64-64", "steps", [stock, *ours])]


def _steps(algorithm: Callable[..., Any], policy: str, quick: bool) -> Work:
    start, chunk = (QUICK_START, QUICK_CHUNK) if quick else (LEARNING_STARTS, CHUNK)
    model = algorithm(
        policy,
        make_reach(),
        batch_size=BATCH_SIZE,
        learning_starts=start,
        replay_buffer_class=HerReplayBuffer,
        policy_kwargs={"net_arch": [64, 64]},
    ).learn(start + chunk)

    def work() -> float:
        model.learn(chunk, reset_num_timesteps=False)
        return chunk

    return work
