"""SACFlow's own options; what it inherits is SB3's to test."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import SimpleMultiObsEnv
from stable_baselines3.common.logger import configure

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.algorithms.demonstrations import load_demonstrations, record_demonstrations
from sb3_flowpolicy.common.vec_env import make_batched_env
from sb3_flowpolicy.engine import Engine, runtime

FAST: dict[str, Any] = {
    "learning_starts": 10,
    "buffer_size": 200,
    "batch_size": 16,
    "seed": 0,
    "device": "cpu",
    "policy_kwargs": {"net_arch": [16, 16]},
}


def demos(n: int = 40) -> dict[str, np.ndarray]:
    env = gym.make("Pendulum-v1", max_episode_steps=15)
    return record_demonstrations(env, lambda obs: np.array([0.5], dtype=np.float32), n, seed=0)


def buffer_of(model: SACFlow) -> Any:
    assert model.replay_buffer is not None
    return model.replay_buffer


@pytest.mark.parametrize(("random_steps", "expected"), [(None, 30), (0, 0), (50, 50)])
def test_random_steps_are_separate_from_learning_starts(
    random_steps: int | None, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = {**FAST, "learning_starts": 30}
    model = SACFlow("FlowPolicy", "Pendulum-v1", random_steps=random_steps, **settings)
    predictions = []
    predict = model.predict
    monkeypatch.setattr(model, "predict", lambda *a, **k: predictions.append(1) or predict(*a, **k))
    model.learn(80)
    assert len(predictions) == 80 - expected
    assert model._n_updates == 80 - 30


def test_fixed_ent_coef_stays_and_learned_one_moves_towards_the_target() -> None:
    fixed = SACFlow("FlowPolicy", "Pendulum-v1", ent_coef=0.25, **FAST).learn(40)
    assert fixed.ent_coef_tensor.item() == 0.25
    high = SACFlow("FlowPolicy", "Pendulum-v1", target_entropy=50.0, **FAST).learn(40)
    low = SACFlow("FlowPolicy", "Pendulum-v1", target_entropy=-50.0, **FAST).learn(40)
    assert high.log_ent_coef is not None
    assert low.log_ent_coef is not None
    assert high.log_ent_coef.item() > 0 > low.log_ent_coef.item()


def train_once(critic_loss_coef: float, weight_decay: float) -> tuple[float, np.ndarray]:
    kwargs = {"net_arch": [16, 16], "optimizer_class": th.optim.SGD}
    kwargs["optimizer_kwargs"] = {"weight_decay": weight_decay}
    settings = {**FAST, "policy_kwargs": kwargs}
    model = SACFlow("GaussPolicy", "Pendulum-v1", critic_loss_coef=critic_loss_coef, **settings)
    before = th.nn.utils.parameters_to_vector(model.critic.parameters()).detach().clone()
    model.add_demonstrations(demos())
    model.set_logger(configure(None, []))
    np.random.seed(0)  # noqa: NPY002 (SB3's buffers draw from the global state)
    th.manual_seed(0)
    model.train(1, batch_size=32)
    after = th.nn.utils.parameters_to_vector(model.critic.parameters()).detach()
    return model.logger.name_to_value["train/critic_loss"], (after - before).numpy()


def test_critic_loss_coef_scales_loss_and_gradient_but_not_weight_decay() -> None:
    loss, step = train_once(0.5, 0.0)
    double_loss, double_step = train_once(1.0, 0.0)
    assert double_loss == pytest.approx(2 * loss)
    np.testing.assert_allclose(double_step, 2 * step, rtol=1e-3, atol=1e-7)
    _, decayed_step = train_once(0.5, 0.1)
    _, double_decayed_step = train_once(1.0, 0.1)
    decay = decayed_step - step
    assert np.abs(decay).max() > 1e-6
    np.testing.assert_allclose(double_decayed_step - double_step, decay, rtol=1e-2, atol=1e-6)


def test_demonstrations_are_in_the_buffer_when_learning_starts(tmp_path: Path) -> None:
    np.savez(tmp_path / "demos.npz", **demos())
    model = SACFlow("FlowPolicy", "Pendulum-v1", demonstrations=tmp_path / "demos.npz", **FAST)
    assert buffer_of(model).size() == 0
    model.learn(20)
    buffer = buffer_of(model)
    assert buffer.size() == 60
    expected = demos()
    np.testing.assert_allclose(buffer.observations[:40, 0], expected["observations"])
    np.testing.assert_allclose(buffer.next_observations[:40, 0], expected["next_observations"])
    np.testing.assert_allclose(buffer.actions[:40, 0], 0.25)  # 0.5 of a torque in [-2, 2]
    np.testing.assert_allclose(buffer.rewards[:40, 0], expected["rewards"], rtol=1e-6)
    # Time limits and the end of the recording do not end the task.
    assert list(np.flatnonzero(buffer.timeouts[:40, 0])) == [14, 29, 39]
    model.learn(10, reset_num_timesteps=False)
    assert buffer.size() == 70  # not added a second time


def test_demonstrations_are_dealt_out_to_several_environments() -> None:
    env = make_vec_env("Pendulum-v1", n_envs=3)
    model = SACFlow("FlowPolicy", env, n_steps=3, **FAST)
    assert isinstance(model.replay_buffer, NStepReplayBuffer)
    assert model.add_demonstrations(demos(41)) == 39
    expected = demos(41)["observations"][:39].reshape(3, 13, 3)
    np.testing.assert_allclose(model.replay_buffer.observations[:13].swapaxes(0, 1), expected)
    assert model.replay_buffer.timeouts[12].all()


def test_loaded_model_needs_no_demonstrations(tmp_path: Path) -> None:
    model = SACFlow("FlowPolicy", "Pendulum-v1", demonstrations=demos(), random_steps=7, **FAST)
    model.learn(20).save(tmp_path / "model")
    loaded = SACFlow.load(tmp_path / "model", env=gym.make("Pendulum-v1"))
    assert loaded.random_steps == 7
    assert buffer_of(loaded.learn(5)).size() == 5


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"random_steps": 1.5}, "random_steps must be None or an integer of at least 0, got 1.5"),
        ({"random_steps": -1}, "random_steps must be None or an integer of at least 0, got -1"),
        ({"critic_loss_coef": 0.0}, "critic_loss_coef must be above 0, got 0.0"),
        ({"critic_loss_coef": float("nan")}, "critic_loss_coef must be finite, got nan"),
        ({"demonstrations": "nowhere.npz"}, "got 'nowhere.npz' .*No such file"),
        ({"demonstrations": {"actions": np.zeros(3)}}, r"KeyError: 'observations'"),
        ({"policy": "NoPolicy"}, "policy must be one of .* got 'NoPolicy'"),
        ({"policy_kwargs": {"distribution": "nvp"}}, "distribution must be one of"),
    ],
)
def test_bad_arguments(kwargs: dict, message: str) -> None:
    arguments = {"policy": "FlowPolicy", "env": "Pendulum-v1", **FAST, **kwargs}
    with pytest.raises(ValueError, match=message):
        SACFlow(**arguments)


def test_demonstrations_that_do_not_fit() -> None:
    model = SACFlow("FlowPolicy", "Pendulum-v1", **{**FAST, "buffer_size": 20})
    with pytest.raises(ValueError, match="must have between 1 and 20 rows, got 40"):
        model.add_demonstrations(demos())
    rows = demos()
    rows["rewards"] = rows["rewards"][:-1]
    with pytest.raises(ValueError, match="must have equally many rows"):
        load_demonstrations(rows)
    multi = SimpleMultiObsEnv(discrete_actions=False, random_start=False)
    other = SACFlow("MultiInputFlowPolicy", multi, **FAST)
    with pytest.raises(ValueError, match="need a replay buffer for array observations"):
        other.add_demonstrations(demos())
    none = record_demonstrations(gym.make("Pendulum-v1"), lambda obs: np.zeros(1), 0)
    with pytest.raises(ValueError, match="must have equally many rows, at least 1"):
        load_demonstrations(none)


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("observations", lambda rows: rows[:, :1], r"observations of shape \(N, \*\(3,\)\), got"),
        ("actions", lambda rows: rows * 100, r"actions within Box.*got 50.0 \.\.\. 50.0"),
        (
            "rewards",
            lambda rows: rows * np.nan,
            "got NaN, infinity or no numbers in rewards",
        ),
    ],
)
def test_demonstrations_are_checked(key: str, change: Any, message: str) -> None:
    rows = demos()
    rows[key] = change(rows[key])
    with pytest.raises(ValueError, match=message):
        SACFlow("FlowPolicy", "Pendulum-v1", **FAST).add_demonstrations(rows)


@pytest.mark.parametrize("dtype", [bool, int, np.uint8, float])
def test_flags_of_any_type_mean_the_same(dtype: type) -> None:
    rows = demos()
    rows["terminations"] = np.zeros(40, dtype=dtype)
    rows["terminations"][-1] = 1
    rows["truncations"] = np.zeros(40, dtype=dtype)
    model = SACFlow("FlowPolicy", "Pendulum-v1", **FAST)
    model.add_demonstrations(rows)
    buffer = buffer_of(model)
    assert (buffer.dones[39, 0], buffer.timeouts[39, 0]) == (1.0, 0.0)


@pytest.mark.parametrize("batched", [False, True])
def test_demonstrations_may_be_a_recipe(batched: bool) -> None:
    recipe = {"controller": "flowpolicy_envs.Holder", "n_steps": 90}
    env = make_batched_env("SquareMove-v0") if batched else "SquareMove-v0"
    model = SACFlow("FlowPolicy", env, demonstrations=recipe, **FAST)
    model.learn(5)
    buffer = model.replay_buffer
    assert buffer is not None
    assert buffer.pos == 95
    assert buffer.actions[0, 0] == pytest.approx([-0.65, 0, 0, -0.65, 0.65, 0, 0, 0.65])
    # The second episode starts where the first was truncated.
    assert buffer.timeouts[79, 0]
    with pytest.raises(ImportError, match="No module named 'nowhere'"):
        SACFlow(
            "FlowPolicy",
            "SquareMove-v0",
            demonstrations={"controller": "nowhere.Nobody", "n_steps": 9},
            **FAST,
        ).learn(1)
    with pytest.raises(TypeError, match="missing 1 required keyword-only argument: 'n_steps'"):
        SACFlow("FlowPolicy", "SquareMove-v0", demonstrations={"controller": "a.b"}, **FAST).learn(
            1
        )


def test_auto_compiles_once_all_calls_of_learn_together_repay_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    class Recorder(Engine):
        def __init__(self, models: Any, compiled: bool):
            asked.append(compiled)
            super().__init__(models, False)

    monkeypatch.setattr("sb3_flowpolicy.algorithms.engine_flow.Engine", Recorder)
    monkeypatch.setattr(runtime, "UPDATES_WORTH_COMPILING", 50)
    model = SACFlow("GaussPolicy", "Pendulum-v1", learning_starts=10, batch_size=8)
    model.learn(40)  # 30 updates
    assert not any(asked)
    model.learn(30, reset_num_timesteps=False)  # and 30 more
    assert asked[-1]
    # A resumed program, whose first call had ended, does the same.
    settings: Any = {"checkpoint_every": 100, "checkpoint_path": tmp_path}
    asked.clear()
    SACFlow("GaussPolicy", "Pendulum-v1", learning_starts=10, batch_size=8).learn(40, **settings)
    resumed = SACFlow.resume(tmp_path, "Pendulum-v1").learn(40, **settings)
    assert not any(asked)
    resumed.learn(30, reset_num_timesteps=False, **settings)
    assert asked[-1]


@pytest.mark.parametrize(("every", "planned"), [((2, "episode"), 5), (4, 500)])
def test_updates_are_planned_by_episodes_of_full_length(every: Any, planned: int) -> None:
    model = SACFlow("GaussPolicy", "Pendulum-v1", train_freq=every, learning_starts=0)
    assert model._planned_updates(2000) == planned
