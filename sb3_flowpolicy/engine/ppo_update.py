"""One PPO update as a function of tensors: eager or compiled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch as th
from stable_baselines3.common.type_aliases import RolloutBufferSamples
from torch.func import functional_call
from torch.nn.functional import mse_loss

from sb3_flowpolicy.engine.adam import AdamSettings, Moments, adam_step
from sb3_flowpolicy.engine.flat import FlatParameters
from sb3_flowpolicy.policies.on_policy import DensityActorCritic, bound_gradient
from sb3_flowpolicy.policies.traced import AsForward

PPO_LOSSES = (
    "entropy_loss",
    "policy_gradient_loss",
    "value_loss",
    "approx_kl",
    "clip_fraction",
    "loss",
)
"""What SB3 logs of an update: the first entries of the tensor (7,) that an update returns. The
last is 1 if all log-probabilities were finite; otherwise nothing was changed."""


@dataclass(frozen=True)
class PPOSettings:
    """Constants of an update: they are compiled into it."""

    adam: AdamSettings
    ent_coef: float
    vf_coef: float
    max_grad_norm: float
    normalize_advantage: bool
    clips_values: bool
    target_kl: float | None


# (parameters (1, P), moments, minibatch, noise (K, B, M) or None if the entropy is not estimated,
# [learning rate, clip range, clip range of values]) -> losses, (7,)
PPOUpdate = Callable[
    [th.Tensor, Moments, RolloutBufferSamples, th.Tensor | None, th.Tensor], th.Tensor
]


def policy_function(
    policy: DensityActorCritic, flat: FlatParameters, method: str
) -> Callable[..., tuple[th.Tensor, ...]]:
    """Return a method of the policy as a function of its flat parameters, (1, P), and arguments."""
    module = AsForward(policy, getattr(policy, method))

    def call(parameters: th.Tensor, *arguments: th.Tensor | None) -> tuple[th.Tensor, ...]:
        named = {name: value.squeeze(0) for name, value in flat.unflatten(parameters).items()}
        return functional_call(module, named, arguments)

    return call


def make_ppo_update(
    policy: DensityActorCritic, flat: FlatParameters, settings: PPOSettings
) -> PPOUpdate:
    """Return the function that performs one update in place: a minibatch of SB3's ``PPO.train``.

    It changes nothing if a log-probability is not finite, or if the estimate of the KL divergence
    exceeds 1.5 times ``target_kl``, where SB3 stops.

    References:
        Proximal Policy Optimization Algorithms (Schulman et al., 2017).
    """
    score = policy_function(policy, flat, "score")

    def update(
        parameters: th.Tensor,
        moments: Moments,
        batch: RolloutBufferSamples,
        noise: th.Tensor | None,
        scalars: th.Tensor,
    ) -> th.Tensor:
        learning_rate, clip_range, clip_range_vf = scalars
        weights = parameters.detach().requires_grad_()
        found = score(weights, batch.observations, batch.actions, noise)
        outputs = [output.flatten() for output in found if output is not None]
        # The loss depends on the networks through these few numbers per row alone. Its gradient
        # with respect to them is bounded before it goes on to the parameters.
        leaves = [output.detach().requires_grad_() for output in outputs]
        values, log_prob = leaves[:2]

        advantages = batch.advantages
        if settings.normalize_advantage and len(advantages) > 1:
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        log_ratio = log_prob - batch.old_log_prob
        ratio = log_ratio.exp()
        clipped = ratio.clamp(1 - clip_range, 1 + clip_range)
        policy_loss = -th.minimum(advantages * ratio, advantages * clipped).mean()
        predicted = values
        if settings.clips_values:
            change = (values - batch.old_values).clamp(-clip_range_vf, clip_range_vf)
            predicted = batch.old_values + change
        value_loss = mse_loss(batch.returns, predicted)
        entropy_loss = -leaves[2].mean() if len(leaves) == 3 else log_prob.mean()
        loss = policy_loss + settings.ent_coef * entropy_loss + settings.vf_coef * value_loss
        approx_kl = ((ratio - 1) - log_ratio).mean()
        clip_fraction = ((ratio - 1).abs() > clip_range).to(loss.dtype).mean()

        gradients = list(th.autograd.grad(loss, leaves))
        gradients[1] = bound_gradient(gradients[1])
        (gradient,) = th.autograd.grad(outputs, weights, gradients)
        norm = gradient.norm()
        gradient = gradient * (settings.max_grad_norm / (norm + 1e-6)).clamp(max=1.0)
        stepped = adam_step(parameters, gradient, moments, learning_rate, settings.adam)

        finite = log_prob.isfinite().all()
        applies = finite
        if settings.target_kl is not None:
            applies = applies & (approx_kl <= 1.5 * settings.target_kl)
        for old, new in zip((parameters, *moments), stepped, strict=True):
            old.copy_(th.where(applies, new, old))
        losses = entropy_loss, policy_loss, value_loss, approx_kl, clip_fraction, loss
        return th.stack([*(part.detach() for part in losses), finite.to(loss.dtype)])

    return update
