"""TQC, CrossQ and PPO refuse NaN as SAC does."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_flowpolicy import CrossQFlow, NonFiniteError, PPOFlow, TQCFlow
from tests.guard.test_guard import SEEDED, Faulty, size


def weights_are_finite(model: Any) -> bool:
    return all(bool(value.isfinite().all()) for value in model.policy.state_dict().values())


@pytest.mark.parametrize("algorithm", [TQCFlow, CrossQFlow])
@pytest.mark.parametrize("what", ["rewards", "final"])
def test_other_algorithms_check_experience(algorithm: Any, what: str) -> None:
    model = algorithm("FlowPolicy", Faulty(what, np.nan), **SEEDED)
    with pytest.raises(NonFiniteError, match="must be finite in float32, got nan from environment"):
        model.learn(40)
    assert size(model) == 19
    assert weights_are_finite(model)
    model.learn(10, reset_num_timesteps=False)


@pytest.mark.parametrize("algorithm", [TQCFlow, CrossQFlow])
def test_other_algorithms_restore_finite_weights(algorithm: Any) -> None:
    model = algorithm("FlowPolicy", Faulty("nothing", 0.0), **SEEDED)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.learn(30)
    model.train(0)
    model.replay_buffer.rewards[:] = np.inf
    # The weights are those that it last looked at and kept.
    message = r"critic_loss must be finite, got .*rewards.* back at update 0\."
    with pytest.raises(NonFiniteError, match=message):
        model.train(2, 16)
    after = model.policy.state_dict()
    changed = {name for name, value in before.items() if not th.equal(value, after[name])}
    assert not {name for name in changed if not name.endswith(".steps")}  # CrossQ's warm-up
    model.replay_buffer.rewards[:] = 1.0
    model.train(1, 16)  # of the losses that were not finite nothing is left
    assert weights_are_finite(model)


def test_ppo_learns_nothing_from_nan() -> None:
    settings: Any = {"n_steps": 16, "batch_size": 16, "n_epochs": 1, "seed": 0, "device": "cpu"}
    model = PPOFlow("FlowPolicy", Faulty("rewards", np.nan), **settings).learn(16)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    with pytest.raises(NonFiniteError, match=r"rewards must be finite, got nan .* ends at step 32"):
        model.learn(16, reset_num_timesteps=False)
    after = model.policy.state_dict()
    assert not [name for name, value in before.items() if not th.equal(value, after[name])]
    model.learn(16, reset_num_timesteps=False)
    assert weights_are_finite(model)
