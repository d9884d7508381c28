"""Results on disk: append-only files per work item, and a folder that keeps to one setting.

A folder holds, per experiment, ``settings.json`` and three files per item:

=======================  ======================================================================
``KEY.csv``              one line per measurement and seed, appended as the run goes
``KEY.details.jsonl``    what does not fit a table: the policy's entropy along the path, samples
``KEY.done.json``        written last; commit, versions, machine and time
=======================  ======================================================================

and ``checkpoints/KEY`` while the item is unfinished.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

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

    def lengths(self) -> dict[str, int]:
        """Return how long the files are: what a checkpoint has to remember."""
        paths = {"table": self.table, "details": self.details}
        return {name: path.stat().st_size if path.exists() else 0 for name, path in paths.items()}

    def cut_to(self, lengths: Mapping[str, int]) -> None:
        """Drop what was written after a checkpoint, half a line perhaps.

        Raises:
            ValueError: If a file is shorter than it was at the checkpoint.
        """
        for name, path in {"table": self.table, "details": self.details}.items():
            size = path.stat().st_size if path.exists() else 0
            if size < lengths[name]:
                raise ValueError(
                    f"{path} must hold the {lengths[name]} bytes that were there at the last "
                    f"checkpoint, got {size}: restore it, or delete {self.checkpoints} and "
                    f"{self.table} to repeat this item"
                )
            if size > lengths[name]:
                os.truncate(path, lengths[name])

    def finish(self, facts: Mapping[str, Any]) -> None:
        """Declare the item complete and drop its checkpoints."""
        write_json(self.done, facts)
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
            if not isinstance(detail, dict):
                raise ValueError(
                    f"{self.details}, line {number} must be an object, got {line[:60]!r}: {_ADVICE}"
                )
            found.append(detail)
        return found

    def read_done(self) -> dict[str, Any] | None:
        """Return the facts of a finished item, None of an unfinished one.

        Raises:
            ValueError: If the file is corrupt.
        """
        return read_json(self.done) if self.finished else None


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


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a file at once or not at all."""
    write_text(path, json.dumps(content, indent=1) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a file at once or not at all."""
    handle, temporary = tempfile.mkstemp(prefix=path.name, suffix=".tmp", dir=path.parent)
    try:
        with os.fdopen(handle, "w") as file:
            file.write(text)
        os.chmod(temporary, 0o644)  # mkstemp's files are for their owner alone
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def read_json(path: Path) -> dict[str, Any]:
    """Read an object.

    Raises:
        ValueError: If the file holds none.
    """
    try:
        content = json.loads(path.read_text())
    except json.JSONDecodeError as error:
        raise ValueError(f"{path} must be JSON, got an error in line {error.lineno}") from error
    except (ValueError, RecursionError) as error:  # other encodings, a hundred thousand brackets
        raise ValueError(f"{path} must be JSON, got {error}") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold an object, got {type(content).__name__}")
    return content


def claim_folder(folder: Path, settings: Mapping[str, Any]) -> None:
    """Make a folder belong to these settings, or check that it does.

    Raises:
        ValueError: If it holds results of other settings; the message names the differences.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "settings.json"
    wanted = json.loads(json.dumps(settings))
    if not path.exists():
        strays = [one.name for one in folder.glob("*.csv")]
        if strays:
            raise ValueError(f"{folder} must be new or have its settings.json, got only {strays}")
        return write_json(path, settings)
    found = read_json(path)
    if found != wanted:
        differences = "; ".join(_differences(found, wanted)[:5])
        raise ValueError(
            f"{folder} must hold results of the same settings, got others ({differences}). "
            "Choose another folder with --out, or run with the settings it was made with"
        )


def _differences(found: Any, wanted: Any, where: str = "") -> list[str]:
    """Say in which leaves two nested objects differ."""
    if isinstance(found, dict) and isinstance(wanted, dict):
        parts = []
        for key in sorted(found.keys() | wanted.keys()):
            place = f"{where}.{key}" if where else key
            parts += _differences(found.get(key), wanted.get(key), place)
        return parts
    if found == wanted:
        return []
    return [f"{where}: there {_short(found)}, now {_short(wanted)}"]


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "..."
