"""Fit one model of one study with all its seeds, and score the result."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th

from sb3_flowpolicy.density.datasets import AngleMoons, Sample, Scaler
from sb3_flowpolicy.density.fit import Curves, Data, Ensemble, fit, mean_nll
from sb3_flowpolicy.density.models import FlowModel
from sb3_flowpolicy.density.studies import STUDIES, Scale, angles_to_score

Row = dict[str, Any]
# Added to a seed for each of its samples.
VALIDATION_SEED, HELDOUT_SEED, ANGLE_SEED = 100_000, 200_000, 300_000
# The integration grid is dense near the data and sparse beyond: x = sinh(u), up to +-74.
REACH = 5.0
# Grid points scored at once.
CHUNK = 80_000


@dataclass(frozen=True)
class Fitted:
    """A trained ensemble, the scalers of its seeds' points, its curves and its scores."""

    model: str
    ensemble: Ensemble
    scalers: list[Scaler]
    curves: Curves
    rows: list[Row]  # one per seed, for fits.csv
    angle_rows: list[Row]  # one per seed and angle, for angles.csv; empty for other studies

    @property
    def middle(self) -> int:
        """Index of the seed with the median likelihood, which the pictures show."""
        order = sorted(range(len(self.rows)), key=lambda i: self.rows[i]["nll"])
        return order[(len(order) - 1) // 2]

    def middle_model(self) -> FlowModel:
        """Return the model of that seed."""
        return self.ensemble.member(self.middle)


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
    train_nll = mean_nll(ensemble, train_data)
    with th.no_grad():
        log_q = ensemble.log_prob(held.points, held.condition).double().numpy()
    entropy = data.entropy()
    accuracy = _accuracy(ensemble, held) if study_name == "two-moons-label" else None
    conditions = th.from_numpy(study.conditions(scale)).float()
    rows = []
    for i, seed in enumerate(seeds):
        # The true density of the standardized points.
        log_p = data.log_density(heldout[i]) + scalers[i].log_volume
        gap = log_p - log_q[i]
        integrals = [integral(ensemble.member(i), one, scale.cells) for one in conditions]
        rows.append(
            {
                "study": study_name,
                "model": model,
                "seed": seed,
                "best_epoch": int(curves.best_epoch[i]),
                "train_nll": float(train_nll[i]),
                "nll": float(-log_q[i].mean()),
                "nll_se": _standard_error(log_q[i]),
                "entropy": entropy - scalers[i].log_volume,
                "gap": float(gap.mean()),
                "gap_se": _standard_error(gap),
                "integral_low": min(integrals),
                "integral_high": max(integrals),
                "accuracy": "" if accuracy is None else float(accuracy[i]),
            }
        )
    angle_rows = _angle_rows(ensemble, scale) if study_name == "angle-moons" else []
    return Fitted(model, ensemble, scalers, curves, rows, angle_rows)


def as_data(samples: Sequence[Sample], scalers: Sequence[Scaler]) -> Data:
    """Standardize one sample per seed and stack them for a model."""
    points = [scaler.apply(one.points) for one, scaler in zip(samples, scalers, strict=True)]
    conditions = np.stack([one.condition for one in samples])
    return Data(th.from_numpy(np.stack(points)).float(), th.from_numpy(conditions).float())


@th.no_grad()
def label_posterior(
    log_prob: Callable[[th.Tensor, th.Tensor], th.Tensor], points: th.Tensor
) -> th.Tensor:
    """Return p(label = 1 | point) for equally frequent labels: points (*, 2) -> (*)."""
    label = th.zeros_like(points[..., :1])
    return th.sigmoid(log_prob(points, label + 1) - log_prob(points, label))


def _accuracy(ensemble: Ensemble, held: Data) -> th.Tensor:
    """Return each seed's fraction of points that are more likely under their own label, (S,)."""
    more_likely = label_posterior(ensemble.log_prob, held.points) > 0.5
    return (more_likely == (held.condition[..., 0] > 0.5)).double().mean(1)


@th.no_grad()
def integral(model: FlowModel, condition: th.Tensor, cells: int) -> float:
    r"""Integrate a density over the plane.

    .. math:: \int p(x)\,dx = \int p(\sinh u) \cosh u_1 \cosh u_2\, du

    Near the origin, where the data lie, the cells are 0.0125 wide, a quarter of the noise of the
    data. The integral reveals a wrong log-determinant, and mass that a flow loses because one of
    its layers does not reach the whole plane.

    Args:
        model: The density.
        condition: Its condition, shape (C,).
        cells: Grid points per axis.

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
        log_p = model(part, condition.expand(len(part), -1))
        total += (log_p.double() + log_size).exp().sum().item()
    return total * (2 * REACH / (cells - 1)) ** 2


@th.no_grad()
def _angle_rows(ensemble: Ensemble, scale: Scale) -> list[Row]:
    """Score new points at single angles, with the same noise at each angle."""
    rows = []
    for kind, angles in angles_to_score(scale).items():
        for angle in angles:
            one = AngleMoons(np.array([angle]))
            samples = [one.draw(scale.n_per_angle, ANGLE_SEED + s) for s in ensemble.seeds]
            data = as_data(samples, [one.scaler(sample) for sample in samples])
            nll = mean_nll(ensemble, data)
            rows += [
                {"seed": seed, "kind": kind, "angle": round(float(angle), 4), "nll": float(value)}
                for seed, value in zip(ensemble.seeds, nll, strict=True)
            ]
    return rows


def _standard_error(values: np.ndarray) -> float:
    return float(values.std(ddof=1) / math.sqrt(len(values)))
