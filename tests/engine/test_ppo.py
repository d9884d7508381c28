"""The PPO engine does what SB3's loop does."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import set_random_seed

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy import PPOFlow
from sb3_flowpolicy.engine.ppo_engine import PPOEngine

# 150 steps leave a minibatch of 22 at the end of each epoch.
SMALL: dict[str, Any] = {"n_steps": 150, "batch_size": 64, "n_epochs": 2, "seed": 0}
ENV = "SquareMove-v1"


class _SameType(FlattenExtractor):
    """SB3 casts observations to float32; here they get the type of the parameters."""

    dtype = th.float32

    def forward(self, obs: th.Tensor) -> th.Tensor:
        return super().forward(obs).to(self.dtype)


class _Collected(PPOFlow):
    """A model that stops before its first update."""

    def train(self) -> None:
        self.policy.action_dist.estimates_entropy = self.ent_coef != 0.0


def collected(policy: str, dtype: th.dtype, kwargs: dict[str, Any]) -> PPOFlow:
    kwargs = dict(kwargs)
    policy_kwargs = {"features_extractor_class": _SameType, **kwargs.pop("policy_kwargs", {})}
    model = _Collected(
        policy, ENV, compile=False, policy_kwargs=policy_kwargs, **{**SMALL, **kwargs}
    ).learn(150)
    # Ratios of exactly 1 at the start would leave clipping untested.
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(0.02 * th.randn_like(parameter))
    model.policy.to(dtype)
    model.policy.features_extractor.dtype = dtype
    buffer = model.rollout_buffer
    for name in ("observations", "actions", "values", "log_probs", "advantages", "returns"):
        array = getattr(buffer, name)
        setattr(buffer, name, array.astype(np.float64 if dtype == th.float64 else np.float32))
    return model


def trained(model: PPOFlow, engine: bool | None) -> tuple[dict[str, th.Tensor], dict[str, Any]]:
    """Train on the rollout: with SB3's loop (None), or with the engine, compiled or not."""
    set_random_seed(1)
    if engine is None:
        PPO.train(model)
    else:
        bound = PPOEngine([model], compiled=engine)
        model._train_with(bound)
        bound.release()
    logged = {k: v for k, v in model.logger.name_to_value.items() if k.startswith("train/")}
    states = {f"{name} {key}": value[key] for name, value in moments(model) for key in value}
    return {**model.policy.state_dict(), **states}, logged


def moments(model: PPOFlow) -> list[tuple[int, dict[str, th.Tensor]]]:
    return list(model.policy.optimizer.state_dict()["state"].items())


@pytest.mark.parametrize("dtype", [th.float32, th.float64])
@pytest.mark.parametrize(
    ("policy", "kwargs"),
    [
        ("FlowPolicy", {}),
        ("FlowPolicy", {"ent_coef": 0.01, "clip_range_vf": 0.2, "max_grad_norm": 0.1}),
        ("GaussPolicy", {"ent_coef": 0.01, "normalize_advantage": False}),
        ("LowRankPolicy", {"target_kl": 0.02, "policy_kwargs": {"squash_output": True}}),
    ],
)
def test_two_epochs_equal_sb3s(policy: str, kwargs: dict[str, Any], dtype: th.dtype) -> None:
    expected, logged = trained(collected(policy, dtype, kwargs), None)
    found, also_logged = trained(collected(policy, dtype, kwargs), False)
    tolerance = 1e-5 if dtype == th.float32 else 1e-10
    th.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance)
    assert logged.keys() == also_logged.keys()
    for name, value in logged.items():
        assert also_logged[name] == pytest.approx(value, rel=1e-4, abs=1e-6), name


def test_compiled_equals_eager() -> None:
    kwargs = {"ent_coef": 0.01}
    expected, _ = trained(collected("FlowPolicy", th.float32, kwargs), False)
    found, _ = trained(collected("FlowPolicy", th.float32, kwargs), True)
    th.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


def test_acting_equals_the_policys_own() -> None:
    model = collected("FlowPolicy", th.float32, {})
    engine, obs = PPOEngine([model], compiled=False), th.randn(3, 42)
    th.manual_seed(2)
    expected = model.policy(obs)
    with engine.collecting():
        th.manual_seed(2)
        found = model.policy(obs)
    th.testing.assert_close(found, tuple(part.detach() for part in expected), rtol=1e-5, atol=1e-5)
    assert "forward" not in vars(model.policy)


@pytest.mark.parametrize("what", ["loaded", "assigned", "moved", "shifted"])
def test_acting_follows_what_callbacks_do_to_the_policy(what: str) -> None:
    model = collected("FlowPolicy", th.float32, {})
    policy, obs = model.policy, th.randn(3, 42)
    engine = PPOEngine([model], compiled=False)
    state = {name: value + 0.1 for name, value in policy.state_dict().items()}
    with engine.collecting():
        if what == "moved":
            policy.to(th.float64)
            policy.features_extractor.dtype = th.float64
        elif what == "shifted":
            for name, parameter in policy.named_parameters():
                parameter.data = state[name]
        else:
            policy.load_state_dict(state, assign=what == "assigned")
        th.manual_seed(2)
        found = policy(obs)
    th.manual_seed(2)
    expected = policy(obs)
    th.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
    assert engine.fits() == (what in ("loaded", "shifted"))


def test_a_minibatch_with_a_log_probability_that_is_not_finite_changes_nothing() -> None:
    model = collected("FlowPolicy", th.float32, {})
    model.rollout_buffer.actions[:] = np.nan
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    with pytest.raises(ValueError, match="got log-probabilities with NaN or infinity"):
        trained(model, False)
    th.testing.assert_close(dict(model.policy.state_dict()), before, rtol=0, atol=0)


class _FreezeOnce(BaseCallback):
    """Freezes the policy's first layer at a step: SB3's loop takes over."""

    def _on_step(self) -> bool:
        if self.num_timesteps == 200:
            self.model.policy.mlp_extractor.policy_net[0].requires_grad_(False)
        return True


def test_the_engine_steps_aside_for_what_it_does_not_support() -> None:
    model = PPOFlow("GaussPolicy", ENV, compile=False, **SMALL).learn(150)
    assert model._runtime._engine is not None
    with pytest.warns(
        UserWarning, match="does not support parameters that are frozen or have hooks"
    ):
        model.learn(300, callback=_FreezeOnce())
    assert PPOEngine.why_unsupported(model) == "parameters that are frozen or have hooks"
    assert model._runtime._engine is None
    assert model._n_updates == 6


def test_the_policy_owns_its_memory_after_learning(tmp_path: Path) -> None:
    model = PPOFlow("GaussPolicy", ENV, compile=False, **SMALL).learn(150)
    storages = {p.untyped_storage().data_ptr() for p in model.policy.parameters()}
    assert len(storages) == len(list(model.policy.parameters()))
    model.save(tmp_path / "model.zip")
    again = PPOFlow.load(tmp_path / "model.zip", env=model.get_env())
    th.testing.assert_close(dict(again.policy.state_dict()), dict(model.policy.state_dict()))
    assert again.learn(150).num_timesteps == 150
