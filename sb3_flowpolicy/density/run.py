"""Run studies: fit all models, in parallel if asked, and write tables and pictures."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import pandas as pd
import torch as th
from tqdm import tqdm

from sb3_flowpolicy.common.files import replacing
from sb3_flowpolicy.density.measure import Fitted, fit_and_measure
from sb3_flowpolicy.density.pictures import DRAW
from sb3_flowpolicy.density.studies import STUDIES, Scale

# (study, model)
Task = tuple[str, str]


def run_studies(
    names: Sequence[str], seeds: Sequence[int], scale: Scale, folder: Path, jobs: int = 1
) -> None:
    """Fit, measure and draw studies.

    Args:
        names: Keys of ``STUDIES``.
        seeds: Seeds of weights and data.
        scale: How much to compute.
        folder: Folder of the results, created if missing.
        jobs: Models fitted at the same time, each in a process with one thread.
    """
    if not set(names) <= STUDIES.keys():
        raise ValueError(f"studies must be among {list(STUDIES)}, got {list(names)}")
    folder.mkdir(parents=True, exist_ok=True)
    # The longest fits first, so that no process runs alone at the end.
    tasks = [(name, model) for name in names for model in STUDIES[name].epochs]
    tasks.sort(key=lambda task: task[1] != "naf")
    done: dict[Task, Fitted] = {}
    fits_as_completed = _fits(tasks, seeds, scale, jobs)
    for (name, model), fitted in tqdm(fits_as_completed, total=len(tasks), unit="model"):
        done[name, model] = fitted
        if all((name, other) in done for other in STUDIES[name].epochs):
            fits = [done[name, other] for other in STUDIES[name].epochs]
            _write_tables(name, fits, folder)
            DRAW[name](fits, folder, scale)


def _fits(
    tasks: Sequence[Task], seeds: Sequence[int], scale: Scale, jobs: int
) -> Iterable[tuple[Task, Fitted]]:
    """Yield fits as they complete."""
    if jobs == 1:
        for task in tasks:
            yield task, fit_and_measure(*task, seeds, scale)
        return
    # Forked children would inherit torch's threads in an unknown state.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, th.set_num_threads, (1,)) as pool:
        futures = {pool.submit(fit_and_measure, *task, seeds, scale): task for task in tasks}
        for future in as_completed(futures):
            yield futures[future], future.result()


def _write_tables(name: str, fits: Sequence[Fitted], folder: Path) -> None:
    """Write ``NAME-fits.csv``, ``NAME-curves.csv`` and, for angles, ``NAME-angles.csv``."""
    for kind in ("fits", "curves", "angles"):
        table = pd.concat([getattr(fitted, kind) for fitted in fits])
        if not table.empty:
            with replacing(folder / f"{name}-{kind}.csv") as draft:
                table.to_csv(draft, index=False, float_format="%.5f")
