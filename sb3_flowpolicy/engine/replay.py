"""Replay buffers as rows, one per transition: a call of ``train()`` gathers once."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_flowpolicy.engine.observations import Observations
from sb3_flowpolicy.engine.update import Batch

# A column is an attribute of SB3's buffer; a row holds one transition, in this order.
COLUMNS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
# Buffers whose samples are independent rows. Not HER's: its real transitions come first.
_INDEPENDENT = (ReplayBuffer, DictReplayBuffer, NStepReplayBuffer)


def is_plain(buffer: ReplayBuffer) -> bool:
    """Whether a buffer is SB3's plain one, which can be read as rows; n-step and HER cannot."""
    return type(buffer) is ReplayBuffer and not buffer.optimize_memory_usage


class ReplayRows:
    """Replay buffers of S agents as one array, (capacity, environments of all agents, width).

    The arrays of these plain buffers (see :func:`is_plain`) become views of it, so they can be
    written and saved as before. All columns are float32, the type in which networks receive
    observations of any type.
    """

    def __init__(self, buffers: Sequence[ReplayBuffer]) -> None:
        self.buffers = list(buffers)
        first = buffers[0]
        self.n_envs = first.n_envs
        self.obs_shape = first.observations.shape[2:]
        samples = [getattr(first, name) for name in COLUMNS]
        self.widths = [int(np.prod(sample.shape[2:])) for sample in samples]
        shape = (first.buffer_size, self.n_envs * len(buffers), sum(self.widths))
        # Pages take no memory until they are written to.
        rows = np.zeros(shape, np.float32)
        parts = np.split(rows, np.cumsum(self.widths)[:-1], axis=-1)
        self.columns = {
            name: part.reshape(*part.shape[:2], *sample.shape[2:])
            for name, part, sample in zip(COLUMNS, parts, samples, strict=True)
        }
        self._owned = []
        for index, buffer in enumerate(self.buffers):
            own = slice(index * self.n_envs, (index + 1) * self.n_envs)
            filled = buffer.size()
            for name, column in self.columns.items():
                column[:filled, own] = getattr(buffer, name)[:filled]
                view = column[:, own]
                setattr(buffer, name, view)
                self._owned.append((buffer, name, view))
        self._flat = th.from_numpy(rows).flatten(0, 1)

    def holds(self, buffers: Sequence[ReplayBuffer]) -> bool:
        """Whether these still are the buffers, and their arrays still views."""
        same = all(ours is theirs for ours, theirs in zip(self.buffers, buffers, strict=True))
        return same and all(getattr(buffer, name) is view for buffer, name, view in self._owned)

    def take(self, index: th.Tensor, gamma: float, noise: th.Tensor) -> list[Batch]:
        """Gather n minibatches.

        Args:
            index: Transitions, (n, S, B), counted over all environments of all agents.
            gamma: Discount factor.
            noise: Standard normals, (n, 2, S, B, M), of the type and on the device to train with.
        """
        rows = self._flat.index_select(0, index.flatten()).to(noise.device, noise.dtype)
        parts = rows.view(*index.shape, -1).split(self.widths, dim=-1)
        obs, next_obs, actions, rewards, dones, timeouts = parts
        if len(self.obs_shape) != 1:
            obs, next_obs = (part.unflatten(-1, self.obs_shape) for part in (obs, next_obs))
        # A time limit does not end the task: the value of the last state is bootstrapped.
        ends = (dones * (1 - timeouts)).squeeze(-1)
        # In float32, as SB3's buffers hold them, also for networks of another type.
        discounts = th.full(index.shape[1:], gamma, device=noise.device).to(noise.dtype)
        rewards = rewards.squeeze(-1)
        return [
            Batch(obs[k], actions[k], next_obs[k], ends[k], rewards[k], discounts, noise[k])
            for k in range(len(index))
        ]


def draw_index(buffers: Sequence[ReplayBuffer], n_updates: int, batch_size: int) -> th.Tensor:
    """Draw indices for :meth:`ReplayRows.take` with the same random numbers as SB3's sampling."""
    # SB3's buffers draw from numpy's global generator: rows, then environments, per minibatch.
    draw = np.random.randint
    width = sum(buffer.n_envs for buffer in buffers)
    index = np.empty((n_updates, len(buffers), batch_size), np.int64)
    for seed, buffer in enumerate(buffers):
        for k in range(n_updates):
            rows, envs = (draw(0, most, size=batch_size) for most in (buffer.size(), buffer.n_envs))
            index[k, seed] = rows * width + seed * buffer.n_envs + envs
    return th.from_numpy(index)


def sample_columns(
    model: Any, observations: Observations, n_updates: int, batch_size: int
) -> list[th.Tensor]:
    """Let a model's buffer sample: n-step, HER, VecNormalize, ...

    Buffers with independent samples do so once for all updates, others once per update.

    Returns:
        The fields of :class:`Batch` except the noise, each (n_updates, 1, batch_size, ...).
    """
    buffer, env = model.replay_buffer, model.get_vec_normalize_env()
    n_calls = 1 if type(buffer) in _INDEPENDENT else n_updates
    calls = []
    with _filled_rows_only(buffer):
        for _ in range(n_calls):
            samples: ReplayBufferSamples = buffer.sample(n_updates * batch_size // n_calls, env=env)
            discounts = samples.discounts
            if discounts is None:
                discounts = th.full_like(samples.rewards, model.gamma)
            columns = (
                observations.pack(samples.observations),
                samples.actions,
                observations.pack(samples.next_observations),
                samples.dones.squeeze(-1),
                samples.rewards.squeeze(-1),
                discounts.squeeze(-1),
            )
            calls.append(columns)
    shape = (n_updates, 1, batch_size)
    return [th.cat(parts).unflatten(0, shape) for parts in zip(*calls, strict=True)]


@contextmanager
def _filled_rows_only(buffer: ReplayBuffer) -> Iterator[None]:
    """Hide the empty rows from HER's buffer, which would search all of them for episodes."""
    if not isinstance(buffer, HerReplayBuffer):
        yield
        return
    lengths = buffer.ep_length
    buffer.ep_length = lengths[: buffer.size()]
    try:
        yield
    finally:
        buffer.ep_length = lengths
