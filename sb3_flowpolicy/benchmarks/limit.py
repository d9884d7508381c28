"""The matrix products of a SAC update and nothing else: no update can be faster than they are."""

from __future__ import annotations

from collections.abc import Sequence

import torch as th
from stable_baselines3.sac.policies import SACPolicy
from torch import nn

from sb3_flowpolicy.benchmarks.timing import Work

# Operands and result: (copies, rows, inner) x (copies, inner, columns), or without copies.
Product = tuple[th.Tensor, th.Tensor, th.Tensor]


def products_alone(policies: Sequence[SACPolicy], batch_size: int, n_updates: int) -> Work:
    """Return the products of ``n_updates`` updates of S equal policies, stacked.

    Per update the actor runs on the present and on the next observations, and back once. The
    critics run three times (targets, loss, actor's loss) and back twice, once for their
    weights and once only through to the actions.

    Args:
        policies: S policies that differ in nothing but their weights.
        batch_size: Transitions per update and policy.
        n_updates: Number of updates.

    Returns:
        Work that counts updates, summed over the policies.
    """
    n_policies = len(policies)
    actor = _linear_layers(policies[0].actor)
    critics = policies[0].critic.q_networks
    products: list[Product] = []
    for i, layer in enumerate(actor):
        x, w, g = _tensors(layer, batch_size, n_policies)
        products += [_product(x, w.mT), _product(x, w.mT), _product(g.mT, x)]
        if i > 0:  # observations need no gradient
            products.append(_product(g, w))
    for i, layer in enumerate(_linear_layers(critics[0])):
        x, w, g = _tensors(layer, batch_size, n_policies * len(critics))
        products += [_product(x, w.mT) for _ in range(3)]
        products += [_product(g.mT, x), _product(g, w)]
        if i > 0:
            products.append(_product(g, w))

    @th.no_grad()
    def work() -> float:
        for _ in range(n_updates):
            for left, right, out in products:
                th.matmul(left, right, out=out)
        return n_updates * n_policies

    return work


def _linear_layers(module: nn.Module) -> list[nn.Linear]:
    return [layer for layer in module.modules() if isinstance(layer, nn.Linear)]


def _tensors(
    layer: nn.Linear, batch_size: int, copies: int
) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    """Return input, weight and output gradient of a layer."""
    lead = () if copies == 1 else (copies,)
    return (
        th.randn(*lead, batch_size, layer.in_features),
        th.randn(*lead, layer.out_features, layer.in_features),
        th.randn(*lead, batch_size, layer.out_features),
    )


def _product(left: th.Tensor, right: th.Tensor) -> Product:
    return left, right, th.empty(*left.shape[:-1], right.shape[-1])
