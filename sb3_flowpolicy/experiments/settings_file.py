"""A folder of results keeps to the settings of its first run."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sb3_flowpolicy.common.files import read_json, require, write_json
from sb3_flowpolicy.experiments.work import SCHEMA

FILE_NAME = "settings.json"
_FIELDS = {"schema": int, "experiment": str, "steps": int, "seeds": list, "items": dict}
_ITEM_FIELDS = {"setting": str, "agent": str, "seeds": list, "steps": int}


def read_settings(folder: Path) -> dict[str, Any] | None:
    """Return the settings of a folder's results, None if it holds none.

    Args:
        folder: Folder of one experiment, called like it.

    Raises:
        ValueError: If the file is corrupt, of another version, or of another experiment.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return None
    settings = read_json(path, _FIELDS)
    if settings["schema"] != SCHEMA:
        raise ValueError(f"{path} must be of schema {SCHEMA}, got {settings['schema']}")
    if settings["experiment"] != folder.name:
        raise ValueError(
            f"{path} must lie in a folder called like its experiment, "
            f"{settings['experiment']!r}, got {folder.name!r}"
        )
    for key, item in settings["items"].items():
        require(f"{path}: {key}", item, _ITEM_FIELDS)
    for seeds in (settings["seeds"], *(one["seeds"] for one in settings["items"].values())):
        if not seeds or not all(isinstance(seed, int) for seed in seeds):
            raise ValueError(f"{path} must hold whole numbers as seeds, got {seeds}")
    return settings


def claim_folder(folder: Path, settings: Mapping[str, Any]) -> None:
    """Make a folder belong to these settings, or check that it does.

    Raises:
        ValueError: If it holds results of other settings; the message names the differences.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / FILE_NAME
    wanted = json.loads(json.dumps(settings))
    if not path.exists():
        strays = [one.name for one in folder.glob("*.csv")]
        if strays:
            raise ValueError(f"{folder} must be new or have its settings.json, got only {strays}")
        return write_json(path, settings)
    found = read_json(path)
    if found != wanted:
        named = "; ".join(differences(found, wanted)[:5])
        raise ValueError(
            f"{folder} must hold results of the same settings, got others ({named}). "
            "Choose another folder with --out, or run with the settings it was made with"
        )


def differences(found: Any, wanted: Any, where: str = "") -> list[str]:
    """Say in which leaves two nested objects differ."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        parts = []
        for key in sorted(found.keys() | wanted.keys()):
            place = f"{where}.{key}" if where else key
            parts += differences(found.get(key), wanted.get(key), place)
        return parts
    if found == wanted:
        return []
    return [f"{where}: there {_short(found)}, now {_short(wanted)}"]


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."
