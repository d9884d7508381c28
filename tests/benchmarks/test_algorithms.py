"""Every policy class is trained beside the stock one, and no run twice."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import pytest

from sb3_flowpolicy.benchmarks import algorithms


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    task = algorithms.TASKS["tunnel-2"]
    few: Any = {"learning_starts": 20, "batch_size": 16, "buffer_size": 200}
    few |= {"policy_kwargs": {"net_arch": [8]}}
    rollout = {"n_steps": 16, "batch_size": 16, "n_epochs": 1, "normalize": True}
    settings = {"tqc": few, "crossq": few, "ppo": rollout}
    task = task._replace(steps=dict.fromkeys(settings, 96), settings=settings)
    monkeypatch.setitem(algorithms.TASKS, "tunnel-2", task)


@pytest.mark.usefixtures("quick")
def test_runs_are_recorded_and_not_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "table.csv"
    command = ["--task", "tunnel-2", "--episodes", "1", "--csv", str(table), "--seeds", "3"]
    algorithms.main([*command, "--algorithms", "tqc", "ppo"])
    rows = list(csv.DictReader(table.open()))
    runs = {(row["algorithm"], row["policy"]) for row in rows}
    assert runs == {("tqc", name) for name in ("stock", "gauss", "lowrank", "flow")} | {
        ("ppo", name)
        for name in ("stock", "gauss", "lowrank", "flow", "lowrank-squashed", "flow-squashed")
    }
    assert len(rows) == 6 * len(runs)
    assert [int(row["step"]) for row in rows[:6]] == [16, 32, 48, 64, 80, 96]
    assert all(0 <= float(row["test_success"]) <= 1 for row in rows)
    assert "| tunnel-2 | ppo | flow |" in capsys.readouterr().out
    trained = []
    train = algorithms.train
    monkeypatch.setattr(algorithms, "train", lambda *run: trained.append(run[1:3]) or train(*run))
    algorithms.main([*command, "--algorithms", "ppo", "crossq"])
    assert trained == [("crossq", name) for name in ("stock", "gauss", "lowrank", "flow")]
