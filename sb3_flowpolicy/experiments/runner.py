"""Run a plan: claim its folder, take over what was done before, and train the rest in processes."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

from filelock import FileLock, Timeout

from sb3_flowpolicy.experiments.progress import Progress
from sb3_flowpolicy.experiments.store import ItemFiles, claim_folder
from sb3_flowpolicy.experiments.work import Plan, WorkItem, item_seconds

# OpenMP and numba read these when a process starts: one thread each, one process per core.
ONE_THREAD = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_reports: Any = None


@contextmanager
def results_folder(out: Path, plan: Plan) -> Iterator[Path]:
    """Claim the folder of an experiment for as long as a run lasts.

    Args:
        out: Folder of all experiments.
        plan: The plan to run.

    Yields:
        The experiment's own folder.

    Raises:
        ValueError: If it holds results of other settings, or another run is at work.
        OSError: If it cannot be written.
    """
    folder = out / plan.experiment.name
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / ".run.lock", timeout=0):
            claim_folder(folder, plan.settings())
            yield folder
    except Timeout as error:
        raise ValueError(f"{folder} must be used by one run at a time, but another is") from error


def unfinished(folder: Path, plan: Plan) -> list[WorkItem]:
    """Return the items to do; raise ``ValueError`` if files of a finished one are damaged."""
    return [
        item
        for item in plan.items
        if ItemFiles(folder, item.key).read_done(item.steps, item.seeds) is None
    ]


def run_local(folder: Path, items: Sequence[WorkItem], progress: Progress, workers: int) -> None:
    """Do items in processes of this machine.

    Args:
        folder: Folder of the experiment, claimed.
        items: The items to do.
        progress: Bar to update.
        workers: Number of processes, at least 1.

    Raises:
        ValueError: If an item's files are damaged.
        OSError: If a file cannot be written.
        RuntimeError: If a process died.
    """
    context = multiprocessing.get_context("spawn")
    reports = context.Queue()
    with (
        mock.patch.dict(os.environ, dict.fromkeys(ONE_THREAD, "1")),
        ProcessPoolExecutor(
            min(workers, len(items)), context, initializer=_start_worker, initargs=(reports,)
        ) as pool,
    ):
        longest_first = sorted(items, key=item_seconds, reverse=True)
        running: set[Future] = {pool.submit(_work, item, folder) for item in longest_first}
        try:
            while running:
                progress.take(reports)
                done, running = wait(running, timeout=0.2, return_when=FIRST_COMPLETED)
                for future in done:
                    future.result()
            progress.take(reports)
        except BrokenProcessPool as error:
            raise RuntimeError(
                "a process was killed, perhaps because memory ran out; the same command goes on "
                "from the last checkpoint, and --workers 1 needs the least memory"
            ) from error
        except BaseException:
            # Otherwise the other items would run to their end, which may be hours away.
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


def _start_worker(reports: Any) -> None:
    global _reports
    _reports = reports
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end_with_parent() -> None:
        parent.join()
        os._exit(1)  # after the runner was killed, its processes must not go on writing

    threading.Thread(target=end_with_parent, daemon=True).start()


def _work(item: WorkItem, folder: Path) -> None:
    from sb3_flowpolicy.experiments.training import run_item

    run_item(item, folder, lambda key, step: _reports.put((key, step)))
