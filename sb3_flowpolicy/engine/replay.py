"""Minibatches for many updates at once, gathered straight from SB3's replay buffer."""

from __future__ import annotations

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize


def sample_transitions(
    buffer: ReplayBuffer,
    n_updates: int,
    batch_size: int,
    gamma: float,
    env: VecNormalize | None = None,
) -> tuple[th.Tensor, ...]:
    """Draw minibatches, with the random numbers that SB3's own sampling would take.

    A plain buffer on the CPU is read through tensors that share its memory, one gather per
    column for all updates of a ``train()`` call. Any other buffer (n-step, HER, memory-saving)
    is asked itself, once.

    Args:
        buffer: SB3's replay buffer, not empty.
        n_updates: Number of minibatches.
        batch_size: Transitions per minibatch.
        gamma: Discount factor, where the buffer does not bring its own.
        env: ``VecNormalize`` that normalises observations and rewards.

    Returns:
        Observations, actions, next observations, dones, rewards and discounts on the buffer's
        device, with n_updates x batch_size rows; the last three one-dimensional.
    """
    plain = type(buffer) is ReplayBuffer and not buffer.optimize_memory_usage and env is None
    if plain and buffer.device.type == "cpu":
        return _gather(buffer, n_updates, batch_size, gamma)
    samples: ReplayBufferSamples = buffer.sample(n_updates * batch_size, env=env)
    discounts = samples.discounts
    if discounts is None:
        discounts = th.full_like(samples.rewards, gamma)
    return (
        samples.observations,
        samples.actions,
        samples.next_observations,
        samples.dones.squeeze(-1),
        samples.rewards.squeeze(-1),
        discounts.squeeze(-1),
    )


def _gather(
    buffer: ReplayBuffer, n_updates: int, batch_size: int, gamma: float
) -> tuple[th.Tensor, ...]:
    # SB3's buffers draw from numpy's global generator: rows, then environments, per minibatch.
    draw = np.random.randint
    if buffer.n_envs == 1:
        rows = draw(0, buffer.size(), size=n_updates * batch_size)
    else:
        parts = [
            draw(0, buffer.size(), size=batch_size) * buffer.n_envs
            + draw(0, buffer.n_envs, size=batch_size)
            for _ in range(n_updates)
        ]
        rows = np.concatenate(parts)
    index = th.from_numpy(rows)

    def take(array: np.ndarray) -> th.Tensor:
        return th.from_numpy(array).flatten(0, 1).index_select(0, index)

    # A time limit is no end of the world: its value is bootstrapped.
    dones = take(buffer.dones) * (1 - take(buffer.timeouts))
    return (
        take(buffer.observations),
        take(buffer.actions),
        take(buffer.next_observations),
        dones,
        take(buffer.rewards),
        th.full_like(dones, gamma),
    )
