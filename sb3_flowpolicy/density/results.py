"""Results on disk: small CSV files, written at once or not at all, and read back for the report."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import bootstrap, trim_mean

from sb3_flowpolicy.density.measure import Fitted

N_RESAMPLES = 2000


def write_results(fits: Sequence[Fitted], folder: Path) -> None:
    """Write ``NAME-fits.csv``, ``NAME-curves.csv`` and, for angles, ``NAME-angles.csv``.

    Args:
        fits: All models of one study.
        folder: An existing folder.
    """
    name = fits[0].study
    write_csv(folder / f"{name}-fits.csv", [row for fitted in fits for row in fitted.rows])
    curves = [
        {"model": fitted.model, "seed": seed, "epoch": int(epoch), "train": train, "other": other}
        for fitted in fits
        for i, seed in enumerate(fitted.ensemble.seeds)
        for epoch, train, other in zip(
            fitted.curves.epoch,
            fitted.curves.train[:, i].tolist(),
            fitted.curves.validation[:, i].tolist(),
            strict=True,
        )
    ]
    write_csv(folder / f"{name}-curves.csv", curves)
    angle_rows = [row for fitted in fits for row in fitted.angle_rows]
    if angle_rows:
        write_csv(folder / f"{name}-angles.csv", angle_rows)


def write_csv(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write rows of equal columns; numbers with five significant digits after the point."""
    temporary = path.with_name(f".{path.name}.tmp")
    with open(temporary, "w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]), lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({key: _short(value) for key, value in row.items()})
    os.replace(temporary, path)


def read_csv(path: Path) -> list[dict[str, Any]]:
    """Read rows back; what looks like a number becomes one."""
    with open(path, newline="") as file:
        return [{key: _number(value) for key, value in row.items()} for row in csv.DictReader(file)]


def interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the interquartile mean over seeds and its 95 % bootstrap interval.

    Args:
        values: One number per seed.

    Returns:
        Mean of the middle half, and both ends of the percentile interval. Not finite where a
        seed is not.

    References:
        Deep Reinforcement Learning at the Edge of the Statistical Precipice (Agarwal et al., 2021).

    Example:
        >>> centre, low, high = interval([1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 99.0])
        >>> print(f"{centre:.2f}", 1.0 < low < centre < high)
        1.35 True
    """
    data = np.asarray(values, dtype=float)

    def middle(sample: np.ndarray, axis: int = -1) -> np.ndarray:
        return trim_mean(sample, 0.25, axis=axis)

    centre = float(middle(data))
    if len(data) < 2 or not np.isfinite(data).all() or np.ptp(data) == 0:
        return centre, centre, centre
    ends = bootstrap(
        (data,), middle, n_resamples=N_RESAMPLES, method="percentile", rng=0
    ).confidence_interval
    return centre, float(ends.low), float(ends.high)


def _short(value: Any) -> Any:
    return f"{value:.5f}" if isinstance(value, float) else value


def _number(text: str) -> Any:
    for convert in (int, float):
        try:
            return convert(text)
        except ValueError:
            continue
    return text
