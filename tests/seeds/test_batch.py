"""SeedBatch: agents that are trained together equal agents that are trained alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.envs import IdentityEnvBox
from stable_baselines3.common.monitor import load_results
from stable_baselines3.common.noise import NormalActionNoise

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy import CrossQFlow, SACFlow, SeedBatch, TQCFlow
from sb3_flowpolicy.algorithms.demonstrations import record_demonstrations
from sb3_flowpolicy.engine import Engine, EngineRuntime
from sb3_flowpolicy.seeds.experience import SeedNoise
from tests.reach import make_reach

FAST: dict[str, Any] = {
    "learning_starts": 30,
    "buffer_size": 500,
    "batch_size": 16,
    "device": "cpu",
    "policy_kwargs": {"net_arch": [16, 16]},
}
ENV = "TunnelDiagonal-v0"


def vector(model: SACFlow) -> np.ndarray:
    return model.policy.parameters_to_vector()


@pytest.mark.parametrize("algorithm", [SACFlow, TQCFlow])
def test_an_agent_does_not_depend_on_the_others(algorithm: Any) -> None:
    """Seed 7 alone, with others, and first or last: the same agent."""
    settings = {"algorithm": algorithm, **FAST}
    alone = SeedBatch("FlowPolicy", ENV, [7], **settings).learn(90).models[0]
    first = SeedBatch("FlowPolicy", ENV, [7, 1, 2], **settings).learn(90).models[0]
    last = SeedBatch("FlowPolicy", ENV, [5, 7], **settings).learn(90).models[1]
    np.testing.assert_allclose(vector(first), vector(alone), rtol=2e-3, atol=2e-4)
    np.testing.assert_allclose(vector(last), vector(alone), rtol=2e-3, atol=2e-4)
    assert last.replay_buffer is not None
    assert alone.replay_buffer is not None
    np.testing.assert_allclose(
        last.replay_buffer.observations[:60], alone.replay_buffer.observations[:60], atol=1e-3
    )


def test_seeds_reproduce_and_differ() -> None:
    def run() -> list[np.ndarray]:
        models = SeedBatch("LowRankPolicy", ENV, 3, **FAST).learn(60).models
        return [vector(model) for model in models]

    once, again = run(), run()
    assert all(np.array_equal(a, b) for a, b in zip(once, again, strict=True))
    assert not np.array_equal(once[0], once[1])


@pytest.mark.parametrize("algorithm", [SACFlow, TQCFlow, CrossQFlow])
def test_models_are_ordinary_models(algorithm: Any, tmp_path: Path) -> None:
    batch = SeedBatch("FlowPolicy", ENV, [3, 4], algorithm=algorithm, **FAST).learn(70)
    obs = np.zeros((5, 2), dtype=np.float32)
    for model in batch.models:
        assert model.num_timesteps == 70
        assert model._n_updates == 40
        assert model.replay_buffer is not None
        assert model.replay_buffer.size() == 70
        expected, _ = model.predict(obs, deterministic=True)
        model.save(tmp_path / "model")
        loaded = algorithm.load(tmp_path / "model", env=gym.make(ENV))
        np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], expected)
        model.save_replay_buffer(tmp_path / "buffer")
        loaded.load_replay_buffer(tmp_path / "buffer")
        np.testing.assert_array_equal(
            loaded.replay_buffer.observations[:70],
            model.replay_buffer.observations[:70],
        )
    # One of them trains on alone and leaves the other as it was.
    one, other = batch.models
    before = vector(other)
    moved = vector(one)
    one.learn(20, reset_num_timesteps=False)
    assert not np.array_equal(vector(one), moved)
    assert np.array_equal(vector(other), before)


def test_a_saved_model_does_not_contain_the_others(tmp_path: Path) -> None:
    for n_seeds in (1, 8):
        batch = SeedBatch("FlowPolicy", ENV, n_seeds, **FAST).learn(35)
        batch.models[0].save(tmp_path / str(n_seeds))
    alone, stacked = ((tmp_path / f"{n}.zip").stat().st_size for n in (1, 8))
    assert stacked < 1.1 * alone


def test_learning_goes_on_where_it_stopped() -> None:
    parts = SeedBatch("FlowPolicy", ENV, 2, **FAST)
    parts.learn(40)
    parts.learn(30, reset_num_timesteps=False)
    whole = SeedBatch("FlowPolicy", ENV, 2, **FAST).learn(70)
    for got, expected in zip(parts.models, whole.models, strict=True):
        assert got.num_timesteps == expected.num_timesteps == 70
        np.testing.assert_allclose(vector(got), vector(expected), rtol=1e-4, atol=1e-5)


def test_training_on_does_not_repeat_the_same_episodes() -> None:
    batch = SeedBatch("FlowPolicy", "Pendulum-v1", 2, **{**FAST, "learning_starts": 50})
    starts = []
    for _ in range(2):
        batch.learn(5, reset_num_timesteps=False)
        buffer = batch.models[0].replay_buffer
        assert buffer is not None
        starts.append(buffer.observations[buffer.pos - 5, 0].copy())
        batch._experience.reset()
    assert not np.array_equal(*starts)


def test_environments_without_a_vectorized_form() -> None:
    batch = SeedBatch("GaussPolicy", lambda: IdentityEnvBox(eps=0.5), 2, **FAST).learn(60)
    assert all(np.isfinite(vector(model)).all() for model in batch.models)


def test_final_observations_and_time_limits_are_stored() -> None:
    batch = SeedBatch("FlowPolicy", "Pendulum-v1", 2, **{**FAST, "learning_starts": 300}).learn(210)
    for model in batch.models:
        buffer = model.replay_buffer
        assert buffer is not None
        assert list(np.flatnonzero(buffer.dones[:, 0])) == [199]
        assert list(np.flatnonzero(buffer.timeouts[:, 0])) == [199]
        # Within an episode one row's next observation is the next row's observation.
        assert np.array_equal(buffer.next_observations[:199], buffer.observations[1:200])
        assert not np.array_equal(buffer.next_observations[199], buffer.observations[200])
        assert np.abs(buffer.actions[:210]).max() <= 1


def test_logs_and_monitors_are_per_seed(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    batch = SeedBatch(
        "FlowPolicy",
        ENV,
        [3, 9],
        monitor_dir=tmp_path / "monitor",
        tensorboard_log=str(tmp_path / "tb"),
        **FAST,
    )
    batch.learn(120, tb_log_name="run")
    assert sorted(path.name for path in (tmp_path / "tb").iterdir()) == [
        "run_seed3_1",
        "run_seed9_1",
    ]
    results = load_results(str(tmp_path / "monitor"))
    episodes = sum(model._episode_num for model in batch.models)
    assert len(results) == episodes
    assert results["l"].sum() <= 240
    assert batch.models[0].ep_success_buffer is not None


class Crash(BaseCallback):
    """Fails in the middle of a run."""

    def _on_step(self) -> bool:
        if self.num_timesteps == 50:
            raise RuntimeError("no more")
        return True


def test_an_interrupted_batch_leaves_ordinary_models() -> None:
    batch = SeedBatch("FlowPolicy", ENV, 2, **FAST)
    with pytest.raises(RuntimeError, match="no more"):
        batch.learn(100, callback=Crash())
    one, other = batch.models
    assert one.replay_buffer is not None
    assert one.replay_buffer.size() == 50
    before = vector(other)
    one.learn(20, reset_num_timesteps=False)
    assert np.array_equal(vector(other), before)
    with pytest.raises(ValueError, match=r"must be equally filled, got \[70, 50\] transitions"):
        batch.learn(10, reset_num_timesteps=False)


def test_demonstrations_come_first() -> None:
    env = gym.make("Pendulum-v1")
    demos = record_demonstrations(env, lambda obs: np.zeros(1, dtype=np.float32), 25, seed=0)
    batch = SeedBatch("FlowPolicy", "Pendulum-v1", 2, demonstrations=demos, **FAST).learn(40)
    for model in batch.models:
        assert model.replay_buffer is not None
        assert model.replay_buffer.size() == 65
        assert np.array_equal(model.replay_buffer.observations[:25, 0], demos["observations"])


def test_what_was_done_to_the_agents_in_between_is_kept(tmp_path: Path) -> None:
    batch = SeedBatch("FlowPolicy", ENV, 2, **FAST).learn(50)
    for model in batch.models:
        model.tau, model.batch_size = 1.0, 8
        model.learn(20, reset_num_timesteps=False)
        model.save_replay_buffer(tmp_path / "buffer")
        model.load_replay_buffer(tmp_path / "buffer")
    batch.learn(30, reset_num_timesteps=False)
    for model in batch.models:
        assert model.replay_buffer is not None
        assert model.replay_buffer.size() == 100
        steps = {float(state["step"]) for state in model.actor.optimizer.state.values()}
        assert steps == {float(model._n_updates)}
        critic, target = model.critic.state_dict(), model.critic_target.state_dict()
        assert all(th.equal(target[key], value) for key, value in critic.items())
    changes = ("tau", 0.5), ("target_update_interval", 7), ("lr_schedule", lambda left: 1e-3 * left)
    for name, value in changes:
        before = getattr(batch.models[0], name)
        setattr(batch.models[0], name, value)
        with pytest.raises(ValueError, match="agents must all have the same settings"):
            batch.learn(1, reset_num_timesteps=False)
        setattr(batch.models[0], name, before)


def test_callbacks_that_write_files_get_their_seed(tmp_path: Path) -> None:
    batch = SeedBatch("FlowPolicy", ENV, [4, 5], **FAST)
    batch.learn(
        40, callback=lambda seed: CheckpointCallback(20, str(tmp_path), name_prefix=f"seed{seed}")
    )
    names = {path.name for path in tmp_path.glob("*_40_steps.zip")}
    assert names == {"seed4_40_steps.zip", "seed5_40_steps.zip"}


class StopAt(BaseCallback):
    """Stops a run, and notes what it was shown."""

    def __init__(self, step: int) -> None:
        super().__init__()
        self.step = step

    def _on_step(self) -> bool:
        self.model.seen = self.num_timesteps  # type: ignore[attr-defined]
        self.model.told = self.model.__dict__.get("told", []) + self.locals["infos"]
        return self.num_timesteps < self.step


def test_callbacks_see_every_step_of_their_own_agent() -> None:
    batch = SeedBatch("FlowPolicy", ENV, 2, **FAST).learn(100, callback=StopAt(50))
    assert [model.seen for model in batch.models] == [50, 50]  # type: ignore[attr-defined]
    assert [model.num_timesteps for model in batch.models] == [50, 50]
    for model in batch.models:
        infos, buffer = model.told, model.replay_buffer  # type: ignore[attr-defined]
        assert buffer is not None
        assert len(infos) == 50
        for info, done, reward in zip(infos, buffer.dones, buffer.rewards, strict=False):
            assert isinstance(info["is_success"], bool)
            assert info["is_success"] == bool(done[0] and reward[0] > 0)


def test_last_infos_are_those_of_sb3s_environments() -> None:
    batch = SeedBatch("FlowPolicy", ENV, 2, **FAST).learn(60, callback=StopAt(60))
    for model in batch.models:
        infos, buffer = model.told, model.replay_buffer  # type: ignore[attr-defined]
        assert buffer is not None
        ended = np.flatnonzero(buffer.dones[:60, 0])
        assert len(ended) > 10
        assert [k for k, info in enumerate(infos) if "episode" in info] == ended.tolist()
        starts = [0, *(ended[:-1] + 1)]
        for start, end in zip(starts, ended, strict=True):
            info, rewards = infos[end], buffer.rewards[start : end + 1, 0]
            assert info["episode"]["l"] == len(rewards)
            assert info["episode"]["r"] == pytest.approx(rewards.sum(), abs=1e-5)
            assert np.array_equal(info["terminal_observation"], buffer.next_observations[end, 0])
            assert info["TimeLimit.truncated"] == bool(buffer.timeouts[end, 0])


def test_a_callback_for_some_seeds_sees_these() -> None:
    batch = SeedBatch("FlowPolicy", ENV, 3, **FAST)
    batch.learn(50, callback=lambda seed: StopAt(50) if seed == 2 else None)
    first, _, last = batch.models
    assert "told" not in first.__dict__
    assert last.replay_buffer is not None
    seen = [info["episode"]["l"] for info in last.told if "episode" in info]  # type: ignore[attr-defined]
    ended = np.flatnonzero(last.replay_buffer.dones[:50, 0])
    assert seen == np.diff([-1, *ended]).tolist()


def test_noise_is_drawn_in_any_number() -> None:
    def noise() -> SeedNoise:
        return SeedNoise([3, 4], (2,), 0, uniform=False)

    many = noise().draw(70_000)
    one_by_one = noise()
    assert many.shape == (70_000, 2, 2)
    assert th.equal(many[:130], th.cat([one_by_one.draw(count) for count in (1, 64, 65)]))


def test_updates_are_drawn_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    def trained(most: int) -> np.ndarray:
        monkeypatch.setattr("sb3_flowpolicy.algorithms.engine_flow.MOST_DRAWN_AT_ONCE", most)
        settings = {**FAST, "train_freq": 10, "gradient_steps": 10}
        batch = SeedBatch("FlowPolicy", ENV, 2, **settings).learn(60)
        assert batch.models[0]._n_updates == 30
        return vector(batch.models[1])

    np.testing.assert_allclose(trained(4), trained(1000), rtol=1e-5, atol=1e-6)


def test_learns_what_a_single_agent_learns() -> None:
    """A bandit with a clear best action: all seeds must find it."""
    settings = {**FAST, "ent_coef": 0.01, "learning_rate": 3e-3, "gamma": 0.0, "batch_size": 64}
    batch = SeedBatch(
        "FlowPolicy",
        lambda: gym.make("Tunnel-v0", width=2.0, goal_reward=0.0, dense_reward=10.0),
        3,
        **settings,
    ).learn(700)
    for model in batch.models:
        action, _ = model.predict(np.zeros(2, dtype=np.float32), deterministic=True)
        assert action.min() > 0.7


@pytest.mark.parametrize(("units", "n_calls"), [(16, 1), (64, 2)])
def test_whether_to_compile_depends_on_the_calls_of_the_update(
    units: int, n_calls: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Agents with large networks are updated in groups."""
    plans: list[float] = []
    monkeypatch.setattr(EngineRuntime, "plan", lambda _, done, updates: plans.append(updates))
    settings = {**FAST, "batch_size": 256, "policy_kwargs": {"net_arch": [units]}}
    SeedBatch("GaussPolicy", ENV, 10, **settings).learn(35)
    assert plans[-1] == 5 * n_calls  # after those of the agents


