"""The thesis's validation environments, briefly: everything trains, nothing turns NaN."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.common.hyperparameters import load_hyperparameters

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # pybullet's bindings warn about SWIG types
    pytest.importorskip("pybullet_envs_gymnasium")


@pytest.mark.parametrize("algo", ["sac_flow", "sac_lowrank", "sac_gauss"])
def test_ant_trains_without_nan(algo: str) -> None:
    settings = load_hyperparameters(algo, "AntBulletEnv-v0")
    del settings["n_timesteps"]
    # Shorter than in the thesis's table, so that the policy itself soon learns and acts.
    settings.update(buffer_size=700, learning_starts=300, random_steps=400, seed=0, device="cpu")
    settings.update(train_freq=32, gradient_steps=8)
    model = SACFlow(env="AntBulletEnv-v0", **settings).learn(700)
    assert model._n_updates >= 96
    assert np.isfinite(model.policy.parameters_to_vector()).all()
    assert model.replay_buffer is not None
    assert np.isfinite(model.replay_buffer.observations).all()
    assert np.isfinite(model.replay_buffer.actions).all()
