"""Files of results: nothing lost, nothing mixed, nothing corrupt read as if it were sound."""

from __future__ import annotations

from pathlib import Path

import pytest

from sb3_flowpolicy.experiments.store import BASIC_COLUMNS, ItemFiles

ROW = dict.fromkeys(BASIC_COLUMNS, 0.25) | {"seed": 1, "step": 100, "train_success": None}


@pytest.fixture
def files(tmp_path: Path) -> ItemFiles:
    found = ItemFiles(tmp_path, "circle-flow")
    found.append_rows([ROW, {**ROW, "seed": 2}])
    found.append_rows([{**ROW, "step": 200}])
    return found


def test_rows_come_back(files: ItemFiles) -> None:
    table = files.read_table()
    assert table[["seed", "step"]].to_numpy().tolist() == [[1, 100], [2, 100], [1, 200]]
    assert table["train_success"].isna().all()
    assert table["entropy"][0] == 0.25


def test_a_corrupt_line_is_noticed(files: ItemFiles) -> None:
    with open(files.table, "a") as file:
        file.write("1,300,oops,0,0,0,0,0,0\n")
    with pytest.raises(ValueError, match=r"circle-flow\.csv must hold numbers: .*'oops'"):
        files.read_table()


def test_half_a_line_is_not_read_and_goes_when_the_run_goes_on(files: ItemFiles) -> None:
    whole, noted = files.table.read_bytes(), files.fingerprint()
    with open(files.table, "a") as file:
        file.write("1,300,0.1")
    assert len(files.read_table()) == 3
    files.cut_to(noted)
    assert files.table.read_bytes() == whole


def test_lines_that_vanished_are_noticed(files: ItemFiles) -> None:
    noted = files.fingerprint()
    files.table.write_text("")
    with pytest.raises(ValueError, match=r"circle-flow\.csv and .* must hold the \d+ and 0 bytes"):
        files.cut_to(noted)


def test_nothing_infinite_is_written(files: ItemFiles) -> None:
    before = files.table.read_bytes()
    with pytest.raises(ValueError, match="must be finite, got nan"):
        files.append_rows([{**ROW, "entropy": float("nan")}])
    assert files.table.read_bytes() == before
