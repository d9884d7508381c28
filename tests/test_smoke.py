"""The least that has to work with every version allowed: `make lowest` runs only this file."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import sb3_flowpolicy
from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.common.vec_env import make_batched_env

pytestmark = pytest.mark.smoke


@pytest.fixture(scope="module")
def model():
    return SACFlow(
        *("FlowPolicy", "TunnelDiagonal-v0"),
        **{"learning_starts": 20, "batch_size": 16, "buffer_size": 100, "seed": 0},
        **{"policy_kwargs": {"net_arch": [8]}, "device": "cpu", "compile": False},
    )


@pytest.mark.parametrize("name", sb3_flowpolicy.__all__)
def test_public_names(name):
    assert getattr(sb3_flowpolicy, name) is not None


def test_train_save_and_load(model, tmp_path):
    before = model.policy.parameters_to_vector()
    model.learn(24)
    assert not np.array_equal(model.policy.parameters_to_vector(), before)
    model.save(tmp_path / "model")
    loaded = SACFlow.load(tmp_path / "model", device="cpu")
    obs = model.observation_space.sample()
    one, other = (m.predict(obs, deterministic=True)[0] for m in (model, loaded))
    assert np.array_equal(one, other)


@pytest.mark.parametrize("env_id", ["TunnelDiagonal-v0", "SquareHold-v0"])
def test_environments(env_id):
    with gym.make(env_id, render_mode="rgb_array") as env:
        env.reset(seed=0)
        env.step(env.action_space.sample())
        assert env.render().ndim == 3
    env = make_batched_env(env_id, n_envs=2, seed=0)
    env.reset()
    env.step(np.zeros((2, *env.action_space.shape), np.float32))
    env.close()


def test_zoo_registration():
    pytest.importorskip("rl_zoo3")
    from rl_zoo3 import ALGOS

    from sb3_flowpolicy.zoo import ALGORITHMS, register

    register()
    assert set(ALGORITHMS) <= set(ALGOS)


def test_lowest_versions_are_the_lower_bounds():
    tomllib = pytest.importorskip("tomllib")  # Python 3.11
    requirements = pytest.importorskip("packaging.requirements")
    root = Path(__file__).parents[1]
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]

    def bounds(lines):
        parsed = map(requirements.Requirement, lines)
        return {
            required.name: bound.version
            for required in parsed
            for bound in required.specifier
            if bound.operator == ">="
        }

    lines = (root / "constraints-lowest.txt").read_text().splitlines()
    pins = dict(line.split("==") for line in lines if not line.startswith("#"))
    needed = bounds([*project["dependencies"], *extras["zoo"], *extras["contrib"]])
    assert needed.keys() <= pins.keys()
    every = bounds([*extras["dev"]]) | needed
    version = pytest.importorskip("packaging.version").Version
    assert {name: version(pin) for name, pin in pins.items()} == {
        name: version(every[name]) for name in pins
    }
