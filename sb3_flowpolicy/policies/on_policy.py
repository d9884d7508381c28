"""Policy classes for PPO and A2C: SB3's, with a registered density."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_flowpolicy.common.validation import flag, number
from sb3_flowpolicy.distributions import ActionDistribution, TanhSquashed, make_distribution
from sb3_flowpolicy.distributions.gaussian import LogStdHead
from sb3_flowpolicy.distributions.loc_scale import StateIndependent, with_heads
from sb3_flowpolicy.guard.finite import check_finite
from sb3_flowpolicy.policies.base import (
    DensityPolicy,
    check_action_space,
    check_net_arch,
    with_forms,
)
from sb3_flowpolicy.policies.sb3_distribution import (
    ENTROPY_PAIRS,
    ActionDistributionAdapter,
    estimate_entropy,
)
from sb3_flowpolicy.policies.traced import TracedCalls

# Bound on the gradient of the loss with respect to a log-probability, which in PPO is advantage
# times ratio. A gradient exceeds it only where the policy has moved far from the stored actions.
_LARGEST_GRADIENT = 1e6


class DensityActorCritic(DensityPolicy, ActorCriticPolicy):
    """Actor-critic policy with a registered density as its action distribution.

    It starts as SB3's policy does: the mean comes from SB3's linear layer (orthogonal weights of
    gain 0.01 unless ``ortho_init=False``), the standard deviation is a parameter, and the density's
    shape (a flow, or the correlations of a Gaussian) starts as the identity or close to it.
    A flow stands between the noise and this location and scale.

    Both while collecting and while learning, the log-probability of an action is computed with the
    density's inverse from the numbers in the rollout buffer. So PPO's ratio is 1 before the first
    update, even for saturated actions (up to rounding, which flows with extreme weights amplify).
    The entropy is exact for Gaussians that are not squashed, and otherwise an estimate whose
    gradient reaches all parameters.

    Args:
        observation_space: As for SB3.
        action_space: Box of any shape; with finite bounds if ``squash_output``.
        lr_schedule: As for SB3.
        distribution: Name of a registered density. Default: that of the policy class.
        distribution_kwargs: Arguments of the density, for example ``dict(layers=4)``.
        squash_output: Whether to squash actions with tanh and rescale them to the action space.
            Otherwise they are clipped to it, as in SB3.
        log_std_init: Initial log standard deviation, of the unsquashed action.
        state_dependent_std: Whether the standard deviation depends on the observation. The
            bounds of its logarithm are then those of SB3's SAC, -20 and 2.
        **policy_kwargs: Other arguments of SB3's ``ActorCriticPolicy``.

    Raises:
        ValueError: If the action space is not a Box (with finite bounds), the density is unknown,
            or ``use_sde=True``.

    References:
        Thesis chapter 5, which proposes these densities for on-policy algorithms.
    """

    action_dist: ActionDistributionAdapter

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        *,
        distribution: str | None = None,
        distribution_kwargs: Mapping[str, Any] | None = None,
        squash_output: bool = False,
        log_std_init: float = 0.0,
        state_dependent_std: bool = False,
        use_sde: bool = False,
        **policy_kwargs: Any,
    ) -> None:
        check_action_space(action_space, bounded=squash_output)
        if use_sde:
            raise ValueError("use_sde must be False, because the density replaces gSDE, got True")
        net_arch = policy_kwargs.get("net_arch")
        if isinstance(net_arch, list) and len(net_arch) == 1 and isinstance(net_arch[0], Mapping):
            net_arch = net_arch[0]  # the form before SB3 1.8, which SB3 accepts with a warning
        check_net_arch(net_arch, set(), {"pi", "vf"})
        self._set_density(observation_space, policy_kwargs, distribution, distribution_kwargs)
        self._squashes = squash_output
        self.state_dependent_std = flag("state_dependent_std", state_dependent_std)
        policy_kwargs["log_std_init"] = number(-20, 20)("log_std_init", log_std_init)
        super().__init__(observation_space, action_space, lr_schedule, **policy_kwargs)
        # SB3's constructor accepts squash_output with gSDE only, but the rest of SB3 supports it.
        self._squash_output = squash_output

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        size, features = spaces.flatdim(self.action_space), self.mlp_extractor.latent_dim_pi
        density = make_distribution(self.distribution, size, features, **self.distribution_kwargs)
        # The location and the scale are the layer and the parameter that SB3 has initialized.
        log_std: nn.Module = StateIndependent(self.log_std)
        if self.state_dependent_std:
            log_std = LogStdHead(features, size)
            nn.init.orthogonal_(log_std.weight, 0.01)
            nn.init.constant_(log_std.bias, self.log_std_init)
        density = with_heads(density, self.action_net, log_std)
        del self.log_std
        density = TanhSquashed(density) if self._squashes else density
        self.action_net: nn.Module = density.to(self.device)
        self.action_dist = ActionDistributionAdapter(density)
        self.traced = TracedCalls()
        with th.no_grad():
            self._has_exact_entropy = density.entropy(th.zeros(1, features)) is not None
        parameters, rate = self.parameters(), lr_schedule(1)
        self.optimizer = self.optimizer_class(parameters, lr=rate, **self.optimizer_kwargs)  # type: ignore[call-arg]

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        features = BasePolicy.extract_features(self, observation, self.pi_features_extractor)
        noise = () if deterministic else (self.action_dist.density.draw_noise(features),)
        return self.traced(_act, (self.mlp_extractor, self.action_net), features, *noise)

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """Return actions, which must be finite, values and log-probabilities, as SB3 does."""
        found = super().forward(*args, **kwargs)
        check_finite(found[0].detach().cpu().numpy())
        return found

    def evaluate_actions(self, *args: Any, **kwargs: Any) -> Any:
        """Return values, log-probabilities and entropies of stored actions, as SB3 does.

        The gradient with respect to a log-probability is bounded. Near the edge of the action box
        float32 is coarse, so a stored action may lie many standard deviations from the one that was
        drawn. In a narrow distribution one update can then raise its log-probability by a hundred,
        which makes PPO's ratio infinite and its gradient NaN.
        """
        found = super().evaluate_actions(*args, **kwargs)
        check_finite(found[1].detach().cpu().numpy(), "log-probabilities")
        if found[1].requires_grad:
            found[1].register_hook(bound_gradient)
        return found

    def score(
        self, obs: PyTorchObs, actions: th.Tensor, noise: th.Tensor | None = None
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """Do the computation of :meth:`evaluate_actions`, given noise (K, B, M) for the entropy.

        Returns:
            Values (B, 1), log-probabilities (B,), and entropies (B,) or None.
        """
        latent, values = self._latent_and_values(obs)
        density = self.action_dist.density
        entropy = density.entropy(latent)
        if entropy is None and noise is not None:
            entropy = estimate_entropy(density, latent, noise)
        return values, density.log_prob(latent, actions), entropy

    def sample_and_score(
        self, obs: PyTorchObs, noise: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Do the computation of :meth:`forward`, given noise (B, M)."""
        latent, values = self._latent_and_values(obs)
        density = self.action_dist.density
        actions = density.rsample(latent, noise)
        log_prob = density.log_prob(latent, actions)
        return actions.reshape(-1, *(self.action_space.shape or ())), values, log_prob

    def draw_noise(self, *shape: int) -> th.Tensor:
        """Draw standard normals, (*shape, M)."""
        shape = (*shape, self.action_dist.density.noise_dim)
        return th.randn(shape, dtype=self.value_net.weight.dtype, device=self.device)

    def draw_entropy_noise(self, batch_size: int) -> th.Tensor | None:
        """Draw the noise for :meth:`score`, (K, B, M); None if the entropy has a closed form."""
        return None if self._has_exact_entropy else self.draw_noise(ENTROPY_PAIRS, batch_size)

    def _latent_and_values(self, obs: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        features = self.extract_features(obs)
        if self.share_features_extractor:
            latent, latent_vf = self.mlp_extractor(features)
        else:
            latent = self.mlp_extractor.forward_actor(features[0])
            latent_vf = self.mlp_extractor.forward_critic(features[1])
        return latent, self.value_net(latent_vf)

    def _get_action_dist_from_latent(self, latent_pi: th.Tensor) -> Distribution:
        return self.action_dist.proba_distribution(latent_pi)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            "squash_output": self._squashes,
            "state_dependent_std": self.state_dependent_std,
        }


