"""Replay storage and random numbers of S seeds, side by side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_flowpolicy.engine.replay import ReplayRows
from sb3_flowpolicy.engine.update import Batch

# Random numbers are drawn for this many updates or steps at once, as each call has a fixed cost.
AHEAD = 64


class SeedStorage:
    """Replay buffers of S models as one: written once per step, read with one gather.

    The models' own buffers become views of it, and can be saved as usual.

    Args:
        buffers: One buffer per seed, equally filled: plain SB3 buffers of one environment.

    Raises:
        ValueError: If they are filled differently.
    """

    def __init__(self, buffers: Sequence[ReplayBuffer]) -> None:
        self.buffers = list(buffers)
        self.check_equally_filled()
        self.rows = ReplayRows(buffers)
        self._seeds = th.arange(len(buffers)).unsqueeze(-1)

    def check_equally_filled(self) -> None:
        """Raise ``ValueError`` unless all seeds have as many transitions."""
        if len({(buffer.pos, buffer.full) for buffer in self.buffers}) > 1:
            sizes = [buffer.size() for buffer in self.buffers]
            raise ValueError(f"replay buffers must be equally filled, got {sizes} transitions")

    def add(self, **values: np.ndarray) -> None:
        """Append one transition per seed; each value has a leading axis S."""
        row, capacity = self.buffers[0].pos, self.buffers[0].buffer_size
        for name, value in values.items():
            self.rows.columns[name][row] = value
        for buffer in self.buffers:
            buffer.pos = (row + 1) % capacity
            buffer.full = buffer.full or buffer.pos == 0

    def gather(self, uniform: th.Tensor, gamma: float, noise: th.Tensor) -> list[Batch]:
        """Return n minibatches.

        Args:
            uniform: Transitions as fractions of the buffer, in [0, 1), (n, S, B).
            gamma: Discount factor.
            noise: Standard normals, (n, 2, S, B, M).
        """
        index = (uniform * self.buffers[0].size()).long().mul_(len(self.buffers)).add_(self._seeds)
        return self.rows.take(index, gamma, noise)


class SeedNoise:
    """Random numbers of S seeds, each from a generator of its own.

    A seed's numbers do not depend on the other seeds of its batch.

    Args:
        seeds: The seeds.
        shape: Shape of one draw of one seed.
        stream: Distinguishes several uses by the same seed.
        uniform: Whether to draw from [0, 1) instead of a standard normal.
    """

    def __init__(
        self, seeds: Sequence[int], shape: tuple[int, ...], stream: int, uniform: bool = False
    ) -> None:
        self.shape = shape
        self.uniform = uniform
        self.generators = [
            th.Generator().manual_seed(
                int(np.random.SeedSequence((seed, stream)).generate_state(1)[0])
            )
            for seed in seeds
        ]
        self._pool = th.empty(0)
        self._next = AHEAD

    def draw(self) -> th.Tensor:
        """Return the next numbers of every seed, (S, *shape)."""
        if self._next == AHEAD:
            # Uniform numbers become indices; float32 cannot represent all of a million rows.
            draw, dtype = (th.rand, th.float64) if self.uniform else (th.randn, th.float32)
            self._pool = th.stack(
                [draw(AHEAD, *self.shape, generator=own, dtype=dtype) for own in self.generators], 1
            )
            self._next = 0
        self._next += 1
        return self._pool[self._next - 1]

    def draw_many(self, count: int) -> th.Tensor:
        """Return the next ``count`` numbers of every seed, (count, S, *shape)."""
        first = self.draw().unsqueeze(0)
        return (
            first if count == 1 else th.cat([first, *(self.draw()[None] for _ in range(1, count))])
        )

    def state(self) -> dict[str, object]:
        """Return everything needed to continue with the same numbers."""
        states = [generator.get_state() for generator in self.generators]
        return {"generators": states, "pool": self._pool, "next": self._next}

    def set_state(self, state: dict[str, object]) -> None:
        """Restore what :meth:`state` returned."""
        for generator, saved in zip(self.generators, state["generators"], strict=True):  # type: ignore[call-overload]
            generator.set_state(saved)
        self._pool, self._next = state["pool"], state["next"]  # type: ignore[assignment]
