"""`python -m sb3_flowpolicy.experiments`: what a user types, and what goes wrong."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from filelock import FileLock

from sb3_flowpolicy.experiments.__main__ import main
from sb3_flowpolicy.experiments.experiment import Experiment
from sb3_flowpolicy.experiments.manifest import EXPERIMENTS
from tests.experiments.conftest import contents


def test_list_shows_every_experiment(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    for name in EXPERIMENTS:
        assert any(line.startswith(f"{name} ") for line in lines)


def test_a_run_leaves_results_and_is_not_repeated(
    tiny: Experiment, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["run", "tiny", "--out", str(tmp_path), "--workers", "2"]
    assert main(command) == 0
    captured = capsys.readouterr()
    assert "2 items of 120 steps x 2 seeds, 0 finished before" in captured.out
    assert "all: 100%" in captured.err
    folder = tmp_path / "tiny"
    found = contents(folder)
    assert {"circle-gauss.csv", "circle-flow.csv"} <= found.keys()
    stamps = [path.stat().st_mtime_ns for path in sorted(folder.glob("*.csv"))]
    assert main([*command, "--no-progress"]) == 0
    captured = capsys.readouterr()
    assert "2 finished before" in captured.out
    assert "%" not in captured.err
    assert [path.stat().st_mtime_ns for path in sorted(folder.glob("*.csv"))] == stamps

    # The same folder takes no results of other settings, and is left as it was.
    assert main([*command, "--steps", "90", "--first-seed", "2"]) == 1
    error = capsys.readouterr().err
    assert "must hold results of the same settings" in error
    assert "items.circle-flow.seeds: there [1, 2], now [2, 3]" in error
    assert "steps: there 120, now 90" in error
    assert contents(folder) == found


def test_tuning_changes_the_environment_and_leaves_agents_out(
    tiny: Experiment, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["run", "tiny", "--first-seed", "100", "--seeds", "1", "--steps", "60"]
    command += ["--agents", "gauss", "--set", "dense_reward=0.2", "width=0.5"]
    assert main([*command, "--out", str(tmp_path), "--workers", "1", "--no-progress"]) == 0
    items = json.loads((tmp_path / "tiny" / "settings.json").read_text())["items"]
    assert list(items) == ["circle-gauss"]
    assert items["circle-gauss"]["env_kwargs"] == {"dense_reward": 0.2, "width": 0.5}
    for wrong, message in (
        (["tiny", "--set", "width"], "must be NAME=VALUE, got 'width'"),
        (["tiny", "--workers", "0"], "argument --workers: value must be an integer of at least 1"),
        (["sparse-fixed-alfa"], "invalid choice: 'sparse-fixed-alfa' (choose from"),
    ):
        with pytest.raises(SystemExit, match="2"):
            main(["run", *wrong])
        assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["tiny", "--set", "dens_reward=1"], "--set must name arguments of"),
        (["tiny", "--set", "max_episode_steps=9"], "--set must name arguments of"),
        (["tiny", "--agents", "flow", "lr"], "agents of tiny must be among ['gauss', 'flow'], got"),
        (["tiny", "--address", "auto"], "--address needs --backend ray, got 'local'"),
    ],
)
def test_wrong_arguments_are_errors_that_help(
    arguments: list[str],
    message: str,
    tiny: Experiment,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["run", *arguments, "--out", str(tmp_path)]) == 1
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full")
def test_a_full_disk_ends_the_run_with_one_sentence(
    tiny: Experiment, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "tiny").mkdir()
    command = ["run", "tiny", "--out", str(tmp_path), "--workers", "1", "--no-progress"]
    details = tmp_path / "tiny" / "circle-gauss.details.jsonl"
    details.symlink_to("/dev/full")
    assert main(command) == 1
    error = capsys.readouterr().err
    assert "No space left on device" in error
    assert "Finished items are kept" in error
    details.unlink()
    assert main(command) == 0


def test_two_runs_do_not_share_a_folder(
    tiny: Experiment, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "tiny").mkdir()
    with FileLock(tmp_path / "tiny" / ".run.lock"):
        assert main(["run", "tiny", "--out", str(tmp_path)]) == 1
    assert "must be used by one run at a time" in capsys.readouterr().err


def test_a_report_of_nothing_says_how_to_make_something(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", "--results", str(tmp_path)]) == 1
    assert "experiments run NAME makes some" in capsys.readouterr().err
    assert main(["report", "--results", str(tmp_path), "--html", str(tmp_path)]) == 1
    assert "--html must be a file, got the folder" in capsys.readouterr().err


def _command(out: Path) -> list[str]:
    module = [sys.executable, "-m", "sb3_flowpolicy.experiments", "run", "sparse-fixed-alpha"]
    options = ["--steps", "1500", "--seeds", "2", "--workers", "2", "--no-progress"]
    return [*module, *options, "--out", str(out)]


@pytest.mark.slow
def test_killed_at_random_moments_it_ends_with_the_same_results(tmp_path: Path) -> None:
    """SIGKILL for the runner alone: its processes have to notice by themselves."""
    straight, killed = tmp_path / "straight", tmp_path / "killed"
    start = time.monotonic()
    subprocess.run(_command(straight), check=True, capture_output=True)
    duration = time.monotonic() - start
    rng = random.Random(0)
    kills = 0
    for _ in range(5):
        process = subprocess.Popen(
            _command(killed), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        try:
            process.wait(rng.uniform(0.25, 0.5) * duration)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            kills += 1
        process.wait()
    assert kills >= 3
    subprocess.run(_command(killed), check=True, capture_output=True)
    results = contents(straight / "sparse-fixed-alpha")
    assert len(results) == 12
    assert contents(killed / "sparse-fixed-alpha") == results
    done = [json.loads(path.read_text()) for path in killed.rglob("*.done.json")]
    assert len(done) == 6
    assert sum(one["sessions"] for one in done) > 6
