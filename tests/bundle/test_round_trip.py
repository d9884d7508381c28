"""What is loaded is what was saved: actions, settings, and every further update."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import safetensors.numpy
import torch as th
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize

from sb3_flowpolicy import BundleError, SACFlow
from sb3_flowpolicy.algorithms.engine_flow import EngineFlow
from sb3_flowpolicy.distributions import registered_distributions
from tests.bundle.conftest import FAST, NET, UNUSUAL, behind_statistics, make_model, multi_env

OURS = [
    name
    for name, one in registered_distributions().items()
    if one.__module__.startswith("sb3_flowpolicy.distributions")
]
CASES: dict[str, Any] = {
    **{name: lambda name=name: make_model(policy_kwargs=density(name)) for name in OURS},
    "one_critic_sgd": lambda: make_model(
        policy_kwargs={
            "net_arch": {"pi": [8], "qf": [12, 12]},
            "activation_fn": th.nn.Tanh,
            "optimizer_class": th.optim.SGD,
            "optimizer_kwargs": {"momentum": 0.9},
            "n_critics": 1,
        }
    ),
    "adamw_fixed_ent_coef_line": lambda: make_model(
        policy_kwargs={
            **NET,
            "optimizer_class": th.optim.AdamW,
            "optimizer_kwargs": {"weight_decay": 1e-3, "betas": (0.8, 0.99)},
        },
        ent_coef=0.2,
        learning_rate=LinearSchedule(1e-3, 1e-4, 0.5),
        train_freq=(1, "episode"),
        gradient_steps=2,
    ),
    "statistics": lambda: make_model(env=behind_statistics()),
    **{
        f"MultiInput{kind}": lambda kind=kind: make_model(
            f"MultiInput{kind}Policy",
            multi_env(),
            replay_buffer_class=HerReplayBuffer,
            replay_buffer_kwargs={"n_sampled_goal": 2, "goal_selection_strategy": "future"},
        )
        for kind in ("Gauss", "LowRank", "Flow")
    },
    "image": lambda: make_model(
        "CnnFlowPolicy",
        FakeImageEnv(screen_height=40, screen_width=40, n_channels=1, discrete=False),
        policy_kwargs={
            **NET,
            "features_extractor_kwargs": {"features_dim": 8},
            "share_features_extractor": True,
        },
    ),
}


def density(name: str) -> dict[str, Any]:
    return {**NET, "distribution": name, "distribution_kwargs": UNUSUAL.get(name, {})}


def bits(model: SACFlow) -> dict[str, th.Tensor]:
    """Return parameters, the entropy coefficient and moments."""
    found = dict(model.policy.state_dict())
    for name in ("actor.optimizer", "critic.optimizer", "ent_coef_optimizer"):
        optimizer: Any = model
        for part in name.split("."):
            optimizer = getattr(optimizer, part)
        for index, state in (optimizer.state_dict()["state"] if optimizer else {}).items():
            found.update({f"{name}.{index}.{k}": v for k, v in state.items() if v is not None})
    found["log_ent_coef"] = model.log_ent_coef if model.log_ent_coef is not None else th.zeros(0)
    return {name: th.as_tensor(value).detach().clone() for name, value in found.items()}


def assert_same_bits(one: SACFlow, other: SACFlow) -> None:
    ours, theirs = bits(one), bits(other)
    assert ours.keys() == theirs.keys()
    for name, value in ours.items():
        assert th.equal(value, theirs[name]), name


def update(model: SACFlow, buffer: Any) -> None:
    model.replay_buffer = buffer
    model.set_logger(configure(None, []))
    np.random.seed(5)  # noqa: NPY002 (SB3's buffers draw from the global state)
    th.manual_seed(5)
    model.train(3, batch_size=16)


@pytest.mark.filterwarnings("ignore:training runs the stock loop")
@pytest.mark.parametrize("case", CASES)
def test_acts_and_learns_on_as_if_never_saved(case: str, tmp_path: Path) -> None:
    model = CASES[case]().learn(60)
    path = model.save_safe(tmp_path / "model")
    # The engine normalizes what it draws from the buffer with the environment's statistics.
    env = make_vec_env("Pendulum-v1", n_envs=2) if case == "statistics" else None
    loaded = SACFlow.load_safe(path, env, device="cpu")
    obs = model.observation_space.sample()
    for seed, deterministic in ((0, True), (1, False)):
        actions = []
        for one in (model, loaded):
            th.manual_seed(seed)
            actions.append(one.predict(obs, deterministic=deterministic)[0])
        np.testing.assert_array_equal(*actions)
    assert_same_bits(model, loaded)
    for name in SACFlow.settings:
        name = "_stats_window_size" if name == "stats_window_size" else name
        assert getattr(loaded, name) == getattr(model, name), name
    # With the same replay data, the next updates are the same numbers.
    buffer = model.replay_buffer
    update(model, buffer)
    update(loaded, buffer)
    assert_same_bits(model, loaded)
    # A loaded model is saved as the same bytes.
    again = SACFlow.load_safe(path, device="cpu").save_safe(tmp_path / "again")
    assert again.read_bytes() == path.read_bytes()


def test_goes_on_learning_in_an_environment(bundle: Path) -> None:
    idle = SACFlow.load_safe(bundle, device="cpu")
    idle.set_env(gym.make("Pendulum-v1"))
    with pytest.raises(ValueError, match="give env to load_safe to train on"):
        idle.learn(1)
    raw = gym.make("Pendulum-v1")
    model = SACFlow.load_safe(bundle, env=raw, device="cpu")
    env = model.get_vec_normalize_env()
    assert env is not None
    steps, count = model.num_timesteps, env.obs_rms.count  # type: ignore[union-attr]
    model.learn(20, reset_num_timesteps=False)
    assert model.num_timesteps == steps + 20
    assert env.obs_rms.count > count  # type: ignore[union-attr]


def test_statistics_are_those_of_the_environment(tmp_path: Path) -> None:
    env = behind_statistics(clip_obs=1.0, norm_reward=False)
    model = make_model(env=env).learn(40)
    loaded = SACFlow.load_safe(model.save_safe(tmp_path / "model"), device="cpu")
    assert loaded.normalization is not None
    obs = np.array([[1.0, -1.0, 8.0], [0.0, 0.5, -8.0]])
    expected = env.normalize_obs(obs)
    assert np.abs(expected).max() == 1.0  # the clip acts
    np.testing.assert_array_equal(loaded.normalization.normalize_obs(obs), expected)
    # Without an environment they survive being saved again, and wrap one later.
    again = loaded.save_safe(tmp_path / "again")
    wrapped = SACFlow.load_safe(again, env="Pendulum-v1").get_vec_normalize_env()
    assert wrapped is not None
    np.testing.assert_array_equal(wrapped.normalize_obs(obs), expected)
    assert (wrapped.norm_reward, wrapped.ret_rms.count) == (False, env.ret_rms.count)
    with pytest.raises(ValueError, match="env must come without VecNormalize"):
        SACFlow.load_safe(again, env=behind_statistics())
    # Zips of the model have them, too.
    for _ in range(2):
        loaded.save(tmp_path / "zip")
        loaded = SACFlow.load(tmp_path / "zip")
        np.testing.assert_array_equal(loaded.normalization.normalize_obs(obs), expected)


def test_statistics_of_dictionaries_name_their_keys(tmp_path: Path) -> None:
    from stable_baselines3.common.vec_env import DummyVecEnv

    env = VecNormalize(DummyVecEnv([dictionary_env]), norm_obs_keys=["b"])
    model = SACFlow("MultiInputFlowPolicy", env, policy_kwargs=NET, **FAST)
    model.learn(30)
    loaded = SACFlow.load_safe(model.save_safe(tmp_path / "model"), device="cpu")
    assert loaded.normalization is not None
    obs = {"a": np.ones(2, np.float32), "b": np.full(3, 0.3, np.float32)}
    expected = env.normalize_obs(obs)
    for key, value in loaded.normalization.normalize_obs(obs).items():
        np.testing.assert_array_equal(value, expected[key])
    assert not np.array_equal(expected["b"], obs["b"])


def dictionary_env() -> gym.Env:
    env = gym.make("Pendulum-v1")
    space = gym.spaces.Dict(
        {"a": gym.spaces.Box(-1, 1, (2,)), "b": gym.spaces.Box(-np.inf, np.inf, (3,))}
    )
    return gym.wrappers.TransformObservation(
        env, lambda obs: {"a": obs[:2].astype(np.float32), "b": obs.astype(np.float32)}, space
    )


def test_an_environment_with_other_spaces_is_refused(bundle: Path) -> None:
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        SACFlow.load_safe(bundle, env="MountainCarContinuous-v0")
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        SACFlow.load_safe(bundle, env=dictionary_env())
    path = make_model().save_safe(bundle.with_name("plain"))
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        SACFlow.load_safe(path, env="MountainCarContinuous-v0")


def test_any_reader_of_safetensors_can_open_it(bundle: Path) -> None:
    arrays = safetensors.numpy.load_file(bundle)
    model = SACFlow.load_safe(bundle)
    weight = model.actor.latent_pi[0].weight.detach().numpy()
    np.testing.assert_array_equal(arrays["policy.actor.latent_pi.0.weight"], weight)


def test_equal_models_are_equal_files(tmp_path: Path) -> None:
    model = make_model()
    first, second = model.save_safe(tmp_path / "a"), copy.copy(model).save_safe(tmp_path / "b.x")
    assert first.read_bytes() == second.read_bytes()
    assert [first.name, second.name] == ["a.safetensors", "b.x"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.safetensors", "b.x"]
    assert SACFlow.load_safe(tmp_path / "a").num_timesteps == 0


def test_every_argument_of_the_constructor_is_held_or_left_out_on_purpose() -> None:
    """A new argument has to be thought of here, and in SACFlow.settings."""
    import inspect

    own = [
        name
        for kind in (SACFlow, EngineFlow)
        for name in inspect.signature(kind.__init__).parameters
    ]
    theirs = [*inspect.signature(SAC).parameters]
    known = {*theirs, *own} - {"self", "policy", "env", "args", "kwargs", "sac_args", "sac_kwargs"}
    elsewhere = {"learning_rate", "policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs"}
    refused = {"action_noise"}
    left_out = {"demonstrations", "tensorboard_log", "verbose", "device", "_init_setup_model"}
    assert known == {*SACFlow.settings, *elsewhere, *refused, *left_out}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"learning_rate": lambda _: 1e-3}, "learning_rate must be a number or a LinearSchedule"),
        ({"policy_kwargs": {"activation_fn": type("Mine", (th.nn.ReLU,), {})}}, "activation_fn"),
        ({"policy_kwargs": {"features_extractor_class": "mine"}}, "features_extractor_class must"),
        ({"policy_kwargs": {"net_arch": [np.pi]}}, "net_arch must be"),
        ({"policy_kwargs": {"optimizer_kwargs": {"x": {1}}}}, "optimizer_kwargs must be made of"),
        ({"action_noise": "any"}, "set model.action_noise = None before saving"),
        ({"replay_buffer_class": dict}, "replay_buffer_class must be one of"),
        ({"replay_buffer_kwargs": {"env": {1}}}, "replay_buffer_kwargs must be made of"),
        ({"policy_kwargs": {"use_sde": True}}, "use_sde must be False for a safe bundle"),
        ({"policy_class": SACFlow}, "policy_class must be one of"),
        ({"gamma": float("nan")}, "gamma must be finite, got nan"),
    ],
)
def test_what_needs_code_is_refused_when_saving(
    change: dict[str, Any], message: str, tmp_path: Path
) -> None:
    model = make_model()
    model.__dict__.update(change)
    with pytest.raises(ValueError, match=message):
        model.save_safe(tmp_path / "model")
    assert not list(tmp_path.iterdir())


def test_models_full_of_nan_are_not_shared(tmp_path: Path) -> None:
    model = make_model()
    with th.no_grad():
        next(model.actor.parameters()).fill_(float("nan"))
    with pytest.raises(ValueError, match=r"NaN or infinity in policy\.actor\.latent_pi"):
        model.save_safe(tmp_path / "model")


def test_errors_are_values_and_name_the_file(tmp_path: Path) -> None:
    with pytest.raises(
        BundleError, match=r"nowhere must be a bundle .*: not a regular file that exists"
    ):
        SACFlow.load_safe(tmp_path / "nowhere")
    assert issubclass(BundleError, ValueError)


def test_a_deterministic_mode_that_was_set_later_on_is_kept(bundle: Path, tmp_path: Path) -> None:
    model = SACFlow.load_safe(bundle)
    model.policy.deterministic_samples = 8
    model.policy.deterministic_mode = "q"
    loaded = SACFlow.load_safe(model.save_safe(tmp_path / "model"))
    assert loaded.policy.deterministic_mode == "q"
    assert loaded.policy.deterministic_samples == 8
