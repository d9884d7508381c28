"""The command that trains many seeds, and where its hyperparameters come from."""

from __future__ import annotations

from pathlib import Path

import pytest

from sb3_flowpolicy.common.hyperparameters import load_hyperparameters
from sb3_flowpolicy.seeds.__main__ import main

TINY = ["--seeds", "2", "-params", "learning_starts:20", "random_steps:20", "batch_size:16"]


def test_trains_saves_reports_and_resumes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["--env", "TunnelHorizontal-v0", "-f", str(tmp_path), "--eval-episodes", "1"]
    main([*command, *TINY, "-n", "40", "--first-seed", "5"])
    output = capsys.readouterr().out
    assert "seeds [5, 6]: 40 steps each" in output
    assert "seed 6    test return" in output
    folder = tmp_path / "sac_flow" / "TunnelHorizontal-v0_seeds"
    names = {path.name for path in folder.iterdir()}
    assert {"seed_5.zip", "seed_6.zip", "seed_5.monitor.csv", "batch.pt"} <= names
    main([*command, "--resume", "-n", "60"])
    assert "seeds [5, 6]: 20 steps each" in capsys.readouterr().out


def test_wrong_arguments(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--env", "NoTunnel-v0"])
    assert "NoTunnel" in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"algo must be one of \['sac_flow'.*got 'ppo'"):
        main(["--algo", "ppo", "-f", str(tmp_path)])
    with pytest.raises(ValueError, match="hyperparams must be of the form key:value, got 'gamma'"):
        main(["-params", "gamma", "-f", str(tmp_path)])
    with pytest.raises(ValueError, match="folder must hold a saved batch"):
        main(["--resume", "-f", str(tmp_path)])


def test_unlisted_environments_get_the_default_block() -> None:
    block = load_hyperparameters("sac_flow", "Pendulum-v1")
    assert block["policy"] == "FlowPolicy"
    assert "callback" not in block
