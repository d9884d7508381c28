"""Pictures of agents on the Square: what they measure and what they reject."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import SAC

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.experiments.square_pictures import record as recording
from sb3_flowpolicy.experiments.square_pictures.__main__ import main
from sb3_flowpolicy.experiments.square_pictures.record import Moment, load_agent, record

pytest.importorskip("matplotlib")
image = pytest.importorskip("PIL.Image")

ENV = "SquareMoveX-v1"


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("models")
    small: dict[str, Any] = {"net_arch": [8]}
    for name in ("realnvp", "gaussian"):
        policy = {**small, "distribution": name}
        SACFlow("FlowPolicy", ENV, seed=100, policy_kwargs=policy).save(folder / name)
    SACFlow("FlowPolicy", "Pendulum-v1", policy_kwargs=small).save(folder / "pendulum")
    SAC("MlpPolicy", ENV, policy_kwargs=small).save(folder / "sac")
    return {path.stem: path for path in folder.iterdir()}


def moment(deviations: np.ndarray) -> Moment:
    places = np.array([[0.4, 0.0], [0.0, 0.4], [-0.4, 0.0], [0.0, -0.4]])
    return Moment(np.zeros(3), 0.3, places, places, places + deviations)


def test_a_joint_movement_is_found_whatever_its_direction() -> None:
    rng = np.random.default_rng(0)
    shape = (recording.N_SAMPLES, 4, 2)
    alone = 0.1 * rng.standard_normal(shape)
    # Counterclockwise: right finger up, top finger left, left finger down, bottom finger right.
    turn = np.array([[0, 1], [-1, 0], [0, -1], [1, 0]])
    for direction in (np.array([1, 0]), np.array([0, 1]), turn):
        shared = 0.2 * rng.standard_normal((len(alone), 1, 1)) * direction
        own, others = moment(alone + shared).joint_movement()
        for k in range(4):
            # Each finger's share of the variance is 0.8, so theory says 0.86.
            assert np.corrcoef(own[:, k], others[:, k])[0, 1] > 0.75
    own, others = moment(alone).joint_movement()
    for k in range(4):
        assert abs(np.corrcoef(own[:, k], others[:, k])[0, 1]) < 0.2


def test_a_target_that_never_changes_is_no_movement() -> None:
    deviations = np.random.default_rng(0).standard_normal((recording.N_SAMPLES, 4, 2))
    deviations[:, 2] = 0.0
    own, others = moment(deviations).joint_movement()
    assert np.isfinite(own).all()
    assert np.isfinite(others).all()
    assert np.abs(own[:, 2]).max() < 1e-6


def test_the_command_writes_two_pictures_and_a_film(
    models: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "folder"
    pairs = [f"NF={models['realnvp']}", f"Gauss={models['gaussian']}"]
    main(["--env", ENV, "--episodes", "3", "-o", str(out)] + [f"--model={pair}" for pair in pairs])
    names = ["correlation.png", "film.webp", "together.png"]
    assert sorted(path.name for path in out.iterdir()) == names
    with image.open(out / "film.webp") as film:
        # One second of warm-up and what follows, two agents wide.
        assert film.n_frames > recording.FILM_LEAD
        assert film.width == 2 * recording.FILM_SIZE
    said = capsys.readouterr().out
    assert "NF (tuning seed 100, 0 steps)" in said
    assert "Gauss (tuning seed 100, 0 steps)" in said


def test_recordings_repeat_and_know_that_the_gaussian_is_independent(
    models: dict[str, Path],
) -> None:
    first, second = (
        record("Gauss", load_agent(models["gaussian"], ENV), ENV, seed=3, n_episodes=2)
        for _ in range(2)
    )
    assert np.array_equal(first.paths, second.paths, equal_nan=True)
    assert np.array_equal(first.correlation, second.correlation)
    assert np.array_equal(first.moment.samples, second.moment.samples)
    assert np.diag(first.correlation).tolist() == [1.0] * 8
    assert first.correlation[~np.eye(8, dtype=bool)].max() < 0.15


def test_the_first_episode_that_is_held_is_shown_else_the_first(
    models: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    model = load_agent(models["gaussian"], ENV)
    still = moment(np.zeros((recording.N_SAMPLES, 4, 2)))
    held: list[int] = []
    monkeypatch.setattr(
        recording,
        "_episode",
        lambda model, env_id, seed: (still, [seed], seed not in held),
    )
    assert record("a", model, ENV, 0, 1).frames == [0]
    held.extend([4, 6])
    assert record("a", model, ENV, 0, 1).frames == [4]
    monkeypatch.setattr(recording, "_episode", lambda *_: (None, [], True))
    with pytest.raises(ValueError, match="a must get through the warm-up"):
        record("a", model, ENV, 0, 1)


@pytest.mark.parametrize(
    ("name", "env_id", "message"),
    [
        ("realnvp", "TunnelDiagonal-v0", "env must be a task of the Square"),
        ("pendulum", ENV, "pendulum.zip must hold a model for SquareMoveX-v1"),
        ("sac", ENV, "must hold a policy of sb3_flowpolicy"),
    ],
)
def test_other_tasks_and_models_are_rejected(
    models: dict[str, Path], tmp_path: Path, name: str, env_id: str, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        main(["--env", env_id, "--model", f"a={models[name]}", "-o", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()


def test_labels_are_required(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--model", "flow.zip"])
    assert "must be LABEL=FILE, such as NF=flow.zip, got 'flow.zip'" in capsys.readouterr().err
