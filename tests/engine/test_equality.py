"""The engine's updates are SB3's, number by number: before speed is worth a word."""

from __future__ import annotations

import copy
import itertools
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.engine import Engine
from sb3_flowpolicy.engine.update import Batch

N_UPDATES = 20
BATCH_SIZE = 32


class DoubleExtractor(FlattenExtractor):
    """SB3 casts observations to float32; here they go on in float64."""

    def forward(self, obs: th.Tensor) -> th.Tensor:
        return super().forward(obs).double()


class Box(gym.Env):
    """Three observations, two actions; never stepped."""

    observation_space = gym.spaces.Box(-1, 1, (3,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)


def make(algorithm: type[SAC], policy: str, dtype: th.dtype, seed: int = 0, **settings: Any) -> SAC:
    policy_kwargs = {"net_arch": [16, 16], **settings.pop("policy_kwargs", {})}
    if dtype == th.float64:
        policy_kwargs["features_extractor_class"] = DoubleExtractor
    if algorithm is SAC:
        policy = SACFlow.policy_aliases[policy] if policy != "MlpPolicy" else policy  # type: ignore[assignment]
    model = algorithm(
        policy,
        Box(),
        buffer_size=300,
        seed=seed,
        device="cpu",
        policy_kwargs=policy_kwargs,
        **settings,
    )
    model.policy.to(dtype)
    if model.log_ent_coef is not None:
        model.log_ent_coef.data = model.log_ent_coef.data.to(dtype)
    model.set_logger(configure(None, []))
    rng = np.random.default_rng(seed)
    assert model.replay_buffer is not None
    for step in range(300):
        obs, next_obs = rng.uniform(-1, 1, (2, 1, 3)).astype(np.float32)
        info = [{"TimeLimit.truncated": step % 7 == 0}]
        done = np.array([step % 5 == 0 or step % 7 == 0])
        action, reward = rng.uniform(-1, 1, (1, 2)), rng.normal(size=1)
        model.replay_buffer.add(obs, next_obs, action, reward, done, info)
    return model


def seed_everything() -> None:
    """The engine draws for all updates at once, and gets the same numbers in order."""
    np.random.seed(1)  # noqa: NPY002 (SB3's buffers draw from the global state)
    th.manual_seed(1)


def everything(model: SAC) -> dict[str, th.Tensor]:
    """Parameters, optimiser states and temperature of a model."""
    tensors = {k: v.clone() for k, v in model.policy.state_dict().items()}
    optimizers = {"actor": model.actor.optimizer, "critic": model.critic.optimizer}
    if model.ent_coef_optimizer is not None and model.log_ent_coef is not None:
        optimizers["ent_coef"] = model.ent_coef_optimizer
        tensors["log_ent_coef"] = model.log_ent_coef.detach().clone()
    for name, optimizer in optimizers.items():
        for i, state in optimizer.state_dict()["state"].items():
            for key, value in state.items():
                tensors[f"{name}.{i}.{key}"] = value.clone()
    return tensors


def assert_close(ours: dict[str, th.Tensor], theirs: dict[str, th.Tensor], dtype: th.dtype) -> None:
    tolerance = 1e-10 if dtype == th.float64 else 1e-5
    assert ours.keys() == theirs.keys()
    for key, value in theirs.items():
        # Relative to the tensor's own size: single entries may pass through zero.
        scale = value.abs().max().item() or 1.0
        th.testing.assert_close(ours[key], value, rtol=tolerance, atol=tolerance * scale, msg=key)


def assert_same(got: SAC, expected: SAC, dtype: th.dtype) -> None:
    assert_close(everything(got), everything(expected), dtype)
    for key in ("actor_loss", "critic_loss", "ent_coef"):
        theirs_mean = expected.logger.name_to_value[f"train/{key}"]
        assert got.logger.name_to_value[f"train/{key}"] == pytest.approx(theirs_mean, rel=1e-5), key


def stock_loop(model: SAC, n_updates: int = N_UPDATES) -> None:
    if isinstance(model.actor.action_dist, SquashedDiagGaussianDistribution):
        model.actor.action_dist.epsilon = 0.0  # stock SAC adds 1e-6 inside a logarithm
    model.train(n_updates, batch_size=BATCH_SIZE)


def compare(
    policy: str, weight_decay: float, ent_coef: Any, dtype: th.dtype, compile: bool
) -> None:
    """For "MlpPolicy" the peer is untouched SB3, for the others SB3's loop with our policy."""
    ours_policy = "GaussPolicy" if policy == "MlpPolicy" else policy
    optimizer_kwargs = {"weight_decay": weight_decay}
    settings = {"ent_coef": ent_coef, "policy_kwargs": {"optimizer_kwargs": optimizer_kwargs}}
    stock = make(SAC, policy, dtype, **settings)
    ours = make(SACFlow, ours_policy, dtype, compile=compile, **settings)
    ours.policy.load_state_dict(stock.policy.state_dict())
    seed_everything()
    stock_loop(stock)
    seed_everything()
    ours.train(N_UPDATES, batch_size=BATCH_SIZE)
    assert isinstance(ours, SACFlow)
    assert ours._engine is not None  # neither took SB3's loop ...
    assert ours._engine.compiled == compile
    assert not ours._engine._compiled_update.broken  # ... nor gave up compiling
    assert_same(ours, stock, dtype)


@pytest.mark.parametrize("dtype", [th.float32, th.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("ent_coef", [0.1, "auto"])
@pytest.mark.parametrize("weight_decay", [0.0, 2.5e-4])
@pytest.mark.parametrize("policy", ["MlpPolicy", "LowRankPolicy", "FlowPolicy"])
def test_eager_engine_equals_sb3(
    policy: str, weight_decay: float, ent_coef: Any, dtype: th.dtype
) -> None:
    compare(policy, weight_decay, ent_coef, dtype, compile=False)


COMPILED = [
    ("MlpPolicy", 2.5e-4, "auto", th.float32),
    ("LowRankPolicy", 2.5e-4, "auto", th.float32),
    ("FlowPolicy", 2.5e-4, "auto", th.float32),
    ("FlowPolicy", 0.0, 0.1, th.float64),
]
# Compiling takes long: the rest of the matrix runs with `pytest -m slow`.
MATRIX = [
    pytest.param(*case, marks=[] if case in COMPILED else pytest.mark.slow)
    for case in itertools.product(
        ["MlpPolicy", "LowRankPolicy", "FlowPolicy"],
        [0.0, 2.5e-4],
        [0.1, "auto"],
        [th.float32, th.float64],
    )
]


@pytest.mark.parametrize(("policy", "weight_decay", "ent_coef", "dtype"), MATRIX)
def test_compiled_engine_equals_sb3(
    policy: str, weight_decay: float, ent_coef: Any, dtype: th.dtype
) -> None:
    compare(policy, weight_decay, ent_coef, dtype, compile=True)


@pytest.mark.parametrize("policy", ["GaussPolicy", "LowRankPolicy", "FlowPolicy"])
@pytest.mark.parametrize("ent_coef", [0.1, "auto"])
@pytest.mark.parametrize("dtype", [th.float32, th.float64], ids=["float32", "float64"])
def test_stacked_update_equals_single_ones(policy: str, ent_coef: Any, dtype: th.dtype) -> None:
    n_seeds = 4
    settings = {"ent_coef": ent_coef}
    settings["policy_kwargs"] = {"optimizer_kwargs": {"weight_decay": 2.5e-4}}

    def models() -> list[SAC]:
        return [make(SACFlow, policy, dtype, seed=seed, **settings) for seed in range(n_seeds)]

    stacked = Engine(models())
    singles = [Engine([model]) for model in models()]
    rate = th.full((3,), 3e-4, dtype=th.float64)
    np.random.seed(1)  # noqa: NPY002
    for step, batch in enumerate(stacked.draw(N_UPDATES, BATCH_SIZE)):
        losses = stacked._update(stacked.state(), batch, rate, step % 2 == 0)
        for seed, single in enumerate(singles):
            own = Batch(*(part[seed : seed + 1] for part in batch[:-1]), batch.noise[:, [seed]])
            expected = single._update(single.state(), own, rate, step % 2 == 0)
            th.testing.assert_close(losses[:, [seed]], expected, rtol=1e-4, atol=1e-5)
    for got, single in zip(stacked.models, singles, strict=True):
        assert_close(everything(got), everything(single.models[0]), dtype)


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
        # What was assigned has no optimiser yet.
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
    with pytest.warns(UserWarning, match=f"the engine does not do {reason}"):
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


def test_nan_stops_the_run() -> None:
    model = make(SACFlow, "FlowPolicy", th.float32, compile=False)
    assert model.replay_buffer is not None
    model.replay_buffer.rewards[:] = np.nan
    with pytest.raises(ValueError, match="loss must be finite, got nan"):
        model.train(2, batch_size=BATCH_SIZE)
    healthy = make(SACFlow, "FlowPolicy", th.float32)
    with pytest.raises(ValueError, match="got actions with NaN"):
        healthy.predict(np.full(3, np.nan, dtype=np.float32))


def test_settings_changed_between_updates_are_noticed() -> None:
    model = make(SACFlow, "FlowPolicy", th.float32, compile=False)
    model.train(1, batch_size=BATCH_SIZE)
    model.tau = 1.0
    model.train(1, batch_size=BATCH_SIZE)
    critic, target = model.critic.state_dict(), model.critic_target.state_dict()
    assert all(th.equal(target[key], value) for key, value in critic.items())


def test_released_models_own_their_memory() -> None:
    models = [make(SACFlow, "FlowPolicy", th.float32, seed=seed) for seed in range(2)]
    engine = Engine(models)
    engine.train(engine.draw(2, BATCH_SIZE))
    before = everything(models[0])
    engine.release()
    assert_close(everything(models[0]), before, th.float32)
    with th.no_grad():
        engine.networks.actor.data.zero_()
        engine.actor_adam.mean.zero_()
    assert_close(everything(models[0]), before, th.float32)
