"""Training an item, interrupted or not."""

from __future__ import annotations

import signal
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from filelock import FileLock

from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.checkpoint import state
from sb3_flowpolicy.checkpoint.state import Run
from sb3_flowpolicy.common.machine import machine
from sb3_flowpolicy.engine import EngineRuntime
from sb3_flowpolicy.experiments import training
from sb3_flowpolicy.experiments.experiment import Experiment
from sb3_flowpolicy.experiments.store import ItemFiles
from sb3_flowpolicy.experiments.training import run_item
from sb3_flowpolicy.experiments.work import WorkItem, make_plan
from sb3_flowpolicy.seeds.experience import SeedExperience
from tests.experiments.conftest import contents


@pytest.fixture
def item(tiny: Experiment) -> WorkItem:
    return make_plan(tiny).items[1]


def quiet(key: str, step: int) -> None:
    pass


def trained(item: WorkItem, folder: Path) -> dict[str, bytes]:
    """What an item leaves that is not interrupted."""
    folder.mkdir()
    run_item(item, folder, quiet)
    return contents(folder)


def test_everything_is_measured(item: WorkItem, tmp_path: Path) -> None:
    steps: list[int] = []
    run_item(item, tmp_path, lambda key, step: steps.append(step))
    files = ItemFiles(tmp_path, item.key)
    assert steps == [0, 20, 40, 60, 80, 100, 120]
    rows = files.read_table().to_dict("records")
    assert [(row["seed"], row["step"]) for row in rows[:3]] == [(1, 20), (2, 20), (1, 40)]
    assert len(rows) == 12
    last = rows[-1]
    assert not np.isnan(list(last.values())).any()
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
    done = files.read_done(item.steps, item.seeds)
    assert done is not None
    assert done["sessions"] == 1
    assert {"commit", "versions", "processor", "date"} <= done["machine"].keys()
    assert not files.checkpoints.exists()
    agent = SACFlow.load(files.agent)
    assert (agent.seed, agent.num_timesteps) == (1, item.steps)


class Crash(BaseException):
    """An error that no handler catches."""


@pytest.mark.parametrize(("crashes", "every"), [([0, 3], 20), ([1, 3, 1, 2], 40)])
def test_interrupted_runs_end_with_the_same_results(
    crashes: list[int], every: int, item: WorkItem, tmp_path: Path
) -> None:
    """A crash after so many reports of a session; half a line is left behind."""
    item = replace(item, checkpoint_every=every)
    straight = trained(item, tmp_path / "straight")
    files = ItemFiles(tmp_path, item.key)
    for count in crashes:
        reports = []

        def crash(key: str, step: int, reports=reports, count=count) -> None:
            reports.append(step)
            if len(reports) > count:
                with open(files.table, "a") as file:
                    file.write("1,13")
                raise Crash

        with pytest.raises(Crash):
            run_item(item, tmp_path, crash)
        assert not files.finished
    run_item(item, tmp_path, quiet)
    assert contents(tmp_path) == straight
    done = files.read_done(item.steps, item.seeds)
    assert done is not None
    assert done["steps"] == 120


def test_a_run_that_was_told_to_stop_finishes_its_stage_later(
    item: WorkItem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """SIGTERM writes a checkpoint between two measurements."""
    straight = trained(item, tmp_path / "straight")
    step = SeedExperience.step

    def stop_at_50(self: SeedExperience, runtime: EngineRuntime) -> tuple:
        if self.models[0].num_timesteps == 50:
            signal.raise_signal(signal.SIGTERM)
        return step(self, runtime)

    with monkeypatch.context() as patch:
        patch.setattr(SeedExperience, "step", stop_at_50)
        with pytest.raises(SystemExit):
            run_item(item, tmp_path, quiet)
    assert list(ItemFiles(tmp_path, item.key).checkpoints.glob("*-step-51"))
    run_item(item, tmp_path, quiet)
    assert contents(tmp_path) == straight


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
    done = files.read_done(item.steps, item.seeds)
    assert done is not None
    assert done["commits"] == ["abc-dirty", "def"]
    assert done["machine"]["commit"] == "def"


def test_a_number_changed_behind_a_checkpoint_is_noticed(item: WorkItem, tmp_path: Path) -> None:
    files = _interrupt(item, tmp_path)
    text = files.table.read_text()
    files.table.write_text(text.replace("1,20,", "1,21,", 1))
    with pytest.raises(ValueError, match="or other contents"):
        run_item(item, tmp_path, quiet)
    files.table.write_text(text)
    run_item(item, tmp_path, quiet)
    assert files.finished


def test_damaged_checkpoints_are_named(item: WorkItem, tmp_path: Path) -> None:
    files = _interrupt(item, tmp_path)
    table = files.table.read_bytes()
    for path in (path for path in files.checkpoints.rglob("*") if path.suffix != ".json"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(ValueError, match=r"only damaged ones .*: delete .* to repeat this item"):
        run_item(item, tmp_path, quiet)
    assert files.table.read_bytes() == table


def test_one_damaged_checkpoint_costs_only_time(item: WorkItem, tmp_path: Path) -> None:
    """Rows are cut to the older checkpoint, too."""
    straight = trained(item, tmp_path / "straight")
    files = _interrupt(item, tmp_path)
    newest = max(files.checkpoints.glob("*-step-*"))
    (newest / "state.pt").write_bytes(b"")
    with pytest.warns(RuntimeWarning, match="newer checkpoints are damaged"):
        run_item(item, tmp_path, quiet)
    assert contents(tmp_path) == straight


def test_a_crash_while_saving_leaves_the_last_checkpoint(
    item: WorkItem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    straight = trained(item, tmp_path / "straight")
    writes = []
    collect = state.collect

    def fail_at_third(run: Run) -> dict[str, bytes]:
        writes.append(run)
        if len(writes) == 3:
            raise Crash
        return collect(run)

    with monkeypatch.context() as patch:
        patch.setattr(state, "collect", fail_at_third)
        with pytest.raises(Crash):
            run_item(item, tmp_path, quiet)
    steps: list[int] = []
    run_item(item, tmp_path, lambda key, step: steps.append(step))
    assert steps[0] == 0
    assert contents(tmp_path) == straight


class Locked(gym.Wrapper):
    """An environment that cannot be pickled, as simulators outside of Python cannot."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.generator = (value for value in range(3))


def test_environments_that_cannot_be_pickled_begin_new_episodes(
    item: WorkItem, tmp_path: Path
) -> None:
    gym.register("Locked-v0", entry_point=lambda: Locked(gym.make("TunnelCircle-v0")))
    item = replace(item, env_id="Locked-v0", measures=(), pictures_at=())
    with pytest.warns(RuntimeWarning, match="cannot be saved"):
        files = _interrupt(item, tmp_path)
    with pytest.warns(RuntimeWarning, match="resuming begins new episodes") as caught:
        run_item(item, tmp_path, quiet)
    assert sum("resuming begins" in str(one.message) for one in caught) == 1
    assert files.read_table().query("seed == 2")["step"].tolist() == [*range(20, 121, 20)]


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
