"""The measurement of the guard's cost, and the run on the Ant."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sb3_flowpolicy.benchmarks import trust


def test_every_call_of_the_guard_is_timed() -> None:
    turns = trust._Turns("SACFlow", quick=True)
    turns.guarded()
    times = trust._time_calls(turns)
    counts = {name: len(values) for name, values in times.items()}
    chunk = trust.QUICK_CHUNK
    assert counts == {
        "check_step": chunk,
        "before_updates": chunk,
        "after_updates": chunk,
        "look": 2,
    }


def test_an_unguarded_turn_checks_nothing() -> None:
    turns = trust._Turns("SACFlow", quick=True)
    turns.unguarded()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trust.TrainingGuard, "look", lambda _: pytest.fail("looked"))
        assert turns.unguarded() == trust.QUICK_CHUNK
    assert turns.guarded() == trust.QUICK_CHUNK


def test_ant_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pybullet_envs_gymnasium")
    from sb3_flowpolicy.benchmarks import ant

    small = {"learning_starts": 40, "compile": False, "policy_kwargs": {"net_arch": [8]}}
    monkeypatch.setattr(ant, "SETTINGS", {**ant.SETTINGS, **small, "buffer_size": 200})
    monkeypatch.setattr(ant, "STEPS_PER_ROW", 50)
    path = tmp_path / "ant.csv"
    with pytest.raises(SystemExit, match="0"):
        ant.main(["--seeds", "3", "4", "--steps", "100", "--csv", str(path)])
    assert "all finite" in capsys.readouterr().out
    rows = np.genfromtxt(path, delimiter=",", names=True)
    assert rows["seed"].tolist() == [3, 4, 3, 4]
    assert rows["step"].tolist() == [50, 50, 100, 100]
    assert np.isfinite(rows["max_parameter"]).all()
