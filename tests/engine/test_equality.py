"""The engine's updates are SB3's and sb3-contrib's, number by number."""

from __future__ import annotations

import itertools
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import SAC
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.logger import configure
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_flowpolicy import CrossQFlow, SACFlow, TQCFlow
from sb3_flowpolicy.engine import Engine, groups, gsde
from sb3_flowpolicy.engine.update import Batch

N_UPDATES = 20
BATCH_SIZE = 32
# Densities that have no policy class of their own: in place of one, their name.
WITHOUT_POLICY = ["lattice", "spline"]
OURS: dict[Any, Any] = {SAC: SACFlow, TQC: TQCFlow, CrossQ: CrossQFlow}


class DoubleExtractor(FlattenExtractor):
    """SB3 casts observations to float32; here they stay in float64."""

    def forward(self, obs: th.Tensor) -> th.Tensor:
        return super().forward(obs).double()


class Box(gym.Env):
    """Three observations, two actions; never stepped."""

    observation_space = gym.spaces.Box(-1, 1, (3,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)


def make(algorithm: Any, policy: str, dtype: th.dtype, seed: int = 0, **settings: Any) -> Any:
    policy_kwargs = {"net_arch": [16, 16], **settings.pop("policy_kwargs", {})}
    if dtype == th.float64:
        policy_kwargs["features_extractor_class"] = DoubleExtractor
    if policy in WITHOUT_POLICY:
        policy, policy_kwargs["distribution"] = "FlowPolicy", policy
    if algorithm in OURS and policy != "MlpPolicy":
        policy = OURS[algorithm].policy_aliases[policy]
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
    """Parameters, optimizer states and entropy coefficient of a model."""
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


def check_equal_to_sb3(
    policy: str,
    weight_decay: float,
    ent_coef: Any,
    dtype: th.dtype,
    compile: bool,
    stock_algorithm: Any = SAC,
    **more: Any,
) -> None:
    """For "MlpPolicy" the peer is untouched SB3, for the others SB3's loop with our policy."""
    ours_policy = "GaussPolicy" if policy == "MlpPolicy" else policy
    policy_kwargs: dict[str, Any] = {"optimizer_kwargs": {"weight_decay": weight_decay}}
    if compile:  # each layer takes long to compile
        policy_kwargs["net_arch"] = [16]
        if policy in ("FlowPolicy", "spline"):
            policy_kwargs["distribution_kwargs"] = {"layers": 2, "hidden": [10]}
    policy_kwargs |= more.pop("policy_kwargs", {})
    settings = {"ent_coef": ent_coef, "policy_kwargs": policy_kwargs, **more}
    stock = make(stock_algorithm, policy, dtype, **settings)
    ours = make(OURS[stock_algorithm], ours_policy, dtype, compile=compile, **settings)
    ours.policy.load_state_dict(stock.policy.state_dict())
    seed_everything()
    stock_loop(stock)
    seed_everything()
    ours.train(N_UPDATES, batch_size=BATCH_SIZE)
    assert ours._runtime._engine is not None  # neither took SB3's loop ...
    assert ours._runtime._engine.compiled == compile
    assert ours._runtime._engine.compiler.enabled == compile  # ... nor gave up compiling
    assert_same(ours, stock, dtype)


@pytest.mark.parametrize("dtype", [th.float32, th.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("ent_coef", [0.1, "auto"])
@pytest.mark.parametrize("weight_decay", [0.0, 2.5e-4])
@pytest.mark.parametrize("policy", ["MlpPolicy", "LowRankPolicy", "FlowPolicy", *WITHOUT_POLICY])
def test_eager_engine_equals_sb3(
    policy: str, weight_decay: float, ent_coef: Any, dtype: th.dtype
) -> None:
    check_equal_to_sb3(policy, weight_decay, ent_coef, dtype, compile=False)


COMPILED = [
    ("LowRankPolicy", 2.5e-4, "auto", th.float32),
    ("FlowPolicy", 2.5e-4, "auto", th.float32),
    ("FlowPolicy", 0.0, 0.1, th.float64),
]
# Compiling takes long: the rest of the matrix runs with `pytest -m slow`.
MATRIX = [
    pytest.param(*case, marks=[] if case in COMPILED else pytest.mark.slow)
    for case in itertools.product(
        ["MlpPolicy", "LowRankPolicy", "FlowPolicy", *WITHOUT_POLICY],
        [0.0, 2.5e-4],
        [0.1, "auto"],
        [th.float32, th.float64],
    )
]


@pytest.mark.parametrize(("policy", "weight_decay", "ent_coef", "dtype"), MATRIX)
def test_compiled_engine_equals_sb3(
    policy: str, weight_decay: float, ent_coef: Any, dtype: th.dtype
) -> None:
    check_equal_to_sb3(policy, weight_decay, ent_coef, dtype, compile=True)


TQC_SETTINGS: dict[str, Any] = {
    "stock_algorithm": TQC,
    "top_quantiles_to_drop_per_net": 1,
    "policy_kwargs": {"n_quantiles": 5, "n_critics": 3, "net_arch": [16]},
}


@pytest.mark.parametrize("compile", [False, True], ids=["eager", "compiled"])
@pytest.mark.parametrize(
    ("policy", "ent_coef", "dtype"),
    [("MlpPolicy", "auto", th.float32), ("LowRankPolicy", 0.1, th.float64)],
)
def test_tqc_equals_sb3_contribs(
    policy: str, ent_coef: Any, dtype: th.dtype, compile: bool
) -> None:
    settings = {**TQC_SETTINGS, "target_update_interval": 1 if compile else 3}
    check_equal_to_sb3(policy, 2.5e-4, ent_coef, dtype, compile, **settings)


def test_tqc_with_a_flow_equals_sb3_contribs() -> None:
    """With all quantiles, and with the default numbers of critics and quantiles."""
    settings = {"stock_algorithm": TQC, "top_quantiles_to_drop_per_net": 0}
    check_equal_to_sb3("FlowPolicy", 0.0, "auto", th.float64, False, **settings)


@pytest.mark.parametrize("policy", ["GaussPolicy", "LowRankPolicy", "FlowPolicy", *WITHOUT_POLICY])
@pytest.mark.parametrize("ent_coef", [0.1, "auto"])
@pytest.mark.parametrize("dtype", [th.float32, th.float64], ids=["float32", "float64"])
def test_stacked_update_equals_single_ones(policy: str, ent_coef: Any, dtype: th.dtype) -> None:
    check_stacked(SACFlow, policy, ent_coef, dtype)


def train_on_drawn(model: Any) -> list[Batch]:
    """Train our model and return its minibatches, for the stock loop to use."""
    with model._runtime.running():
        engine = model._runtime.engine()
        batches = engine.draw(N_UPDATES, BATCH_SIZE)
        engine.draw = lambda *_: batches
        model.train(N_UPDATES, batch_size=BATCH_SIZE)
        assert engine.compiler.enabled == engine.compiled == model.compile
    return batches


def sample_these(model: Any, batches: list[Batch]) -> None:
    flat = [[column[0].reshape(BATCH_SIZE, -1) for column in batch[:-1]] for batch in batches]
    remaining = iter([ReplayBufferSamples(*columns) for columns in flat])
    model.replay_buffer.sample = lambda *_, **__: next(remaining)


@pytest.mark.parametrize(
    ("stock_algorithm", "dtype", "use_expln", "compile"),
    [
        (SAC, th.float32, False, False),
        (SAC, th.float32, False, True),
        (SAC, th.float64, True, False),
        (TQC, th.float64, False, False),
    ],
)
def test_gsde_equals_sb3(
    stock_algorithm: Any, dtype: th.dtype, use_expln: bool, compile: bool
) -> None:
    settings = {"use_sde": True, "policy_kwargs": {"net_arch": [16], "use_expln": use_expln}}
    stock = make(stock_algorithm, "MlpPolicy", dtype, **settings)
    ours = make(OURS[stock_algorithm], "GaussPolicy", dtype, compile=compile, **settings)
    ours.policy.load_state_dict(stock.policy.state_dict())
    batches = train_on_drawn(ours)

    density, noise = stock.actor.action_dist, iter([batch.noise for batch in batches])
    density.bijector.epsilon = 0.0  # SB3 adds 1e-6 inside a logarithm

    def sample_weights(log_std: th.Tensor, batch_size: int = 1) -> None:
        of_states, of_next_states = next(noise)
        assert th.equal(of_states, of_next_states)
        std = density.get_std(log_std)
        density.exploration_mat = std * of_states.reshape(std.shape)

    density.sample_weights = sample_weights
    sample_these(stock, batches)
    stock.train(N_UPDATES, BATCH_SIZE)
    assert_same(ours, stock, dtype)


def crossq_loop(model: CrossQ, batches: list[Batch]) -> None:
    """Run sb3-contrib's loop on our minibatches and noise."""
    noise = []
    for k, batch in enumerate(batches, 1):
        # Next actions come first; the actor is not updated every time.
        noise += [batch.noise[1, 0]] + ([batch.noise[0, 0]] if k % model.policy_delay == 0 else [])
    drawn = iter(noise)
    model.actor.density.draw_noise = lambda context: next(drawn)  # type: ignore[assignment]
    sample_these(model, batches)
    model.train(len(batches), BATCH_SIZE)


@pytest.mark.parametrize("compile", [False, True], ids=["eager", "compiled"])
@pytest.mark.parametrize(
    ("policy", "ent_coef", "dtype"),
    [("GaussPolicy", "auto", th.float32), ("FlowPolicy", 0.1, th.float64)],
)
def test_crossq_equals_sb3_contribs(
    policy: str, ent_coef: Any, dtype: th.dtype, compile: bool
) -> None:
    """The renormalization begins within these updates.

    Not with ReLU: where a unit is active for a whole minibatch, normalization cancels its bias. The
    gradient is then nothing but rounding, which Adam scales up to whole steps.
    """
    policy_kwargs: dict[str, Any] = {"net_arch": [16], "activation_fn": th.nn.Tanh}
    policy_kwargs["renorm_warmup_steps"] = 8
    if policy == "FlowPolicy":
        policy_kwargs["distribution_kwargs"] = {"layers": 2, "hidden": [10]}
    settings = {"ent_coef": ent_coef, "policy_kwargs": policy_kwargs, "policy_delay": 3}
    stock = make(CrossQ, policy, dtype, **settings)
    ours = make(CrossQFlow, policy, dtype, compile=compile, **settings)
    ours.policy.load_state_dict(stock.policy.state_dict())
    crossq_loop(stock, train_on_drawn(ours))
    assert_same(ours, stock, dtype)


def test_gsde_computes_in_the_type_of_its_parameters() -> None:
    """SeedBatch draws noise in float32, whatever the type of the networks."""
    actor = make(SACFlow, "GaussPolicy", th.float64, use_sde=True).actor
    obs, noise = th.randn(8, 3), th.randn(1, gsde.noise_dim(actor))
    got, expected = (gsde.action_log_prob(actor, obs, one) for one in (noise, noise.double()))
    th.testing.assert_close(got, expected, rtol=1e-12, atol=1e-12)


def test_stacked_update_with_gsde_equals_single_ones() -> None:
    check_stacked(SACFlow, "GaussPolicy", "auto", th.float64, use_sde=True)


@pytest.mark.parametrize("algorithm", [TQCFlow, CrossQFlow])
def test_stacked_updates_of_others_equal_single_ones(algorithm: Any) -> None:
    check_stacked(algorithm, "LowRankPolicy", "auto", th.float64, n_seeds=2)


def check_stacked(
    algorithm: Any, policy: str, ent_coef: Any, dtype: th.dtype, n_seeds: int = 4, **settings: Any
) -> None:
    settings["ent_coef"] = ent_coef
    settings["policy_kwargs"] = {"optimizer_kwargs": {"weight_decay": 2.5e-4}}

    def models() -> list[Any]:
        return [make(algorithm, policy, dtype, seed=seed, **settings) for seed in range(n_seeds)]

    stacked = Engine(models())
    singles = [Engine([model]) for model in models()]
    rate = th.full((3,), 3e-4, dtype=th.float64)
    np.random.seed(1)  # noqa: NPY002
    for step, batch in enumerate(stacked.draw(N_UPDATES, BATCH_SIZE)):
        losses = stacked._update.function(stacked.state(), batch, rate, step % 2 == 0)
        for seed, single in enumerate(singles):
            own = batch.of(slice(seed, seed + 1))
            expected = single._update.function(single.state(), own, rate, step % 2 == 0)
            th.testing.assert_close(losses[:, [seed]], expected, rtol=1e-4, atol=1e-5)
    for got, single in zip(stacked.models, singles, strict=True):
        assert_close(everything(got), everything(single.models[0]), dtype)


# Compiling takes long: only the groups are compiled, and with the simplest density.
@pytest.mark.parametrize(
    ("policy", "ent_coef", "compiled"),
    [("FlowPolicy", 0.1, False), ("FlowPolicy", "auto", False), ("GaussPolicy", "auto", True)],
)
def test_updating_seeds_in_groups_changes_nothing(
    policy: str, ent_coef: Any, compiled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Large networks are updated a few seeds at a time, because their activations fit the cache."""
    n_seeds, engines = 4, []
    for bytes_at_once in (10**9, 2 * 2 * 16 * BATCH_SIZE * 4):
        monkeypatch.setattr(groups, "BYTES_AT_ONCE", bytes_at_once)
        kwargs = {"ent_coef": ent_coef, "policy_kwargs": {"net_arch": [16]}}
        models = [make(SACFlow, policy, th.float32, seed, **kwargs) for seed in range(n_seeds)]
        in_groups = bytes_at_once < 10**9
        engine = Engine(models, compiled=compiled and in_groups)
        seed_everything()
        losses = [engine.train(engine.draw(5, BATCH_SIZE)) for _ in range(2)]
        sizes = [len(part.actor) for _, part in engine._groups(BATCH_SIZE)]
        assert sizes == ([2, 2] if in_groups else [n_seeds])
        assert engine.compiler.enabled == (compiled and in_groups)
        engines.append((engine, th.stack(losses)))
    (whole, expected), (grouped, losses_in_groups) = engines
    assert expected.shape == (2, 4, n_seeds)
    th.testing.assert_close(losses_in_groups, expected, rtol=1e-4, atol=1e-5)
    for got, wanted in zip(grouped.models, whole.models, strict=True):
        assert_close(everything(got), everything(wanted), th.float32)


@pytest.mark.parametrize(
    ("policy", "use_sde"),
    [
        ("GaussPolicy", True),
        *(
            (name, False)
            for name in ("GaussPolicy", "LowRankPolicy", "FlowPolicy", *WITHOUT_POLICY)
        ),
    ],
)
def test_autocast_rounds_products_and_nothing_else(policy: str, use_sde: bool) -> None:
    exact, rounded = (
        make(SACFlow, policy, th.float32, autocast=on, use_sde=use_sde) for on in (False, True)
    )
    rounded.policy.load_state_dict(exact.policy.state_dict())
    for model in (exact, rounded):
        seed_everything()
        model.train(1, batch_size=BATCH_SIZE)
    losses = [model.logger.name_to_value["train/critic_loss"] for model in (exact, rounded)]
    assert losses[0] != losses[1]
    assert losses[1] == pytest.approx(losses[0], rel=0.02)
    # One step of Adam moves each parameter by at most about the learning rate.
    for key, value in everything(exact).items():
        assert everything(rounded)[key].dtype == value.dtype, key
        th.testing.assert_close(everything(rounded)[key], value, rtol=0.05, atol=1e-3, msg=key)
