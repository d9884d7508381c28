"""The engine notices what others do to the models that it trains."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from sb3_contrib.common.torch_layers import BatchRenorm1d
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure

from sb3_flowpolicy import CrossQFlow, SACFlow, TQCFlow
from sb3_flowpolicy.algorithms.engine_flow import EngineFlow
from sb3_flowpolicy.engine import Engine
from tests.engine.test_equality import (
    BATCH_SIZE,
    N_UPDATES,
    Box,
    assert_close,
    assert_same,
    everything,
    make,
    seed_everything,
)


def test_loading_a_checkpoint_between_updates_is_noticed(tmp_path: Path) -> None:
    model = make(SACFlow, "FlowPolicy", th.float32, compile=False)
    model.train(3, batch_size=BATCH_SIZE)
    before = everything(model)
    model.save(tmp_path / "model")
    model.train(3, batch_size=BATCH_SIZE)
    assert not th.equal(everything(model)["log_ent_coef"], before["log_ent_coef"])
    model.set_parameters(str(tmp_path / "model.zip"))
    assert model.log_ent_coef is not None
    model.log_ent_coef.data = before["log_ent_coef"].clone()  # not among SB3's parameters
    seed_everything()
    model.train(3, batch_size=BATCH_SIZE)
    went_on = everything(model)
    fresh = SACFlow.load(tmp_path / "model", env=Box(), device="cpu")
    fresh.replay_buffer = model.replay_buffer
    fresh.set_logger(configure(None, []))
    seed_everything()
    fresh.train(3, batch_size=BATCH_SIZE)
    assert_close(everything(fresh), went_on, th.float32)


def test_several_environments_draw_as_sb3_does() -> None:
    """Rows, then environments, minibatch by minibatch."""

    def train(algorithm: type[SAC], policy: Any, **settings: Any) -> SAC:
        env = make_vec_env(Box, n_envs=2)
        model = algorithm(policy, env, seed=0, buffer_size=200, device="cpu", **settings)
        model.set_logger(configure(None, []))
        rng = np.random.default_rng(0)
        assert model.replay_buffer is not None
        for _ in range(100):
            obs, next_obs = rng.uniform(-1, 1, (2, 2, 3)).astype(np.float32)
            action, reward = rng.uniform(-1, 1, (2, 2)), rng.normal(size=2)
            model.replay_buffer.add(obs, next_obs, action, reward, np.zeros(2), [{}, {}])
        seed_everything()
        model.train(N_UPDATES, batch_size=BATCH_SIZE)
        return model

    kwargs = {"policy_kwargs": {"net_arch": [16, 16]}}
    stock = train(SAC, SACFlow.policy_aliases["FlowPolicy"], **kwargs)
    ours = train(SACFlow, "FlowPolicy", compile=False, **kwargs)
    assert_same(ours, stock, th.float32)


def test_copies_and_steps_by_hand_see_the_true_step_count() -> None:
    """The engine's state is torch.optim's state, at any moment."""
    model = make(SACFlow, "FlowPolicy", th.float32, compile=False)
    model.train(5, batch_size=BATCH_SIZE)
    copied = copy.deepcopy(model.policy)
    steps = [float(state["step"]) for state in copied.actor.optimizer.state.values()]
    assert set(steps) == {5.0}
    for parameter in model.actor.parameters():
        parameter.grad = th.zeros_like(parameter)
    model.actor.optimizer.step()
    model.train(1, batch_size=BATCH_SIZE)
    steps = [float(state["step"]) for state in model.actor.optimizer.state.values()]
    assert set(steps) == {7.0}


@pytest.mark.parametrize("what", ["policy", "optimizer", "temperature", "assign"])
def test_replaced_objects_are_noticed(what: str) -> None:
    model = make(SACFlow, "FlowPolicy", th.float32, compile=False)
    model.train(2, batch_size=BATCH_SIZE)
    if what == "policy":
        model.policy = copy.deepcopy(model.policy)
        model._create_aliases()
    elif what == "optimizer":
        model.actor.optimizer = th.optim.Adam(model.actor.parameters(), lr=1e-3)
    elif what == "assign":
        state = {key: value.clone() for key, value in model.policy.state_dict().items()}
        model.policy.load_state_dict(state, assign=True)
        # What was assigned has no optimizer yet.
        for network in (model.actor, model.critic):
            network.optimizer = th.optim.Adam(network.parameters(), lr=1e-3)
    else:
        model.log_ent_coef = th.log(th.full((1,), 0.01)).requires_grad_(True)
        model.ent_coef_optimizer = th.optim.Adam([model.log_ent_coef], lr=3e-4)
    before = model.policy.parameters_to_vector()
    model.train(1, batch_size=BATCH_SIZE)
    assert not np.array_equal(model.policy.parameters_to_vector(), before)
    assert len(model.actor.optimizer.state) == len(list(model.actor.parameters()))
    if what == "temperature":
        assert model.logger.name_to_value["train/ent_coef"] == pytest.approx(0.01, rel=1e-3)


@pytest.mark.parametrize(
    ("policy_kwargs", "reason"),
    [
        ({"activation_fn": th.nn.PReLU}, "critic layer of type PReLU"),
        ({"activation_fn": th.nn.RReLU}, "layer of type RReLU"),
        ({"optimizer_class": th.optim.RMSprop}, "optimizer of type RMSprop"),
        ({"optimizer_kwargs": {"amsgrad": True}}, "optimizer of type Adam"),
    ],
)
def test_what_the_engine_cannot_do_is_left_to_sb3(policy_kwargs: dict, reason: str) -> None:
    model = make(SACFlow, "FlowPolicy", th.float32, policy_kwargs=policy_kwargs)
    with pytest.warns(UserWarning, match=f"the engine does not support {reason}"):
        model.train(1, batch_size=BATCH_SIZE)


def test_crossq_with_gsde_is_left_to_sb3_contrib() -> None:
    model = make(CrossQFlow, "GaussPolicy", th.float32, use_sde=True)
    with pytest.warns(UserWarning, match="actor of type Actor with gSDE"):
        model.train(1, batch_size=BATCH_SIZE)


def test_frozen_parameters_and_hooks_are_left_to_sb3() -> None:
    model = make(SACFlow, "FlowPolicy", th.float32)
    for parameter in model.actor.latent_pi.parameters():
        parameter.requires_grad_(False)
    before = [parameter.clone() for parameter in model.actor.latent_pi.parameters()]
    with pytest.warns(UserWarning, match="parameters that are frozen or have hooks"):
        model.train(2, batch_size=BATCH_SIZE)
    assert all(map(th.equal, model.actor.latent_pi.parameters(), before))
    hooked = make(SACFlow, "FlowPolicy", th.float32)
    calls = []
    hooked.actor.optimizer.register_step_pre_hook(lambda *_: calls.append(1))
    with pytest.warns(UserWarning, match="optimizer with hooks"):
        hooked.train(2, batch_size=BATCH_SIZE)
    assert len(calls) == 2


def test_gsde_that_was_switched_off_is_left_to_sb3() -> None:
    """SB3 then keeps its exploration matrix, which the engine would draw anew."""
    model = make(SACFlow, "GaussPolicy", th.float32, use_sde=True)
    model.use_sde = False
    before = model.actor.action_dist.exploration_mat
    with pytest.warns(UserWarning, match="use_sde=False with an actor made with use_sde=True"):
        model.train(1, batch_size=BATCH_SIZE)
    assert model.actor.action_dist.exploration_mat is before


def test_assigned_parameters_without_an_optimizer_are_left_to_sb3() -> None:
    model = make(SACFlow, "GaussPolicy", th.float32, compile=False)
    model.train(2, batch_size=BATCH_SIZE)
    state = {key: value.clone() for key, value in model.policy.state_dict().items()}
    model.policy.load_state_dict(state, assign=True)
    with pytest.warns(UserWarning, match="optimizer of other parameters than the network's"):
        model.train(1, batch_size=BATCH_SIZE)
    model.get_parameters()


def test_an_engine_that_no_longer_fits_is_dropped() -> None:
    """The policy must not act with the tensors of an engine that no longer trains it."""
    model = make(SACFlow, "FlowPolicy", th.float32, compile=False)
    assert isinstance(model, SACFlow)
    model.train(1, batch_size=BATCH_SIZE)
    assert model._runtime._engine is not None
    model.actor.optimizer = th.optim.SGD(model.actor.parameters(), lr=1e-3)
    with pytest.warns(UserWarning, match="optimizer of type SGD"):
        model.train(1, batch_size=BATCH_SIZE)
    assert model._runtime._engine is None


def test_settings_changed_between_updates_are_noticed() -> None:
    model = make(SACFlow, "FlowPolicy", th.float32, compile=False)
    model.train(1, batch_size=BATCH_SIZE)
    model.tau = 1.0
    model.train(1, batch_size=BATCH_SIZE)
    critic, target = model.critic.state_dict(), model.critic_target.state_dict()
    assert all(th.equal(target[key], value) for key, value in critic.items())


def test_other_numbers_of_quantiles_are_noticed() -> None:
    kept, changed = (make(TQCFlow, "GaussPolicy", th.float32, compile=False) for _ in range(2))
    for model in (kept, changed):
        for dropped in (2, 2 if model is kept else 20):
            model.top_quantiles_to_drop_per_net = dropped
            seed_everything()
            model.train(3, batch_size=BATCH_SIZE)
    losses = [model.logger.name_to_value["train/critic_loss"] for model in (kept, changed)]
    assert losses[0] != losses[1]


def test_running_statistics_that_were_moved_are_noticed() -> None:
    """Moving a policy replaces its buffers, while its parameters stay the same objects."""
    calm, moved = (make(CrossQFlow, "GaussPolicy", th.float32, compile=False) for _ in range(2))
    for model in (calm, moved):
        with model._runtime.running():
            for _ in range(3):
                seed_everything()
                model.train(3, batch_size=BATCH_SIZE)
                if model is moved:
                    model.policy.to(th.float64).to(th.float32)
    assert_close(everything(moved), everything(calm), th.float32)


def test_an_engine_of_another_data_type_is_dropped() -> None:
    """Compiled functions do not check the types of their arguments."""
    model = make(SACFlow, "GaussPolicy", th.float32, compile=False)
    with model._runtime.running():
        before = model._runtime.engine()
        model.policy.to(th.float64)
        assert model._runtime.engine() is not before


@pytest.mark.parametrize("name", ["momentum", "eps", "warmup_steps"])
def test_other_constants_of_the_renormalization_are_noticed(name: str) -> None:
    """They are compiled into the update."""
    model = make(CrossQFlow, "GaussPolicy", th.float32, compile=False)
    with model._runtime.running():
        before = model._runtime.engine()
        assert model._runtime.engine() is before
        for layer in model.policy.modules():
            if isinstance(layer, BatchRenorm1d):
                setattr(layer, name, 0.5)
        assert model._runtime.engine() is not before


def test_critics_with_unequal_renormalization_are_left_to_sb3_contrib() -> None:
    model = make(CrossQFlow, "GaussPolicy", th.float32)
    model.critic.q_networks[1][0].momentum = 0.5
    with pytest.warns(UserWarning, match="critics that differ in their batch renormalization"):
        model.train(1, batch_size=BATCH_SIZE)


def test_a_compiled_policy_follows_the_running_statistics() -> None:
    model = make(CrossQFlow, "GaussPolicy", th.float32, policy_kwargs={"net_arch": [8]})
    engine, obs, noise = Engine([model], compiled=True), th.randn(1, 4, 3), th.randn(1, 4, 2)
    model.policy.set_training_mode(False)
    seen = []
    for _ in range(3):
        with th.no_grad():
            seen.append(engine.act(obs, noise)[0])
            th.testing.assert_close(seen[-1], model.actor(obs[0], noise=noise[0]))
            for name, buffer in model.actor.named_buffers():
                if name.endswith("ra_mean"):
                    buffer.add_(0.5)
        if len(seen) == 2:  # as between two calls of learn()
            engine.release()
            engine.synchronize()
    assert engine.compiler.enabled
    assert not th.equal(seen[0], seen[1])
    assert not th.equal(seen[1], seen[2])


def test_losses_of_the_actor_are_logged_when_it_is_updated() -> None:
    model = make(CrossQFlow, "GaussPolicy", th.float32, compile=False, policy_delay=3)
    logged = model.logger.name_to_value
    model.train(2, batch_size=BATCH_SIZE)
    assert "train/critic_loss" in logged
    assert "train/actor_loss" not in logged
    model.train(4, batch_size=BATCH_SIZE)
    assert {"train/actor_loss", "train/ent_coef_loss"} <= set(logged)


def test_crossq_without_normalization_is_left_to_sb3_contrib() -> None:
    model = make(CrossQFlow, "FlowPolicy", th.float32, policy_kwargs={"batch_norm": False})
    with pytest.warns(UserWarning, match="not support CrossQ without batch renormalization"):
        model.train(1, batch_size=BATCH_SIZE)


def test_released_models_own_their_memory() -> None:
    models = [make(SACFlow, "FlowPolicy", th.float32, seed=seed) for seed in range(2)]
    engine = Engine(models)
    engine.train(engine.draw(2, BATCH_SIZE))
    before = everything(models[0])
    engine.release()
    assert_close(everything(models[0]), before, th.float32)
    with th.no_grad():
        engine.networks.actor.data.zero_()
        engine.actor_adam.moments.mean.zero_()
    assert_close(everything(models[0]), before, th.float32)


@pytest.mark.parametrize("what", ["moment", "entries", "temperature", "frozen", "part"])
def test_changes_between_updates_count_as_they_do_in_sb3(what: str) -> None:
    """The engine and SB3's loop agree after a callback has changed the model."""

    def reach_in(model: SAC) -> None:
        states = model.actor.optimizer.state
        parameters = list(model.actor.parameters())
        if what == "moment":
            states[parameters[1]]["exp_avg"] = th.ones_like(parameters[1])
        elif what == "entries":
            states.clear()
        elif what == "temperature":
            model.ent_coef_tensor.fill_(2.0)
        elif what == "frozen":
            model.actor.requires_grad_(False)
        else:
            del states[parameters[-1]]

    def train(loop: str) -> SAC:
        model = make(SACFlow, "FlowPolicy", th.float32, compile=False, ent_coef=0.1)
        assert isinstance(model, SACFlow)
        for n_updates in (3, 4):
            seed_everything()
            if loop == "sb3":
                model._train_with_sb3(n_updates, BATCH_SIZE)
            else:
                model.train(n_updates, batch_size=BATCH_SIZE)
            reach_in(model) if n_updates == 3 else None
        return model

    if what in ("frozen", "part"):
        with pytest.warns(UserWarning, match="frozen" if what == "frozen" else "part was reset"):
            ours = train("engine")
    else:
        ours = train("engine")
    theirs = train("sb3")
    ours_then, theirs_then = (m.policy.parameters_to_vector() for m in (ours, theirs))
    np.testing.assert_allclose(ours_then, theirs_then, rtol=1e-4, atol=1e-5)


