"""Do work items on a Ray cluster.

Each item is a task with one core. It works in a temporary folder of its machine and returns its
files, which are written into the results here once the item is complete. A task whose machine is
lost starts again on another one.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_flowpolicy.common.files import replacing
from sb3_flowpolicy.experiments.runner import ONE_THREAD, Progress
from sb3_flowpolicy.experiments.store import ItemFiles
from sb3_flowpolicy.experiments.work import WorkItem

MOST_RETRIES = 10
"""Lost machines are expected; an item that crashes every machine is not."""
_POLL_SECONDS = 0.5


def run_on_ray(
    folder: Path, items: Sequence[WorkItem], progress: Progress, address: str | None = None
) -> None:
    """Do items as Ray tasks; only this machine needs access to the folder, which has to be locked.

    The cluster is that of ``address``, else the one that this process is connected to, that of the
    variable ``RAY_ADDRESS``, or a new one on this machine alone.

    Raises:
        ModuleNotFoundError: If Ray is missing.
        ValueError: If an item's files are damaged.
        RuntimeError: If an item could not be done.
        OSError: If a file cannot be written here, or no cluster answers.
    """
    try:
        import ray
        from ray.exceptions import RayError, RayTaskError
        from ray.util.queue import Queue
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            '--backend ray needs Ray: pip install "sb3_flowpolicy[distributed]"'
        ) from error

    if not ray.is_initialized():
        ray.init(address=address, log_to_driver=False, logging_level="warning")
    environment = {"env_vars": dict.fromkeys(ONE_THREAD, "1")}
    # On the runner's machine, which is the only one that must not be lost.
    here = NodeAffinitySchedulingStrategy(ray.get_runtime_context().get_node_id(), soft=False)
    reports = Queue(actor_options={"num_cpus": 0, "scheduling_strategy": here})
    task = ray.remote(_run_remotely).options(
        num_cpus=1, max_retries=MOST_RETRIES, runtime_env=environment
    )
    waiting = {task.remote(item, reports): item for item in items}
    try:
        while waiting:
            done, _ = ray.wait(list(waiting), timeout=_POLL_SECONDS)
            progress.take(reports)
            for reference in done:
                item = waiting.pop(reference)
                for name, data in ray.get(reference).items():
                    (folder / name).parent.mkdir(exist_ok=True)
                    with replacing(folder / name) as draft:
                        draft.write_bytes(data)
                progress.note(item.key, item.steps)
    except RayTaskError as error:
        for kind in (OSError, ValueError):
            if isinstance(error.cause, kind):
                raise kind(f"on another machine: {error.cause}") from error
        raise RuntimeError(f"an item failed on another machine: {error}") from error
    except RayError as error:
        raise RuntimeError(
            f"the cluster gave up on an item after {MOST_RETRIES} retries; finished items are "
            f"kept: {error}"
        ) from error
    finally:
        for reference in waiting:
            ray.cancel(reference, force=True)
        reports.shutdown(force=True)


def _run_remotely(item: WorkItem, reports: Any) -> dict[str, bytes]:
    """Do an item on another machine, and return its files."""
    from sb3_flowpolicy.experiments.training import run_item

    with tempfile.TemporaryDirectory(prefix="sb3_flowpolicy_", ignore_cleanup_errors=True) as name:
        files = ItemFiles(Path(name), item.key)
        run_item(item, files.folder, lambda key, steps: reports.put((key, steps)))
        # The file that declares the item finished comes last.
        paths = (files.table, files.details, files.agent, files.done)
        return {
            str(path.relative_to(files.folder)): path.read_bytes()
            for path in paths
            if path.exists()
        }
