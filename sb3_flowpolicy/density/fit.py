"""Maximum likelihood for an ensemble: Adam, two batches per epoch, the best validated weights."""

from __future__ import annotations

from dataclasses import dataclass

import torch as th
from torch.optim.lr_scheduler import OneCycleLR
from tqdm import tqdm

from sb3_flowpolicy.density.ensemble import Ensemble, Weights

# Thesis 2.1.2.
BATCHES_PER_EPOCH = 2


@dataclass(frozen=True)
class Recipe:
    """How a model is trained. The thesis names Adam and the two batches; the rest is ours.

    Args:
        epochs: Passes over the training sample.
        learning_rate: Highest step size of Adam: it rises for the first 30 % of the steps and
            falls to zero after that (torch's ``OneCycleLR``).
        jitter: Standard deviation of normal noise that is added to the training points, fresh in
            each batch, in the units that the model sees. It keeps a flow from wrapping itself
            around single points, which costs far more on new points than the slight blur does.
        max_grad_norm: Each seed's gradient is scaled down to this norm. Without it, one point in
            a gap of the data can throw a flow with large scales far off.
        averaging: Decay per step of the moving average of the weights, which is what is scored:
            the weights themselves jump about with the last batches.
        check_every: Epochs between two looks at the validation sample.

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
    """Samples of S seeds, as the models see them.

    Args:
        points: Shape (S, N, 2).
        condition: Shape (S, N, C).
    """

    points: th.Tensor
    condition: th.Tensor


@dataclass(frozen=True)
class Curves:
    """Mean negative log-likelihoods in nats, while training.

    Args:
        epoch: Epochs done at each check, shape (T,).
        train: Of the training sample, shape (T, S).
        validation: Of the validation sample, shape (T, S).
        best_epoch: When each seed's validation was best, shape (S,).
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
    """Train an ensemble and leave it with the weights that validated best, seed by seed.

    Args:
        ensemble: S copies of a model; its weights are replaced.
        train: Training sample of each seed.
        validation: Another sample of each seed. It decides which weights are kept, so the
            likelihoods to report are those of a third.
        recipe: How to train.
        seed: Seed of the order of the points.
        progress: Whether to show a progress bar.

    Returns:
        Likelihoods over the epochs.

    Raises:
        ValueError: If the recipe has no epochs.
    """
    if recipe.epochs < 1:
        raise ValueError(f"epochs must be at least 1, got {recipe.epochs}")
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
    """Pick points by number: index (S, B) -> (S, B, 2), (S, B, C)."""
    seed = th.arange(len(index))[:, None]
    return data.points[seed, index], data.condition[seed, index]


def _clip(weights: Weights, max_norm: float) -> None:
    """Scale down each seed's gradient on its own: the seeds know nothing of each other."""
    gradients = [value.grad for value in weights.values() if value.grad is not None]
    norm = th.stack([grad.flatten(1).square().sum(1) for grad in gradients]).sum(0).sqrt()
    factor = (max_norm / norm).clamp(max=1)
    for grad in gradients:
        grad.mul_(factor.view(-1, *[1] * (grad.ndim - 1)))
