"""The folder of checkpoints: whatever happens to the newest, the one before can be read."""

from __future__ import annotations

import json
import random
import shutil
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy import SACFlow, SeedBatch
from sb3_flowpolicy.checkpoint import RunCheckpointCallback, has_checkpoint
from sb3_flowpolicy.checkpoint.store import FORMAT, CheckpointStore, _seal

ENV = "TunnelDiagonal-v0"
FAST: dict[str, Any] = {
    "learning_starts": 10,
    "buffer_size": 60,
    "batch_size": 8,
    "seed": 0,
    "device": "cpu",
    "policy_kwargs": {"net_arch": [8]},
}


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the checkpoints of steps 40 and 80."""
    path = tmp_path_factory.mktemp("run") / "checkpoints"
    SACFlow("FlowPolicy", ENV, **FAST).learn(80, checkpoint_every=40, checkpoint_path=path)
    return path


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(trained, tmp_path / "run"))


def steps(path: Path) -> list[int]:
    return [int(folder.name.split("-")[-1]) for folder in CheckpointStore(path).folders()]


def files_of_the_newest(path: Path) -> list[Path]:
    """Everything that belongs to the newest checkpoint alone."""
    older, newest = CheckpointStore(path).folders()
    before = json.loads((older / "manifest.json").read_text())["files"]
    rows = [one for one in (path / "replay").iterdir() if f"replay/{one.name}" not in before]
    assert rows
    return sorted([*newest.iterdir(), *rows])


def test_the_last_two_are_kept_and_nothing_else(run: Path) -> None:
    assert steps(run) == [40, 80]
    named = {
        name
        for folder in CheckpointStore(run).folders()
        for name in json.loads((folder / "manifest.json").read_text())["files"]
    }
    here = {str(path.relative_to(run)) for path in run.rglob("*") if path.is_file()}
    assert {name for name in here if not name.endswith("manifest.json")} == named


def test_a_checkpoint_cut_anywhere_never_prevents_resuming_from_the_one_before(run: Path) -> None:
    draw = random.Random(0)
    victims = files_of_the_newest(run)
    assert {path.name for path in victims} >= {"manifest.json", "model.zip", "state.pt"}
    for _ in range(200):
        victim = draw.choice(victims)
        whole = victim.read_bytes()
        victim.write_bytes(whole[: draw.randrange(len(whole))])
        with pytest.warns(RuntimeWarning, match="newer checkpoints are damaged"):
            checkpoint = CheckpointStore(run).newest()
        assert checkpoint.manifest["num_timesteps"] == 40
        victim.write_bytes(whole)
    assert CheckpointStore(run).newest().manifest["num_timesteps"] == 80
    victim.write_bytes(whole[:-1])
    with pytest.warns(RuntimeWarning, match=victim.name):
        model = SACFlow.resume(run, ENV)
    assert model.num_timesteps == 40
    # And the run goes on over the damaged one.
    model.learn(120, checkpoint_every=40, checkpoint_path=run)
    assert steps(run) == [80, 120]
    assert SACFlow.resume(run, ENV).num_timesteps == 120


def test_a_checkpoint_that_was_never_completed_does_not_count(run: Path) -> None:
    newest = CheckpointStore(run).folders()[-1]
    newest.rename(run / f".partial-{newest.name}")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = SACFlow.resume(run, ENV)
    assert model.num_timesteps == 40
    model.learn(80, checkpoint_every=40, checkpoint_path=run)
    assert steps(run) == [40, 80]
    assert not list(run.glob(".partial*"))


@pytest.mark.parametrize("name", ["manifest.json", "model.zip", "state.pt"])
def test_altered_and_missing_files_are_noticed(name: str, run: Path) -> None:
    path = CheckpointStore(run).folders()[-1] / name
    contents = bytearray(path.read_bytes())
    contents[len(contents) // 2] ^= 1
    path.write_bytes(contents)
    with pytest.warns(RuntimeWarning, match=name):
        assert CheckpointStore(run).newest().manifest["num_timesteps"] == 40
    path.unlink()
    with pytest.warns(RuntimeWarning, match=name):
        assert CheckpointStore(run).newest().manifest["num_timesteps"] == 40


def test_folders_without_a_good_checkpoint(run: Path, tmp_path: Path) -> None:
    assert has_checkpoint(run)
    assert not has_checkpoint(tmp_path / "nowhere")
    with pytest.raises(
        ValueError, match=r"a folder of checkpoints, got .* which has no checkpoint"
    ):
        SACFlow.resume(tmp_path / "nowhere", ENV)
    for path in run.rglob("model.zip"):
        path.unlink()
    assert not has_checkpoint(run)
    with pytest.raises(ValueError, match=r"only damaged ones .*model\.zip is missing"):
        SACFlow.resume(run, ENV)


def test_later_formats_are_refused(run: Path) -> None:
    path = CheckpointStore(run).folders()[-1] / "manifest.json"
    facts = json.loads(path.read_text())
    del facts["sha256"]
    facts["format"] = FORMAT + 1
    path.write_text(json.dumps({**facts, "sha256": _seal(facts)}))
    with pytest.raises(ValueError, match=f"format {FORMAT} or earlier, got format {FORMAT + 1}"):
        SACFlow.resume(run, ENV)


def test_the_wrong_thing_is_refused(run: Path) -> None:
    with pytest.raises(ValueError, match=r"checkpoints of SeedBatch, got .* of SACFlow"):
        SeedBatch.resume(run, ENV)
    with pytest.raises(ValueError, match=r"env must be built and wrapped .* got .*PendulumEnv"):
        SACFlow.resume(run, "Pendulum-v1")
    with pytest.raises(ValueError, match=r"env must be built and wrapped .* got .*total_dims=3"):
        SACFlow.resume(run, gym.make(ENV, total_dims=3, free_dims=1))
    model = SACFlow("FlowPolicy", ENV, **FAST)
    with pytest.raises(ValueError, match=r"an empty folder for a new run, got .*-step-80"):
        model.learn(10, checkpoint_every=5, checkpoint_path=run)


def test_a_tunnel_of_another_width_is_another_environment(run: Path) -> None:
    with pytest.raises(ValueError, match=r"env must be built and wrapped .* got .*width=0\.5"):
        SACFlow.resume(run, gym.make(ENV, width=0.5))


def test_the_folder_must_be_a_path_to_a_folder(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match=r"must be an empty folder .*file, which is a file"):
        SACFlow("FlowPolicy", ENV, **FAST).learn(
            20, checkpoint_every=10, checkpoint_path=tmp_path / "file"
        )
    with pytest.raises(TypeError, match="NoneType"):
        RunCheckpointCallback(5, None)  # type: ignore[arg-type]


def test_a_replay_buffer_of_another_size_is_refused(run: Path) -> None:
    model = SACFlow("FlowPolicy", ENV, **{**FAST, "buffer_size": 70})
    with pytest.raises(ValueError, match=r"buffer_size must be .* 60 steps .*, got 70"):
        model.learn(120, callback=RunCheckpointCallback(40, run, resume=True))


@pytest.mark.parametrize(
    "changes", [{"policy_kwargs": {"net_arch": [9]}}, {"ent_coef": 0.1}, {"policy": "GaussPolicy"}]
)
def test_a_model_with_other_settings_does_not_resume(changes: dict[str, Any], run: Path) -> None:
    model = SACFlow(env=ENV, **{"policy": "FlowPolicy", **FAST, **changes})
    with pytest.raises(ValueError, match="model must be built with the settings of the run in"):
        model.learn(120, callback=RunCheckpointCallback(40, run, resume=True))


def test_one_folder_at_a_time(tmp_path: Path) -> None:
    model = SACFlow("FlowPolicy", ENV, **FAST)
    callback = RunCheckpointCallback(10, tmp_path / "b")
    with pytest.raises(ValueError, match=r"checkpoint_path must be one folder .* got .*a and .*b"):
        model.learn(20, callback=callback, checkpoint_every=10, checkpoint_path=tmp_path / "a")


def test_a_second_run_in_the_folder_goes_on_counting(tmp_path: Path) -> None:
    model = SACFlow("FlowPolicy", ENV, **FAST)
    model.learn(20, checkpoint_every=10, checkpoint_path=tmp_path)
    model.set_env(gym.make(ENV, width=0.5))
    model.learn(10, checkpoint_every=10, checkpoint_path=tmp_path, reset_num_timesteps=False)
    assert steps(tmp_path) == [20, 30]
    assert SACFlow.resume(tmp_path, gym.make(ENV, width=0.5)).num_timesteps == 30
    with pytest.raises(ValueError, match=r"reset_num_timesteps must be False .* got a count of 0"):
        model.learn(10, checkpoint_every=10, checkpoint_path=tmp_path)
    assert steps(tmp_path) == [20, 30]


def test_folders_of_others_do_not_count(run: Path) -> None:
    (run / "9-step-tone").mkdir()
    assert steps(run) == [40, 80]
    assert SACFlow.resume(run, ENV).num_timesteps == 80


@pytest.mark.parametrize("every", [0, 2.5, "10", True])
def test_an_interval_is_a_positive_whole_number(every: Any, tmp_path: Path) -> None:
    model = SACFlow("FlowPolicy", ENV, **FAST)
    with pytest.raises(ValueError, match=f"an integer of at least 1, got {every!r}"):
        model.learn(10, checkpoint_every=every, checkpoint_path=tmp_path)


def test_arguments_are_checked(tmp_path: Path) -> None:
    model = SACFlow("FlowPolicy", ENV, **FAST)
    with pytest.raises(ValueError, match="go together, got 10 and None"):
        model.learn(10, checkpoint_every=10)
