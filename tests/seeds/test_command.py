"""The command that trains many seeds, and where its hyperparameters come from."""

from __future__ import annotations

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.common.hyperparameters import load_hyperparameters
from sb3_flowpolicy.seeds import __main__ as command
from sb3_flowpolicy.seeds.__main__ import main

TINY = ["--seeds", "2", "-params", "learning_starts:20", "random_steps:20", "batch_size:16"]


def test_trains_saves_reports_and_resumes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["--env", "TunnelHorizontal-v0", "-f", str(tmp_path), "--eval-episodes", "1"]
    main(
        [*command, *TINY, "-n", "40", "--first-seed", "5", "--eval-freq", "-1"]
    )  # off, as in rl_zoo3
    output = capsys.readouterr().out
    assert "seeds [5, 6]: 40 steps each" in output
    assert "seed 6    test return" in output
    folder = tmp_path / "sac_flow" / "TunnelHorizontal-v0_seeds"
    names = {path.name for path in folder.iterdir()}
    assert {"seed_5.zip", "seed_6.zip", "seed_5.monitor.csv", "checkpoints"} <= names
    monitor = (folder / "seed_5.monitor.csv").read_text()
    with pytest.raises(ValueError, match="must be new, or --resume given"):
        main([*command, *TINY, "-n", "60"])
    assert (folder / "seed_5.monitor.csv").read_text() == monitor
    main([*command, "--resume", "-n", "60"])
    assert "seeds [5, 6]: 20 steps each" in capsys.readouterr().out
    assert SACFlow.load(folder / "seed_6.zip").num_timesteps == 60


def test_an_interrupted_run_ends_with_the_same_agents_and_evaluations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed after the checkpoint of step 20, before its evaluation was written."""

    def run(name: str, *more: str) -> Path:
        command = ["--env", "TunnelHorizontal-v0", "-f", str(tmp_path / name), "-n", "50"]
        main([*command, *TINY, "--eval-freq", "10", "--eval-episodes", "1", *more])
        return tmp_path / name / "sac_flow" / "TunnelHorizontal-v0_seeds"

    straight = run("straight")
    record = command._record

    def break_at_20(path: Path, seeds: list[int], step: int, returns: np.ndarray) -> None:
        if step == 20:
            raise KeyboardInterrupt
        record(path, seeds, step, returns)

    with monkeypatch.context() as patch:
        patch.setattr(command, "_record", break_at_20)
        with pytest.raises(KeyboardInterrupt):
            run("interrupted")
    interrupted = run("interrupted", "--resume")
    table = (straight / "evaluations.csv").read_text()
    assert len(table.splitlines()) == 11
    assert (interrupted / "evaluations.csv").read_text() == table
    for seed in (0, 1):
        one, other = (SACFlow.load(path / f"seed_{seed}.zip") for path in (straight, interrupted))
        assert np.array_equal(
            one.policy.parameters_to_vector(), other.policy.parameters_to_vector()
        )


def test_wrong_arguments(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(gym.error.Error, match="NoTunnel"):
        main(["--env", "NoTunnel-v0", "-f", str(tmp_path)])
    with pytest.raises(ValueError, match=r"algo must be one of .*'sac_flow'.*got 'ppo'"):
        main(["--algo", "ppo", "-f", str(tmp_path)])
    with pytest.raises(SystemExit):
        main(["-params", "gamma", "-f", str(tmp_path)])
    assert "must be NAME:VALUE, got 'gamma'" in capsys.readouterr().err
    with pytest.raises(ValueError, match="path must be a folder of checkpoints"):
        main(["--resume", "-f", str(tmp_path)])


def test_unlisted_environments_get_the_default_block() -> None:
    block = load_hyperparameters("sac_flow", "Pendulum-v1")
    assert block["policy"] == "FlowPolicy"
    assert "callback" not in block
