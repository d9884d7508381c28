"""An off-policy algorithm with SB3's own update gets what ours have from one small class.

In the package these are at most four files of code: one in ``algorithms/``, one in ``policies/``
unless SAC's will do, and entries in ``sb3_flowpolicy/__init__.py`` and ``zoo/registration.py``. A
file in ``zoo_hyperparams`` has the defaults for rl_zoo3.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy import NonFiniteError, SACFlow
from sb3_flowpolicy.algorithms.engine_flow import EngineFlow
from sb3_flowpolicy.common.validation import number
from tests.checkpoint.test_resume import BreakAt, BrokenError
from tests.guard.test_guard import Faulty

ENV = "TunnelDiagonal-v0"
FAST: dict[str, Any] = {
    "learning_starts": 20,
    "batch_size": 16,
    "buffer_size": 200,
    "seed": 0,
    "device": "cpu",
    "policy_kwargs": {"net_arch": [8]},
}


class CautiousSAC(SAC):
    """Stands for an algorithm of another library: SAC with an argument of its own."""

    def __init__(self, policy: Any, env: Any, caution: float = 0.5, **kwargs: Any) -> None:
        self.caution = caution
        super().__init__(policy, env, **kwargs)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        super().train(gradient_steps, max(2, round(self.caution * batch_size)))


class CautiousSACFlow(EngineFlow, CautiousSAC):
    stock = CautiousSAC
    policy_aliases = SACFlow.policy_aliases
    settings: ClassVar = {**EngineFlow.settings, "caution": number(0, 1)}


def test_it_resumes_bit_for_bit_with_colored_noise(tmp_path: Path) -> None:
    settings: Any = {**FAST, "action_noise_color": 1.0, "caution": 0.25}
    th.manual_seed(0)
    calm = CautiousSACFlow("LowRankPolicy", ENV, **settings).learn(90)
    th.manual_seed(0)
    broken = CautiousSACFlow("LowRankPolicy", ENV, **settings)
    with pytest.raises(BrokenError):
        broken.learn(90, BreakAt(67), checkpoint_every=20, checkpoint_path=tmp_path)
    resumed = CautiousSACFlow.resume(tmp_path, ENV, device="cpu")
    assert (resumed.num_timesteps, resumed.caution) == (60, 0.25)
    resumed.learn(90)
    expected, found = calm.policy.state_dict(), resumed.policy.state_dict()
    assert not [name for name, value in expected.items() if not th.equal(value, found[name])]


def test_it_is_guarded_and_its_arguments_are_checked() -> None:
    with pytest.raises(NonFiniteError, match="rewards must be finite"):
        CautiousSACFlow("FlowPolicy", Faulty("rewards", np.nan), **FAST).learn(40)
    with pytest.raises(ValueError, match="caution must be at most 1, got 2"):
        CautiousSACFlow("FlowPolicy", ENV, caution=2, **FAST)
    with pytest.raises(
        ValueError, match=r"must be one of .* or subclass SACPolicy, got 'NoPolicy'"
    ):
        CautiousSACFlow("NoPolicy", ENV, **FAST)
