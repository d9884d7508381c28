"""Acting with recorded graphs: the same actions, whatever happens to the weights."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_flowpolicy import PPOFlow, SACFlow
from sb3_flowpolicy.distributions import registered_distributions
from sb3_flowpolicy.policies import traced
from sb3_flowpolicy.policies.traced import TracedCalls
from tests.policies.test_deterministic import Spaces

OBSERVATIONS = np.random.default_rng(0).normal(size=(6, 4)).astype(np.float32)
OFF_POLICY = [(SACFlow, mode) for mode in ("base", "log_prob", "q")]


def make(algorithm: type, distribution: str) -> Any:
    kwargs = {"net_arch": [16, 16], "distribution": distribution}
    return algorithm("FlowPolicy", Spaces(), policy_kwargs=kwargs, seed=0, device="cpu")


def actions(model: Any, deterministic: bool) -> np.ndarray:
    """Return actions of single observations and of a batch, drawn with a fixed seed."""
    th.manual_seed(1)
    single = [model.predict(one, deterministic=deterministic)[0] for one in OBSERVATIONS]
    return np.stack([*single, *model.predict(OBSERVATIONS, deterministic=deterministic)[0]])


@pytest.fixture
def eagerly(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that acts without graphs."""

    def act(model: Any, deterministic: bool) -> np.ndarray:
        with monkeypatch.context() as patch:
            patch.setattr(TracedCalls, "__call__", lambda _, f, modules, *args: f(*modules, *args))
            return actions(model, deterministic)

    return act


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize(("algorithm", "mode"), [*OFF_POLICY, (PPOFlow, "base")])
@pytest.mark.parametrize("distribution", registered_distributions())
def test_graphs_give_the_same_actions_and_follow_the_weights(
    distribution: str,
    algorithm: type,
    mode: str,
    deterministic: bool,
    monkeypatch: pytest.MonkeyPatch,
    eagerly: Any,
) -> None:
    monkeypatch.setattr(traced, "CALLS_WORTH_TRACING", 2)
    model = make(algorithm, distribution)
    model.policy.deterministic_mode = mode
    actions(model, deterministic)
    graphs = getattr(model.policy, "actor", model.policy).traced
    before = actions(model, deterministic)
    assert graphs._graphs
    np.testing.assert_array_equal(before, eagerly(model, deterministic))

    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(0.1 * th.randn_like(parameter))
    after = actions(model, deterministic)
    np.testing.assert_array_equal(after, eagerly(model, deterministic))
    assert not np.array_equal(before, after)

    for parameter in model.policy.parameters():  # as the engine does
        parameter.data = parameter.data + 0.1
    np.testing.assert_array_equal(actions(model, deterministic), eagerly(model, deterministic))


def test_a_network_that_is_replaced_acts_in_its_own_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(traced, "CALLS_WORTH_TRACING", 2)
    model = make(SACFlow, "gaussian")
    before = actions(model, True)
    model.actor.latent_pi = nn.Sequential(nn.Linear(4, 16), nn.Dropout())
    after = actions(model, True)
    assert not np.array_equal(before, after)
    assert not any(module.training for module in model.actor.modules())
    np.testing.assert_array_equal(actions(model, True), after)


def test_copies_have_their_own_graphs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(traced, "CALLS_WORTH_TRACING", 2)
    model = make(SACFlow, "realnvp")
    before = actions(model, True)
    actor = copy.deepcopy(model.actor)
    assert not actor.traced._graphs
    assert not pickle.loads(pickle.dumps(model.actor.traced))._graphs
    with th.no_grad():
        for parameter in actor.parameters():
            parameter.zero_()
    np.testing.assert_array_equal(actions(model, True), before)


def _absolute(module: nn.Module, values: th.Tensor) -> th.Tensor:
    return values if values.sum() > 0 else -values


def test_functions_that_branch_on_values_are_not_recorded() -> None:
    calls, module = TracedCalls(), nn.Identity()
    for _ in range(traced.CALLS_WORTH_TRACING + 2):
        assert calls(_absolute, (module,), th.ones(1)) == 1
    assert calls(_absolute, (module,), -th.ones(1)) == 1


def test_acting_works_without_the_tracer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(traced, "CALLS_WORTH_TRACING", 1)
    model = make(SACFlow, "realnvp")
    expected = actions(model, False)

    def missing(*args: Any, **kwargs: Any) -> None:
        raise AttributeError("module 'torch.jit' has no attribute 'trace'")

    monkeypatch.setattr(th.jit, "trace", missing)
    np.testing.assert_array_equal(actions(make(SACFlow, "realnvp"), False), expected)


def test_images_and_dictionaries_act_with_graphs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(traced, "CALLS_WORTH_TRACING", 2)
    space = spaces.Dict(
        {"a": spaces.Box(-1, 1, (2,)), "b": spaces.Box(0, 255, (40, 40, 3), np.uint8)}
    )
    env = Spaces()
    env.observation_space = space
    kwargs = {"net_arch": [16]}
    model = SACFlow("MultiInputPolicy", env, policy_kwargs=kwargs, buffer_size=10, seed=0)
    observation = space.sample()
    chosen = [model.predict(observation, deterministic=True)[0] for _ in range(5)]
    assert model.actor.traced._graphs
    assert all(np.array_equal(one, chosen[0]) for one in chosen)
