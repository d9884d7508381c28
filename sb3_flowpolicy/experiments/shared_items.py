"""Items that two experiments have in common are trained once."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_flowpolicy.common.machine import machine
from sb3_flowpolicy.experiments.manifest import EXPERIMENTS
from sb3_flowpolicy.experiments.settings_file import read_settings
from sb3_flowpolicy.experiments.store import ItemFiles
from sb3_flowpolicy.experiments.work import WorkItem, describe

# How an experiment calls an item; the rest of its description is what it does.
_NAMES = ("setting", "agent")


def adopt(folder: Path, items: Sequence[WorkItem]) -> dict[str, str]:
    """Copy finished items of other experiments that did exactly the same.

    The same is: equal in everything that results depend on, at the same commit, with the same
    versions. Where the commit is not known, or source files differ from it, nothing is copied;
    neither is an item that was begun or continued at another commit, or whose files are not what
    they were when it was finished.

    Args:
        folder: Folder of the experiment, claimed; others lie beside it.
        items: What is still to be done.

    Returns:
        Key of each copied item to the experiment that it came from.

    Raises:
        ValueError: If a file of another experiment is corrupt; the message names it.
    """
    here = machine()
    adopted: dict[str, str] = {}
    if here["commit"] is None or here["commit"].endswith("-dirty"):
        return adopted
    wanted = {_work(describe(item)): item.key for item in items}
    for other in EXPERIMENTS:  # other folders beside this one are none of our business
        settings = None if other == folder.name else read_settings(folder.parent / other)
        for key, described in (settings or {"items": {}})["items"].items():
            mine = wanted.get(_work(described))
            if mine is None or mine in adopted:
                continue
            there = ItemFiles(folder.parent / other, key)
            done = there.read_done()
            if done is not None and _same_code(done, here) and there.damage(done) is None:
                _copy(there, ItemFiles(folder, mine), done)
                adopted[mine] = other
    return adopted


def _same_code(done: dict[str, Any], here: dict[str, Any]) -> bool:
    commits = done.get("commits", [done["machine"]["commit"]])
    return commits == [here["commit"]] and done["machine"]["versions"] == here["versions"]


def _work(described: dict[str, Any]) -> str:
    """Return what is done, as text: tuples there are the lists that a file holds."""
    return json.dumps({k: v for k, v in described.items() if k not in _NAMES}, sort_keys=True)


def _copy(there: ItemFiles, here: ItemFiles, done: dict[str, Any]) -> None:
    shutil.rmtree(here.checkpoints, ignore_errors=True)
    for source, target in ((there.table, here.table), (there.details, here.details)):
        target.unlink(missing_ok=True)
        if source.exists():
            shutil.copyfile(source, target)
    here.finish({**done, "adopted_from": f"{there.folder.name}/{there.key}"})
