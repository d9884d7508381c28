"""Maximum likelihood fits of all seeds of a model at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import pandas as pd
import torch as th
from torch.func import functional_call, stack_module_state, vmap
from torch.optim.lr_scheduler import OneCycleLR

from sb3_flowpolicy.density.models import FlowModel, make_model

# Thesis 2.1.2, which also specifies Adam; the other constants are ours.
BATCHES_PER_EPOCH = 2
# Maximum step size: it rises for the first 30 % of the steps and then falls to zero.
LEARNING_RATE = 2e-2
# Standard deviation of the normal noise that is added to the training points of each batch, in the
# units of the model. It prevents overfitting to single points.
JITTER = 0.03
# Without a bound, one point in a gap of the data can make a flow with large scales diverge.
MAX_GRAD_NORM = 1.0
# Decay per step of the moving average of the weights. The averaged weights are scored, because the
# weights themselves vary with the last batches.
AVERAGING = 0.98
# Parameter name -> values of all S copies, (S, *shape).
Weights = dict[str, th.Tensor]


class Ensemble:
    """S copies of a model that differ in their weights only, evaluated together.

    Ten small networks, stacked along a leading axis, cost far less than ten single ones. Models
    that ``vmap`` cannot stack are evaluated one after the other, with the same result.

    Example:
        >>> ensemble = Ensemble("realnvp", condition_dim=0, seeds=[0, 1, 2])
        >>> ensemble.log_prob(th.zeros(3, 7, 2), th.zeros(3, 7, 0)).shape
        torch.Size([3, 7])
    """

    def __init__(self, name: str, condition_dim: int, seeds: Sequence[int]) -> None:
        self.name, self.condition_dim, self.seeds = name, condition_dim, list(seeds)
        models = [make_model(name, condition_dim, seed) for seed in seeds]
        self._template = models[0]
        self.weights, buffers = stack_module_state(models)
        # Buffers such as masks. Equal ones are not stacked: zuko's couplings index by their masks,
        # which vmap cannot do.
        self._own = {key: value for key, value in buffers.items() if (value != value[:1]).any()}
        self._shared = {key: value[0] for key, value in buffers.items() if key not in self._own}

    def log_prob(self, points: th.Tensor, condition: th.Tensor) -> th.Tensor:
        """Score other points with each copy: (S, N, 2), (S, N, C) -> (S, N), in nats."""

        def score(state: Weights, points: th.Tensor, condition: th.Tensor) -> th.Tensor:
            return functional_call(self._template, {**state, **self._shared}, (points, condition))

        states = {**self.weights, **self._own}
        if self._template.stackable:
            return vmap(score)(states, points, condition)
        each = zip(points, condition, strict=True)
        return th.stack([score(_of(states, i), x, c) for i, (x, c) in enumerate(each)])

    def member(self, index: int) -> FlowModel:
        """Return one copy as a module."""
        model = make_model(self.name, self.condition_dim, self.seeds[index])
        model.load_state_dict(_of(self.weights, index), strict=False)
        return model.eval()


def _of(states: Weights, index: int) -> Weights:
    return {name: value[index] for name, value in states.items()}


class Data(NamedTuple):
    """Samples of S seeds in the units of the models."""

    points: th.Tensor  # (S, N, 2)
    condition: th.Tensor  # (S, N, C)


def fit(
    ensemble: Ensemble,
    train: Data,
    validation: Data,
    epochs: int,
    seed: int = 0,
    check_every: int = 10,
) -> pd.DataFrame:
    """Train an ensemble and keep the weights with the best validation of each seed.

    Args:
        ensemble: S copies of a model; its weights are replaced.
        train: Training sample of each seed.
        validation: Validation sample of each seed. Report likelihoods of a third sample.
        epochs: Passes over the training sample.
        seed: Seed of the order of the points.
        check_every: Epochs between two evaluations of both samples.

    Returns:
        Mean negative log-likelihoods in nats, a row for each seed and check: ``seed``, ``epoch``,
        ``train``, and ``other`` of the validation sample.

    References:
        Noise Regularization for Conditional Density Estimation (Rothfuss et al., 2019);
        Super-Convergence (Smith and Topin, 2018) for the one-cycle schedule.
    """
    generator = th.Generator().manual_seed(seed)
    n_seeds, n_points = train.points.shape[:2]
    raw = ensemble.weights
    optimizer = th.optim.Adam(list(raw.values()), lr=LEARNING_RATE, fused=True)
    schedule = OneCycleLR(optimizer, LEARNING_RATE, total_steps=BATCHES_PER_EPOCH * epochs)
    average = {name: value.detach().clone() for name, value in raw.items()}
    best = {name: value.clone() for name, value in average.items()}
    best_nll = th.full((n_seeds,), th.inf)
    checks = []

    for epoch in range(1, epochs + 1):
        keys = th.rand(n_seeds, n_points, generator=generator)
        for batch in keys.argsort(dim=1).chunk(BATCHES_PER_EPOCH, dim=1):
            each = th.arange(n_seeds)[:, None]
            points, condition = train.points[each, batch], train.condition[each, batch]
            points = points + JITTER * th.randn(points.shape, generator=generator)
            optimizer.zero_grad()
            (-ensemble.log_prob(points, condition).mean(1)).sum().backward()
            _clip(raw)
            optimizer.step()
            schedule.step()
            for name, value in average.items():
                value.lerp_(raw[name].detach(), 1 - AVERAGING)
        if epoch % check_every and epoch != epochs:
            continue
        ensemble.weights = average
        nll, train_nll = mean_nll(ensemble, validation), mean_nll(ensemble, train)
        columns = {"train": train_nll.double().numpy(), "other": nll.double().numpy()}
        checks.append(pd.DataFrame({"seed": ensemble.seeds, "epoch": epoch, **columns}))
        ensemble.weights = raw
        better = nll < best_nll
        best_nll = th.where(better, nll, best_nll)
        for name, value in best.items():
            value[better] = average[name][better]
    ensemble.weights = best
    return pd.concat(checks).sort_values(["seed", "epoch"], ignore_index=True)


@th.no_grad()
def mean_nll(ensemble: Ensemble, data: Data) -> th.Tensor:
    """Return the mean negative log-likelihood of each seed's sample in nats, shape (S,)."""
    return -ensemble.log_prob(data.points, data.condition).mean(1)


def _clip(weights: Weights) -> None:
    """Clip the norm of each seed's gradient."""
    gradients = [value.grad for value in weights.values() if value.grad is not None]
    norm = th.stack([grad.flatten(1).square().sum(1) for grad in gradients]).sum(0).sqrt()
    factor = (MAX_GRAD_NORM / norm).clamp(max=1)
    for grad in gradients:
        grad.mul_(factor.view(-1, *[1] * (grad.ndim - 1)))
