"""What the pictures show: sampled targets, correlations and paths of one trained agent."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th

from flowpolicy_envs.square import kernels
from flowpolicy_envs.square.env import SquareEnv
from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.experiments.measures import own_random_numbers
from sb3_flowpolicy.policies import FlowActor

FILM_LEAD = 4
"""Steps of the warm-up that a film shows: one second."""
FILM_SIZE = 256
ATTEMPTS = 10
"""Most episodes to play until one is found, for the film, in which the square is not lost."""
N_SAMPLES, N_SHOWN = 1300, 300
"""Sampled actions per state, and those shown; the others tell how the fingers move together."""
MEASURED_STATES, MEASURED_SAMPLES = 256, 1024


class Moment(NamedTuple):
    """A state of the Square and the policy's targets there, in world units.

    Attributes:
        body: x, y and angle of the square, (3,).
        half: Half the edge of the square.
        fingers: Positions of the fingers: right, top, left, bottom, (4, 2).
        starts: Centers of the boxes that the fingers reach, (4, 2).
        samples: Targets of N sampled actions, (N, 4, 2).
    """

    body: np.ndarray
    half: float
    fingers: np.ndarray
    starts: np.ndarray
    samples: np.ndarray

    def joint_movement(self) -> tuple[np.ndarray, np.ndarray]:
        """Find the movement that the fingers share most, and each finger's part in it.

        It is the first principal component of the correlation matrix of all samples that are not
        shown, so that chance patterns of those that are shown have no part in it.

        Returns:
            Each finger's component along it in the N_SHOWN samples, and the sum of the other three
            fingers' components, (N_SHOWN, 4) each. Independent fingers have no correlation of the
            two.
        """
        fitted = self.samples[N_SHOWN:].reshape(-1, 8)
        # A target that never changes has no part in any movement.
        scale = np.maximum(fitted.std(0), np.finfo(np.float32).eps)
        unit = (self.samples.reshape(-1, 8) - fitted.mean(0)) / scale
        first = np.linalg.eigh(unit[N_SHOWN:].T @ unit[N_SHOWN:])[1][:, -1]
        own = (unit[:N_SHOWN] * first).reshape(-1, 4, 2).sum(2)
        return own, own.sum(1, keepdims=True) - own


class Recording(NamedTuple):
    """What one agent did.

    Attributes:
        label: Name of the agent.
        origin: Its seed and steps of training.
        moment: First state of one episode after the warm-up.
        frames: Pictures of the same episode from a second before, (size, size, 3) each.
        paths: x of the square after the warm-up in E sampled episodes of up to T steps, NaN
            once they have ended, (E, T).
        dropped: Whether the square fell or a finger broke in each of them, (E,).
        correlation: Mean absolute correlation of the actions given the state, over states of these
            episodes after the warm-up, (8, 8).
        entropy: Mean entropy of the squashed policy over the same states, nats.
    """

    label: str
    origin: str
    moment: Moment
    frames: list[np.ndarray]
    paths: np.ndarray
    dropped: np.ndarray
    correlation: np.ndarray
    entropy: float

    @property
    def x_std(self) -> float:
        """Mean over the episodes of the standard deviation of x after the warm-up."""
        return float(pd.DataFrame(self.paths).std(axis=1, ddof=0).mean())


def load_agent(path: Path, env_id: str) -> SACFlow:
    """Load a model for a task of the Square; raise ``ValueError`` if it does not fit the task."""
    env = gym.make(env_id)
    if not isinstance(env.unwrapped, SquareEnv):
        raise ValueError(f"env must be a task of the Square, such as SquareMoveX-v1, got {env_id}")
    model = SACFlow.load(path, device="cpu")
    if not isinstance(model.actor, FlowActor):
        raise ValueError(
            f"{path} must hold a policy of sb3_flowpolicy, got {type(model.policy).__name__}"
        )
    spaces = (model.observation_space, model.action_space)
    if spaces != (env.observation_space, env.action_space):
        raise ValueError(f"{path} must hold a model for {env_id}, got one for {spaces}")
    return model


def record(label: str, model: SACFlow, env_id: str, seed: int, n_episodes: int) -> Recording:
    """Play the episodes that the pictures show, with ``seed`` and the seeds after it.

    The film shows the first of ``ATTEMPTS`` episodes in which the square is not lost, or else the
    first of all. This episode is deterministic during the warm-up, so that all agents start to
    explore from similar states, and sampled afterwards. The ``n_episodes`` of paths and correlation
    are sampled from the start and kept whatever their end.

    Raises:
        ValueError: If the agent always breaks a finger before the end of the warm-up.
    """
    kind = "tuning seed" if model.seed is not None and model.seed >= 100 else "seed"
    origin = f"{kind} {model.seed}, {model.num_timesteps:,} steps"
    with own_random_numbers(seed, 0):
        shown: tuple[Moment, list[np.ndarray]] | None = None
        for k in range(ATTEMPTS):
            moment, frames, lost = _episode(model, env_id, seed + k)
            if moment is not None and (shown is None or not lost):
                shown = moment, frames
            if not lost:
                break
    with own_random_numbers(seed, 1) as rng:
        paths, dropped, states = _paths(model, env_id, seed + ATTEMPTS, n_episodes)
        if shown is None or not len(states):
            raise ValueError(f"{label} must get through the warm-up, but breaks a finger before")
        chosen = rng.choice(len(states), min(MEASURED_STATES, len(states)), replace=False)
        obs = th.as_tensor(states[chosen])
        assert isinstance(model.actor, FlowActor)
        correlation = model.actor.action_correlation(obs, MEASURED_SAMPLES).abs().mean(0)
        entropy = model.actor.entropy(obs, MEASURED_SAMPLES).mean().item()
    return Recording(label, origin, *shown, paths, dropped, correlation.numpy(), entropy)


def _episode(
    model: SACFlow, env_id: str, seed: int
) -> tuple[Moment | None, list[np.ndarray], bool]:
    """Return what is drawn of one episode, and whether the square was lost."""
    env = gym.make(env_id, render_mode="rgb_array", render_size=FILM_SIZE)
    square: Any = env.unwrapped
    warm = int(square.config.warm_steps)
    obs, _ = env.reset(seed=seed)
    moment, frames = None, []
    step, terminated, truncated = 0, False, False
    while not (terminated or truncated):
        samples, _ = model.predict(np.repeat(obs[None], N_SAMPLES, axis=0))
        action, _ = model.predict(obs, deterministic=step < warm)
        if step == warm:
            moment = _moment(square.get_state(), samples)
        if step >= warm - FILM_LEAD:
            square.set_action_samples(samples[:N_SHOWN])
            frames.append(env.render())
        obs, _, terminated, truncated, _ = env.step(action)
        step += 1
    square.set_action_samples(None)
    frames.append(env.render())
    env.close()
    return moment, frames, terminated  # type: ignore[return-value]


def _moment(state: dict[str, Any], samples: np.ndarray) -> Moment:
    reach = float(state["constants"][kernels.REACH])
    return Moment(
        body=state["bodies"][:3],
        half=float(state["constants"][kernels.HALF_SIDE]),
        fingers=state["fingers"],
        starts=state["starts"],
        samples=state["starts"] + reach * samples.reshape(-1, 4, 2),
    )


def _paths(
    model: SACFlow, env_id: str, first_seed: int, n_episodes: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Play sampled episodes side by side: paths (E, T), which dropped (E,), and states (S, O)."""
    envs = [gym.make(env_id) for _ in range(n_episodes)]
    squares: list[Any] = [env.unwrapped for env in envs]
    warm = int(squares[0].config.warm_steps)
    obs = np.stack([env.reset(seed=first_seed + k)[0] for k, env in enumerate(envs)])
    running, dropped = np.ones(n_episodes, bool), np.zeros(n_episodes, bool)
    rows: list[np.ndarray] = []
    states: list[np.ndarray] = []
    step = 0
    while running.any():
        if step >= warm:
            x = [square.get_state()["bodies"][0] for square in squares]
            rows.append(np.where(running, x, np.nan))
            states.extend(obs[running].copy())
        actions, _ = model.predict(obs)
        for k in np.flatnonzero(running):
            obs[k], _, terminated, truncated, _ = envs[k].step(actions[k])
            dropped[k], running[k] = terminated, not (terminated or truncated)
        step += 1
    paths = np.array(rows).reshape(-1, n_episodes).T
    return paths, dropped, np.array(states)
