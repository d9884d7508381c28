"""Actor and critics as functions of flat parameters, for one seed or S stacked ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch as th
from torch import nn
from torch.func import functional_call, vmap
from torch.utils._pytree import tree_leaves, tree_map

from sb3_flowpolicy.engine import gsde
from sb3_flowpolicy.engine.flat import FlatParameters, Layout
from sb3_flowpolicy.engine.observations import Observations
from sb3_flowpolicy.policies import FlowActor
from sb3_flowpolicy.policies.traced import AsForward

Tensors = dict[str, th.Tensor]


class StackedNetworks:
    """The networks of S policies that differ in nothing but their weights.

    Its functions take the parameters of any number of them, and observations as
    :class:`~sb3_flowpolicy.engine.observations.Observations` packs them. With ``autocast`` matrix
    products run in bfloat16; parameters and results stay as they are.
    """

    def __init__(self, policies: Sequence[Any], autocast: bool) -> None:
        first = policies[0]
        self.autocast = autocast
        self.actor = FlatParameters([_actor_layout(policy) for policy in policies])
        self.critic = FlatParameters([_critic_layout(policy.critic) for policy in policies], True)
        #: Further parameters that an update changes: those of the target networks.
        self.others = self._others(policies)
        self.uses_gsde = not isinstance(first.actor, FlowActor)
        self.noise_dim = noise_shape(first.actor, 1)[-1]
        self.observations = Observations(first.observation_space)
        if self.uses_gsde:
            self._action_log_prob = partial(gsde.action_log_prob, first.actor)
        else:
            self._action_log_prob = first.actor.action_log_prob
        self._sampler = AsForward(first.actor, self._sample)
        self._actor, self._critic = first.actor, first.critic

    def _others(self, policies: Sequence[Any]) -> list[FlatParameters]:
        targets = [_critic_layout(policy.critic_target) for policy in policies]
        return [FlatParameters(targets, True)]

    @property
    def acting(self) -> list[FlatParameters]:
        """What :meth:`sample` reads."""
        return [self.actor]

    def draw_noise(self, n_updates: int, batch_size: int) -> th.Tensor:
        """Draw the standard normals of updates, (n, 2, S, B, M)."""
        data = self.actor.data
        n_draws, *rows = noise_shape(self._actor, batch_size)
        shape = (n_updates, n_draws, len(data), *rows)
        noise = th.randn(shape, dtype=data.dtype, device=data.device)
        return noise.expand(-1, 2, -1, -1, -1)

    def sample(
        self, actor: th.Tensor, obs: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Sample actions (S, B, D) and their log-probabilities (S, B).

        From flat parameters (S, P), observations (S, B, ...), and standard normals (S, B, M).
        """
        parameters = self.actor.unflatten(actor)
        with th.autocast(obs.device.type, th.bfloat16, enabled=self.autocast):
            sample = partial(functional_call, self._sampler)
            actions, log_prob = per_seed(sample, parameters, (obs, noise))
        return actions.to(actor.dtype), log_prob.to(actor.dtype)

    def _sample(self, obs: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return self._action_log_prob(self.observations.unpack(obs), noise)

    def q_values(
        self,
        critic: th.Tensor,
        obs: th.Tensor,
        actions: th.Tensor,
        normalize: Callable[[str, nn.Module, Tensors, th.Tensor], th.Tensor] | None = None,
    ) -> th.Tensor:
        """Return values or quantiles (S, C, B, Q): each layer is one batched product.

        Args:
            critic: Flat parameters of critics or target critics, (S, P).
            obs: Observations, (S, B, ...).
            actions: Scaled actions, (S, B, D).
            normalize: Applies layers other than linear ones: given a layer's name, the layer, all
                parameters, and its input, it returns the output.
        """
        rows = self.observations.unpack(obs.flatten(0, 1))
        features = self._critic.extract_features(rows, self._critic.features_extractor)
        features = features.unflatten(0, obs.shape[:2])
        hidden = th.cat([features, actions], dim=-1).unsqueeze(1)
        parameters = self.critic.unflatten(critic)
        with th.autocast(obs.device.type, th.bfloat16, enabled=self.autocast):
            for name, layer in self._critic.q_networks[0].named_children():
                if isinstance(layer, nn.Linear):
                    weight, bias = parameters[f"{name}.weight"], parameters[f"{name}.bias"]
                    hidden = hidden @ weight.mT + bias.unsqueeze(-2)
                elif normalize is not None:
                    hidden = normalize(name, layer, parameters, hidden)
                else:
                    hidden = layer(hidden)
        return hidden.to(critic.dtype)


def noise_shape(actor: Any, batch_size: int) -> tuple[int, int, int]:
    """Return the shape of the standard normals that an update of one seed draws: (2, B, M).

    The first are for the states of a minibatch, the others for the next states. With gSDE, all
    have one exploration matrix: (1, 1, M).
    """
    if isinstance(actor, FlowActor):
        return 2, batch_size, actor.density.noise_dim
    return 1, 1, gsde.noise_dim(actor)


def per_seed(function: Callable[..., Any], *arguments: Any) -> Any:
    """Map a function over the leading dimension, one entry per seed, of trees of tensors."""
    if len(tree_leaves(arguments)[0]) > 1:
        return vmap(function)(*arguments)
    # Without vmap for one seed: it would turn products into slower, batched ones.
    outputs = function(*tree_map(lambda tensor: tensor.squeeze(0), arguments))
    return tree_map(lambda tensor: tensor.unsqueeze(0), outputs)


def _actor_layout(policy: Any) -> Layout:
    return {f"module.{name}": [value] for name, value in policy.actor.named_parameters()}


def _critic_layout(critic: Any) -> Layout:
    """Return each weight's copies in all C critics."""
    copies = [dict(network.named_parameters()) for network in critic.q_networks]
    return {name: [copy[name] for copy in copies] for name in copies[0]}
