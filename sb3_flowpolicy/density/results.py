"""Results on disk: small CSV files, written by ``run`` and read by ``report``."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_flowpolicy.common.files import replacing
from sb3_flowpolicy.density.measure import Fitted, Row


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


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write rows of equal columns; floats with five digits after the point."""
    with replacing(path) as draft, draft.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]), lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({k: f"{v:.5f}" if isinstance(v, float) else v for k, v in row.items()})


def read_csv(path: Path) -> list[Row]:
    """Read rows; texts that look like numbers become numbers."""
    with open(path, newline="") as file:
        return [{key: _number(value) for key, value in row.items()} for row in csv.DictReader(file)]


def _number(text: str) -> Any:
    for convert in (int, float):
        try:
            return convert(text)
        except ValueError:
            continue
    return text
