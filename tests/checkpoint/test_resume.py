"""A run that is broken off and resumed equals an undisturbed run, bit for bit."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize
from stable_baselines3.sac.policies import SACPolicy

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.checkpoint import RunCheckpointCallback
from sb3_flowpolicy.common.vec_env import make_batched_env
from tests.checkpoint.broken_runs import BreakAt, BrokenError, differences
from tests.checkpoint.kill_and_resume import log_rows

ENV = "TunnelDiagonal-v0"
FAST: dict[str, Any] = {
    "learning_starts": 20,
    "buffer_size": 70,
    "batch_size": 8,
    "seed": 0,
    "device": "cpu",
    "policy_kwargs": {"net_arch": [8]},
}
TOTAL, EVERY, BREAKS = 110, 20, (47, 92)


def run_to(
    step: int | None,
    make_env: Callable[[], Any],
    path: Path | None,
    settings: dict[str, Any],
    callbacks: Callable[[], list[BaseCallback]] = list,
    resume: bool = False,
) -> SACFlow:
    """Train, or go on training, to the end or until it breaks."""
    # What other programs draw must not matter.
    th.manual_seed(123)
    np.random.seed(123)  # noqa: NPY002
    env = make_env()
    model = SACFlow.resume(path, env) if resume and path else SACFlow(env=env, **settings)
    if path is not None:
        model.set_logger(configure(str(path.parent / "log"), ["csv", "json"]))
    else:
        model.set_logger(configure(str(settings["tensorboard_log"]), ["csv", "json"]))
    listed = callbacks() + ([] if step is None else [BreakAt(step)])
    checkpoints = {} if path is None else {"checkpoint_every": EVERY, "checkpoint_path": path}
    try:
        model.learn(TOTAL, callback=listed, log_interval=2, **checkpoints)
    except BrokenError:
        assert step is not None
    return model


def compare(
    make_env: Callable[[], Any],
    tmp_path: Path,
    callbacks: Callable[[], list[BaseCallback]] = list,
    **changes: Any,
) -> list[str]:
    """Compare a run and its log with those of a run that was broken off twice."""
    settings = {
        "policy": "FlowPolicy",
        **FAST,
        **changes,
        "tensorboard_log": str(tmp_path / "calm"),
    }
    calm = run_to(None, make_env, None, settings, callbacks)
    path = tmp_path / "broken" / "checkpoints"
    run_to(BREAKS[0], make_env, path, settings, callbacks)
    run_to(BREAKS[1], make_env, path, settings, callbacks, resume=True)
    resumed = run_to(None, make_env, path, settings, callbacks, resume=True)
    assert resumed.num_timesteps == calm.num_timesteps >= TOTAL
    assert calm._n_updates > 0
    found = differences(calm, resumed)
    expected = log_rows(tmp_path / "calm" / "progress.csv")
    assert len(expected) > 2
    logged = log_rows(path.parent / "log" / "progress.csv")
    return found + (["log"] if logged != expected else [])


def normalized() -> VecEnv:
    return VecNormalize(make_vec_env("Pendulum-v1", n_envs=2, wrapper_class=short))


def short(env: gym.Env) -> gym.Env:
    return gym.wrappers.TimeLimit(env.unwrapped, 13)


VARIANTS: dict[str, tuple[Callable[[], Any], dict[str, Any]]] = {
    "plain": (lambda: gym.make(ENV), {}),
    "fixed entropy coefficient, another density": (
        lambda: gym.make("TunnelCircle-v0"),
        {"policy": "LowRankPolicy", "ent_coef": 0.1, "random_steps": 40},
    ),
    "several normalized environments": (normalized, {"learning_rate": lambda left: left * 1e-3}),
    "stacked frames": (lambda: VecFrameStack(make_vec_env(ENV, n_envs=2), 3), {"train_freq": 3}),
    "batched environments": (lambda: make_batched_env("SquareHold-v0", 2), {}),
    "updates per episode": (lambda: gym.make(ENV), {"train_freq": (1, "episode")}),
    "n-step returns": (lambda: gym.make(ENV), {"n_steps": 3}),
    "pixels' memory": (
        lambda: gym.make(ENV),
        {
            "optimize_memory_usage": True,
            "replay_buffer_kwargs": {"handle_timeout_termination": False},
        },
    ),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_resumed_run_is_the_undisturbed_one(variant: str, tmp_path: Path) -> None:
    make_env, changes = VARIANTS[variant]
    assert compare(make_env, tmp_path, **changes) == []


def test_action_noise_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "run" / "checkpoints"

    def noisy() -> dict[str, Any]:
        noise = OrnsteinUhlenbeckActionNoise(np.zeros(2), 0.1 * np.ones(2))
        calm = str(tmp_path / "calm")
        return {"policy": "FlowPolicy", **FAST, "action_noise": noise, "tensorboard_log": calm}

    calm = run_to(None, lambda: gym.make(ENV), None, noisy())
    run_to(47, lambda: gym.make(ENV), path, noisy())
    resumed = run_to(None, lambda: gym.make(ENV), path, noisy(), resume=True)
    assert differences(calm, resumed) == []


def test_sb3s_own_loop(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="the stock loop"):
        assert compare(lambda: gym.make(ENV), tmp_path, policy=SACPolicy) == []


def test_state_dependent_exploration(tmp_path: Path) -> None:
    assert compare(lambda: gym.make(ENV), tmp_path, policy=SACPolicy, use_sde=True) == []


def test_hindsight_replay(tmp_path: Path) -> None:
    def goal_env() -> gym.Env:
        return BitFlippingEnv(n_bits=2, continuous=True, max_steps=5)

    changes = {"policy": "MultiInputFlowPolicy", "replay_buffer_class": HerReplayBuffer}
    assert compare(goal_env, tmp_path, **changes) == []


def test_callbacks_and_their_environments_go_on(tmp_path: Path) -> None:
    made: list[EvalCallback] = []

    def evaluate() -> list[BaseCallback]:
        # Its environment draws from a generator of its own at each reset.
        env = Monitor(gym.make("Pendulum-v1", max_episode_steps=9))
        env.reset(seed=5)
        made.append(EvalCallback(env, eval_freq=25, verbose=0, log_path=str(tmp_path / "eval")))
        return [made[-1]]

    make_env = lambda: gym.make("Pendulum-v1", max_episode_steps=13)  # noqa: E731
    assert compare(make_env, tmp_path, evaluate) == []
    calm, *_, resumed = made
    assert resumed.evaluations_timesteps == calm.evaluations_timesteps == [25, 50, 75, 100]
    assert resumed.evaluations_results == calm.evaluations_results
    assert resumed.n_calls == calm.n_calls == TOTAL


def test_monitor_files_are_those_of_the_undisturbed_run(tmp_path: Path) -> None:
    settings = {"policy": "FlowPolicy", **FAST, "tensorboard_log": str(tmp_path / "calm")}

    def monitored(name: str) -> Callable[[], gym.Env]:
        return lambda: Monitor(gym.make(ENV), str(tmp_path / name))

    run_to(None, monitored("calm"), None, settings)
    path = tmp_path / "run" / "checkpoints"
    run_to(47, monitored("broken"), path, settings)
    run_to(None, monitored("broken"), path, settings, resume=True)
    calm, broken = (log_rows(tmp_path / f"{name}.monitor.csv") for name in ("calm", "broken"))
    assert calm == broken
    assert len(calm) > 10
    # One header, and its clock goes on.
    assert (tmp_path / "broken.monitor.csv").read_text().count("t_start") == 1


def test_tensorboard_shows_one_run(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    path = tmp_path / "checkpoints"
    checkpoints: dict[str, Any] = {"checkpoint_every": 20, "checkpoint_path": path}

    def new(name: str) -> SACFlow:
        return SACFlow("FlowPolicy", ENV, **FAST, tensorboard_log=str(tmp_path / name))

    new("calm").learn(110, log_interval=2)
    with pytest.raises(BrokenError):
        new("broken").learn(110, log_interval=2, callback=BreakAt(57), **checkpoints)
    SACFlow.resume(path, ENV).learn(110, log_interval=2, **checkpoints)
    curves = []
    for name in ("calm", "broken"):
        assert [folder.name for folder in (tmp_path / name).iterdir()] == ["SAC_1"]
        events = EventAccumulator(str(tmp_path / name / "SAC_1")).Reload()
        curves.append([(one.step, one.value) for one in events.Scalars("rollout/ep_rew_mean")])
    assert curves[0] == curves[1]
    assert len(curves[0]) > 3


def test_several_calls_of_learn(tmp_path: Path) -> None:
    """A program that is run again makes all its calls again: finished ones pass at once."""

    def program(step: int | None, resume: bool) -> SACFlow:
        path = tmp_path / "checkpoints"
        model = SACFlow.resume(path, ENV) if resume else SACFlow("FlowPolicy", ENV, **FAST)
        checkpoints: dict[str, Any] = {"checkpoint_every": 20, "checkpoint_path": path}
        callback = None if step is None else BreakAt(step)
        model.learn(60, callback=callback, **checkpoints)
        model.learn(50, callback=callback, reset_num_timesteps=False, **checkpoints)
        return model

    calm = SACFlow("FlowPolicy", ENV, **FAST).learn(60).learn(50, reset_num_timesteps=False)
    for step, resume in ((47, False), (93, True)):
        with pytest.raises(BrokenError):
            program(step, resume)
    # Once more when all is done, too.
    for resumed in (program(None, True), program(None, True)):
        assert resumed.num_timesteps == 110
        assert differences(calm, resumed) == []


def test_a_second_call_that_breaks_twice_keeps_its_end(tmp_path: Path) -> None:
    """Its checkpoints say where it began itself, not where the call before it did."""
    checkpoints: dict[str, Any] = {"checkpoint_every": 20, "checkpoint_path": tmp_path}
    SACFlow("FlowPolicy", ENV, **FAST).learn(60, **checkpoints)
    model = SACFlow.resume(tmp_path, ENV).learn(60, **checkpoints)
    with pytest.raises(BrokenError):
        model.learn(50, callback=BreakAt(93), reset_num_timesteps=False, **checkpoints)
    resumed = SACFlow.resume(tmp_path, ENV)
    assert resumed.num_timesteps == 80
    assert resumed.learn(50, reset_num_timesteps=False, **checkpoints).num_timesteps == 110


def test_a_run_goes_on_after_a_checkpoint_that_could_not_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoints: dict[str, Any] = {"checkpoint_every": 20, "checkpoint_path": tmp_path}
    model = SACFlow("FlowPolicy", ENV, **FAST)
    rename, calls = Path.rename, []

    def fail_once(path: Path, target: Path) -> Path:
        calls.append(path)
        if len(calls) == 3:
            raise OSError("no space left on device")
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", fail_once)
    with pytest.raises(OSError, match="no space left"):
        model.learn(80, **checkpoints)
    model.learn(80, **checkpoints, reset_num_timesteps=False)
    resumed = SACFlow.resume(tmp_path, ENV)
    assert differences(model, resumed) == []


class Locked(gym.Wrapper):
    """Holds something that cannot be pickled."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.lock = threading.Lock()


