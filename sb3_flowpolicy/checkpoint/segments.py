"""A replay buffer on disk, as files of rows: a checkpoint adds only what is new."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

# Small files are merged into the next one up to this size: few files, and little written twice.
_MERGED_BYTES = 16_000_000


@dataclass(frozen=True)
class Ring:
    """A replay buffer: a ring of rows, in columns.

    Args:
        columns: Name -> array, (capacity, ...).
        pos: Where the next row goes.
        full: Whether all rows are filled.
        source: The object that it belongs to, to detect that it was replaced.
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

    def rows(self, first: int, end: int) -> dict[str, np.ndarray]:
        """Return rows by serial number: row number n is at n modulo the capacity."""
        start, stop = first % self.capacity, (end - 1) % self.capacity + 1
        if start < stop:
            return {name: column[start:stop] for name, column in self.columns.items()}
        return {
            name: np.concatenate([column[start:], column[:stop]])
            for name, column in self.columns.items()
        }


@dataclass(frozen=True)
class Segment:
    """A file of consecutive rows, by serial number, from ``first`` up to ``end``."""

    file: str
    first: int
    end: int


class RowFiles:
    """Files that together hold a ring as it was at the last checkpoint.

    Args:
        source: The ring's source.
        segments: The files, oldest rows first.
        steps: Rows that had been added in the life of the agent.
    """

    def __init__(
        self, source: object = None, segments: Sequence[Segment] = (), steps: int = 0
    ) -> None:
        self.source = source
        self.segments = list(segments)
        self.steps = steps

    def update(self, ring: Ring, steps: int, path: Path) -> list[Segment]:
        """Write the new rows; all rows, unless ``steps`` explains how the ring has moved.

        Args:
            ring: The ring as it is now.
            steps: Rows added in the life of the agent.
            path: File for the new rows; not written if there are none.

        Returns:
            The files, oldest rows first, that hold all rows now.
        """
        added = steps - self.steps
        end = self.segments[-1].end + added if self.segments else -1
        follows = (
            ring.source is self.source
            and 0 <= added < ring.capacity
            and end % ring.capacity == ring.pos
            and ring.full == (end >= ring.capacity)
        )
        kept = list(self.segments) if follows else []
        if not follows:
            end = ring.pos + (ring.capacity if ring.full else 0)
        oldest = end - ring.size
        first = kept[-1].end if kept else oldest
        if first < end:
            width = sum(column[0].nbytes for column in ring.columns.values())
            while kept and (end - kept[-1].first) * width <= _MERGED_BYTES:
                if kept[-1].end - kept[-1].first > end - first:
                    break
                first = max(kept.pop().first, oldest)
            with path.open("wb") as file:
                np.savez(file, allow_pickle=False, **ring.rows(first, end))
            kept.append(Segment(path.name, first, end))
        self.source, self.steps = ring.source, steps
        self.segments = [segment for segment in kept if segment.end > oldest]
        return self.segments


def fill(columns: Mapping[str, np.ndarray], folder: Path, segments: Sequence[Segment]) -> None:
    """Read files into the columns of a ring, (capacity, ...)."""
    for segment in segments:
        with np.load(folder / segment.file, allow_pickle=False) as rows:
            for name, column in columns.items():
                column[np.arange(segment.first, segment.end) % len(column)] = rows[name]
