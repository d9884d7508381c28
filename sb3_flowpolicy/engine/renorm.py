"""Networks with batch renormalization, whose running statistics are a part of the state."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch as th
from sb3_contrib.common.torch_layers import BatchRenorm
from torch import nn
from torch.func import functional_call
from torch.nn.functional import linear

from sb3_flowpolicy.engine.flat import FlatParameters
from sb3_flowpolicy.engine.networks import StackedNetworks, Tensors, per_seed
from sb3_flowpolicy.policies.traced import AsForward


def renormalize(
    layer: BatchRenorm, x: th.Tensor, values: Tensors, training: bool
) -> tuple[th.Tensor, Tensors]:
    """Do what sb3-contrib's layer does, without a branch on data and without changing the layer.

    Args:
        layer: Its constants are used.
        x: Inputs, (..., B, F).
        values: The layer's parameters and buffers, (..., F), and ``steps``, broadcastable to them.
        training: Whether to normalize with the statistics of this batch.

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


# The entries ``others`` of the state: running statistics, and by how many steps they were updated.
_ACTOR, _CRITICS, _STEPS_OF_ACTOR, _STEPS_OF_CRITICS = range(4)


class RenormNetworks(StackedNetworks):
    """Networks of CrossQ: instead of target networks they have running statistics.

    With ``training``, functions use the statistics of the batch, and also return new running ones
    by name.
    """

    def _others(self, policies: Sequence[Any]) -> list[FlatParameters]:
        actors = [[policy.actor.latent_pi] for policy in policies]
        critics = [policy.critic.q_networks for policy in policies]
        density = policies[0].actor.density
        self._density = AsForward(density, density.rsample_and_log_prob)
        return [
            _buffers(actors, counts=False, copies=False),
            _buffers(critics, counts=False, copies=True),
            _buffers(actors, counts=True, copies=True),
            _buffers(critics, counts=True, copies=True),
        ]

    @property
    def acting(self) -> list[FlatParameters]:
        """The actor and its running statistics."""
        return [self.actor, self.others[_ACTOR], self.others[_STEPS_OF_ACTOR]]

    def sample(
        self, actor: th.Tensor, obs: th.Tensor, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Sample with the running statistics, as the parent class does."""
        others = [part.data for part in self.others]
        return self.sample_with(actor, others, obs, noise, training=False)[:2]

    def sample_with(
        self,
        actor: th.Tensor,
        others: Sequence[th.Tensor],
        obs: th.Tensor,
        noise: th.Tensor,
        training: bool,
    ) -> tuple[th.Tensor, th.Tensor, Tensors]:
        """Sample actions (S, B, D) and their log-probabilities (S, B)."""
        parameters, statistics = self.actor.unflatten(actor), self._statistics(others, _ACTOR)
        one = partial(self._sample_one_seed, training=training)
        with th.autocast(obs.device.type, th.bfloat16, enabled=self.autocast):
            actions, log_prob, new = per_seed(
                one, parameters, statistics, others[_STEPS_OF_ACTOR][:, :1], obs, noise
            )
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
            own = _of(f"module.latent_pi.{name}.", parameters)
            if isinstance(layer, BatchRenorm):
                values = {**own, **_of(f"{name}.", statistics), "steps": steps}
                hidden, found = renormalize(layer, hidden, values, training)
                new |= {f"{name}.{key}": value for key, value in found.items()}
            elif isinstance(layer, nn.Linear):
                hidden = linear(hidden, own["weight"], own["bias"])
            else:
                hidden = layer(hidden)
        density = {f"module.{k}": v for k, v in _of("module.density.", parameters).items()}
        actions, log_prob = functional_call(self._density, density, (hidden, noise))
        return actions, log_prob, new

    def q_values_with(
        self,
        critic: th.Tensor,
        others: Sequence[th.Tensor],
        obs: th.Tensor,
        actions: th.Tensor,
        training: bool,
    ) -> tuple[th.Tensor, Tensors]:
        """Evaluate all critics of all seeds, (S, C, B, 1)."""
        statistics = self._statistics(others, _CRITICS)
        steps = others[_STEPS_OF_CRITICS][:, :1, None]
        new: Tensors = {}

        def normalize(name: str, layer: Any, weights: Tensors, hidden: th.Tensor) -> th.Tensor:
            if not isinstance(layer, BatchRenorm):
                return layer(hidden)
            values = {**_of(f"{name}.", {**weights, **statistics}), "steps": steps}
            hidden, found = renormalize(layer, hidden, values, training)
            new.update({f"{name}.{key}": value for key, value in found.items()})
            return hidden

        return self.q_values(critic, obs, actions, normalize), new

    def write_statistics(self, others: Sequence[th.Tensor], new: Tensors, of_critics: bool) -> None:
        """Overwrite the running statistics of the actor or the critics, and count the step."""
        olds = self._statistics(others, _CRITICS if of_critics else _ACTOR)
        for name, value in new.items():
            olds[name].copy_(value)
        others[_STEPS_OF_CRITICS if of_critics else _STEPS_OF_ACTOR].add_(1)

    def _statistics(self, others: Sequence[th.Tensor], which: int) -> Tensors:
        return self.others[which].unflatten(others[which])


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