def _act(
    extractor: MlpExtractor, density: ActionDistribution, features: th.Tensor, *noise: th.Tensor
) -> th.Tensor:
    """Return a sample, or without noise the mode."""
    context = extractor.forward_actor(features)
    return density.rsample(context, *noise) if noise else density.mode(context)


def bound_gradient(gradient: th.Tensor) -> th.Tensor:
    """Bound a gradient. NaN, which is 0 times infinity for a ratio that PPO clipped, becomes 0."""
    return gradient.nan_to_num(nan=0.0).clamp(-_LARGEST_GRADIENT, _LARGEST_GRADIENT)


class GaussActorCriticPolicy(DensityActorCritic):
    """Diagonal normal distribution for PPO and A2C, the policy of stock PPO."""

    default_distribution = "gaussian"


class FlowActorCriticPolicy(DensityActorCritic):
    """Conditional RealNVP for PPO and A2C, for correlated actions and curved densities.

    Example:
        >>> from stable_baselines3 import PPO
        >>> model = PPO(FlowActorCriticPolicy, "Pendulum-v1", n_steps=64).learn(64)
    """

    default_distribution = "realnvp"


class LowRankActorCriticPolicy(DensityActorCritic):
    """Normal distribution with low-rank covariance for PPO and A2C, for correlated actions.

    Example:
        >>> from stable_baselines3 import A2C
        >>> kwargs = dict(distribution_kwargs=dict(rank=1), squash_output=True)
        >>> model = A2C(LowRankActorCriticPolicy, "Pendulum-v1", policy_kwargs=kwargs)
    """

    default_distribution = "low_rank"


ALIASES = with_forms(
    FlowPolicy=FlowActorCriticPolicy,
    LowRankPolicy=LowRankActorCriticPolicy,
    GaussPolicy=GaussActorCriticPolicy,
)
