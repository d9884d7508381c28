"""Rows on disk: whatever was added between checkpoints, the newest files hold the ring."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_flowpolicy.checkpoint import segments
from sb3_flowpolicy.checkpoint.segments import Ring, RowFiles, fill

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


def check(buffer: Buffer, folder: Path, files: list[segments.Segment]) -> None:
    read = {name: np.zeros_like(column) for name, column in buffer.columns.items()}
    fill(read, folder, files)
    for name, column in buffer.columns.items():
        np.testing.assert_array_equal(read[name], column)


@settings(deadline=None)
@given(
    before=st.integers(0, 2 * CAPACITY),
    added=st.lists(st.integers(0, CAPACITY + 3), max_size=12),
    merged=st.sampled_from([0, 150, 10_000]),
)
def test_the_files_hold_the_ring(before: int, added: list[int], merged: int) -> None:
    with tempfile.TemporaryDirectory() as scratch, pytest.MonkeyPatch.context() as patch:
        patch.setattr(segments, "_MERGED_BYTES", merged)
        folder, buffer, rows = Path(scratch), Buffer(), RowFiles()
        buffer.add(before)
        for number, count in enumerate([0, *added]):
            buffer.add(count)
            files = rows.update(buffer.ring(), buffer.steps, folder / f"{number}.npz")
            check(buffer, folder, files)


def test_only_new_rows_are_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(segments, "_MERGED_BYTES", 0)
    buffer, rows = Buffer(), RowFiles()
    buffer.add(5)
    rows.update(buffer.ring(), buffer.steps, tmp_path / "1.npz")
    buffer.add(2)
    files = rows.update(buffer.ring(), buffer.steps, tmp_path / "2.npz")
    assert [(one.file, one.first, one.end) for one in files] == [("1.npz", 0, 5), ("2.npz", 5, 7)]
    rows.update(buffer.ring(), buffer.steps, tmp_path / "3.npz")
    assert not (tmp_path / "3.npz").exists()
    # Rows that have left the ring need no file.
    buffer.add(11)
    files = rows.update(buffer.ring(), buffer.steps, tmp_path / "4.npz")
    assert [one.file for one in files] == ["2.npz", "4.npz"]


def test_small_files_are_merged(tmp_path: Path) -> None:
    buffer, rows = Buffer(), RowFiles()
    for number in range(100):
        buffer.add(1)
        files = rows.update(buffer.ring(), buffer.steps, tmp_path / f"{number}.npz")
        assert len(files) <= 5
        check(buffer, tmp_path, files)


@pytest.mark.parametrize("meddle", ["reset", "replaced", "demonstrations"])
def test_what_steps_do_not_explain_is_written_anew(meddle: str, tmp_path: Path) -> None:
    buffer, rows = Buffer(), RowFiles()
    buffer.add(8)
    rows.update(buffer.ring(), buffer.steps, tmp_path / "1.npz")
    if meddle == "reset":
        buffer.pos = 0
    elif meddle == "replaced":
        buffer = Buffer(buffer.pos, buffer.full, buffer.steps)
    else:
        buffer.add(1)
        buffer.steps -= 1
    files = rows.update(buffer.ring(), buffer.steps, tmp_path / "2.npz")
    read = {name: np.zeros_like(column) for name, column in buffer.columns.items()}
    fill(read, tmp_path, files)
    for name, column in buffer.columns.items():
        np.testing.assert_array_equal(read[name][: buffer.pos], column[: buffer.pos])
