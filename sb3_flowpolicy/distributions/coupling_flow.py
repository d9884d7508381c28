"""Flows of couplings, of any kind of coupling."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Literal, cast

import torch as th
from torch import nn

from sb3_flowpolicy.distributions.base import (
    ActionDistribution,
    positive_int,
    score_standard_normal,
    standard_normal_log_prob,
)
from sb3_flowpolicy.distributions.coupling import Coupling, CouplingPair


class CouplingFlow(ActionDistribution):
    r"""Normalizing flow of couplings over a standard normal, conditioned on h.

    .. math:: u = (g_L \circ \dots \circ g_1)(\epsilon), \qquad
        \log p(u \mid h) = \log \mathcal N(\epsilon; 0, I) - \sum_{l,i} \log |g_{l,i}'|

    Couplings come in pairs: one half of the coordinates is transformed given the other, then the
    other given the first. The pairs split the coordinates differently, so that coordinates in the
    same half of one pair are in different halves of another. With D = 1 there is no other half, and
    the transformation of the only coordinate depends on h alone.

    Args:
        action_dim: Number of action dimensions D, at least 1.
        context_dim: Number of context features H, at least 1.
        layers: Number of couplings L, at least 1.
        hidden: Units of the hidden layers of each coupling's network.
        init: ``"identity"`` starts as a standard normal for every h. ``"default"`` leaves
            torch's initialization.

    Raises:
        ValueError: If ``layers`` or a unit count is not a positive integer, or ``init`` is unknown.
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
        self.layers = positive_int("layers", layers)
        if isinstance(hidden, str) or not isinstance(hidden, Sequence) or len(hidden) == 0:
            raise ValueError(f"hidden must be a non-empty sequence of integers, got {hidden!r}")
        self.hidden = tuple(positive_int("hidden", units) for units in hidden)
        if init not in ("identity", "default"):
            raise ValueError(f'init must be "identity" or "default", got {init!r}')

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

    def _project(
        self, context: th.Tensor, value: th.Tensor
    ) -> tuple[th.Tensor, list[list[th.Tensor]]]:
        """Broadcast ``value`` against the context and project the context for each pair."""
        shape = th.broadcast_shapes(context.shape[:-1], value.shape[:-1])
        projected = list(self.context_proj(context).chunk(self.layers, dim=-1))
        shares = [[projected.pop(0) for _ in pair.couplings] for pair in self.pairs]
        return value.expand(*shape, self.action_dim), shares

    def _rsample_and_log_prob(
        self, context: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        value, shares = self._project(context, noise)
        log_prob = standard_normal_log_prob(noise)
        for pair, share in zip(self.pairs, shares, strict=True):
            value, ladj = pair(value, share)
            log_prob = log_prob - ladj
        return value, log_prob

    def _log_prob(self, context: th.Tensor, value: th.Tensor) -> th.Tensor:
        value, shares = self._project(context, value)
        total = value.new_zeros(())
        for pair, share in zip(reversed(self.pairs), reversed(shares), strict=True):
            value, ladj = pair.inverse(value, share)
            total = total + ladj
        return score_standard_normal(value) - total

    def _mode(self, context: th.Tensor) -> th.Tensor:
        zeros = context.new_zeros(*context.shape[:-1], self.action_dim)
        return self._rsample_and_log_prob(context, zeros)[0]
