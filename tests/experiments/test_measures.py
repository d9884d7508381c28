"""Measurements against what they claim to measure."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from flowpolicy_envs.registration import TUNNEL_IDS
from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.experiments import measures


@pytest.mark.parametrize("env_id", TUNNEL_IDS)
def test_the_profile_follows_the_way_that_is_rewarded(
    env_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    geometry = gym.make(env_id).unwrapped.config.geometry  # type: ignore[attr-defined]
    model = SACFlow("GaussPolicy", env_id, seed=0, policy_kwargs={"net_arch": [4]}, device="cpu")
    visited = []

    def entropy(obs, samples):
        visited.append(obs.numpy()[:, : geometry.dims])
        return obs[:, 0]

    monkeypatch.setattr(model.actor, "entropy", entropy)
    measures.entropy_profile(model, env_id, 0)
    offsets, remaining = zip(*(geometry.locate(point) for point in visited[0]), strict=True)
    assert max(offsets) < 1e-6
    length = geometry.locate(geometry.point(0.0))[1]
    expected = length * (1 - np.arange(measures.PROFILE_POINTS) / measures.PROFILE_POINTS)
    np.testing.assert_allclose(remaining, expected, atol=1e-6)


def test_episodes_use_the_mode_and_leave_the_policy_as_it_was() -> None:
    model = SACFlow(
        "FlowPolicy",
        "TunnelHorizontal-v0",
        policy_kwargs={"net_arch": [4], "deterministic_mode": "q"},
        device="cpu",
    )
    used = set()
    predict = model.policy.predict
    model.policy.predict = lambda *given, **more: (  # type: ignore[method-assign]
        used.add(model.policy.deterministic_mode) or predict(*given, **more)  # type: ignore[func-returns-value]
    )
    tests = measures.DeterministicEpisodes("TunnelHorizontal-v0", [1], 2)
    tests.run([model], "log_prob")
    assert used == {"log_prob"}
    assert model.policy.deterministic_mode == "q"


def test_gsde_has_no_most_likely_action() -> None:
    model = SACFlow("GaussPolicy", "TunnelHorizontal-v0", use_sde=True, device="cpu")
    tests = measures.DeterministicEpisodes("TunnelHorizontal-v0", [1], 2)
    assert tests.run([model], "log_prob") == [(None, None)]
