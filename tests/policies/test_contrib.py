"""TQC and CrossQ with our densities can do what they can with their own policies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from sb3_contrib import TQC, CrossQ
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv, SimpleMultiObsEnv
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_flowpolicy.policies import tqc
from sb3_flowpolicy.policies.crossq import (
    FlowCrossQPolicy,
    GaussCrossQPolicy,
    LowRankCrossQPolicy,
)
from sb3_flowpolicy.policies.tqc import FlowTQCPolicy, GaussTQCPolicy, LowRankTQCPolicy

SMALL = {"net_arch": [16, 16]}
PAIRS: list[Any] = [
    (TQC, GaussTQCPolicy),
    (TQC, LowRankTQCPolicy),
    (TQC, FlowTQCPolicy),
    (CrossQ, GaussCrossQPolicy),
    (CrossQ, LowRankCrossQPolicy),
    (CrossQ, FlowCrossQPolicy),
]
ALL = pytest.mark.parametrize(("algorithm", "policy"), PAIRS)


def make(algorithm: Any, policy: type[BasePolicy], env: Any = "Pendulum-v1", **kwargs: Any) -> Any:
    settings = {"learning_starts": 20, "batch_size": 16, "buffer_size": 300, "seed": 0}
    settings |= {"policy_kwargs": SMALL} | kwargs
    return algorithm(policy, env, **settings)


@pytest.mark.parametrize(
    ("algorithm", "policy"), [(TQC, GaussTQCPolicy), (CrossQ, GaussCrossQPolicy)]
)
def test_gauss_is_the_stock_policy(algorithm: Any, policy: type[BasePolicy]) -> None:
    ours, stock = make(algorithm, policy), make(algorithm, "MlpPolicy")
    theirs = stock.policy.state_dict()
    assert ours.policy.state_dict().keys() == theirs.keys()
    for name, value in ours.policy.state_dict().items():
        assert th.equal(value, theirs[name]), name
    stock.learn(60)
    ours.policy.load_state_dict(stock.policy.state_dict())
    obs = np.random.default_rng(0).uniform(-1, 1, (7, 3)).astype(np.float32)
    expected = stock.predict(obs, deterministic=True)[0]
    np.testing.assert_allclose(ours.predict(obs, deterministic=True)[0], expected, atol=1e-6)


@ALL
def test_a_saved_model_predicts_and_learns_on(
    algorithm: Any, policy: type[BasePolicy], tmp_path: Path
) -> None:
    model = make(algorithm, policy).learn(60)
    name = "actor.latent_pi.0.weight" if algorithm is TQC else "actor.latent_pi.1.weight"
    before = dict(model.policy.named_parameters())[name].clone()
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=model.get_env())
    obs = np.random.default_rng(0).uniform(-1, 1, (5, 3)).astype(np.float32)
    for deterministic in (True, False):
        actions = []
        for one in (model, loaded):
            th.manual_seed(1)
            actions.append(one.predict(obs, deterministic=deterministic)[0])
        assert actions[0].shape == (5, 1)
        np.testing.assert_array_equal(*actions)
    loaded.learn(40, reset_num_timesteps=False)
    parameters = dict(loaded.policy.named_parameters())
    assert not th.equal(parameters[name], before)
    assert all(value.isfinite().all() for value in parameters.values())
    model.policy.save(tmp_path / "policy")
    alone = policy.load(tmp_path / "policy")
    np.testing.assert_array_equal(
        alone.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0]
    )


@pytest.mark.parametrize(("algorithm", "policy"), [PAIRS[2], PAIRS[5]])
def test_several_environments(algorithm: Any, policy: type[BasePolicy]) -> None:
    model = make(algorithm, policy, make_vec_env("Pendulum-v1", 3)).learn(60)
    assert model.predict(model.env.reset())[0].shape == (3, 1)


@pytest.mark.parametrize(
    ("alias", "env"),
    [
        (f"{form}{kind}Policy", env)
        for form, env in (
            ("Cnn", lambda: FakeImageEnv(40, 40, discrete=False)),
            ("MultiInput", lambda: SimpleMultiObsEnv(discrete_actions=False)),
        )
        for kind in ("Gauss", "LowRank", "Flow")
    ],
)
def test_images_and_dictionaries(alias: str, env: Any, tmp_path: Path) -> None:
    policy = tqc.ALIASES[alias]
    assert policy is getattr(tqc, policy.__name__)
    model = make(TQC, policy, env(), learning_starts=8, batch_size=8).learn(12)
    model.save(tmp_path / "model")
    loaded: OffPolicyAlgorithm = TQC.load(tmp_path / "model")
    obs = model.get_env().reset()
    np.testing.assert_array_equal(
        loaded.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0]
    )


@pytest.mark.parametrize(("algorithm", "policy"), [PAIRS[2], PAIRS[5]])
def test_the_best_by_the_critics(algorithm: Any, policy: type[BasePolicy]) -> None:
    """The critics of these algorithms have quantiles or batch renormalization."""
    model = make(algorithm, policy).learn(60)
    obs = np.random.default_rng(0).uniform(-1, 1, (9, 3)).astype(np.float32)

    def value(actions: np.ndarray) -> th.Tensor:
        seen, scaled = th.as_tensor(obs), th.as_tensor(model.policy.scale_action(actions))
        with th.no_grad():
            found = model.critic(seen, scaled)
        return (found.mean(-1) if algorithm is TQC else th.cat(found, 1)).amin(1)

    base = model.predict(obs, deterministic=True)[0]
    model.policy.deterministic_mode = "q"
    best = model.predict(obs, deterministic=True)[0]
    assert (value(best) >= value(base) - 1e-5).all()
    assert (value(best) > value(base) + 1e-4).any()


@pytest.mark.parametrize("pair", [PAIRS[2], PAIRS[5]])
def test_bad_arguments(pair: Any) -> None:
    with pytest.raises(ValueError, match="distribution must be one of"):
        make(*pair, policy_kwargs={"distribution": "nvp"})
    with pytest.raises(TypeError, match="unexpected keyword argument 'layers'"):
        make(*pair, policy_kwargs={"layers": 2})
    with pytest.raises(ValueError, match="use_sde must be False unless distribution is 'gaussian'"):
        make(*pair, use_sde=True)
