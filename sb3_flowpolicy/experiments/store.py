"""Results on disk: the settings of an experiment, and append-only files per work item.

A folder holds, per experiment, ``settings.json`` and three files per item:

=======================  ======================================================================
``KEY.csv``              one line per measurement and seed, appended during the run
``KEY.details.jsonl``    what does not fit a table: entropy profiles, recorded policies
``KEY.done.json``        written last; commit, versions, machine and time
=======================  ======================================================================

An unfinished item also has ``checkpoints/KEY``, a finished one its first agent, ``agents/KEY.zip``.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import math
import os
import shutil
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_flowpolicy.common.files import read_json, write_json

SCHEMA = 1
"""Version of the files; increased when their meaning changes."""

BASIC_COLUMNS = (
    *("seed", "step", "episodes", "train_return", "train_success", "test_return"),
    *("test_success", "entropy", "ent_coef"),
)

# What the files hold, see common.files.read_json.
_SETTINGS_FIELDS = {"schema": int, "experiment": str, "steps": int, "seeds": list, "items": dict}
_DONE_FIELDS = {
    **{"key": str, "steps": int, "seeds": list, "table": int, "details": int, "sha256": str},
    **{"cpu_seconds": (int, float), "steps_per_second": (int, float), "machine": dict},
}
_ADVICE = "restore the file, or delete all files of this item and run it again"


def read_settings(folder: Path) -> dict[str, Any] | None:
    """Return the settings of an experiment's folder, None if it holds no results.

    Raises:
        ValueError: If the file is corrupt, of another version, or of another experiment.
    """
    path = folder / "settings.json"
    if not path.is_file():
        return None
    settings = read_json(path, _SETTINGS_FIELDS)
    if settings["schema"] != SCHEMA:
        raise ValueError(f"{path} must be of schema {SCHEMA}, got {settings['schema']}")
    if settings["experiment"] != folder.name:
        raise ValueError(
            f"{path} must be in a folder named after its experiment, "
            f"{settings['experiment']!r}, got {folder.name!r}"
        )
    return settings


def differences(found: Any, wanted: Any, where: str = "") -> list[str]:
    """Describe the leaves in which two nested objects differ."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        return [
            difference
            for key in sorted(found.keys() | wanted.keys())
            for difference in differences(
                found.get(key), wanted.get(key), f"{where}.{key}" if where else key
            )
        ]
    there, now = (textwrap.shorten(json.dumps(one), 60) for one in (found, wanted))
    return [] if found == wanted else [f"{where}: there {there}, now {now}"]


