"""A replay buffer on disk, as files of rows; a checkpoint writes only those that changed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

# Files are written again when one of their rows has changed; smaller files would be too many.
_FILE_BYTES = 4_000_000


@dataclass(frozen=True)
class Ring:
    """A replay buffer: a ring of rows, in columns.

    Args:
        columns: Name -> array, (capacity, ...).
        pos: Where the next row goes.
        full: Whether all rows are filled.
        source: The object that holds the rows, to detect its replacement.
    """

    columns: Mapping[str, np.ndarray]
    pos: int
    full: bool
    source: object

    @property
    def capacity(self) -> int:
        """Number of rows that fit."""
        return len(next(iter(self.columns.values())))

    @property
    def size(self) -> int:
        """Number of rows that are filled."""
        return self.capacity if self.full else self.pos


class RowFiles:
    """The files that hold a ring as it was at the last checkpoint.

    A manifest describes each as ``{"file": name, "first": 0, "end": 1000}``, with the rows that it
    holds.
    """

    def __init__(self) -> None:
        self._ring: Ring | None = None
        self._steps = 0
        self._files: Sequence[dict[str, Any]] = ()

    def note(self, ring: Ring, steps: int, files: Sequence[dict[str, Any]]) -> None:
        """Remember that these files hold the ring as it is now, after ``steps`` steps."""
        self._ring, self._steps, self._files = ring, steps, files

    def write(self, ring: Ring, steps: int, prefix: Path) -> list[dict[str, Any]]:
        """Write the rows that were added since :meth:`note`.

        ``prefix`` is the path and the first part of the names of new files. Returns the files,
        earlier ones included, that hold all rows now.
        """
        width = sum(column[0].nbytes for column in ring.columns.values())
        length = max(1, _FILE_BYTES // width)
        known = {(one["first"], one["end"]): one for one in self._files}
        added = self._added(ring, steps)
        files = []
        for first in range(0, ring.size, length):
            end = min(first + length, ring.size)
            # New rows are those before the position, and around the end of the ring.
            behind = end > ring.capacity + ring.pos - added
            changed = behind or (added > 0 and first < ring.pos and end > ring.pos - added)
            if changed or (first, end) not in known:
                path = prefix.with_name(f"{prefix.name}-{first}.npz")
                rows = {name: column[first:end] for name, column in ring.columns.items()}
                with path.open("wb") as file:
                    np.savez(file, allow_pickle=False, **rows)
                known[first, end] = {"file": path.name, "first": first, "end": end}
            files.append(known[first, end])
        return files

    def _added(self, ring: Ring, steps: int) -> int:
        """Count the new rows: all of them, unless ``steps`` explains the position of the ring."""
        before, added = self._ring, steps - self._steps
        if (
            before is not None
            and before.source is ring.source
            and 0 <= added < ring.capacity
            and (before.pos + added) % ring.capacity == ring.pos
        ):
            return added
        return ring.size


def fill(
    columns: Mapping[str, np.ndarray], folder: Path, files: Sequence[Mapping[str, Any]]
) -> None:
    """Read files into the columns of a ring, (capacity, ...)."""
    for one in files:
        with np.load(folder / one["file"], allow_pickle=False) as rows:
            for name, column in columns.items():
                # Earlier versions counted rows on around the ring.
                column[np.arange(one["first"], one["end"]) % len(column)] = rows[name]
