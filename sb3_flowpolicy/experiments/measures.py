"""Measurements of a policy, besides those that training itself reports.

All of them draw from generators of their own: measuring does not change a run, and measuring twice
gives the same numbers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium.vector import VectorEnv

from flowpolicy_envs.tunnel.paths import Path
from sb3_flowpolicy.algorithms.engine_flow import EngineFlow
from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.policies import FlowActor
from sb3_flowpolicy.seeds.setup import make_env, make_vec_env

N_STATES, N_SAMPLES = 256, 64
PROFILE_POINTS, PROFILE_SAMPLES = 36, 512
PICTURE_STATES, PICTURE_SAMPLES = 4, 150


@contextmanager
def own_random_numbers(*seed: int) -> Iterator[np.random.Generator]:
    """Draw from a fresh generator, and leave torch's as it was."""
    sequence = np.random.SeedSequence(seed)
    with th.random.fork_rng(devices=[]), th.no_grad():
        th.manual_seed(int(sequence.generate_state(1)[0]))
        yield np.random.default_rng(sequence)


def policy_entropy(model: SACFlow, seed: int) -> float | None:
    """Estimate the policy's mean entropy at states of the replay buffer, nats; None for gSDE."""
    if not isinstance(model.actor, FlowActor):
        return None
    obs = _buffer_states(model, seed)
    with own_random_numbers(seed, model.num_timesteps, 1):
        return model.actor.entropy(obs, N_SAMPLES).mean().item()


def same_axis_correlation(model: SACFlow, seed: int) -> float:
    """Mean absolute correlation of action pairs of the same axis (thesis Fig. 3.17).

    The actions are x and y of each finger in turn: pairs of even and of odd indices.
    """
    assert isinstance(model.actor, FlowActor)
    obs = _buffer_states(model, seed)[:64]
    with own_random_numbers(seed, model.num_timesteps, 2):
        correlation = model.actor.action_correlation(obs).abs().mean(0)
    index = th.arange(len(correlation))
    same = (index[:, None] % 2 == index % 2) & (index[:, None] != index)
    return correlation[same].mean().item()


def _buffer_states(model: SACFlow, seed: int) -> th.Tensor:
    buffer = model.replay_buffer
    assert buffer is not None
    with own_random_numbers(seed, model.num_timesteps, 0) as rng:
        rows = rng.integers(0, buffer.size(), N_STATES)
    return th.as_tensor(buffer.observations[rows, 0])


@contextmanager
def _acting_with(models: Sequence[EngineFlow], mode: str) -> Iterator[None]:
    """Set the deterministic mode for a while."""
    policies: list[Any] = [model.policy for model in models]
    before = [policy.deterministic_mode for policy in policies]
    for policy in policies:
        policy.deterministic_mode = mode
    try:
        yield
    finally:
        for policy, usual in zip(policies, before, strict=True):
            policy.deterministic_mode = usual


TRAINING_INFOS = ("x_std", "x_max")
"""Means over the training episodes since the last measurement (thesis Fig. 3.18)."""


