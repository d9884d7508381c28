"""Fit one model of one study with all its seeds, and score the result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch as th
from scipy.stats import sem

from sb3_flowpolicy.density.datasets import AngleMoons, DataSet, Sample, Scaler
from sb3_flowpolicy.density.fit import Data, Ensemble, fit, mean_nll
from sb3_flowpolicy.density.models import FlowModel
from sb3_flowpolicy.density.studies import STUDIES, Scale, angles_to_score

# Added to a seed for each of its samples.
VALIDATION_SEED, HELDOUT_SEED, ANGLE_SEED = 100_000, 200_000, 300_000
# The integration grid is dense near the data and sparse beyond: x = sinh(u), up to +-74.
REACH = 5.0
# Grid points scored at once.
CHUNK = 80_000
# Points (N, 2) and conditions (N, C) -> log-densities in nats (N,), such as a model.
LogProb = Callable[[th.Tensor, th.Tensor], th.Tensor]


class Fitted(NamedTuple):
    """A trained ensemble, the scalers of its seeds' points, and the tables of its scores."""

    model: str
    ensemble: Ensemble
    scalers: list[Scaler]
    fits: pd.DataFrame  # one row per seed
    curves: pd.DataFrame  # one row per seed and check during training
    angles: pd.DataFrame  # one row per seed and angle; empty for other studies

    @property
    def middle(self) -> int:
        """Index of the seed with the median likelihood, which the pictures show."""
        return int(self.fits["nll"].argsort(stable=True).iloc[(len(self.fits) - 1) // 2])

    def middle_model(self) -> FlowModel:
        """Return the model of that seed."""
        return self.ensemble.member(self.middle)

    def middle_data(self, data: DataSet) -> tuple[Scaler, Sample]:
        """Return the scaler and the training sample of that seed."""
        sample = data.draw(data.n_train, self.ensemble.seeds[self.middle])
        return self.scalers[self.middle], sample


def fit_and_measure(study_name: str, model: str, seeds: Sequence[int], scale: Scale) -> Fitted:
    """Draw each seed's data, train its copy of a model, and score it on held-out data."""
    study = STUDIES[study_name]
    data = study.data()
    train = [data.draw(data.n_train, seed) for seed in seeds]
    scalers = [data.scaler(sample) for sample in train]
    validation = [data.draw(scale.n_validation, VALIDATION_SEED + seed) for seed in seeds]
    heldout = [data.draw(scale.n_heldout, HELDOUT_SEED + seed) for seed in seeds]

    ensemble = Ensemble(model, data.condition_dim, seeds)
    train_data, held = as_data(train, scalers), as_data(heldout, scalers)
    epochs = max(2, study.epochs[model] // scale.shrink)
    curves = fit(ensemble, train_data, as_data(validation, scalers), epochs, seed=min(seeds))
    best = curves.loc[curves.groupby("seed")["other"].idxmin()].set_index("seed")
    log_p = np.stack([data.log_density(sample) for sample in heldout])
    with th.no_grad():
        log_q = ensemble.log_prob(held.points, held.condition).double().numpy()
    # Of the standardized points, as the model sees them.
    log_volume = np.array([scaler.log_volume for scaler in scalers])
    gap = log_p + log_volume[:, None] - log_q
    conditions = th.from_numpy(data.conditions(scale.integral_angles)).float()
    integrals = [
        [integral(ensemble.member(i), one, scale.cells) for one in conditions]
        for i in range(len(seeds))
    ]
    fits = pd.DataFrame(
        {
            "study": study_name,
            "model": model,
            "seed": list(seeds),
            "best_epoch": best["epoch"][list(seeds)].to_numpy(),
            "train_nll": mean_nll(ensemble, train_data).double().numpy(),
            "nll": -log_q.mean(1),
            "nll_se": sem(log_q, axis=1),
            "entropy": data.entropy() - log_volume,
            "gap": gap.mean(1),
            "gap_se": sem(gap, axis=1),
            "integral_low": np.min(integrals, axis=1),
            "integral_high": np.max(integrals, axis=1),
            "accuracy": _accuracy(ensemble, held) if study_name == "two-moons-label" else None,
        }
    )
    curves.insert(0, "model", model)
    angles = _angles(ensemble, scale) if study_name == "angle-moons" else pd.DataFrame()
    return Fitted(model, ensemble, scalers, fits, curves, angles)


def as_data(samples: Sequence[Sample], scalers: Sequence[Scaler]) -> Data:
    """Standardize one sample per seed and stack them for a model."""
    points = [scaler.apply(one.points) for one, scaler in zip(samples, scalers, strict=True)]
    conditions = np.stack([one.condition for one in samples])
    return Data(th.from_numpy(np.stack(points)).float(), th.from_numpy(conditions).float())


@th.no_grad()
def label_posterior(log_prob: LogProb, points: th.Tensor) -> th.Tensor:
    """Return p(label = 1 | point) for equally frequent labels: points (*, 2) -> (*)."""
    label = th.zeros_like(points[..., :1])
    return th.sigmoid(log_prob(points, label + 1) - log_prob(points, label))


def _accuracy(ensemble: Ensemble, held: Data) -> np.ndarray:
    """Return each seed's fraction of points that are more likely under their own label, (S,)."""
    more_likely = label_posterior(ensemble.log_prob, held.points) > 0.5
    return (more_likely == (held.condition[..., 0] > 0.5)).double().mean(1).numpy()


@th.no_grad()
def integral(log_prob: LogProb, condition: th.Tensor, cells: int) -> float:
    r"""Integrate a density over the plane.

    .. math:: \int p(x)\,dx = \int p(\sinh u) \cosh u_1 \cosh u_2\, du

    With 700 cells per axis, the cells near the origin, where the data lie, are a quarter of the
    data's noise wide. The integral reveals a wrong log-determinant, and mass that a flow loses
    because one of its layers does not reach the whole plane. The condition has shape (C,).

    Example:
        >>> from sb3_flowpolicy.density.models import make_model
        >>> print(f"{integral(make_model('realnvp', 0, seed=0), th.zeros(0), cells=100):.4f}")
        1.0000
    """
    u = th.linspace(-REACH, REACH, cells, dtype=th.float64)
    points = th.cartesian_prod(u.sinh(), u.sinh()).float()
    log_cell = th.cartesian_prod(u.cosh().log(), u.cosh().log()).sum(1)
    total = 0.0
    for part, log_size in zip(points.split(CHUNK), log_cell.split(CHUNK), strict=True):
        log_p = log_prob(part, condition.expand(len(part), -1))
        total += (log_p.double() + log_size).exp().sum().item()
    return total * (2 * REACH / (cells - 1)) ** 2


def _angles(ensemble: Ensemble, scale: Scale) -> pd.DataFrame:
    """Score new points at single angles, with the same noise at each angle."""
    rows = []
    for kind, angles in angles_to_score(scale).items():
        for angle in angles:
            one = AngleMoons(np.array([angle]))
            samples = [one.draw(scale.n_per_angle, ANGLE_SEED + s) for s in ensemble.seeds]
            nll = mean_nll(ensemble, as_data(samples, [one.scaler(sample) for sample in samples]))
            each = zip(ensemble.seeds, nll.tolist(), strict=True)
            rows += [(seed, kind, round(float(angle), 4), value) for seed, value in each]
    return pd.DataFrame(rows, columns=["seed", "kind", "angle", "nll"])
