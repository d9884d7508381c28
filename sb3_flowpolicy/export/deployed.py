"""Everything that acts between sensor and motor, as one module of tensors."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_flowpolicy.bundle import Normalization
from sb3_flowpolicy.policies import DistributionPolicy, FlowActor

#: Name of the input where observations are arrays, and of the key of their statistics.
OBS, NO_KEY = "obs", ""


class DeployedPolicy(nn.Module):
    """From the environment's observations to actions in its units.

    Does what ``VecNormalize`` and ``policy.predict`` do: normalise and clip, the policy, tanh,
    rescale to the action space, reshape to its shape.

    Args:
        policy: A policy of ours, without gSDE.
        normalization: Statistics of the observations, if the policy was trained behind some.
        stochastic: Whether noise is a further input, and a sampled action a further output.
    """

    def __init__(
        self, policy: DistributionPolicy, normalization: Normalization | None, stochastic: bool
    ) -> None:
        super().__init__()
        assert isinstance(policy.actor, FlowActor)
        assert isinstance(policy.action_space, spaces.Box)
        # A copy: it goes to the CPU and into evaluation mode, where the model may not be.
        self.actor = copy.deepcopy(policy.actor)
        self.stochastic = stochastic
        space = policy.observation_space
        self.keys = list(space.spaces) if isinstance(space, spaces.Dict) else [NO_KEY]
        self.action_shape = policy.action_space.shape
        low, high = policy.action_space.low.reshape(-1), policy.action_space.high.reshape(-1)
        self.register_buffer("low", th.from_numpy(low.copy()))
        self.register_buffer("span", th.from_numpy(high - low))
        self.clip = 0.0 if normalization is None else normalization.settings["clip_obs"]
        self.normalized: list[str] = []
        for index, key in enumerate(self.keys):
            if normalization is not None and key in normalization.statistics:
                rms = normalization.statistics[key]
                std = np.sqrt(rms.var + normalization.settings["epsilon"])
                # float64 as in VecNormalize: a large mean would eat the digits of float32.
                self.register_buffer(f"mean_{index}", th.from_numpy(np.array(rms.mean)))
                self.register_buffer(f"std_{index}", th.from_numpy(np.array(std)))
                self.normalized.append(key)

    def forward(self, *inputs: th.Tensor) -> tuple[th.Tensor, ...]:
        """Return the deterministic action (batch, ...) and, if stochastic, a sampled one.

        Args:
            *inputs: One observation (batch, ...) per key and, if stochastic, standard normal noise
                (batch, M).
        """
        obs: Any = {key: self._normalize(i, inputs[i]) for i, key in enumerate(self.keys)}
        context = self.actor.context(obs.get(NO_KEY, obs))
        actions = [self.actor.density.mode(context)]
        if self.stochastic:
            actions.append(self.actor.density.rsample_and_log_prob(context, inputs[-1])[0])
        return tuple(self._unscale(action) for action in actions)

    def _normalize(self, index: int, obs: th.Tensor) -> th.Tensor:
        if self.keys[index] not in self.normalized:
            return obs
        mean, std = self.get_buffer(f"mean_{index}"), self.get_buffer(f"std_{index}")
        return ((obs.double() - mean) / std).clamp(-self.clip, self.clip).float()

    def _unscale(self, action: th.Tensor) -> th.Tensor:
        low, span = self.get_buffer("low"), self.get_buffer("span")
        return (low + 0.5 * (action + 1.0) * span).unflatten(-1, self.action_shape)

    def input_names(self) -> list[str]:
        """Return the names that inputs get, in order: Dict keys stay what they are."""
        names = [OBS if key == NO_KEY else key for key in self.keys]
        return [*names, *(["noise"] * self.stochastic)]

    def output_names(self) -> list[str]:
        """Return the names that outputs get, in order."""
        return ["action", *(["sampled_action"] * self.stochastic)]


def random_inputs(
    policy: DistributionPolicy, stochastic: bool, n: int, rng: np.random.Generator
) -> list[np.ndarray]:
    """Draw n observations, as the environment would give them, and noise.

    Bounded spaces are drawn uniformly, unbounded ones normally.
    """
    space = policy.observation_space
    parts = list(space.spaces.values()) if isinstance(space, spaces.Dict) else [space]
    drawn = []
    for part in parts:
        part.seed(int(rng.integers(2**31)))
        drawn.append(np.stack([np.asarray(part.sample()) for _ in range(n)]))
    if stochastic:
        assert isinstance(policy.actor, FlowActor)
        shape = (n, policy.actor.density.noise_dim)
        drawn.append(rng.standard_normal(shape, dtype=np.float32))
    return drawn


def expected_actions(
    policy: DistributionPolicy, normalization: Normalization | None, inputs: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return what ``predict`` makes of inputs as :func:`random_inputs` draws them."""
    assert isinstance(policy.actor, FlowActor)
    space = policy.observation_space
    obs: Any = inputs[0]
    if isinstance(space, spaces.Dict):
        obs = dict(zip(space.spaces, inputs, strict=False))
    obs = obs if normalization is None else normalization.normalize_obs(obs)
    actions = [policy.predict(obs, deterministic=True)[0]]
    n_observations = len(space.spaces) if isinstance(space, spaces.Dict) else 1
    if len(inputs) > n_observations:
        noise = th.from_numpy(inputs[-1]).to(policy.device)
        with th.no_grad():
            tensors = policy.obs_to_tensor(obs)[0]
            scaled = policy.actor(tensors, noise=noise).cpu().numpy()
        shape = policy.action_space.shape or ()
        actions.append(np.asarray(policy.unscale_action(scaled.reshape(-1, *shape))))
    return actions
