"""Flows of couplings: the coupling, the pair of couplings, and the flow."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Literal, cast

import torch as th
from torch import nn

from sb3_flowpolicy.common.validation import integer, layer_sizes, one_of
from sb3_flowpolicy.distributions.base import (
    ActionDistribution,
    score_standard_normal,
    standard_normal_log_prob,
)


class Coupling(nn.Module, ABC):
    r"""Map of one half b of the coordinates, whose parameters a network computes from the other, a.

    .. math:: b \mapsto g(b; \mathrm{network}(a, h))

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
        """Return the parameters of g, (..., outputs); with zeros g is the identity.

        ``projected`` is the first layer's share of h, which all couplings compute in one product.
        """
        if self.first is not None:
            projected = projected + self.first(passive)
        return self.last(self.between(projected))

    @abstractmethod
    def move(self, active: th.Tensor, outputs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return g(b) and log|g'(b)|, both (..., number of active coordinates)."""

    @abstractmethod
    def move_back(self, moved: th.Tensor, outputs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Invert :meth:`move`: return b and log|g'(b)|."""


class CouplingPair(nn.Module):
    """Two couplings that split the coordinates in the same way and swap roles.

    There is only one where the flow's length is odd or D = 1.
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
        self, value: th.Tensor, projected: Sequence[th.Tensor], inverse: bool = False
    ) -> tuple[th.Tensor, th.Tensor]:
        """Map base to action side, or back: (..., D) -> (..., D).

        The second result is log|det J|, shape (...), of the map from base to action side.
        """
        halves, ladj = self._split(value), value.new_zeros(())
        turns = list(enumerate(self.couplings))
        for i, coupling in reversed(turns) if inverse else turns:
            outputs = coupling(halves[i], projected[i])
            move = coupling.move_back if inverse else coupling.move
            halves[1 - i], ladjs = move(halves[1 - i], outputs)
            ladj = ladj + ladjs.sum(-1)
        return self._join(halves), ladj

    def push(self, value: th.Tensor, projected: Sequence[th.Tensor]) -> th.Tensor:
        """Map base to action side without the log-determinant."""
        halves = self._split(value)
        for i, coupling in enumerate(self.couplings):
            halves[1 - i], _ = coupling.move(halves[1 - i], coupling(halves[i], projected[i]))
        return self._join(halves)

    def _split(self, value: th.Tensor) -> list[th.Tensor]:
        ordered = value if self.in_order else value.index_select(-1, self.order)
        return list(ordered.split(self.sizes, dim=-1))

    def _join(self, halves: list[th.Tensor]) -> th.Tensor:
        value = th.cat(halves, dim=-1)
        return value if self.in_order else value.index_select(-1, self.back)


def split_order(features: int, index: int) -> tuple[list[int], int]:
    """Order the coordinates so that the half read first comes first.

    Pair 0 separates even from odd coordinates, pair 1 alternating blocks of two, then of four,
    and so on. After ceil(log2 D) pairs any two coordinates have been in different halves.

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


class CouplingFlow(ActionDistribution):
    r"""Normalizing flow of couplings over a standard normal, conditioned on h.

    .. math:: u = (g_L \circ \dots \circ g_1)(\epsilon), \qquad
        \log p(u \mid h) = \log \mathcal N(\epsilon; 0, I) - \sum_{l,i} \log |g_{l,i}'|

    Couplings come in pairs: one half of the coordinates is transformed given the other, then the
    other given the first. The pairs split the coordinates differently, so that coordinates in the
    same half of one pair are in different halves of another. With D = 1 there is no other half, and
    the transformation of the only coordinate depends on h alone.

    Args:
        layers: Number of couplings L, at least 1.
        hidden: Units of the hidden layers of each coupling's network.
        init: ``"identity"`` starts as a standard normal for every h. ``"default"`` leaves
            torch's initialization.
    """

    def __init__(
        self,
        action_dim: int,
        context_dim: int,
        layers: int = 4,
        hidden: Sequence[int] = (10, 10),
        init: Literal["identity", "default"] = "identity",
    ) -> None:
        super().__init__(action_dim, context_dim)
        self.layers = integer(1)("layers", layers)
        self.hidden = layer_sizes("hidden", hidden, least=1)
        one_of("identity", "default")("init", init)

        # The context enters all L couplings through one matrix product.
        self.context_proj = nn.Linear(context_dim, layers * self.hidden[0])
        # With a single coordinate every coupling transforms the same one.
        per_pair = min(2, action_dim)
        pairs = nn.ModuleList(
            CouplingPair(
                action_dim, index, self._make_coupling, couplings=min(per_pair, layers - start)
            )
            for index, start in enumerate(range(0, layers, per_pair))
        )
        self.pairs = cast("Sequence[CouplingPair]", pairs)  # ModuleList is not generic
        self._reset_parameters(init)

    @abstractmethod
    def _make_coupling(self, passive: int, active: int) -> Coupling:
        """Build a coupling that reads ``passive`` coordinates and moves ``active`` others."""

    def _reset_parameters(self, init: str) -> None:
        """Initialize as if each first layer were one ``nn.Linear`` on [passive half, h]."""
        weights = self.context_proj.weight.data.chunk(self.layers)
        biases = self.context_proj.bias.data.chunk(self.layers)
        couplings = [coupling for pair in self.pairs for coupling in pair.couplings]
        for weight, bias, coupling in zip(weights, biases, couplings, strict=True):
            bound = 1 / math.sqrt(self.context_dim + coupling.passive)
            weight.uniform_(-bound, bound)
            bias.uniform_(-bound, bound)
            if coupling.first is not None:
                nn.init.uniform_(coupling.first.weight, -bound, bound)
            if init == "identity":
                nn.init.zeros_(coupling.last.weight)
                nn.init.zeros_(coupling.last.bias)

    def shrink_heads(self) -> None:
        """Do nothing: ``init`` sets how the flow starts, by default as the identity."""

    def _through(
        self, context: th.Tensor, value: th.Tensor, log_prob: th.Tensor, inverse: bool
    ) -> tuple[th.Tensor, th.Tensor]:
        """Map ``value`` through all pairs and subtract their log-determinants from ``log_prob``."""
        value, steps = self._prepare(context, value)
        for pair, share in reversed(steps) if inverse else steps:
            value, ladj = pair(value, share, inverse)
            log_prob = log_prob - ladj
        return value, log_prob

    def _prepare(
        self, context: th.Tensor, value: th.Tensor
    ) -> tuple[th.Tensor, list[tuple[CouplingPair, list[th.Tensor]]]]:
        """Return ``value`` with the leading dimensions of both, and each pair's share of h."""
        shape = th.broadcast_shapes(context.shape[:-1], value.shape[:-1])
        projected = list(self.context_proj(context).chunk(self.layers, dim=-1))
        steps = [(pair, [projected.pop(0) for _ in pair.couplings]) for pair in self.pairs]
        return value.expand(*shape, self.action_dim), steps

    def _rsample(self, context: th.Tensor, noise: th.Tensor) -> th.Tensor:
        value, steps = self._prepare(context, noise)
        for pair, share in steps:
            value = pair.push(value, share)
        return value

    def _rsample_and_log_prob(
        self, context: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        return self._through(context, noise, standard_normal_log_prob(noise), inverse=False)

    def _log_prob(self, context: th.Tensor, value: th.Tensor) -> th.Tensor:
        noise, minus_ladj = self._through(context, value, value.new_zeros(()), inverse=True)
        return score_standard_normal(noise) + minus_ladj

    def _mode(self, context: th.Tensor) -> th.Tensor:
        zeros = context.new_zeros(*context.shape[:-1], self.action_dim)
        return self._rsample(context, zeros)
