"""All parameters of a network, or of the same network of S seeds, in one tensor."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch as th
from torch import nn

# Entry name -> its parameters, one per copy; several copies are stacked along a leading axis.
Layout = Mapping[str, Sequence[nn.Parameter]]


class FlatParameters:
    """One tensor (S, P) whose parts are the parameters of S equal networks.

    An optimizer step, a target update or a gradient is then one operation instead of one per
    parameter, and modules, SB3's checkpoints and ``torch.optim`` still see ordinary parameters.

    Args:
        layouts: Per seed, entry name -> its copies: one parameter, or the same parameter of each
            of C critics.
        copies: Whether entries are presented with a leading axis C for their copies.

    Example:
        >>> linear = th.nn.Linear(2, 1)
        >>> flat = FlatParameters([{"weight": [linear.weight], "bias": [linear.bias]}])
        >>> _ = flat.data.zero_()
        >>> linear.weight
        Parameter containing:
        tensor([[0., 0.]], requires_grad=True)
    """

    def __init__(self, layouts: Sequence[Layout], copies: bool = False) -> None:
        #: The parameters of each seed.
        self.owners = [[part for parts in one.values() for part in parts] for one in layouts]
        self.shapes = {
            name: (len(parts), *parts[0].shape) if copies else tuple(parts[0].shape)
            for name, parts in layouts[0].items()
        }
        self.bind()

    def views(self, flat: th.Tensor, seed: int) -> list[tuple[nn.Parameter, th.Tensor]]:
        """Pair each parameter of a seed with its part of ``flat`` (S, P), in its own shape."""
        owners = self.owners[seed]
        parts = flat[seed].split([owner.numel() for owner in owners])
        return [(owner, part.view(owner.shape)) for owner, part in zip(owners, parts, strict=True)]

    def bind(self) -> None:
        """Gather the parameters' present values and make them views of :attr:`data`."""
        rows = [th.cat([owner.detach().flatten() for owner in owners]) for owners in self.owners]
        self.data = th.stack(rows)
        self._addresses = []
        for seed in range(len(rows)):
            for owner, view in self.views(self.data, seed):
                owner.data = view
                self._addresses.append((owner, view.data_ptr()))

    def is_bound(self) -> bool:
        """Whether the parameters are still views: moving or reassigning a module undoes it."""
        for owner, address in self._addresses:  # noqa: SIM110 - takes half the time
            if owner.data_ptr() != address:
                return False
        return True

    def release(self) -> None:
        """Give every parameter memory of its own again."""
        for owner, _ in self._addresses:
            owner.data = owner.data.clone()

    def unflatten(self, flat: th.Tensor) -> dict[str, th.Tensor]:
        """Split (S, P) into named tensors of shape (S, *shape), without copying."""
        parts = flat.split([math.prod(shape) for shape in self.shapes.values()], dim=-1)
        return {
            name: part.unflatten(-1, shape) if len(shape) != 1 else part
            for (name, shape), part in zip(self.shapes.items(), parts, strict=True)
        }
