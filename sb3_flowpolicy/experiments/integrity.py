"""Whether results are all there, and of what the manifest asks for."""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from typing import Any

from sb3_flowpolicy.experiments.experiment import Experiment
from sb3_flowpolicy.experiments.settings_file import differences
from sb3_flowpolicy.experiments.store import ItemFiles, Row
from sb3_flowpolicy.experiments.work import FIRST_SEED, make_plan


def rows_of_seeds(
    files: ItemFiles, item: Mapping[str, Any], done: Mapping[str, Any] | None
) -> dict[int, list[Row]]:
    """Return an item's rows by seed.

    Args:
        files: Its files.
        item: Its description in the folder's settings.
        done: What was noted when it was finished; None if it is not.

    Returns:
        Seed to rows, in order of steps; seeds without rows are left out.

    Raises:
        ValueError: If rows are not those of its seeds in order or, once it is finished, if any is
            missing or was changed.
    """
    logs: dict[int, list[Row]] = {seed: [] for seed in item["seeds"]}
    if done is not None and done["seeds"] != [*logs]:
        raise ValueError(f"{files.done} must tell of seeds {[*logs]}, got {done['seeds']}")
    if done is not None and done["steps"] < item["steps"]:
        raise ValueError(f"{files.done} must tell of {item['steps']} steps, got {done['steps']}")
    for row in files.read_rows():
        if row["seed"] not in logs:
            raise ValueError(f"{files.table} must hold seeds {[*logs]}, got {row['seed']:g}")
        logs[int(row["seed"])].append(row)
    for seed, rows in logs.items():
        steps = [row["step"] or 0 for row in rows]
        if any(later <= earlier for earlier, later in itertools.pairwise(steps)):
            raise ValueError(f"{files.table} must hold increasing steps, seed {seed} does not")
        if done is not None and (not steps or steps[-1] != done["steps"]):
            last = f"{steps[-1]:g}" if steps else "none"
            raise ValueError(
                f"{files.table} must hold seed {seed} up to step {done['steps']}, got {last}"
            )
    damage = None if done is None else files.damage(done)
    if damage:
        raise ValueError(f"{damage}: restore it, or delete all files of this item and run it again")
    return {seed: rows for seed, rows in logs.items() if rows}


def reservation(experiment: Experiment, settings: Mapping[str, Any]) -> str | None:
    """Say why results made with these settings are not the experiment's own.

    Args:
        experiment: The experiment.
        settings: What :func:`~sb3_flowpolicy.experiments.settings_file.read_settings` returned.

    Returns:
        A few words; None if they are.
    """
    planned = make_plan(experiment)
    seeds = settings["seeds"]
    if settings["steps"] < planned.steps or len(seeds) < len(planned.seeds):
        return "try-out, not a result"
    if seeds[0] != FIRST_SEED:
        return f"seeds from {seeds[0]} on, which are for tuning: not a result"
    together = max(len(item["seeds"]) for item in settings["items"].values())
    same = make_plan(experiment, steps=settings["steps"], seeds=len(seeds), seeds_per_item=together)
    wanted = json.loads(json.dumps(same.settings()))
    if settings != wanted:
        return f"made with other settings ({differences(dict(settings), wanted)[0]})"
    return None
