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
    # Fewer random steps than in the thesis's table, so that the policy itself acts in the test.
    settings.update(buffer_size=3000, random_steps=2200, seed=0, device="cpu")
    model = SACFlow(env="AntBulletEnv-v0", **settings).learn(3000)
    assert model._n_updates >= 768
    assert np.isfinite(model.policy.parameters_to_vector()).all()
    assert model.replay_buffer is not None
    assert np.isfinite(model.replay_buffer.observations[:3000]).all()
    assert np.isfinite(model.replay_buffer.actions[:3000]).all()