def test_environments_that_cannot_be_pickled_begin_a_new_episode(tmp_path: Path) -> None:
    settings = {**FAST, "learning_starts": 300, "buffer_size": 300}

    def env() -> gym.Env:
        return Locked(gym.make("Pendulum-v1"))

    model = SACFlow("FlowPolicy", env(), **settings)
    with pytest.warns(RuntimeWarning, match="cannot be saved .*pickle.*begin a new episode"):
        model.learn(50, checkpoint_every=50, checkpoint_path=tmp_path)
    with pytest.warns(RuntimeWarning, match="resuming begins new episodes"):
        resumed = SACFlow.resume(tmp_path, env())
    with pytest.warns(RuntimeWarning, match="cannot be saved"):
        resumed.learn(100, checkpoint_every=50, checkpoint_path=tmp_path)
    buffer = resumed.replay_buffer
    assert buffer is not None
    assert resumed.num_timesteps == buffer.pos == 100
    # Neither the old episode nor the first one over again.
    assert not np.array_equal(buffer.observations[50], buffer.next_observations[49])
    assert not np.array_equal(buffer.observations[50], buffer.observations[0])


def test_pybullet_is_not_taken_for_something_that_can_be_saved(tmp_path: Path) -> None:
    """Its objects can be pickled, but hold handles of a simulation outside of Python."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pybullet's bindings warn about SWIG types
        pytest.importorskip("pybullet_envs_gymnasium")
    env_id = "InvertedPendulumBulletEnv-v0"
    settings = {**FAST, "learning_starts": 300, "buffer_size": 300}
    model = SACFlow("FlowPolicy", VecNormalize(make_vec_env(env_id)), **settings)
    with pytest.warns(RuntimeWarning, match="cannot be saved .*lives outside of Python"):
        model.learn(50, checkpoint_every=50, checkpoint_path=tmp_path)
    with pytest.warns(RuntimeWarning, match="resuming begins new episodes"):
        resumed = SACFlow.resume(tmp_path, VecNormalize(make_vec_env(env_id)))
    before, after = model.get_vec_normalize_env(), resumed.get_vec_normalize_env()
    assert before is not None
    assert after is not None
    np.testing.assert_array_equal(before.obs_rms.mean, after.obs_rms.mean)  # type: ignore[union-attr]
    assert resumed.learn(80).num_timesteps == 80


def test_without_further_checkpoints_and_by_callback(tmp_path: Path) -> None:
    calm = SACFlow("FlowPolicy", ENV, **FAST).learn(80)
    model = SACFlow("FlowPolicy", ENV, **FAST)
    callback = RunCheckpointCallback(checkpoint_every=20, checkpoint_path=tmp_path)
    with pytest.raises(BrokenError):
        model.learn(80, callback=[callback, BreakAt(55)])
    before = sorted(tmp_path.rglob("*"))
    resumed = SACFlow.resume(tmp_path, ENV)
    assert resumed.num_timesteps == 40
    assert resumed.replay_buffer is not None
    assert resumed.replay_buffer.size() == 40
    resumed.learn(80)
    assert differences(calm, resumed) == []
    assert sorted(tmp_path.rglob("*")) == before
    # The same command given again goes on, too, with a model that is new.
    again = SACFlow("FlowPolicy", ENV, **FAST)
    callback = RunCheckpointCallback(20, tmp_path, resume=True)
    again.learn(80, callback=callback)
    assert differences(calm, again) == []
    assert again.ep_info_buffer is not None
    assert calm.ep_info_buffer is not None
    assert [one["r"] for one in again.ep_info_buffer] == [one["r"] for one in calm.ep_info_buffer]
    with pytest.raises(ValueError, match="empty folder for a new run"):
        SACFlow("FlowPolicy", ENV, **FAST).learn(80, callback=RunCheckpointCallback(20, tmp_path))
    # A checkpoint's model is an ordinary one.
    loaded = SACFlow.load(next(tmp_path.glob("*-step-80")) / "model.zip")
    assert loaded.num_timesteps == 80
