"""The models of the chapter, ours and zuko's, with the same methods."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

import torch as th
from torch import nn

from sb3_flowpolicy.distributions import RealNVP

# Thesis 2.1.2: eight layers, a two-layer network of ten units each.
LAYERS, HIDDEN = 8, (10, 10)
# Thesis 2.1.3: the condition passes a single linear layer of 16 units.
ENCODER_UNITS = 16


class OurRealNVP(nn.Module):
    """The policy's flow with a linear encoder of C conditions; with C = 0, the context is 1.

    Example:
        >>> model = OurRealNVP(condition_dim=0)
        >>> noise, none = th.randn(5, 2), th.zeros(5, 0)
        >>> th.equal(model.sample(noise, none), noise)  # the identity before training
        True
    """

    # Whether torch.func.vmap can evaluate many copies at once.
    stackable = True

    def __init__(self, condition_dim: int) -> None:
        super().__init__()
        self.encoder = nn.Linear(condition_dim, ENCODER_UNITS) if condition_dim else None
        context_dim = ENCODER_UNITS if condition_dim else 1
        self.flow = RealNVP(2, context_dim, layers=LAYERS, hidden=HIDDEN)

    def forward(self, points: th.Tensor, condition: th.Tensor) -> th.Tensor:
        """Return log p(points | condition) in nats: (N, 2), (N, C) -> (N,)."""
        return self.flow.log_prob(self._context(condition), points)

    def sample(self, noise: th.Tensor, condition: th.Tensor) -> th.Tensor:
        """Turn standard normal noise (N, 2) and conditions (N, C) into points (N, 2)."""
        return self.flow.rsample(self._context(condition), noise)

    def _context(self, condition: th.Tensor) -> th.Tensor:
        if self.encoder is None:
            return condition.new_ones(*condition.shape[:-1], 1)
        return self.encoder(condition)

    @th.no_grad()
    def after_each_layer(self, noise: th.Tensor, condition: th.Tensor) -> list[th.Tensor]:
        """Return the noise and its image after each coupling, L + 1 tensors (N, 2)."""
        images = [noise]
        shares = list(self.flow.context_proj(self._context(condition)).chunk(LAYERS, dim=-1))
        halves = list(noise.split(1, dim=-1))
        for pair in self.flow.pairs:
            for turn, coupling in enumerate(pair.couplings):
                outputs = coupling(halves[turn], shares.pop(0))
                halves[1 - turn], _ = coupling.move(halves[1 - turn], outputs)
                images.append(th.cat(halves, dim=-1))
        return images


class ZukoModel(nn.Module):
    """A flow from zuko (Rozet et al., 2022) with the same encoder and methods.

    Args:
        flow: Name of a class in ``zuko.flows``.
        condition_dim: Number C of conditioning variables.
        **settings: Arguments of that class.
    """

    def __init__(self, flow: str, condition_dim: int, **settings: Any) -> None:
        super().__init__()
        # Imported late: it disables torch's validation of distributions in the whole process.
        zuko = import_module("zuko")
        self.encoder = nn.Linear(condition_dim, ENCODER_UNITS) if condition_dim else None
        self.flow = getattr(zuko.flows, flow)(2, ENCODER_UNITS if condition_dim else 0, **settings)
        self.stackable = flow != "NAF"

    def forward(self, points: th.Tensor, condition: th.Tensor) -> th.Tensor:
        """See :class:`OurRealNVP`."""
        return self._given(condition).log_prob(points)

    def sample(self, noise: th.Tensor, condition: th.Tensor) -> th.Tensor:
        """See :class:`OurRealNVP`."""
        return self._given(condition).transform.inv(noise)

    def _given(self, condition: th.Tensor) -> Any:
        return self.flow(None if self.encoder is None else self.encoder(condition))


FlowModel = OurRealNVP | ZukoModel


def zuko_naf(condition_dim: int) -> ZukoModel:
    """Return zuko's neural autoregressive flow, with initial weights close to the identity.

    A monotone network with one hidden layer of 16 units (Pyro's default) transforms each
    coordinate. With zuko's initial weights, eight layers compress the plane so much that most of
    the training undoes it. Here each network starts with an average slope of about 1 and with its
    bends spread over the data.

    References:
        Neural Autoregressive Flows (Huang et al., 2018).
    """
    model = ZukoModel("NAF", condition_dim, **_SIZES, network={"hidden_features": (16,)})
    networks = [
        module.network
        for module in model.flow.modules()
        if isinstance(module, import_module("zuko").flows.neural.MNN)
    ]
    with th.no_grad():
        for network in networks:
            # The networks use the absolute values of their weights. Their inputs are the coordinate
            # and 16 signals from the other coordinates.
            first, last = network[0], network[-1]
            first.weight[..., :1].uniform_(0.5, 2.0)
            first.weight[..., 1:].uniform_(0.0, 1.0)
            first.bias.uniform_(-2.0, 2.0)
            last.weight.abs_().div_(last.weight.sum(-1, keepdim=True))
            last.bias.zero_()
    return model


# The thesis's sizes. The spline flow is not in the thesis; it has zuko's usual three transforms of
# eight bins.
_SIZES: dict[str, Any] = {"transforms": LAYERS, "hidden_features": HIDDEN}
# Name -> (condition_dim -> model).
MODELS: dict[str, Callable[[int], FlowModel]] = {
    "realnvp": OurRealNVP,
    "zuko-realnvp": partial(ZukoModel, "RealNVP", **_SIZES),
    "maf": partial(ZukoModel, "MAF", **_SIZES),
    # In the plane, half of the random orders repeat the previous one and add little.
    "maf-random": partial(ZukoModel, "MAF", **_SIZES, randperm=True),
    "naf": zuko_naf,
    "nsf": partial(ZukoModel, "NSF", transforms=3, bins=8, hidden_features=HIDDEN),
}


def make_model(name: str, condition_dim: int, seed: int) -> FlowModel:
    """Build a model with the initial weights of a seed; the global random state does not change.

    Example:
        >>> sum(p.numel() for p in make_model("realnvp", 0, seed=0).parameters())
        1296
    """
    with th.random.fork_rng(devices=[]):
        th.manual_seed(seed)
        return MODELS[name](condition_dim)
