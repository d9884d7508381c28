"""Rows on disk: whatever was added between checkpoints, the newest files hold the ring."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_flowpolicy.checkpoint import rows as row_files
from sb3_flowpolicy.checkpoint.rows import Ring, RowFiles, fill

CAPACITY = 12


@dataclass
class Buffer:
    """A ring of numbered rows."""

    pos: int = 0
    full: bool = False
    steps: int = 0
    columns: dict[str, np.ndarray] = field(
        default_factory=lambda: {
            "obs": np.zeros((CAPACITY, 2, 3), np.float32),
            "done": np.zeros((CAPACITY, 2), np.uint8),
        }
    )

    def add(self, count: int) -> None:
        for _ in range(count):
            self.steps += 1
            for column in self.columns.values():
                column[self.pos] = self.steps
            self.pos = (self.pos + 1) % CAPACITY
            self.full = self.full or self.pos == 0

    def ring(self) -> Ring:
        return Ring(self.columns, self.pos, self.full, self)


def write(buffer: Buffer, rows: RowFiles, prefix: Path) -> list[dict[str, Any]]:
    files = rows.write(buffer.ring(), buffer.steps, prefix)
    rows.note(buffer.ring(), buffer.steps, files)
    return files


def check(buffer: Buffer, folder: Path, files: list[dict[str, Any]]) -> None:
    read = {name: np.zeros_like(column) for name, column in buffer.columns.items()}
    fill(read, folder, files)
    for name, column in buffer.columns.items():
        filled = CAPACITY if buffer.full else buffer.pos
        np.testing.assert_array_equal(read[name][:filled], column[:filled])


@settings(deadline=None)
@given(
    before=st.integers(0, 2 * CAPACITY),
    added=st.lists(st.integers(0, CAPACITY + 3), max_size=12),
    bytes_per_file=st.sampled_from([0, 80, 150, 10_000]),
)
def test_the_files_hold_the_ring(before: int, added: list[int], bytes_per_file: int) -> None:
    with tempfile.TemporaryDirectory() as scratch, pytest.MonkeyPatch.context() as patch:
        patch.setattr(row_files, "_FILE_BYTES", bytes_per_file)
        folder, buffer, rows = Path(scratch), Buffer(), RowFiles()
        buffer.add(before)
        for number, count in enumerate([0, *added]):
            buffer.add(count)
            check(buffer, folder, write(buffer, rows, folder / str(number)))


def test_only_files_with_new_rows_are_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(row_files, "_FILE_BYTES", 3 * 26)  # three rows
    buffer, rows = Buffer(), RowFiles()
    buffer.add(5)
    names = [one["file"] for one in write(buffer, rows, tmp_path / "1")]
    assert names == ["1-0.npz", "1-3.npz"]
    buffer.add(2)
    names = [one["file"] for one in write(buffer, rows, tmp_path / "2")]
    assert names == ["1-0.npz", "2-3.npz", "2-6.npz"]
    assert [one["file"] for one in write(buffer, rows, tmp_path / "3")] == names
    # Around the end of the ring.
    buffer.add(8)
    names = [one["file"] for one in write(buffer, rows, tmp_path / "4")]
    assert names == ["4-0.npz", "2-3.npz", "4-6.npz", "4-9.npz"]


@pytest.mark.parametrize("meddle", ["reset", "replaced", "demonstrations"])
def test_what_steps_do_not_explain_is_written_anew(meddle: str, tmp_path: Path) -> None:
    buffer, rows = Buffer(), RowFiles()
    buffer.add(8)
    write(buffer, rows, tmp_path / "1")
    if meddle == "reset":
        buffer.pos = 0
    elif meddle == "replaced":
        buffer = Buffer(buffer.pos, buffer.full, buffer.steps)
    else:
        buffer.add(1)
        buffer.steps -= 1
    check(buffer, tmp_path, write(buffer, rows, tmp_path / "2"))


def test_files_of_other_lengths_are_read_and_replaced(tmp_path: Path) -> None:
    """Earlier versions of this package wrote them, with rows counted on around the ring."""
    buffer, rows = Buffer(), RowFiles()
    buffer.add(CAPACITY + 3)
    for name, first, end in (("old-1", 3, 10), ("old-2", 10, CAPACITY + 3)):
        index = np.arange(first, end) % CAPACITY
        np.savez(tmp_path / name, **{key: one[index] for key, one in buffer.columns.items()})
    files = [
        {"file": "old-1.npz", "first": 3, "end": 10},
        {"file": "old-2.npz", "first": 10, "end": CAPACITY + 3},
    ]
    check(buffer, tmp_path, files)
    rows.note(buffer.ring(), buffer.steps, files)
    files = write(buffer, rows, tmp_path / "new")
    assert [one["file"] for one in files] == ["new-0.npz"]
    check(buffer, tmp_path, files)