class DeterministicEpisodes:
    """Deterministic episodes of several policies, all stepped at once.

    They start from the same seeds every time, far from those of training.
    """

    def __init__(self, env: str, seeds: Sequence[int], n_episodes: int) -> None:
        self.starts = [10**6 * (seed + 1) + k for seed in seeds for k in range(n_episodes)]
        self.venv: VectorEnv = make_vec_env(env, len(self.starts))

    def run(
        self, models: Sequence[EngineFlow], mode: str = "base"
    ) -> list[tuple[float | None, float | None]]:
        """Return mean return and success rate of each policy, one per seed.

        ``mode`` is the ``deterministic_mode`` to act with. The success rate is None if the
        environment does not report success, and both are if the actor has no such mode (gSDE).
        """
        if mode != "base" and not isinstance(models[0].actor, FlowActor):
            return [(None, None)] * len(models)
        with _acting_with(models, mode):
            returns, success = self._run(models)
        means, rates = (values.reshape(len(models), -1).mean(1) for values in (returns, success))
        return [
            (float(mean), None if np.isnan(rate) else float(rate))
            for mean, rate in zip(means, rates, strict=True)
        ]

    def _run(self, models: Sequence[EngineFlow]) -> tuple[np.ndarray, np.ndarray]:
        """Return the return of each episode, and 1.0, 0.0, or NaN for its success."""
        obs, _ = self.venv.reset(seed=self.starts)  # type: ignore[arg-type]
        count = len(self.starts)
        returns, running = np.zeros(count), np.ones(count, dtype=bool)
        success = np.full(count, np.nan)
        while running.any():
            actions = [
                model.predict(part, deterministic=True)[0]
                for model, part in zip(models, np.split(obs, len(models)), strict=True)
            ]
            obs, rewards, terminated, truncated, infos = self.venv.step(np.concatenate(actions))
            returns += rewards * running
            ended = (terminated | truncated) & running
            reported = infos.get("final_info", {}).get("is_success")
            if reported is not None:
                success[ended] = np.asarray(reported)[ended]
            running &= ~ended
        return returns, success


def entropy_profile(model: SACFlow, env_id: str, seed: int) -> dict[str, list[float]]:
    """Estimate the entropy at points of a Tunnel's center line from start to goal.

    Returns:
        ``way``, fractions of the way to the goal in [0, 1), and ``entropy`` in nats.
    """
    tunnel: Any = make_env(env_id).unwrapped
    config = tunnel.config
    way = np.arange(PROFILE_POINTS) / PROFILE_POINTS
    points = np.stack([config.geometry.point(arc) for arc in way * _arc_to_goal(config.geometry)])
    if config.path == "circle":
        radius = np.full(len(points), config.radius)
        points = np.column_stack([points, radius, np.linalg.norm(points, axis=1)])
    assert isinstance(model.actor, FlowActor)
    with own_random_numbers(seed, model.num_timesteps, 3):
        entropy = model.actor.entropy(th.as_tensor(points.astype(np.float32)), PROFILE_SAMPLES)
    return {"way": _rounded(way), "entropy": _rounded(entropy.numpy())}


def _arc_to_goal(path: Path) -> float:
    """Return the signed arc from the start to the goal region, along the shorter way."""
    length = path.locate(path.point(0.0))[1]
    ahead = path.locate(path.point(length / PROFILE_POINTS))[1]
    return length if ahead < length else -length


def policy_picture(model: SACFlow, env_id: str, seed: int) -> dict[str, Any] | None:
    """Record action samples at several states of one deterministic episode.

    Returns:
        ``steps``, ``positions`` and ``samples`` (actions), at states spread evenly over the
        episode, and ``trail``, all its positions; None unless the environment is a
        two-dimensional Tunnel and the policy's actions have a density.
    """
    env: gym.Env = make_env(env_id)
    drawable = hasattr(env.unwrapped, "set_action_samples") and env.action_space.shape == (2,)
    if not drawable or not isinstance(model.actor, FlowActor):
        return None
    obs, _ = env.reset(seed=seed)
    states, done = [obs], False
    while not done:
        action, _ = model.predict(obs, deterministic=True)
        obs, _, terminated, truncated, _ = env.step(action)
        states.append(obs)
        done = terminated or truncated
    trail = np.stack(states)
    chosen = np.unique(np.linspace(0, len(states) - 2, PICTURE_STATES).round().astype(int))
    actor = model.actor
    with own_random_numbers(seed, model.num_timesteps, 4):
        batch = th.as_tensor(np.repeat(trail[chosen], PICTURE_SAMPLES, axis=0))
        samples = model.policy.unscale_action(actor(batch).numpy())
    return {
        "steps": chosen.tolist(),
        "positions": _rounded(trail[chosen, :2]),
        "samples": _rounded(samples.reshape(len(chosen), PICTURE_SAMPLES, 2)),
        "trail": _rounded(trail[:, :2]),
    }


def _rounded(values: np.ndarray) -> list:
    return np.round(np.asarray(values, np.float64), 4).tolist()
