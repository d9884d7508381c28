"""Run studies: fit all models, in parallel if asked, and write tables and pictures."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import torch as th
from tqdm import tqdm

from sb3_flowpolicy.density.measure import Fitted, fit_and_measure
from sb3_flowpolicy.density.pictures import draw_angles, draw_label, draw_two_moons
from sb3_flowpolicy.density.results import write_results
from sb3_flowpolicy.density.studies import STUDIES, Scale

PICTURES = {
    "two-moons": draw_two_moons,
    "two-moons-label": draw_label,
    "angle-moons": draw_angles,
}
# (study, model)
Task = tuple[str, str]


def run_studies(
    names: Sequence[str],
    seeds: Sequence[int],
    scale: Scale,
    folder: Path,
    jobs: int = 1,
    progress: bool = False,
) -> None:
    """Fit, measure and draw studies.

    Args:
        names: Keys of ``STUDIES``.
        seeds: Seeds of weights and data.
        scale: How much to compute.
        folder: Folder of the results, created if missing.
        jobs: Models fitted at the same time, each in a process with one thread.
        progress: Whether to show progress bars.
    """
    unknown = [name for name in names if name not in STUDIES]
    if unknown or not names:
        raise ValueError(f"studies must be among {list(STUDIES)}, got {list(names)}")
    if not seeds:
        raise ValueError("seeds must be at least 1, got 0")
    if jobs < 1:
        raise ValueError(f"jobs must be at least 1, got {jobs}")
    folder.mkdir(parents=True, exist_ok=True)
    # The longest fits first, so that no process runs alone at the end.
    tasks = [(name, model) for name in names for model in STUDIES[name].recipes]
    tasks.sort(key=lambda task: task[1] != "naf")
    waiting = {name: len(STUDIES[name].recipes) for name in names}
    done: dict[Task, Fitted] = {}
    for task, fitted in _fits(tasks, seeds, scale, jobs, progress):
        done[task] = fitted
        waiting[task[0]] -= 1
        if not waiting[task[0]]:
            fits = [done[task[0], model] for model in STUDIES[task[0]].recipes]
            write_results(fits, folder)
            PICTURES[task[0]](fits, folder, scale)


def _fits(
    tasks: Sequence[Task], seeds: Sequence[int], scale: Scale, jobs: int, progress: bool
) -> Iterable[tuple[Task, Fitted]]:
    """Yield fits as they complete."""
    if jobs == 1 or len(tasks) == 1:
        for task in tasks:
            yield task, fit_and_measure(*task, seeds, scale, progress)
        return
    # Forked children would inherit torch's threads in an unknown state.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        jobs, mp_context=context, initializer=th.set_num_threads, initargs=(1,)
    ) as pool:
        futures = {pool.submit(fit_and_measure, *task, seeds, scale): task for task in tasks}
        bar = tqdm(as_completed(futures), total=len(tasks), unit="model", disable=not progress)
        for future in bar:
            bar.set_postfix_str("{}: {}".format(*futures[future]))
            yield futures[future], future.result()