class ItemFiles:
    """The files of one work item, by its experiment's folder and its key."""

    def __init__(self, folder: Path, key: str) -> None:
        self.folder, self.key = folder, key
        self.table = folder / f"{key}.csv"
        self.details = folder / f"{key}.details.jsonl"
        self.done = folder / f"{key}.done.json"
        self.checkpoints = folder / "checkpoints" / key
        self.agent = folder / "agents" / f"{key}.zip"
        self.advice = f"delete {self.checkpoints} and {self.table} to repeat this item"

    @property
    def finished(self) -> bool:
        """Whether the item is complete."""
        return self.done.is_file()

    def append_rows(self, rows: Sequence[Mapping[str, float | None]]) -> None:
        """Append one line per row, after the header in a new file.

        Five digits are more than a curve shows; whole numbers stay whole, None is left empty.

        Raises:
            ValueError: If a number is not finite.
        """
        for name, value in itertools.chain.from_iterable(row.items() for row in rows):
            if value is not None and not math.isfinite(value):
                raise ValueError(f"{name} must be finite, got {value}")
        new = not self.table.exists() or self.table.stat().st_size == 0
        lines = pd.DataFrame(rows).to_csv(
            index=False, header=new, float_format="%.5g", lineterminator="\n"
        )
        _append(self.table, lines)

    def append_detail(self, detail: Mapping[str, Any]) -> None:
        """Append one object."""
        _append(self.details, json.dumps(detail, separators=(",", ":")) + "\n")

    def fingerprint(self) -> dict[str, Any]:
        """Return the lengths of both files and a digest of their contents."""
        # Only regular files have a length: reading a device may never end.
        table, details = (
            path.read_bytes() if path.is_file() else b"" for path in (self.table, self.details)
        )
        digest = hashlib.sha256(table + details).hexdigest()
        return {"table": len(table), "details": len(details), "sha256": digest}

    def check(self, noted: Mapping[str, Any], advice: str) -> None:
        """Raise ``ValueError``, with this advice, if the files changed since a fingerprint."""
        found = self.fingerprint()
        if any(found[name] != noted[name] for name in found.keys() & noted.keys()):
            raise ValueError(
                f"{self.table} and {self.details} must hold the {noted['table']} and "
                f"{noted['details']} bytes written to them, got {found['table']} and "
                f"{found['details']} bytes or other contents: {advice}"
            )

    def cut_to(self, noted: Mapping[str, Any]) -> None:
        """Drop everything that was written after a :meth:`fingerprint`, even half a line.

        Raises:
            ValueError: If the files hold less than they did, or something else.
        """
        for path, length in ((self.table, noted["table"]), (self.details, noted["details"])):
            if path.exists() and path.stat().st_size > length:
                os.truncate(path, length)
        self.check(noted, f"restore them, or {self.advice}")

    def finish(self, facts: Mapping[str, Any]) -> None:
        """Declare the item complete and drop its checkpoints."""
        write_json(self.done, {**facts, "key": self.key})
        shutil.rmtree(self.checkpoints, ignore_errors=True)

    def read_table(self) -> pd.DataFrame:
        """Return the table; of an unfinished item, up to the last whole line.

        Raises:
            ValueError: If a line is corrupt.
        """
        lines = _whole_lines(self.table)
        if not lines:
            return pd.DataFrame(columns=list(BASIC_COLUMNS))
        text = io.StringIO("".join(lines))
        try:
            table = pd.read_csv(text, dtype=np.float64, float_precision="round_trip")
            basic = table.reindex(columns=["seed", "step"])
            if not {*basic} <= {*table} or not np.isfinite(basic.to_numpy()).all():
                raise ValueError("a row lacks its seed or step")
            return table
        except ValueError as error:
            raise ValueError(f"{self.table} must hold numbers: {error}; {_ADVICE}") from error

    def read_details(self) -> list[dict[str, Any]]:
        """Return what :meth:`append_detail` wrote, up to the last whole line.

        Raises:
            ValueError: If a line is corrupt.
        """
        lines = _whole_lines(self.details)
        try:
            return [json.loads(line) for line in lines]
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{self.details} must hold JSON: {error}; {_ADVICE}") from error

    def read_done(self, steps: int, seeds: Sequence[int]) -> dict[str, Any] | None:
        """Return the facts of a finished item, None of an unfinished one.

        Raises:
            ValueError: If a file was changed since, or is another item's, or it has done fewer
                steps, or other seeds.
        """
        if not self.finished:
            return None
        done = read_json(self.done, _DONE_FIELDS)
        if done["key"] != self.key:
            raise ValueError(f"{self.done} must be of {self.key}, got {done['key']!r}: {_ADVICE}")
        if done["seeds"] != list(seeds) or done["steps"] < steps:
            raise ValueError(
                f"{self.done} must be of {steps} steps of seeds {list(seeds)}, "
                f"got {done['steps']} of {done['seeds']}"
            )
        self.check(done, _ADVICE)
        return done


def _whole_lines(path: Path) -> list[str]:
    """Return the lines of a file without the last if it is being written or was interrupted."""
    if not path.exists():
        return []
    lines = path.read_text(errors="replace").splitlines(keepends=True)
    return [line for line in lines if line.endswith("\n")]


def _append(path: Path, text: str) -> None:
    with open(path, "a") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