@pytest.mark.parametrize(("sde_sample_freq", "steps_alike"), [(-1, 6), (4, 4)])
def test_gsde_keeps_its_matrices(
    sde_sample_freq: int, steps_alike: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in SB3: for a rollout, unless there is a frequency, which begins anew with a rollout."""
    settings = {**FAST, "train_freq": 6, "gradient_steps": 1, "sde_sample_freq": sde_sample_freq}
    batch = SeedBatch("GaussPolicy", ENV, 2, use_sde=True, use_sde_at_warmup=True, **settings)
    matrices, act = [], Engine.act

    def acting(engine: Engine, obs: th.Tensor, noise: th.Tensor) -> th.Tensor:
        matrices.append(noise)
        return act(engine, obs, noise)

    monkeypatch.setattr(Engine, "act", acting)
    batch.learn(36)
    assert len(matrices) == 36  # at warm-up, too
    for step in range(1, 36):
        is_new = step % 6 % steps_alike == 0
        assert th.equal(matrices[step], matrices[step - 1]) != is_new
    assert all((one[0] != one[1]).all() for one in matrices)


def test_gsde_acts_as_sb3s_actor() -> None:
    batch = SeedBatch("GaussPolicy", "Pendulum-v1", 2, use_sde=True, **FAST).learn(60)
    obs, noise = th.randn(2, 1, 3), th.randn(2, 1, 16)
    with batch._runtime.running():
        got = batch._runtime.engine().act(obs, noise)
    for model, own_obs, own_noise, own_action in zip(batch.models, obs, noise, got, strict=True):
        density = model.actor.action_dist
        std = density.get_std(model.actor.log_std)
        density.exploration_mat = std * own_noise.reshape(std.shape)
        th.testing.assert_close(own_action, model.actor(own_obs).detach())


def test_agents_with_gsde_predict_with_the_matrices_that_the_batch_acts_with(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = {**FAST, "gradient_steps": 0, "random_steps": 0, "train_freq": 8}
    batch = SeedBatch("GaussPolicy", "Pendulum-v1", 2, use_sde=True, **settings)
    for model in batch.models:  # agents are made with other matrices and deviations
        model.actor.log_std.data.fill_(0.5)
    calls, act = [], Engine.act

    def acting(engine: Engine, obs: th.Tensor, noise: th.Tensor) -> th.Tensor:
        calls.append((obs, act(engine, obs, noise)))
        return calls[-1][1]

    monkeypatch.setattr(Engine, "act", acting)
    batch.learn(16)
    for model, obs, scaled in zip(batch.models, *calls[-1], strict=True):
        action, _ = model.predict(obs.numpy())
        np.testing.assert_allclose(model.policy.scale_action(action), scaled, atol=1e-5)


def test_gsde_that_was_switched_on_or_off_is_refused() -> None:
    for policy, use_sde in (("FlowPolicy", False), ("GaussPolicy", True)):
        batch = SeedBatch(policy, ENV, 2, use_sde=use_sde, **FAST)
        for model in batch.models:
            model.use_sde = not use_sde
        with pytest.raises(ValueError, match=f"use_sde={not use_sde} with an actor made with use_"):
            batch.learn(40)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seeds": 0}, "seeds must be one or more different integers from 0 on, got 0"),
        ({"seeds": [1, 1]}, r"one or more different integers .*got \[1, 1\]"),
        ({"seeds": [-3]}, r"different integers from 0 on, got \[-3\]"),
        ({"train_freq": (1, "episode")}, "got train_freq .*EPISODE"),
        ({"gradient_steps": -1}, "with gradient_steps -1"),
        ({"n_steps": 3}, "plain replay buffers .* got NStepReplayBuffer"),
        ({"optimize_memory_usage": True}, "optimize_memory_usage=True"),
        ({"action_noise": NormalActionNoise(np.zeros(2), np.ones(2))}, "got action_noise Normal"),
        ({"policy_kwargs": {"optimizer_class": th.optim.SGD}}, "got optimizer of type SGD"),
    ],
)
def test_bad_arguments(arguments: dict[str, Any], message: str) -> None:
    settings = {"seeds": 2, **FAST, **arguments}
    if arguments.get("optimize_memory_usage"):
        settings["replay_buffer_kwargs"] = {"handle_timeout_termination": False}
    with pytest.raises(ValueError, match=message):
        SeedBatch("FlowPolicy", ENV, **settings)


def test_dictionary_observations_are_not_supported() -> None:
    with pytest.raises(ValueError, match=r"fixed .*, got dictionary observations, which are not"):
        SeedBatch("MultiInputFlowPolicy", make_reach, 2, **FAST)


def test_seeds_are_integers() -> None:
    assert SeedBatch("GaussPolicy", ENV, np.arange(2, 4), **FAST).seeds == [2, 3]
    with pytest.raises(TypeError, match="cannot be interpreted as an integer"):
        SeedBatch("GaussPolicy", ENV, [0.2, 1.9], **FAST)  # type: ignore[list-item]


def test_info_keywords_are_noted_as_monitor_does(tmp_path: Path) -> None:
    batch = SeedBatch(
        "GaussPolicy",
        "SquareMoveX-v0",
        2,
        monitor_dir=tmp_path,
        info_keywords=["x_std", "x_max"],
        **{**FAST, "learning_starts": 500, "random_steps": 500},
    )
    batch.learn(60)
    noted = [
        episode["x_max"]
        for model in batch.models
        if model.ep_info_buffer is not None
        for episode in model.ep_info_buffer
    ]
    assert len(noted) >= 4
    assert sorted(noted) == pytest.approx(sorted(load_results(str(tmp_path))["x_max"]))
    # No episode starts exactly in the middle.
    assert min(noted) > 0


def test_callbacks_may_reset_optimizers_and_move_weights() -> None:
    class Meddler(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 45:
                assert isinstance(self.model, SACFlow)
                self.model.actor.optimizer.state.clear()
                for parameter in self.model.policy.parameters():
                    parameter.data = parameter.data.clone()
                self.before = vector(self.model)
            if self.num_timesteps == 55:
                assert isinstance(self.model, SACFlow)
                assert not np.array_equal(vector(self.model), self.before)
            return True

    batch = SeedBatch("FlowPolicy", ENV, 2, **FAST).learn(60, callback=Meddler())
    for model in batch.models:
        steps = {float(state["step"]) for state in model.actor.optimizer.state.values()}
        assert steps == {16.0}  # since the reset, that of step 45 included


def test_a_learning_rate_schedule_moves_every_optimizer() -> None:
    batch = SeedBatch(
        "GaussPolicy",
        "Pendulum-v1",
        2,
        learning_rate=lambda remaining: 1e-3 * remaining,
        learning_starts=10,
        batch_size=8,
        device="cpu",
        compile=False,
        policy_kwargs={"net_arch": [8]},
    )
    batch.learn(40)
    for model in batch.models:
        optimizers = (model.actor.optimizer, model.critic.optimizer, model.ent_coef_optimizer)
        rates = [optimizer.param_groups[0]["lr"] for optimizer in optimizers]
        assert rates[0] < 1e-4
        assert rates == [rates[0]] * 3
