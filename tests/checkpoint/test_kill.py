"""SIGKILL at random moments, the short form; the long one is the script itself."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.checkpoint import kill_and_resume


def tally(*options: str) -> str:
    script = str(Path(kill_and_resume.__file__))
    result = subprocess.run([sys.executable, script, *options], capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def test_killed_run_is_the_undisturbed_one() -> None:
    options = ("--agents", "SACFlow", "--engines", "eager", "--steps", "400", "--every", "40")
    printed = tally("--moments", "2", *options)
    assert "2 kills in 1 runs, 1 runs equal, 0 not" in printed


@pytest.mark.slow
def test_killed_runs_of_all_kinds_are_the_undisturbed_ones() -> None:
    assert "50 kills in 4 runs, 4 runs equal, 0 not" in tally("--moments", "50")


def test_a_difference_is_seen(tmp_path: Path) -> None:
    for seed, name in enumerate(("one", "other")):
        (tmp_path / name).mkdir()
        kill_and_resume.train("SACFlow", "eager", 250, 0, tmp_path / name, seed)
    found = kill_and_resume.compare(tmp_path / "one", tmp_path / "other")
    assert "agent 0: buffer observations" in found
    assert any("progress.csv" in name for name in found)
    assert any("monitor.csv" in name for name in found)
