"""``python -m sb3_flowpolicy.export``."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import onnx
import pytest
from stable_baselines3 import SAC, HerReplayBuffer

from sb3_flowpolicy import GaussPolicy, SACFlow
from sb3_flowpolicy.common.command_line import run
from sb3_flowpolicy.export.__main__ import find_statistics, main
from tests.bundle.conftest import FAST, NET, behind_statistics, make_model, multi_env


def test_a_run_of_the_zoo_becomes_a_bundle_and_a_graph(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Laid out as rl_zoo3 does: statistics in a folder of the environment's name."""
    env = behind_statistics()
    model = make_model("GaussPolicy", env).learn(30)
    model.save(tmp_path / "Pendulum-v1.zip")
    (tmp_path / "Pendulum-v1").mkdir()
    env.save(str(tmp_path / "Pendulum-v1" / "vecnormalize.pkl"))
    main(["safe", str(tmp_path / "Pendulum-v1.zip")])
    bundle = tmp_path / "Pendulum-v1.safetensors"
    assert f"{bundle}: " in capsys.readouterr().out
    loaded = SACFlow.load_safe(bundle)
    assert loaded.normalization is not None
    obs = np.ones(3, np.float32)
    expected = env.normalize_obs(obs)
    np.testing.assert_array_equal(loaded.normalization.normalize_obs(obs), expected)
    np.testing.assert_array_equal(
        loaded.predict(expected, deterministic=True)[0],
        model.predict(expected, deterministic=True)[0],
    )
    # From the bundle alone, with the statistics that came with it.
    main(["onnx", str(bundle), "-o", str(tmp_path / "out.onnx"), "--stochastic"])
    proto = onnx.load(tmp_path / "out.onnx")
    facts = {entry.key: entry.value for entry in proto.metadata_props}
    assert facts["vec_normalize"] == "inside"
    assert [one.name for one in proto.graph.input] == ["obs", "noise"]


def test_zips_of_plain_sac_and_of_hindsight_replay(tmp_path: Path) -> None:
    SAC(GaussPolicy, "Pendulum-v1", policy_kwargs=NET, **FAST).save(tmp_path / "sac.zip")
    main(["safe", str(tmp_path / "sac.zip")])
    assert SACFlow.load_safe(tmp_path / "sac.safetensors").random_steps is None
    kwargs = {"replay_buffer_class": HerReplayBuffer, "replay_buffer_kwargs": {"n_sampled_goal": 2}}
    make_model("MultiInputFlowPolicy", multi_env(), **kwargs).save(tmp_path / "her.zip")
    main(["safe", str(tmp_path / "her.zip")])
    loaded = SACFlow.load_safe(tmp_path / "her.safetensors", env=multi_env())
    assert isinstance(loaded.replay_buffer, HerReplayBuffer)


def test_where_statistics_are_looked_for(tmp_path: Path) -> None:
    def touch(name: str) -> Path:
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.touch()
        return path

    model = tmp_path / "best_model.zip"
    assert find_statistics(model) is None
    nested = touch("A-v0/vecnormalize.pkl")
    assert find_statistics(model) == nested
    touch("B-v0/vecnormalize.pkl")
    with pytest.raises(ValueError, match="--vecnormalize must say which belongs to"):
        find_statistics(model)
    assert find_statistics(tmp_path / "A-v0.zip") == nested
    steps = touch("rl_model_vecnormalize_500_steps.pkl")
    assert find_statistics(tmp_path / "rl_model_500_steps.zip") == steps
    beside = touch("vecnormalize.pkl")
    assert find_statistics(model) == beside


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["safe", "nowhere.zip"],
            "nowhere.zip must be a bundle written by save_safe: not a regular file that exists",
        ),
        (["safe", "text.zip"], "text.zip must be a bundle written by save_safe: a header of"),
        (["onnx", "stock.zip"], "model must have a policy of sb3_flowpolicy"),
        (["safe", "stock.zip"], "policy_class must be one of"),
        (["safe", "model.zip", "--vecnormalize", "x"], "No such file or directory: 'x'"),
        (
            ["safe", "model.zip", "--vecnormalize", "list.pkl"],
            "list.pkl must be what VecNormalize.save wrote, got list",
        ),
    ],
)
def test_errors_are_one_line(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("text.zip").write_text("this is no zip, and no bundle either")
    Path("list.pkl").write_bytes(pickle.dumps([]))
    if "model.zip" in arguments:
        make_model().save("model.zip")
    if "stock.zip" in arguments:
        SAC("MlpPolicy", "Pendulum-v1", **FAST).save("stock.zip")
    with pytest.raises(SystemExit) as end:
        run(lambda: main(arguments))
    error = str(end.value.code)
    assert message in error
    assert "\n" not in error
    assert not list(tmp_path.glob("*.safetensors"))


def test_beside_a_bundle_no_pickle_is_opened(tmp_path: Path) -> None:
    make_model("GaussPolicy").save_safe(tmp_path / "model")
    (tmp_path / "vecnormalize.pkl").write_bytes(pickle.dumps([]))
    main(["safe", str(tmp_path / "model.safetensors"), "-o", str(tmp_path / "copy.safetensors")])
    first, second = tmp_path / "model.safetensors", tmp_path / "copy.safetensors"
    assert first.read_bytes() == second.read_bytes()


def test_help_teaches(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    out = capsys.readouterr().out
    assert "python -m sb3_flowpolicy.export onnx" in out
    assert "loading a pickle runs the code in it" in " ".join(out.split())
