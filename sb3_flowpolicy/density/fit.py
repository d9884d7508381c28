"""Maximum likelihood fits of all seeds of a model at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch as th
from torch.func import functional_call, stack_module_state, vmap
from torch.optim.lr_scheduler import OneCycleLR
from tqdm import tqdm

from sb3_flowpolicy.density.models import FlowModel, make_model

# Thesis 2.1.2.
BATCHES_PER_EPOCH = 2
# Parameter name -> values of all S copies, (S, *shape).
Weights = dict[str, th.Tensor]


class Ensemble:
    """S copies of a model that differ in their weights only, evaluated together.

    Stacked along a leading axis, ten small networks cost far less than ten times one. Models that
    ``vmap`` cannot stack are evaluated one after the other, with the same result.

    Args:
        name: Name of the model.
        condition_dim: Number C of conditioning variables.
        seeds: One seed per copy.

    Example:
        >>> ensemble = Ensemble("realnvp", condition_dim=0, seeds=[0, 1, 2])
        >>> ensemble.log_prob(th.zeros(3, 7, 2), th.zeros(3, 7, 0)).shape
        torch.Size([3, 7])
    """

    def __init__(self, name: str, condition_dim: int, seeds: Sequence[int]) -> None:
        self.name, self.condition_dim, self.seeds = name, condition_dim, list(seeds)
        models = [make_model(name, condition_dim, seed) for seed in seeds]
        self._template = models[0]
        self.weights: Weights = stack_module_state(models)[0]
        # Buffers such as masks. Equal ones are not stacked: zuko's couplings index by their masks,
        # which vmap cannot do.
        each = [dict(model.named_buffers()) for model in models]
        stacks = {key: th.stack([one[key] for one in each]) for key in each[0]}
        self._own = {key: value for key, value in stacks.items() if (value != value[:1]).any()}
        self._shared = {key: value for key, value in each[0].items() if key not in self._own}

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


@dataclass(frozen=True)
class Recipe:
    """How a model is trained. The thesis specifies Adam and two batches; the rest is ours.

    Args:
        epochs: Passes over the training sample.
        learning_rate: Maximum step size of Adam: it rises for the first 30 % of the steps and
            then falls to zero (torch's ``OneCycleLR``).
        jitter: Standard deviation of the normal noise that is added to the training points of
            each batch, in the units of the model. It prevents overfitting to single points.
        max_grad_norm: Each seed's gradient is scaled down to this norm. Without it, one point in
            a gap of the data can make a flow with large scales diverge.
        averaging: Decay per step of the moving average of the weights. The averaged weights are
            scored, because the weights themselves vary with the last batches.
        check_every: Epochs between two evaluations of the validation sample.

    References:
        Noise Regularization for Conditional Density Estimation (Rothfuss et al., 2019);
        Super-Convergence (Smith and Topin, 2018) for the one-cycle schedule.
    """

    epochs: int
    learning_rate: float = 2e-2
    jitter: float = 0.03
    max_grad_norm: float = 1.0
    averaging: float = 0.98
    check_every: int = 10


@dataclass(frozen=True)
class Data:
    """Samples of S seeds in the units of the models.

    Args:
        points: Shape (S, N, 2).
        condition: Shape (S, N, C).
    """

    points: th.Tensor
    condition: th.Tensor


@dataclass(frozen=True)
class Curves:
    """Mean negative log-likelihoods in nats during training.

    Args:
        epoch: Epochs done at each check, shape (T,).
        train: Of the training sample, shape (T, S).
        validation: Of the validation sample, shape (T, S).
        best_epoch: Epoch with the best validation of each seed, shape (S,).
    """

    epoch: th.Tensor
    train: th.Tensor
    validation: th.Tensor
    best_epoch: th.Tensor


def fit(
    ensemble: Ensemble,
    train: Data,
    validation: Data,
    recipe: Recipe,
    seed: int = 0,
    progress: bool = False,
) -> Curves:
    """Train an ensemble and keep the weights with the best validation of each seed.

    Args:
        ensemble: S copies of a model; its weights are replaced.
        train: Training sample of each seed.
        validation: Validation sample of each seed. Report likelihoods of a third sample.
        recipe: How to train.
        seed: Seed of the order of the points.
        progress: Whether to show a progress bar.

    Returns:
        Likelihoods over the epochs.
    """
    generator = th.Generator().manual_seed(seed)
    n_seeds, n_points = train.points.shape[:2]
    raw = ensemble.weights
    optimizer = th.optim.Adam(list(raw.values()), lr=recipe.learning_rate, fused=True)
    schedule = OneCycleLR(
        optimizer, recipe.learning_rate, total_steps=BATCHES_PER_EPOCH * recipe.epochs
    )
    average = {name: value.detach().clone() for name, value in raw.items()}
    best = {name: value.clone() for name, value in average.items()}
    best_nll, best_epoch = th.full((n_seeds,), th.inf), th.zeros(n_seeds, dtype=th.long)
    rows: list[tuple[int, th.Tensor, th.Tensor]] = []

    bar = tqdm(range(1, recipe.epochs + 1), desc=ensemble.name, unit="epoch", disable=not progress)
    for epoch in bar:
        keys = th.rand(n_seeds, n_points, generator=generator)
        for batch in keys.argsort(dim=1).chunk(BATCHES_PER_EPOCH, dim=1):
            points, condition = _take(train, batch)
            points = points + recipe.jitter * th.randn(points.shape, generator=generator)
            optimizer.zero_grad()
            (-ensemble.log_prob(points, condition).mean(1)).sum().backward()
            _clip(raw, recipe.max_grad_norm)
            optimizer.step()
            schedule.step()
            for name, value in average.items():
                value.lerp_(raw[name].detach(), 1 - recipe.averaging)
        if epoch % recipe.check_every and epoch != recipe.epochs:
            continue
        ensemble.weights = average
        nll = mean_nll(ensemble, validation)
        rows.append((epoch, mean_nll(ensemble, train), nll))
        ensemble.weights = raw
        better = nll < best_nll
        best_nll, best_epoch = th.where(better, nll, best_nll), best_epoch.where(~better, epoch)
        for name, value in best.items():
            value[better] = average[name][better]
        bar.set_postfix_str(f"validation {best_nll.mean():.3f} nats")
    ensemble.weights = best
    epochs, train_nll, validation_nll = zip(*rows, strict=True)
    return Curves(th.tensor(epochs), th.stack(train_nll), th.stack(validation_nll), best_epoch)


@th.no_grad()
def mean_nll(ensemble: Ensemble, data: Data) -> th.Tensor:
    """Return the mean negative log-likelihood of each seed's sample in nats, shape (S,)."""
    return -ensemble.log_prob(data.points, data.condition).mean(1)


def _take(data: Data, index: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Select points: index (S, B) -> (S, B, 2), (S, B, C)."""
    seed = th.arange(len(index))[:, None]
    return data.points[seed, index], data.condition[seed, index]


def _clip(weights: Weights, max_norm: float) -> None:
    """Clip the norm of each seed's gradient."""
    gradients = [value.grad for value in weights.values() if value.grad is not None]
    norm = th.stack([grad.flatten(1).square().sum(1) for grad in gradients]).sum(0).sqrt()
    factor = (max_norm / norm).clamp(max=1)
    for grad in gradients:
        grad.mul_(factor.view(-1, *[1] * (grad.ndim - 1)))