def test_replay_columns_stay_what_sb3_can_train_with() -> None:
    env = gym.make("Pendulum-v1")
    space = env.observation_space
    assert isinstance(space, gym.spaces.Box)
    double = gym.spaces.Box(space.low, space.high, dtype=np.float64)
    env = gym.wrappers.TransformObservation(env, lambda obs: obs.astype(np.float64), double)
    model = SACFlow("GaussPolicy", env, learning_starts=10, batch_size=8, compile=False, seed=0)
    model.learn(20)
    assert model.replay_buffer is not None
    assert model.replay_buffer.rewards.dtype == model.replay_buffer.actions.dtype == np.float32
    model._train_with_sb3(1, 8)


class ActInCallback(BaseCallback):
    """Compares the model with its policy, which acts eagerly, once the policy is compiled."""

    def __init__(self) -> None:
        super().__init__()
        self.compared = 0

    def _on_step(self) -> bool:
        assert isinstance(self.model, EngineFlow)
        if self.num_timesteps < 30:
            return True
        if self.num_timesteps == 35:  # other weights have to be noticed
            for parameter in self.model.actor.parameters():
                parameter.data.add_(0.1)
        if self.num_timesteps == 37:  # and weights in other memory
            for parameter in self.model.actor.parameters():
                parameter.data = parameter.data - 0.1
        rng = np.random.default_rng(self.num_timesteps)
        one = rng.normal(size=3).astype(np.float32)
        for obs in (one, one[None], one.astype(np.float64), np.stack([one, -one])):
            for deterministic in (True, False):
                th.manual_seed(0)
                got, _ = self.model.predict(obs, deterministic=deterministic)
                th.manual_seed(0)
                expected, _ = self.model.policy.predict(obs, deterministic=deterministic)
                assert got.shape == expected.shape
                np.testing.assert_allclose(got, expected, rtol=0, atol=1e-5)
        with pytest.raises(ValueError, match=r"observation .*must be finite"):
            self.model.predict(np.full(3, np.nan, np.float32))
        self.compared += 1
        return True


