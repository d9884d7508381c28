"""The actor: SB3's SAC actor with any registered density in place of its Gaussian heads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.sac.policies import Actor
from torch import nn

from sb3_flowpolicy.common.validation import integer
from sb3_flowpolicy.distributions import TanhSquashed, make_distribution
from sb3_flowpolicy.policies.sb3_distribution import ActionDistributionAdapter
from sb3_flowpolicy.policies.traced import TracedCalls

# State dicts omit this prefix, so that the heads have the names of SB3's `mu` and `log_std`, and a
# Gauss actor and a stock SAC actor can load each other's checkpoints.
_HEAD_PREFIX = "density.base."


class FlowActor(Actor):
    r"""Policy network whose action distribution is a registered density, squashed by tanh.

    .. math:: a = \tanh(u), \qquad u \sim p(\cdot \mid h), \qquad h = \mathrm{latent\_pi}(s)

    Actions are in SB3's scaled box [-1, 1]^D, flattened to (batch, D) whatever the shape of the
    action space. All methods that sample accept the noise to use. The arguments are those of SB3's
    ``Actor`` and two more.

    Args:
        distribution: Name of a registered density.
        distribution_kwargs: Arguments of its constructor.

    Raises:
        ValueError: If the density is unknown or an argument is out of range.
    """

    density: TanhSquashed

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.ReLU,
        normalize_images: bool = True,
        distribution: str = "realnvp",
        distribution_kwargs: Mapping[str, Any] | None = None,
    ) -> None:
        # Not Actor.__init__: it would build Gaussian heads, and the random numbers that they draw
        # would keep GaussPolicy from starting with the weights of stock SAC.
        BasePolicy.__init__(
            self,
            observation_space,
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
            squash_output=True,
        )
        self.net_arch = net_arch
        self.features_dim = features_dim
        self.activation_fn = activation_fn
        self.use_sde = False
        self.distribution = distribution
        self.distribution_kwargs = dict(distribution_kwargs or {})

        self.latent_pi = self._make_latent_pi()
        context_dim = net_arch[-1] if net_arch else features_dim
        action_dim = get_action_dim(action_space)
        density = make_distribution(
            distribution, action_dim, context_dim, **self.distribution_kwargs
        )
        clashes = dict(density.named_children()).keys() & dict(self.named_children()).keys()
        if clashes:  # their parameters would have the same names in a state dict
            raise ValueError(
                f'distribution "{distribution}" must not name a submodule as the actor does, '
                f"got {sorted(clashes)}"
            )
        self.density = TanhSquashed(density)
        self.traced = TracedCalls()
        self.action_dist = ActionDistributionAdapter(self.density)  # type: ignore[assignment]
        self.register_state_dict_post_hook(_lift_heads)
        self.register_load_state_dict_pre_hook(_lower_heads)

    def _make_latent_pi(self) -> nn.Sequential:
        return nn.Sequential(*create_mlp(self.features_dim, -1, self.net_arch, self.activation_fn))

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **BasePolicy._get_constructor_parameters(self),
            "net_arch": self.net_arch,
            "features_dim": self.features_dim,
            "features_extractor": self.features_extractor,
            "activation_fn": self.activation_fn,
            "distribution": self.distribution,
            "distribution_kwargs": self.distribution_kwargs,
        }

    def context(self, obs: PyTorchObs) -> th.Tensor:
        """Return the features h that the density is conditioned on, shape (batch, H)."""
        return self.latent_pi(self.extract_features(obs, self.features_extractor))

    def forward(
        self, obs: PyTorchObs, deterministic: bool = False, noise: th.Tensor | None = None
    ) -> th.Tensor:
        """Return the mode or a sample, (batch, D), from standard normals (batch, M)."""
        context = self.context(obs)
        if deterministic:
            return self.density.mode(context)
        noise = self.density.draw_noise(context) if noise is None else noise
        return self.density.rsample(context, noise)

    def act(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Return the same actions as :meth:`forward`, sooner; gradients must be disabled."""
        features = self.extract_features(obs, self.features_extractor)
        noise = () if deterministic else (self.density.draw_noise(features),)
        return self.traced(_act, (self.latent_pi, self.density), features, *noise)

    def action_log_prob(
        self, obs: PyTorchObs, noise: th.Tensor | None = None
    ) -> tuple[th.Tensor, th.Tensor]:
        """Sample reparametrized actions (batch, D) and score them (batch,) in one pass."""
        context = self.context(obs)
        noise = self.density.draw_noise(context) if noise is None else noise
        return self.density.rsample_and_log_prob(context, noise)

    def log_prob(self, obs: PyTorchObs, action: th.Tensor) -> th.Tensor:
        """Score arbitrary actions; the log-density is finite at the edge of the box, too.

        Args:
            obs: Batch of observations.
            action: Actions in SB3's scaled [-1, 1], shape (batch, D) or unflattened;
                ``policy.scale_action`` maps an environment's actions to this range.

        Returns:
            Log-density in nats, shape (batch,).

        Raises:
            ValueError: If an action is outside [-1, 1].
        """
        context = self.context(obs)
        action = th.as_tensor(action, dtype=context.dtype, device=context.device)
        if (action.detach().abs() > 1 + 1e-4).any():
            raise ValueError(
                "action must be scaled to [-1, 1], got values between "
                f"{action.min().item():.3g} and {action.max().item():.3g}"
            )
        return self.density.log_prob(context, action.reshape(len(context), -1))

    @th.no_grad()
    def entropy(self, obs: PyTorchObs, n_samples: int = 64) -> th.Tensor:
        """Estimate the entropy of the squashed policy from ``n_samples`` samples per observation.

        Returns:
            Entropy in nats, shape (batch,); at most D log 2, the value of the uniform distribution.
        """
        context = self.context(obs)
        noise = self.density.draw_noise(context, integer(1)("n_samples", n_samples))
        return -self.density.rsample_and_log_prob(context, noise)[1].mean(0)

    @th.no_grad()
    def action_correlation(self, obs: PyTorchObs, n_samples: int = 1024) -> th.Tensor:
        """Estimate Pearson's correlation of the action dimensions (thesis eq. 3.1).

        Returns:
            Correlation matrices, shape (batch, D, D), entries in [-1, 1].
        """
        context = self.context(obs)
        noise = self.density.draw_noise(context, integer(2)("n_samples", n_samples))
        actions = self.density.rsample(context, noise).movedim(0, -1)
        centered = actions - actions.mean(-1, keepdim=True)
        # A constant dimension has correlation 0 with all others and 1 with itself.
        tiny = th.finfo(actions.dtype).tiny
        unit = centered / centered.norm(dim=-1, keepdim=True).clamp_min(tiny)
        correlation = (unit @ unit.mT).clamp(-1, 1)
        return correlation.diagonal_scatter(th.ones_like(correlation[..., 0]), dim1=-2, dim2=-1)


def _act(
    latent_pi: nn.Module, density: TanhSquashed, features: th.Tensor, *noise: th.Tensor
) -> th.Tensor:
    """Return a sample, or without noise the mode."""
    context = latent_pi(features)
    return density.rsample(context, *noise) if noise else density.mode(context)


def _lift_heads(
    actor: nn.Module, state_dict: dict[str, Any], prefix: str, local_metadata: dict[str, Any]
) -> None:
    inner = prefix + _HEAD_PREFIX
    for key in [key for key in state_dict if key.startswith(inner)]:
        state_dict[prefix + key.removeprefix(inner)] = state_dict.pop(key)


def _lower_heads(actor: FlowActor, state_dict: dict[str, Any], prefix: str, *_: Any) -> None:
    for name in actor.density.base.state_dict():
        if prefix + name in state_dict:
            state_dict[prefix + _HEAD_PREFIX + name] = state_dict.pop(prefix + name)
