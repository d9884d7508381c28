"""PPO and A2C with our densities: exact ratios, and all that SB3 does with a policy."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import RecurrentPPO
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.envs import FakeImageEnv, SimpleMultiObsEnv
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_flowpolicy import FlowActorCriticPolicy, LowRankActorCriticPolicy
from sb3_flowpolicy.policies.on_policy import ALIASES
from sb3_flowpolicy.policies.recurrent import FlowLstmPolicy

POLICIES = [FlowActorCriticPolicy, LowRankActorCriticPolicy]
BOTH = pytest.mark.parametrize("policy", POLICIES)
SQUASHED_OR_NOT = pytest.mark.parametrize("squash_output", [True, False])


class Box2D(gym.Env[np.ndarray, np.ndarray]):
    """Three observations, a 2 x 2 action with different bounds, ten steps."""

    observation_space = spaces.Box(-1, 1, (3,))
    action_space = spaces.Box(np.full((2, 2), -3.0, np.float32), np.float32([[1, 2], [3, 4]]))

    def reset(
        self, *, seed: int | None = None, options: Any = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), action
        self.steps += 1
        return self.observation_space.sample(), float(action.sum()), False, self.steps == 10, {}


def disturbed(model: PPO | A2C, scale: float = 0.3) -> PPO | A2C:
    """Move the weights off their initial values, where flows are the identity."""
    with th.no_grad():
        for parameter in model.policy.action_net.parameters():
            parameter.add_(scale * th.randn_like(parameter))
    return model


@BOTH
@SQUASHED_OR_NOT
@pytest.mark.parametrize("scale", [0.0, 0.3])
def test_stored_actions_have_the_log_prob_they_were_collected_with(
    policy: type[ActorCriticPolicy], squash_output: bool, scale: float
) -> None:
    model = PPO(
        policy,
        Box2D(),
        n_steps=256,
        batch_size=256,
        seed=0,
        policy_kwargs={"squash_output": squash_output},
    )
    disturbed(model, scale)
    found: list[float] = []
    model.train = lambda: found.append(_largest_difference(model))  # type: ignore[method-assign]
    model.learn(256)
    assert found
    assert found[0] < 1e-5


def _largest_difference(model: PPO) -> float:
    """Return the largest difference to the log-probabilities that were collected one by one."""
    (data,) = model.rollout_buffer.get(256)
    with th.no_grad():
        _, log_prob, _ = model.policy.evaluate_actions(data.observations, data.actions)
    return (log_prob - data.old_log_prob).abs().max().item()


@BOTH
def test_kl_and_clip_fraction_are_those_of_a_recomputation_in_float64(
    policy: type[ActorCriticPolicy],
) -> None:
    kwargs = {"squash_output": True}
    model = PPO(
        policy,
        Box2D(),
        n_steps=128,
        batch_size=128,
        n_epochs=1,
        seed=0,
        policy_kwargs=kwargs,
    )
    disturbed(model)
    model.learn(128)
    data = next(model.rollout_buffer.get(128))
    with th.no_grad():  # the policy now differs from the one that collected
        for parameter in model.policy.action_net.parameters():
            parameter.add_(0.1 * th.randn_like(parameter))
        _, new, _ = model.policy.evaluate_actions(data.observations, data.actions)
        model.policy.double()
        context = model.policy.mlp_extractor.forward_actor(data.observations.double())
        # An action at the edge is scored as the largest number of float32 below it.
        edge = 1 - th.finfo(th.float32).eps
        actions = data.actions.double().clamp(-edge, edge)
        new64 = model.policy.action_net.log_prob(context, actions)
    ratio, ratio64 = ((now.double() - data.old_log_prob.double()).exp() for now in (new, new64))
    kl, kl64 = ((r - 1 - r.log()).mean().item() for r in (ratio, ratio64))
    clipped, clipped64 = (((r - 1).abs() > 0.2).double().mean().item() for r in (ratio, ratio64))
    assert kl64 > 1e-3
    assert kl == pytest.approx(kl64, rel=1e-3)
    assert 0 < clipped64 < 1
    assert clipped == pytest.approx(clipped64, abs=1 / 128)


@BOTH
def test_a_ratio_beyond_float32_leaves_weights_finite(policy: type[ActorCriticPolicy]) -> None:
    """An action at the edge can be many standard deviations from the one that was drawn."""
    model = PPO(policy, Box2D(), n_steps=64, batch_size=64, n_epochs=1, seed=0)
    model.learn(64)
    before = model.policy.action_net.state_dict()
    before = {name: value.clone() for name, value in before.items()}
    model.rollout_buffer.log_probs[::2] -= 200.0
    advantages = model.rollout_buffer.advantages
    assert (advantages[::2] > 0).any()
    assert (advantages[::2] < 0).any()
    model.train()
    after = model.policy.state_dict()
    assert all(value.isfinite().all() for value in after.values())
    changed = model.policy.action_net.state_dict()
    assert any(not th.equal(changed[name], value) for name, value in before.items())


@BOTH
@SQUASHED_OR_NOT
def test_the_entropy_bonus_is_the_entropy_and_moves_it(
    policy: type[ActorCriticPolicy], squash_output: bool
) -> None:
    kwargs = {"squash_output": squash_output}
    model = PPO(policy, Box2D(), seed=0, policy_kwargs=kwargs, learning_rate=1e-2)
    disturbed(model, 0.1)
    obs = th.randn(64, 3)
    dist = model.policy.get_distribution(obs)
    with th.no_grad():
        scores = th.stack([dist.log_prob(dist.sample()) for _ in range(4000)])
        estimates = th.stack([dist.entropy() for _ in range(100)])
    expected = -scores.mean(0)
    error = estimates.std(0) / 100**0.5 + scores.std(0) / 4000**0.5
    assert ((estimates.mean(0) - expected).abs() < 5 * error).all()

    before = estimates.mean()
    for _ in range(20):  # descend on the entropy alone
        loss = model.policy.get_distribution(obs).entropy().mean()
        model.policy.optimizer.zero_grad()
        loss.backward()
        model.policy.optimizer.step()
    with th.no_grad():
        assert model.policy.get_distribution(obs).entropy().mean() < before - 0.1


@BOTH
@SQUASHED_OR_NOT
@pytest.mark.parametrize("algorithm", [PPO, A2C])
def test_a_saved_model_predicts_the_same(
    policy: type[ActorCriticPolicy], squash_output: bool, algorithm: Any, tmp_path: Path
) -> None:
    kwargs = {"squash_output": squash_output, "net_arch": [16]}
    model = algorithm(policy, Box2D(), n_steps=32, policy_kwargs=kwargs, seed=1).learn(64)
    obs = np.random.default_rng(0).uniform(-1, 1, (5, 3)).astype(np.float32)
    expected = model.predict(obs, deterministic=True)[0]
    assert expected.shape == (5, 2, 2)
    assert (expected >= Box2D.action_space.low).all()
    assert (expected <= Box2D.action_space.high).all()
    loaded = algorithm.load(_saved(model, tmp_path))
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], expected)
    np.testing.assert_array_equal(_sampled(loaded, obs), _sampled(model, obs))
    model.policy.save(tmp_path / "policy")
    alone = type(model.policy).load(tmp_path / "policy")
    np.testing.assert_array_equal(alone.predict(obs, deterministic=True)[0], expected)


def _saved(model: PPO | A2C, folder: Path) -> Path:
    model.save(folder / "model")
    return folder / "model.zip"


def _sampled(model: PPO | A2C, obs: np.ndarray) -> np.ndarray:
    th.manual_seed(3)
    return model.predict(obs)[0]


def test_a_saved_model_loads_in_a_new_process(tmp_path: Path) -> None:
    model = PPO(FlowActorCriticPolicy, "Pendulum-v1", n_steps=32, batch_size=32, seed=0).learn(32)
    expected = model.predict(np.zeros(3, np.float32), deterministic=True)[0].item()
    code = (
        "import sys, numpy as np\n"
        "from stable_baselines3 import PPO\n"
        "model = PPO.load(sys.argv[1])\n"
        "print(repr(model.predict(np.zeros(3, np.float32), deterministic=True)[0].item()))\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", code, str(_saved(model, tmp_path))],
        capture_output=True,
        text=True,
        check=True,
    )
    assert float(run.stdout) == expected


@pytest.mark.parametrize(
    ("alias", "env"),
    [
        ("CnnFlowPolicy", lambda: FakeImageEnv(40, 40, discrete=False)),
        ("CnnLowRankPolicy", lambda: FakeImageEnv(40, 40, discrete=False)),
        ("MultiInputFlowPolicy", lambda: SimpleMultiObsEnv(discrete_actions=False)),
        ("MultiInputLowRankPolicy", lambda: SimpleMultiObsEnv(discrete_actions=False)),
    ],
)
def test_images_and_dictionaries(alias: str, env: Any, tmp_path: Path) -> None:
    model = PPO(ALIASES[alias], env(), n_steps=16, batch_size=16, n_epochs=1, seed=0).learn(16)
    env = model.get_env()
    assert env is not None
    obs = env.reset()
    expected = model.predict(obs, deterministic=True)[0]
    loaded = PPO.load(_saved(model, tmp_path))
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], expected)


def test_recurrent_ppo(tmp_path: Path) -> None:
    kwargs = {"lstm_hidden_size": 8, "net_arch": [8]}
    model = RecurrentPPO(FlowLstmPolicy, Box2D(), n_steps=32, policy_kwargs=kwargs, seed=0)
    model.learn(64)
    model.save(tmp_path / "model")
    loaded = RecurrentPPO.load(tmp_path / "model")
    obs = np.zeros((1, 3), np.float32)
    expected, memory = model.predict(obs, deterministic=True)
    found, same_memory = loaded.predict(obs, deterministic=True)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(same_memory, memory)
    with pytest.raises(ValueError, match=r"squash_output must be False.* got True"):
        RecurrentPPO(FlowLstmPolicy, Box2D(), policy_kwargs={"squash_output": True})


class Shifted(Box2D):
    """A box outside the range of tanh, which records the actions it receives."""

    action_space = spaces.Box(10, 20, (2,))

    def __init__(self) -> None:
        self.received: list[np.ndarray] = []

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.received.append(action.copy())
        return super().step(action)


@pytest.mark.parametrize(
    ("algorithm", "policy", "squash_output"),
    [
        (PPO, FlowActorCriticPolicy, False),
        (PPO, FlowActorCriticPolicy, True),
        (RecurrentPPO, FlowLstmPolicy, False),
    ],
)
def test_environments_are_sent_the_actions_that_are_learned_from(
    algorithm: Any, policy: type[ActorCriticPolicy], squash_output: bool
) -> None:
    env = Shifted()
    settings = {"n_steps": 32, "batch_size": 32, "n_epochs": 1, "seed": 0}
    kwargs = {"squash_output": squash_output}
    model = algorithm(policy, env, policy_kwargs=kwargs, **settings).learn(32)
    assert model.policy.squash_output == squash_output
    stored = model.rollout_buffer.actions.reshape(-1, 2)
    if model.policy.squash_output:
        expected = model.policy.unscale_action(stored)
    else:  # as in SB3, the buffer holds the actions before clipping
        assert (stored < 10).any()
        expected = stored.clip(10, 20)
    np.testing.assert_allclose(np.stack(env.received), expected, rtol=1e-6)
    if model.policy.squash_output:
        assert np.stack(env.received).std() > 0.5


@pytest.mark.parametrize(
    ("algorithm", "policy"), [(PPO, FlowActorCriticPolicy), (RecurrentPPO, FlowLstmPolicy)]
)
def test_nan_is_refused(algorithm: Any, policy: type[ActorCriticPolicy]) -> None:
    model = algorithm(policy, Box2D(), n_steps=16, batch_size=16, n_epochs=1, seed=0)
    with pytest.raises(ValueError, match="observation must be finite in float32, got nan"):
        model.predict(np.full(3, np.nan, np.float32))
    model.learn(16)
    with th.no_grad():
        model.policy.value_net.weight.fill_(th.nan)  # does not affect actions
        model.policy.mlp_extractor.policy_net[0].weight[0, 0] = th.nan
    with pytest.raises(ValueError, match="weights must be finite, got actions with NaN"):
        model.learn(16, reset_num_timesteps=False)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"net_arch": 4}, "net_arch must be a list of layer sizes.* got 4"),
        ({"net_arch": [-4]}, "net_arch must be an integer of at least 1, got -4"),
        ({"net_arch": {"pi": [2.5]}}, "net_arch must be an integer of at least 1, got 2.5"),
        (
            {"net_arch": {"pi": [4], "qf": [4]}},
            r"net_arch must be a dict with the keys .*'vf'.*, got",
        ),
        ({"distribution": "nvp"}, "distribution must be one of"),
        ({"distribution_kwargs": 4}, "distribution_kwargs must be None or a dict .* got 4"),
        ({"log_std_init": 21}, "log_std_init must be at most 20, got 21"),
        ({"state_dependent_std": 1}, "state_dependent_std must be True or False, got 1"),
    ],
)
def test_bad_arguments(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PPO(FlowActorCriticPolicy, Box2D(), policy_kwargs=kwargs)


def test_bad_spaces_and_gsde() -> None:
    with pytest.raises(ValueError, match=r"action_space must be a Box, got Discrete\(2\)"):
        PPO(FlowActorCriticPolicy, "CartPole-v1")
    with pytest.raises(ValueError, match="use_sde must be False"):
        PPO(FlowActorCriticPolicy, "Pendulum-v1", use_sde=True)
    space, schedule = spaces.Box(-np.inf, np.inf, (2,)), lambda _: 1e-3
    with pytest.raises(ValueError, match="action_space must be a Box with finite bounds"):
        FlowActorCriticPolicy(Box2D.observation_space, space, schedule, squash_output=True)
    policy = FlowActorCriticPolicy(Box2D.observation_space, space, schedule)
    assert policy.predict(np.zeros(3, np.float32))[0].shape == (2,)


@BOTH
def test_it_learns(policy: type[ActorCriticPolicy]) -> None:
    """The reward is the sum of the actions, so the upper corner is best."""
    model = PPO(policy, Box2D(), n_steps=256, batch_size=128, learning_rate=1e-2, seed=0)
    model.learn(3072)
    action = model.predict(np.zeros((1, 3), np.float32), deterministic=True)[0]
    assert action.sum() > 2  # it starts at 0; the maximum is 10
