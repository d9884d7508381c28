"""Run studies: fit all models, and write tables and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from tqdm import tqdm

from sb3_flowpolicy.common.files import replacing
from sb3_flowpolicy.density.measure import fit_and_measure
from sb3_flowpolicy.density.pictures import DRAW
from sb3_flowpolicy.density.studies import STUDIES, Scale


def run_studies(names: Sequence[str], seeds: Sequence[int], scale: Scale, folder: Path) -> None:
    """Fit, measure and draw studies.

    Writes ``NAME-fits.csv``, ``NAME-curves.csv`` and, for angles, ``NAME-angles.csv``.

    Args:
        names: Keys of ``STUDIES``.
        seeds: Seeds of weights and data.
        scale: How much to compute.
        folder: Folder of the results, created if missing.
    """
    if not set(names) <= STUDIES.keys():
        raise ValueError(f"studies must be among {list(STUDIES)}, got {list(names)}")
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        models = tqdm(STUDIES[name].epochs, desc=name, unit="model")
        fits = [fit_and_measure(name, model, seeds, scale) for model in models]
        for kind in ("fits", "curves", "angles"):
            table = pd.concat([getattr(fitted, kind) for fitted in fits])
            if not table.empty:
                with replacing(folder / f"{name}-{kind}.csv") as draft:
                    table.to_csv(draft, index=False, float_format="%.5f")
        DRAW[name](fits, folder, scale)
