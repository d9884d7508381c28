"""Training an item, interrupted or not."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filelock import FileLock

from sb3_flowpolicy.common.machine import machine
from sb3_flowpolicy.experiments import training
from sb3_flowpolicy.experiments.experiment import Experiment
from sb3_flowpolicy.experiments.store import ItemFiles
from sb3_flowpolicy.experiments.training import run_item
from sb3_flowpolicy.experiments.work import WorkItem, make_plan, merge


@pytest.fixture
def item(tiny: Experiment) -> WorkItem:
    return make_plan(tiny).items[1]


def quiet(key: str, step: int) -> None:
    pass


def contents(folder: Path) -> dict[str, bytes]:
    return {
        path.name: path.read_bytes()
        for path in folder.iterdir()
        if path.suffix in (".csv", ".jsonl")
    }


def test_everything_is_measured(item: WorkItem, tmp_path: Path) -> None:
    steps: list[int] = []
    run_item(item, tmp_path, lambda key, step: steps.append(step))
    files = ItemFiles(tmp_path, item.key)
    assert steps == [0, 20, 40, 60, 80, 100, 120]
    rows = files.read_rows()
    assert [(row["seed"], row["step"]) for row in rows[:3]] == [(1, 20), (2, 20), (1, 40)]
    assert len(rows) == 12
    last = rows[-1]
    assert all(value is not None for value in last.values())
    assert last["ent_coef"] < 1  # type: ignore[operator]
    assert -5 < last["entropy"] < 2 * np.log(2) + 0.01  # type: ignore[operator]
    assert sum(row["episodes"] for row in rows) > 12  # type: ignore[misc]
    kinds = [(one["kind"], one["seed"], one["step"]) for one in files.read_details()]
    assert kinds == [
        ("picture", 1, 60),
        ("picture", 1, 120),
        ("profile", 1, 120),
        ("profile", 2, 120),
    ]
    done = files.read_done()
    assert done is not None
    assert done["sessions"] == 1
    assert {"commit", "versions", "processor", "date"} <= done["machine"].keys()
    assert not files.checkpoints.exists()


class Crash(BaseException):
    """Not an error that anybody would catch."""


GSDE = {"policy": "GaussPolicy", "use_sde": True, "train_freq": 8, "gradient_steps": 8}


@pytest.mark.parametrize(("crashes", "overrides"), [([0, 3], {}), ([1, 1, 2], {}), ([1, 2], GSDE)])
def test_interrupted_runs_end_with_the_same_results(
    crashes: list[int], overrides: dict[str, Any], item: WorkItem, tmp_path: Path
) -> None:
    """A crash after so many reports of a session; half a line is left behind."""
    hyperparameters = merge(item.hyperparameters, overrides)
    measures = () if overrides else item.measures
    item = replace(item, hyperparameters=hyperparameters, measures=measures)
    straight, folder = tmp_path / "straight", tmp_path / "interrupted"
    straight.mkdir()
    folder.mkdir()
    run_item(item, straight, quiet)
    files = ItemFiles(folder, item.key)
    for count in crashes:
        reports = []

        def crash(key: str, step: int, reports=reports, count=count) -> None:
            reports.append(step)
            if len(reports) > count:
                with open(files.table, "a") as file:
                    file.write("1,13")
                raise Crash

        with pytest.raises(Crash):
            run_item(item, folder, crash)
        assert not files.finished
    run_item(item, folder, quiet)
    assert contents(folder) == contents(straight)
    done = files.read_done()
    assert done is not None
    assert done["steps"] == 120


def _interrupt(item: WorkItem, folder: Path) -> ItemFiles:
    """Leave an item after its second checkpoint."""

    def crash(key: str, step: int) -> None:
        if step >= 60:
            raise Crash

    with pytest.raises(Crash):
        run_item(item, folder, crash)
    return ItemFiles(folder, item.key)


def test_all_commits_of_a_run_are_noted(
    item: WorkItem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "machine", lambda: {**machine(), "commit": "abc-dirty"})
    files = _interrupt(item, tmp_path)
    monkeypatch.setattr(training, "machine", lambda: {**machine(), "commit": "def"})
    run_item(item, tmp_path, quiet)
    done = files.read_done()
    assert done is not None
    assert done["commits"] == ["abc-dirty", "def"]
    assert done["machine"]["commit"] == "def"


def test_a_number_changed_behind_a_checkpoint_is_noticed(item: WorkItem, tmp_path: Path) -> None:
    files = _interrupt(item, tmp_path)
    text = files.table.read_text()
    files.table.write_text(text.replace("1,20,", "1,21,", 1))
    with pytest.raises(ValueError, match="must hold what was written, got something else"):
        run_item(item, tmp_path, quiet)
    files.table.write_text(text)
    run_item(item, tmp_path, quiet)
    assert files.finished


@pytest.mark.parametrize("overrides", [{}, GSDE], ids=["batch", "separate"])
def test_half_a_checkpoint_is_named(
    overrides: dict[str, Any], item: WorkItem, tmp_path: Path
) -> None:
    hyperparameters = merge(item.hyperparameters, overrides)
    item = replace(item, hyperparameters=hyperparameters, measures=(), pictures_at=())
    files = _interrupt(item, tmp_path)
    for path in (path for path in files.checkpoints.rglob("*") if path.suffix != ".json"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(ValueError, match=r"step_0+\d+ must hold a whole checkpoint, got"):
        run_item(item, tmp_path, quiet)


def test_a_state_without_its_fields_is_named(item: WorkItem, tmp_path: Path) -> None:
    files = _interrupt(item, tmp_path)
    next(files.checkpoints.glob("step_*/state.json")).write_text("{}")
    with pytest.raises(ValueError, match=r"state\.json must hold 'step' \(int\), got {}"):
        run_item(item, tmp_path, quiet)
    next(files.checkpoints.glob("step_*/state.json")).unlink()
    with pytest.raises(ValueError, match=r"step_0+\d+ must hold state\.json: delete .* to repeat"):
        run_item(item, tmp_path, quiet)


def test_a_crash_while_saving_leaves_the_last_checkpoint(
    item: WorkItem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writes = []
    write = training.write_json

    def fail_at_third(path: Path, content: dict) -> None:
        writes.append(path)
        if len(writes) == 3:
            raise Crash
        write(path, content)

    with monkeypatch.context() as patch:
        patch.setattr(training, "write_json", fail_at_third)
        with pytest.raises(Crash):
            run_item(item, tmp_path, quiet)
    first: list[int] = []
    run_item(item, tmp_path, lambda key, step: first.append(step))
    assert first[0] == 40
    assert len(ItemFiles(tmp_path, item.key).read_rows()) == 12


def test_a_finished_item_is_not_repeated(item: WorkItem, tmp_path: Path) -> None:
    ItemFiles(tmp_path, item.key).finish({})
    run_item(item, tmp_path, quiet)
    assert not ItemFiles(tmp_path, item.key).table.exists()


def test_two_processes_do_not_share_an_item(
    item: WorkItem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "_LOCK_SECONDS", 0.1)
    with (
        FileLock(tmp_path / f".{item.key}.lock"),
        pytest.raises(ValueError, match="another is at work on circle-flow"),
    ):
        run_item(item, tmp_path, quiet)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full")
def test_a_full_disk_is_an_error_that_names_the_file(item: WorkItem, tmp_path: Path) -> None:
    files = ItemFiles(tmp_path, item.key)
    files.table.symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left on device"):
        run_item(item, tmp_path, quiet)
    assert not files.finished
    files.table.unlink()
    run_item(item, tmp_path, quiet)
    assert len(files.read_rows()) == 12
