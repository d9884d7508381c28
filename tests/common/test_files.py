"""Files are replaced as a whole or not at all."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from sb3_flowpolicy.common import files


def write_half(path: Path) -> None:
    with files.replacing(path) as draft:
        draft.write_text("half a ")
        raise KeyboardInterrupt


def test_an_interrupted_write_leaves_what_was_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "result.json"
    files.write_json(path, {"rate": 1.5})
    before = path.read_text()

    def full(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(files.os, "replace", full)
    with pytest.raises(OSError, match="disk full"):
        files.write_json(path, {"rate": 2.5})
    with pytest.raises(KeyboardInterrupt):
        write_half(path)
    assert path.read_text() == before
    assert files.read_json(path) == {"rate": 1.5}
    assert list(tmp_path.iterdir()) == [path]


def test_other_users_may_read_the_file(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    files.write_json(path, {})
    assert stat.S_IMODE(path.stat().st_mode) == 0o644