@pytest.mark.parametrize(
    ("algorithm", "policy"),
    [
        (SACFlow, "GaussPolicy"),
        (SACFlow, "LowRankPolicy"),
        (SACFlow, "FlowPolicy"),
        (TQCFlow, "FlowPolicy"),
        (CrossQFlow, "FlowPolicy"),
    ],
)
@pytest.mark.parametrize("mode", ["base", "log_prob"])
def test_callbacks_act_with_the_compiled_policy(
    algorithm: Any, policy: str, mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    acted: list[tuple[int, ...]] = []
    act = Engine.act

    def count(self: Engine, obs: th.Tensor, noise: th.Tensor | None = None) -> th.Tensor:
        acted.append(tuple(obs.shape))
        return act(self, obs, noise)

    monkeypatch.setattr(Engine, "act", count)
    # The function itself in place of its graph: compiling is not what is tested here.
    monkeypatch.setattr(th, "compile", lambda function, **_: function)
    settings = {"policy_kwargs": {"net_arch": [8], "deterministic_mode": mode}, "batch_size": 4}
    model = algorithm(policy, "Pendulum-v1", learning_starts=20, compile=True, seed=0, **settings)
    callback = ActInCallback()
    model.learn(40, callback=callback)
    assert callback.compared == 11
    # Twenty steps of experience; per callback, two shapes of one observation, sampled and not.
    per_callback = 4 if mode == "base" else 2
    assert acted == [(1, 1, 3)] * (20 + 11 * per_callback)
