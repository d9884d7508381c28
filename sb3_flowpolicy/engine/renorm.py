"""Networks with batch renormalization, whose running statistics are a part of the state."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch as th
from sb3_contrib.common.torch_layers import BatchRenorm
from torch import nn
from torch.func import functional_call, vmap
from torch.nn.functional import linear

from sb3_flowpolicy.engine.flat import FlatParameters
from sb3_flowpolicy.engine.networks import StackedNetworks

Tensors = dict[str, th.Tensor]


def renormalize(
    layer: BatchRenorm, x: th.Tensor, values: Tensors, training: bool
) -> tuple[th.Tensor, Tensors]:
    """Do what sb3-contrib's layer does, without a branch on data and without changing the layer.

    Args:
        layer: Its constants are used.
        x: Inputs, (..., B, F).
        values: The layer's parameters and buffers, (..., F), and ``steps``, broadcastable to them.
        training: Whether to normalize with the statistics of this batch, and to update the others.

    Returns:
        Outputs (..., B, F), and the new buffers, empty without ``training``.

    References:
        Batch Renormalization (Ioffe, 2017).
    """
    scale, bias, mean, var, steps = (
        values[name].unsqueeze(-2) for name in ("scale", "bias", "ra_mean", "ra_var", "steps")
    )
    used_mean, used_var, new = mean, var, {}
    if training:
        batch_mean, batch_var = x.mean(-2, keepdim=True), x.var(-2, keepdim=True)
        running_std = (var + layer.eps).sqrt()
        r = ((batch_var.detach() + layer.eps).sqrt() / running_std).clamp(
            1 / layer.rmax, layer.rmax
        )
        d = ((batch_mean.detach() - mean) / running_std).clamp(-layer.dmax, layer.dmax)
        # During the warm-up it is plain batch normalization.
        warm = steps > layer.warmup_steps
        r, d = th.where(warm, r, 1.0), th.where(warm, d, 0.0)
        # The gradient of the root is infinite at 0, the variance of an inactive unit.
        batch_std = batch_var.clamp(min=th.finfo(x.dtype).tiny).sqrt()
        used_mean, used_var = batch_mean - d * batch_std / r, batch_var / r**2
        new = {
            "ra_mean": mean + layer.momentum * (batch_mean.detach() - mean),
            "ra_var": var + layer.momentum * (batch_var.detach() - var),
        }
    x = scale * ((x - used_mean) / (used_var + layer.eps).sqrt()) + bias
    return x, {name: value.squeeze(-2) for name, value in new.items()}


class _Density(nn.Module):
    """Samples and scores in ``forward``, which is what ``functional_call`` calls."""

    def __init__(self, density: Any) -> None:
        super().__init__()
        self.density = density

    def forward(self, context: th.Tensor, noise: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return self.density.rsample_and_log_prob(context, noise)


class RenormNetworks(StackedNetworks):
    """Networks of CrossQ: instead of target networks they have running statistics.

    Its functions return new statistics where they are told to use those of the batch, which are
    named as in :attr:`actor_statistics` and :attr:`critic_statistics`.

    Args:
        policies: As for the parent class.
        autocast: As for the parent class.
    """

    def _others(self, policies: Sequence[Any]) -> list[FlatParameters]:
        actors = [[policy.actor.latent_pi] for policy in policies]
        critics = [policy.critic.q_networks for policy in policies]
        self.actor_statistics = _buffers(actors, counts=False, copies=False)
        self.critic_statistics = _buffers(critics, counts=False, copies=True)
        self.actor_steps, self.critic_steps = (_buffers(n, True, True) for n in (actors, critics))
        self._actor, self._density = policies[0].actor, _Density(policies[0].actor.density)
        return [
            self.actor_statistics,
            self.critic_statistics,
            self.actor_steps,
            self.critic_steps,
        ]

    def sample(
        self, actor: th.Tensor, obs: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Sample with the running statistics, as the parent class does."""
        statistics, steps = self.actor_statistics.data, self.actor_steps.data
        return self.sample_with(actor, statistics, steps, obs, noise, training=False)[:2]

    def sample_with(
        self,
        actor: th.Tensor,
        statistics: th.Tensor,
        steps: th.Tensor,
        obs: th.Tensor,
        noise: th.Tensor,
        training: bool,
    ) -> tuple[th.Tensor, th.Tensor, Tensors]:
        """Sample actions (S, B, D) and their log-probabilities (S, B)."""
        parameters = self.actor.unflatten(actor)
        buffers = self.actor_statistics.unflatten(statistics)
        one = partial(self._sample_one_seed, training=training)
        with th.autocast(obs.device.type, th.bfloat16, enabled=self.autocast):
            if len(actor) > 1:
                actions, log_prob, new = vmap(one)(parameters, buffers, steps[:, :1], obs, noise)
            else:
                parameters, buffers = (
                    {name: value.squeeze(0) for name, value in part.items()}
                    for part in (parameters, buffers)
                )
                found = one(parameters, buffers, steps[0, :1], obs.squeeze(0), noise.squeeze(0))
                actions, log_prob = found[0].unsqueeze(0), found[1].unsqueeze(0)
                new = {name: value.unsqueeze(0) for name, value in found[2].items()}
        return actions.to(actor.dtype), log_prob.to(actor.dtype), new

    def _sample_one_seed(
        self,
        parameters: Tensors,
        statistics: Tensors,
        steps: th.Tensor,
        obs: th.Tensor,
        noise: th.Tensor,
        training: bool,
    ) -> tuple[th.Tensor, th.Tensor, Tensors]:
        actor = self._actor
        new: Tensors = {}
        hidden = actor.extract_features(self.observations.unpack(obs), actor.features_extractor)
        for name, layer in actor.latent_pi.named_children():
            own = _of(f"actor.latent_pi.{name}.", parameters)
            if isinstance(layer, BatchRenorm):
                values = {**own, **_of(f"{name}.", statistics), "steps": steps}
                hidden, found = renormalize(layer, hidden, values, training)
                new |= {f"{name}.{key}": value for key, value in found.items()}
            elif isinstance(layer, nn.Linear):
                hidden = linear(hidden, own["weight"], own["bias"])
            else:
                hidden = layer(hidden)
        density = {f"density.{k}": v for k, v in _of("actor.density.", parameters).items()}
        actions, log_prob = functional_call(self._density, density, (hidden, noise))
        return actions, log_prob, new

    def q_values_with(
        self,
        critic: th.Tensor,
        statistics: th.Tensor | Tensors,
        steps: th.Tensor,
        obs: th.Tensor,
        actions: th.Tensor,
        training: bool,
    ) -> tuple[th.Tensor, Tensors]:
        """Evaluate all critics of all seeds, (S, C, B, 1)."""
        if isinstance(statistics, th.Tensor):
            statistics = self.critic_statistics.unflatten(statistics)
        parameters = self.critic.unflatten(critic)
        new: Tensors = {}
        hidden = self._critic_inputs(obs, actions)
        with th.autocast(obs.device.type, th.bfloat16, enabled=self.autocast):
            for name, layer in self._critic.q_networks[0].named_children():
                own = _of(f"{name}.", parameters)
                if isinstance(layer, BatchRenorm):
                    values = {**own, **_of(f"{name}.", statistics), "steps": steps[:, :1, None]}
                    hidden, found = renormalize(layer, hidden, values, training)
                    new |= {f"{name}.{key}": value for key, value in found.items()}
                elif isinstance(layer, nn.Linear):
                    hidden = hidden @ own["weight"].mT + own["bias"].unsqueeze(-2)
                else:
                    hidden = layer(hidden)
        return hidden.to(critic.dtype), new


def _buffers(networks: Sequence[Sequence[nn.Module]], counts: bool, copies: bool) -> FlatParameters:
    """Return the layers' counts of steps, or their statistics, of S times C networks."""
    layouts = []
    for equal in networks:
        named = [dict(network.named_buffers()) for network in equal]
        names = [name for name in named[0] if name.endswith(".steps") == counts]
        layouts.append({name: [buffers[name] for buffers in named] for name in names})
    return FlatParameters(layouts, copies)  # type: ignore[arg-type]


def _of(prefix: str, tensors: Tensors) -> Tensors:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
