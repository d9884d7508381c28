"""Results on disk: append-only files per work item.

A folder holds, per experiment, ``settings.json`` and three files per item:

=======================  ======================================================================
``KEY.csv``              one line per measurement and seed, appended as the run goes
``KEY.details.jsonl``    what does not fit a table: the policy's entropy along the path, samples
``KEY.done.json``        written last; commit, versions, machine and time
=======================  ======================================================================

and ``checkpoints/KEY`` while the item is unfinished.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sb3_flowpolicy.common.files import read_json, require, write_json

BASIC_COLUMNS = (
    "seed",
    "step",
    "episodes",
    "train_return",
    "train_success",
    "test_return",
    "test_success",
    "entropy",
    "ent_coef",
)
Row = dict[str, float | None]

DONE_FIELDS = {
    **{"key": str, "steps": int, "seeds": list, "table": int, "details": int, "sha256": str},
    **{"cpu_seconds": (int, float), "steps_per_second": (int, float)},
    "machine": {
        **{"commit": (str, type(None)), "cpu_count": (int, type(None))},
        **{"processor": str, "python": str, "versions": dict},
    },
}
"""What ``KEY.done.json`` holds, see :func:`~sb3_flowpolicy.common.files.require`."""

DETAIL_FIELDS = {
    "profile": {"seed": int, "way": list, "entropy": list},
    "picture": {
        **{"seed": int, "step": int, "steps": list},
        **{"positions": list, "samples": list, "trail": list},
    },
}
"""Kinds of lines in ``KEY.details.jsonl``, and what each holds."""


class ItemFiles:
    """The files of one work item.

    Args:
        folder: Folder of the experiment.
        key: The item's key.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self.folder, self.key = folder, key
        self.table = folder / f"{key}.csv"
        self.details = folder / f"{key}.details.jsonl"
        self.done = folder / f"{key}.done.json"
        self.checkpoints = folder / "checkpoints" / key

    @property
    def finished(self) -> bool:
        """Whether the item is complete."""
        return self.done.is_file()

    def append_rows(self, rows: Sequence[Mapping[str, float | None]]) -> None:
        """Append one line per row; the first one brings the head."""
        columns = list(rows[0])
        lines = [",".join(_number(row[name]) for name in columns) for row in rows]
        if not self.table.exists() or self.table.stat().st_size == 0:
            lines.insert(0, ",".join(columns))
        _append(self.table, "\n".join(lines) + "\n")

    def append_detail(self, detail: Mapping[str, Any]) -> None:
        """Append one object."""
        _append(self.details, json.dumps(detail, separators=(",", ":")) + "\n")

    def fingerprint(self) -> dict[str, Any]:
        """Return length and contents, in short: what a checkpoint has to remember."""
        digest = hashlib.sha256()
        lengths = {}
        for name, path in self._paths().items():
            lengths[name] = path.stat().st_size if path.exists() else 0
            if lengths[name]:  # devices have no length, and some no end
                digest.update(path.read_bytes())
        return {**lengths, "sha256": digest.hexdigest()}

    def damage(self, noted: Mapping[str, Any]) -> str | None:
        """Say how the files differ from what they were.

        Args:
            noted: What :meth:`fingerprint` returned; the ``sha256`` may be missing.

        Returns:
            A sentence; None if they are the same.
        """
        found = self.fingerprint()
        for name, path in self._paths().items():
            if found[name] != noted[name]:
                return f"{path} must hold the {noted[name]} bytes written to it, got {found[name]}"
        if found["sha256"] != noted.get("sha256", found["sha256"]):
            return f"{self.table} and {self.details} must hold what was written, got something else"
        return None

    def cut_to(self, noted: Mapping[str, Any]) -> None:
        """Drop what was written after a checkpoint, half a line perhaps.

        Args:
            noted: What :meth:`fingerprint` returned then.

        Raises:
            ValueError: If the files hold less than they did, or something else.
        """
        for name, path in self._paths().items():
            if path.exists() and path.stat().st_size > noted[name]:
                os.truncate(path, noted[name])
        damage = self.damage(noted)
        if damage:
            raise ValueError(
                f"{damage}: restore it, or delete {self.checkpoints} and {self.table} to repeat "
                "this item"
            )

    def _paths(self) -> dict[str, Path]:
        return {"table": self.table, "details": self.details}

    def finish(self, facts: Mapping[str, Any]) -> None:
        """Declare the item complete and drop its checkpoints."""
        write_json(self.done, {**facts, "key": self.key})
        shutil.rmtree(self.checkpoints, ignore_errors=True)

    def read_rows(self) -> list[Row]:
        """Return the table; of an unfinished item, up to the last whole line.

        Raises:
            ValueError: If a line is corrupt; the message names file and line.
        """
        if not self.table.exists():
            return []
        lines = self.table.read_text(errors="replace").splitlines(keepends=True)
        if lines and not lines[-1].endswith("\n") and not self.finished:
            lines.pop()  # it is being written, or the run was interrupted here
        if not lines:
            return []
        columns = lines[0].rstrip("\n").split(",")  # as append_rows writes it, without quotes
        missing = [name for name in BASIC_COLUMNS if name not in columns]
        if missing:
            raise ValueError(f"{self.table}, line 1 must name the columns {missing}, got {columns}")
        return [
            _parse(self.table, number, line, columns)
            for number, line in enumerate(lines[1:], start=2)
        ]

    def read_details(self) -> list[dict[str, Any]]:
        """Return what :meth:`append_detail` wrote.

        Raises:
            ValueError: If a line is corrupt; the message names file and line.
        """
        if not self.details.exists():
            return []
        found = []
        lines = self.details.read_text(errors="replace").splitlines(keepends=True)
        if lines and not lines[-1].endswith("\n") and not self.finished:
            lines.pop()
        for number, line in enumerate(lines, start=1):
            try:
                detail = json.loads(line)
            except (ValueError, RecursionError) as error:
                raise ValueError(
                    f"{self.details}, line {number} must be JSON, got {line[:60]!r}: {_ADVICE}"
                ) from error
            where = f"{self.details}, line {number}"
            require(where, detail, {"kind": str})
            if detail["kind"] not in DETAIL_FIELDS:
                raise ValueError(
                    f"{where} must be of a kind among {[*DETAIL_FIELDS]}, got {detail['kind']!r}"
                )
            require(where, detail, DETAIL_FIELDS[detail["kind"]])
            found.append(detail)
        return found

    def read_done(self) -> dict[str, Any] | None:
        """Return the facts of a finished item, None of an unfinished one.

        Raises:
            ValueError: If the file is corrupt, or another item's.
        """
        if not self.finished:
            return None
        done = read_json(self.done, DONE_FIELDS)
        if done["key"] != self.key:
            raise ValueError(f"{self.done} must be of {self.key}, got {done['key']!r}: {_ADVICE}")
        return done


_ADVICE = "restore the file, or delete all files of this item and run it again"


def _number(value: float | None) -> str:
    """Five digits are more than a curve shows; whole numbers stay whole."""
    if value is None:
        return ""
    if not math.isfinite(value):
        raise ValueError(f"a measurement must be finite, got {value}")
    return str(value) if isinstance(value, int) else f"{value:.5g}"


def _parse(path: Path, number: int, line: str, columns: list[str]) -> Row:
    cells = line.rstrip("\n").split(",")
    try:
        if not line.endswith("\n") or len(cells) != len(columns):
            raise ValueError
        row: Row = {
            name: float(cell) if cell else None for name, cell in zip(columns, cells, strict=True)
        }
        if row["seed"] is None or row["step"] is None:
            raise ValueError
        if not all(value is None or math.isfinite(value) for value in row.values()):
            raise ValueError
    except ValueError:
        raise ValueError(
            f"{path}, line {number} must hold {len(columns)} finite numbers "
            f"({','.join(columns)}), got {line[:80]!r}: {_ADVICE}"
        ) from None
    return row


def _append(path: Path, text: str) -> None:
    with open(path, "a") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
