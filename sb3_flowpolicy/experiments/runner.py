"""Run a plan: lock its folder, find what was done before, and train the rest in processes."""

from __future__ import annotations

import multiprocessing
import os
import queue
import threading
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

from filelock import FileLock, Timeout
from tqdm import tqdm

from sb3_flowpolicy.common.files import read_json, write_json
from sb3_flowpolicy.experiments.store import ItemFiles, differences
from sb3_flowpolicy.experiments.work import Plan, WorkItem

# OpenMP and numba read these when a process starts: one thread each, one process per core.
ONE_THREAD = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_reports: Any = None


@contextmanager
def results_folder(out: Path, plan: Plan) -> Iterator[Path]:
    """Lock the experiment's own folder in ``out`` for as long as a run lasts.

    The first run writes its settings there, and the folder keeps to them.

    Raises:
        ValueError: If it holds results of other settings, or another run is at work.
        OSError: If it cannot be written.
    """
    folder = out / plan.experiment.name
    folder.mkdir(parents=True, exist_ok=True)
    path, settings = folder / "settings.json", plan.settings()
    try:
        with FileLock(folder / ".run.lock", timeout=0):
            if not path.exists():
                write_json(path, settings)
            if found := differences(read_json(path), settings):
                raise ValueError(
                    f"{folder} must hold results of the same settings, got others "
                    f"({'; '.join(found[:5])}). Choose another folder with --out, or use the "
                    "settings of the first run"
                )
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


class Progress(tqdm):
    """A bar over the environment steps of all seeds that names the items at work.

    ``finished`` holds the keys of the items that were finished before this run.
    """

    def __init__(
        self, items: Sequence[WorkItem], finished: Collection[str] = (), shown: bool = True
    ) -> None:
        self.items = {item.key: item for item in items}
        self.steps = {key: self.items[key].steps for key in finished}
        super().__init__(
            total=sum(item.all_steps for item in items),
            initial=sum(item.all_steps for item in items if item.key in finished),
            desc="all",
            unit=" steps",
            unit_scale=True,
            disable=not shown,
            dynamic_ncols=True,
        )

    def note(self, key: str, steps: int) -> None:
        """Note that each seed of an item has done so many steps."""
        item, known = self.items[key], key in self.steps
        steps = min(steps, item.steps)
        gained = (steps - self.steps.get(key, 0)) * len(item.seeds)
        self.steps[key] = steps
        if not known and not self.disable:
            self.initial += gained  # an earlier session's steps are no measure of this speed
        shares = {name: done / self.items[name].steps for name, done in self.steps.items()}
        at_work = (f"{name} {share:.0%}" for name, share in shares.items() if share < 1)
        self.set_postfix_str(", ".join(at_work), False)
        self.update(gained)

    def take(self, reports: Any) -> None:
        """Note all reports in a queue: pairs of an item's key and its steps."""
        while True:
            try:
                self.note(*reports.get_nowait())
            except queue.Empty:
                return


def run_local(folder: Path, items: Sequence[WorkItem], progress: Progress, workers: int) -> None:
    """Do items in at most ``workers`` processes of this machine; ``folder`` has to be locked.

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
        running: set[Future] = {pool.submit(_work, item, folder) for item in items}
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
