"""The path from raw observations to actions as one module."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_flowpolicy.bundle.normalization import ONLY_KEY, obs_statistics, parts_of
from sb3_flowpolicy.policies import DistributionPolicy, FlowActor


class DeployedPolicy(nn.Module):
    """Map the environment's observations to actions in the environment's units.

    Includes what ``VecNormalize`` and ``policy.predict`` do: normalize and clip, apply the policy
    and tanh, rescale and reshape to the action space. If ``stochastic``, noise is a further input
    and a sampled action a further output.
    """

    def __init__(
        self, policy: DistributionPolicy, normalization: VecNormalize | None, stochastic: bool
    ) -> None:
        super().__init__()
        # A copy, because it is moved to the CPU and set to evaluation mode.
        self.actor: FlowActor = copy.deepcopy(policy.actor)
        self.stochastic = stochastic
        self.keys = list(parts_of(policy.observation_space))
        space: Any = policy.action_space
        self.action_shape = space.shape
        low, high = space.low.reshape(-1), space.high.reshape(-1)
        self.register_buffer("low", th.from_numpy(low.copy()))
        self.register_buffer("span", th.from_numpy(high - low))
        self.clip = 0.0 if normalization is None else normalization.clip_obs
        self.moments: dict[str, tuple[th.Tensor, th.Tensor]] = {}
        for key, rms in obs_statistics(normalization).items():
            assert normalization is not None
            std = np.sqrt(rms.var + normalization.epsilon)
            # float64 as in VecNormalize: float32 would lose digits to a large mean.
            self.moments[key] = th.tensor(rms.mean), th.tensor(std)
        #: Names of the inputs and outputs of the graph, in order.
        self.inputs = [key or "obs" for key in self.keys] + ["noise"] * stochastic
        self.outputs = ["action"] + ["sampled_action"] * stochastic

    def forward(self, *inputs: th.Tensor) -> tuple[th.Tensor, ...]:
        """Return the deterministic action (batch, ...) and, if stochastic, a sampled one.

        ``inputs`` are an observation (batch, ...) per key and, if stochastic, noise (batch, M).
        """
        obs: Any = dict(zip(self.keys, inputs, strict=False))
        for key, (mean, std) in self.moments.items():
            scaled = ((obs[key].double() - mean) / std).clamp(-self.clip, self.clip)
            obs[key] = scaled.float()
        context = self.actor.context(obs.get(ONLY_KEY, obs))
        actions = [self.actor.density.mode(context)]
        if self.stochastic:
            actions.append(self.actor.density.rsample(context, inputs[-1]))
        low, span = self.get_buffer("low"), self.get_buffer("span")
        return tuple(
            (low + 0.5 * (action + 1.0) * span).unflatten(-1, self.action_shape)
            for action in actions
        )


def random_inputs(policy: DistributionPolicy, stochastic: bool, n: int = 64) -> list[np.ndarray]:
    """Draw n raw observations per key, uniform where bounded and normal elsewhere, and noise."""
    rng, drawn = np.random.default_rng(0), []
    for part in parts_of(policy.observation_space).values():
        part.seed(int(rng.integers(2**31)))
        drawn.append(np.stack([np.asarray(part.sample()) for _ in range(n)]))
    if stochastic:
        drawn.append(rng.standard_normal((n, policy.actor.density.noise_dim), dtype=np.float32))
    return drawn


def expected_actions(
    policy: DistributionPolicy,
    normalization: VecNormalize | None,
    stochastic: bool,
    inputs: Sequence[np.ndarray],
) -> list[np.ndarray]:
    """Return the model's actions for inputs from :func:`random_inputs`."""
    space = policy.observation_space
    obs: Any = inputs[0]
    if isinstance(space, spaces.Dict):
        obs = dict(zip(space.spaces, inputs, strict=False))
    obs = obs if normalization is None else normalization.normalize_obs(obs)
    actions = [policy.predict(obs, deterministic=True)[0]]
    if stochastic:
        noise = th.from_numpy(inputs[-1]).to(policy.device)
        with th.no_grad():
            scaled = policy.actor(policy.obs_to_tensor(obs)[0], noise=noise).cpu().numpy()
        scaled = scaled.reshape(-1, *(policy.action_space.shape or ()))
        actions.append(np.asarray(policy.unscale_action(scaled)))
    return actions
