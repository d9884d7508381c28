"""Actor and critics as functions of flat parameters, for one seed or S stacked ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch as th
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.sac.policies import SACPolicy
from torch import nn
from torch.func import functional_call, vmap

from sb3_flowpolicy.engine.flat import FlatParameters, Layout
from sb3_flowpolicy.policies import FlowActor


class _ActionLogProb(nn.Module):
    """``functional_call`` calls ``forward``: this one samples and scores."""

    def __init__(self, actor: FlowActor) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, obs: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return self.actor.action_log_prob(obs, noise)


class StackedNetworks:
    """The networks of S policies that differ in nothing but their weights.

    Args:
        policies: S policies with a :class:`FlowActor` and parameter-free features extractors.
    """

    def __init__(self, policies: Sequence[SACPolicy]) -> None:
        first = policies[0]
        assert isinstance(first.actor, FlowActor)
        self.n_seeds = len(policies)
        self.actor = FlatParameters([_actor_layout(policy) for policy in policies])
        self.critic = FlatParameters([_critic_layout(policy.critic) for policy in policies])
        self.target = FlatParameters([_critic_layout(policy.critic_target) for policy in policies])
        self.noise_dim = first.actor.density.noise_dim
        self._sampler = _ActionLogProb(first.actor)
        self._critic = first.critic
        self._q_network = first.critic.q_networks[0]

    def release(self) -> None:
        """Give all modules memory of their own again."""
        for flat in (self.actor, self.critic, self.target):
            flat.release()

    def is_bound(self) -> bool:
        """Whether all modules still are views of the flat tensors."""
        return all(flat.is_bound() for flat in (self.actor, self.critic, self.target))

    def sample(
        self, actor: th.Tensor, obs: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Sample actions and their log-probabilities.

        Args:
            actor: Flat parameters, (S, P).
            obs: Observations, (S, B, ...).
            noise: Standard normals, (S, B, M).

        Returns:
            Actions (S, B, D) and log-probabilities (S, B).
        """

        def one(parameters: dict[str, th.Tensor], obs: th.Tensor, noise: th.Tensor) -> Any:
            return functional_call(self._sampler, parameters, (obs, noise))

        return self._over_seeds(one, self.actor.unflatten(actor), obs, noise)

    def q_values(self, critic: th.Tensor, obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Evaluate all critics.

        Args:
            critic: Flat parameters of critics or target critics, (S, P).
            obs: Observations, (S, B, ...).
            actions: Scaled actions, (S, B, D).

        Returns:
            Values, (S, C, B).
        """

        def one(parameters: dict[str, th.Tensor], obs: th.Tensor, actions: th.Tensor) -> th.Tensor:
            features = self._critic.extract_features(obs, self._critic.features_extractor)
            inputs = th.cat([features, actions], dim=1)

            def one_critic(parameters: dict[str, th.Tensor]) -> th.Tensor:
                return functional_call(self._q_network, parameters, (inputs,))

            if self._critic.n_critics == 1:
                return one_critic(parameters).mT
            return vmap(one_critic)(parameters).squeeze(-1)

        return self._over_seeds(one, self.critic.unflatten(critic), obs, actions)

    def _over_seeds(self, function: Any, parameters: dict[str, th.Tensor], *inputs: th.Tensor) -> Any:
        if self.n_seeds > 1:
            return vmap(function)(parameters, *inputs)
        # One seed takes no detour: vmap over a single one would turn products into batched ones.
        single = {name: value.squeeze(0) for name, value in parameters.items()}
        result = function(single, *(value.squeeze(0) for value in inputs))
        if isinstance(result, tuple):
            return tuple(value.unsqueeze(0) for value in result)
        return result.unsqueeze(0)


def _actor_layout(policy: SACPolicy) -> Layout:
    return {f"actor.{name}": [value] for name, value in policy.actor.named_parameters()}


def _critic_layout(critic: ContinuousCritic) -> Layout:
    """Weight by weight, the copies of all C critics."""
    copies = [dict(network.named_parameters()) for network in critic.q_networks]
    return {name: [copy[name] for copy in copies] for name in copies[0]}
