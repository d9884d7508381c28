"""Couplings, the invertible layers of flows: the base class, the affine coupling, pairs."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import cast

import torch as th
from torch import nn

from sb3_flowpolicy.distributions.base import soft_bound

# A layer may scale a coordinate by up to e^5: far more than a policy needs, and float32 holds the
# product over any sensible number of layers.
LOG_SCALE_BOUND = 5.0


class Coupling(nn.Module, ABC):
    r"""Map of one half b of the coordinates, whose parameters a network computes from the other, a.

    .. math:: b \mapsto g(b; \mathrm{network}(a, h))

    The caller computes the part of the network's first layer that reads h, for all couplings at
    once.

    Args:
        passive: Number of coordinates that are read, at least 0.
        outputs: Number of outputs of the network.
        hidden: Units of the hidden layers.
    """

    def __init__(self, passive: int, outputs: int, hidden: Sequence[int]) -> None:
        super().__init__()
        self.passive = passive
        self.first = nn.Linear(passive, hidden[0], bias=False) if passive else None
        layers: list[nn.Module] = [nn.ReLU()]
        for n_in, n_out in pairwise(hidden):
            layers += [nn.Linear(n_in, n_out), nn.ReLU()]
        self.between = nn.Sequential(*layers)
        self.last = nn.Linear(hidden[-1], outputs)

    def forward(self, passive: th.Tensor, projected: th.Tensor) -> th.Tensor:
        """Return the parameters of g, (..., outputs); with zeros g is the identity."""
        if self.first is not None:
            projected = projected + self.first(passive)
        return self.last(self.between(projected))

    @abstractmethod
    def move(self, active: th.Tensor, outputs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return g(b) and log|g'(b)|, both (..., number of active coordinates)."""

    @abstractmethod
    def move_back(self, moved: th.Tensor, outputs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Invert :meth:`move`: return b and log|g'(b)|."""


class AffineCoupling(Coupling):
    r"""Coupling that scales and shifts.

    .. math:: b \mapsto b \odot \exp(s(a, h)) + t(a, h)

    Args:
        passive: Number of coordinates that are read, at least 0.
        active: Number of coordinates that are moved, at least 1.
        hidden: Units of the hidden layers.

    References:
        Density estimation using Real NVP (Dinh et al., 2017), eq. 7.
    """

    def __init__(self, passive: int, active: int, hidden: Sequence[int]) -> None:
        super().__init__(passive, 2 * active, hidden)

    def move(self, active: th.Tensor, outputs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Scale and shift."""
        shift, log_scale = outputs.chunk(2, dim=-1)
        log_scale = soft_bound(log_scale, LOG_SCALE_BOUND)
        return active * log_scale.exp() + shift, log_scale

    def move_back(self, moved: th.Tensor, outputs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Undo the shift and the scaling."""
        shift, log_scale = outputs.chunk(2, dim=-1)
        log_scale = soft_bound(log_scale, LOG_SCALE_BOUND)
        return (moved - shift) * (-log_scale).exp(), log_scale


class CouplingPair(nn.Module):
    """Two couplings that split the coordinates in the same way and swap roles.

    Args:
        features: Number of coordinates D, at least 1.
        index: Position in the flow, from 0; decides the split (see :func:`split_order`).
        make: Builds a coupling, given the numbers of coordinates that it reads and moves.
        couplings: 2, or 1 where the flow's length is odd or D = 1.
    """

    order: th.Tensor
    back: th.Tensor

    def __init__(
        self, features: int, index: int, make: Callable[[int, int], Coupling], couplings: int
    ) -> None:
        super().__init__()
        order, n_first = split_order(features, index)
        # With two dimensions the order is the identity, and indexing would only cost time.
        self.in_order = order == sorted(order)
        self.sizes = [n_first, features - n_first]
        self.register_buffer("order", th.tensor(order), persistent=False)
        self.register_buffer("back", th.tensor(order).argsort(), persistent=False)
        modules = nn.ModuleList(make(self.sizes[i], self.sizes[1 - i]) for i in range(couplings))
        self.couplings = cast("Sequence[Coupling]", modules)  # ModuleList is not generic

    def forward(
        self, value: th.Tensor, projected: Sequence[th.Tensor]
    ) -> tuple[th.Tensor, th.Tensor]:
        """Map base to action side: (..., D) -> (..., D) and log|det J|, shape (...)."""
        halves, ladj = self._split(value), value.new_zeros(())
        for i, coupling in enumerate(self.couplings):
            outputs = coupling(halves[i], projected[i])
            halves[1 - i], ladjs = coupling.move(halves[1 - i], outputs)
            ladj = ladj + ladjs.sum(-1)
        return self._merge(halves), ladj

    def inverse(
        self, value: th.Tensor, projected: Sequence[th.Tensor]
    ) -> tuple[th.Tensor, th.Tensor]:
        """Invert :meth:`forward`; the log-determinant is that of :meth:`forward`."""
        halves, ladj = self._split(value), value.new_zeros(())
        for i, coupling in reversed(list(enumerate(self.couplings))):
            outputs = coupling(halves[i], projected[i])
            halves[1 - i], ladjs = coupling.move_back(halves[1 - i], outputs)
            ladj = ladj + ladjs.sum(-1)
        return self._merge(halves), ladj

    def _split(self, value: th.Tensor) -> list[th.Tensor]:
        if not self.in_order:
            value = value.index_select(-1, self.order)
        return list(value.split(self.sizes, dim=-1))

    def _merge(self, halves: list[th.Tensor]) -> th.Tensor:
        value = th.cat(halves, dim=-1)
        return value if self.in_order else value.index_select(-1, self.back)


def split_order(features: int, index: int) -> tuple[list[int], int]:
    """Order the coordinates so that the half read first comes first.

    Pair 0 separates even from odd coordinates, pair 1 alternating blocks of two, then of four,
    and so on. After ceil(log2 D) pairs any two coordinates have been in different halves.

    Args:
        features: Number of coordinates D, at least 1.
        index: Position of the pair in the flow, from 0.

    Returns:
        A permutation of 0 ... D-1, and the size of its first half (0 where D = 1).

    Example:
        >>> split_order(4, 0), split_order(4, 1)
        (([0, 2, 1, 3], 2), ([0, 1, 2, 3], 2))
    """
    if features == 1:
        return [0], 0
    n_splits = math.ceil(math.log2(features))
    block = min(2 ** (index % n_splits), math.ceil(features / 2))
    first = [i for i in range(features) if (i // block) % 2 == 0]
    second = [i for i in range(features) if (i // block) % 2 == 1]
    return first + second, len(first)
