"""Dictionary observations as rows of numbers, so that an update works on one tensor of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces


class Observations:
    """Converts observations of a space between SB3's form and one tensor.

    Only dictionaries differ: their entries are flattened and concatenated, in float32, the type
    in which networks receive observations of any type.

    Example:
        >>> box = spaces.Box(0, 1, (2,))
        >>> observations = Observations(spaces.Dict(achieved=box, desired=box))
        >>> rows = observations.pack({"desired": np.ones((1, 2)), "achieved": np.zeros((1, 2))})
        >>> rows
        tensor([[0., 0., 1., 1.]])
        >>> observations.unpack(rows)["desired"]
        tensor([[1., 1.]])
    """

    def __init__(self, space: spaces.Space) -> None:
        parts = space.items() if isinstance(space, spaces.Dict) else ()
        self.shapes = {name: part.shape for name, part in parts}
        self._widths = [int(np.prod(shape or ())) for shape in self.shapes.values()]

    def pack(self, obs: Any, device: th.device | str | None = None) -> th.Tensor:
        """Return N observations, arrays or tensors, as one tensor (N, ...)."""
        if not self.shapes:
            return th.as_tensor(obs, device=device)
        parts = [th.as_tensor(obs[name], device=device).flatten(1).float() for name in self.shapes]
        return th.cat(parts, dim=1)

    def unpack(self, rows: th.Tensor) -> Any:
        """Return what the policy takes: the dictionary, or ``rows`` themselves, (N, ...)."""
        if not self.shapes:
            return rows
        parts = rows.split(self._widths, dim=1)
        return {
            name: part.unflatten(1, shape)
            for (name, shape), part in zip(self.shapes.items(), parts, strict=True)
        }
