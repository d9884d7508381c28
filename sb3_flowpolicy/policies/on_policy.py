"""Policy classes for PPO and A2C: SB3's, with a registered density."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_flowpolicy.distributions import TanhSquashed, make_distribution
from sb3_flowpolicy.guard.finite import all_finite
from sb3_flowpolicy.policies.extractors import check_observation_space, for_dicts, for_images
from sb3_flowpolicy.policies.off_policy import check_finite_actions, check_net_arch
from sb3_flowpolicy.policies.sb3_distribution import ActionDistributionAdapter

# Of SB3's normal distributions, which are not built.
_NOT_OURS = {"use_sde", "log_std_init", "full_std", "use_expln", "squash_output"}
# Of the loss, by an action's log-probability. PPO's is advantage times ratio; a larger one says
# only that the policy has left the actions that it is judged by.
_LARGEST_GRADIENT = 1e6


class DensityActorCritic(ActorCriticPolicy):
    """Actor-critic policy with a registered density as its action distribution.

    The log-probability of an action is that of the very numbers in the rollout buffer, by the
    density's inverse, while collecting and while learning. So the ratio of PPO is 1 before the
    first update, however far an action is saturated (up to rounding, which flows with extreme
    weights amplify). The entropy bonus is a Monte
    Carlo estimate whose gradient reaches all parameters of the density.

    Args:
        observation_space: Observation space.
        action_space: Box of any shape; with finite bounds if ``squash_output``.
        lr_schedule: Learning rate schedule.
        distribution: Name of a registered density. Default: the policy class's own.
        distribution_kwargs: Arguments of the density, for example ``dict(layers=4)``.
        squash_output: Whether tanh bounds actions, in which case they are rescaled to the action
            space. Otherwise they are clipped to it, as SB3 does by default.
        **policy_kwargs: Everything else that SB3's ``ActorCriticPolicy`` takes: ``net_arch``,
            ``activation_fn``, ``ortho_init``, ``features_extractor_class``, ...

    Raises:
        ValueError: If the action space is no Box (with finite bounds), the density or an argument
            is unknown, or ``use_sde=True``.

    References:
        Proximal Policy Optimization Algorithms (Schulman et al., 2017); thesis chapter 5 on
        on-policy algorithms as the next to be given these densities.
    """

    default_distribution: ClassVar[str]
    default_features_extractor_class: ClassVar[type[BaseFeaturesExtractor]] = FlattenExtractor

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        *,
        distribution: str | None = None,
        distribution_kwargs: Mapping[str, Any] | None = None,
        squash_output: bool = True,
        use_sde: bool = False,
        **policy_kwargs: Any,
    ) -> None:
        if not isinstance(action_space, spaces.Box):
            raise ValueError(f"action_space must be a Box, got {action_space}")
        if not isinstance(squash_output, bool):
            raise ValueError(f"squash_output must be True or False, got {squash_output!r}")
        if squash_output and not np.isfinite([action_space.low, action_space.high]).all():
            raise ValueError(
                "action_space must have finite bounds for actions to be squashed into, got "
                f"{action_space}"
            )
        if use_sde:
            raise ValueError("use_sde must be False: gSDE goes with SB3's own policies, got True")
        if not isinstance(distribution_kwargs, Mapping | None):
            raise ValueError(f"distribution_kwargs must be a dict, got {distribution_kwargs!r}")
        net_arch = policy_kwargs.get("net_arch")
        if isinstance(net_arch, list) and len(net_arch) == 1 and isinstance(net_arch[0], Mapping):
            net_arch = net_arch[0]  # as before SB3 1.8, which still takes it with a warning
        check_net_arch(net_arch, "vf", both=False)
        extractor = policy_kwargs.setdefault(
            "features_extractor_class", self.default_features_extractor_class
        )
        check_observation_space(observation_space, extractor)
        bases = [base for base in type(self).__mro__ if issubclass(base, ActorCriticPolicy)]
        known = {name for base in bases for name in inspect.signature(base).parameters} - _NOT_OURS
        unknown = sorted(set(policy_kwargs) - known)
        if unknown:
            raise ValueError(
                "policy_kwargs must be ActorCriticPolicy's (but for its normal distribution's), "
                f"distribution, distribution_kwargs or squash_output, got {unknown}"
            )
        # Plain attributes before super().__init__(), which builds the networks.
        self.distribution = self.default_distribution if distribution is None else distribution
        self.distribution_kwargs = dict(distribution_kwargs or {})
        self._squashes = squash_output
        super().__init__(observation_space, action_space, lr_schedule, **policy_kwargs)
        # SB3's constructor allows it to gSDE only, though all of SB3 that reads it is ready for us.
        self._squash_output = squash_output

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        # The normal heads were initialised with all the rest, and now give way.
        del self.log_std
        size, features = spaces.flatdim(self.action_space), self.mlp_extractor.latent_dim_pi
        density = make_distribution(self.distribution, size, features, **self.distribution_kwargs)
        density = TanhSquashed(density) if self._squashes else density
        self.action_net: nn.Module = density.to(self.device)
        self.action_dist = ActionDistributionAdapter(density)
        parameters, rate = self.parameters(), lr_schedule(1)
        self.optimizer = self.optimizer_class(parameters, lr=rate, **self.optimizer_kwargs)  # type: ignore[call-arg]

    def forward(self, *args: Any, **kwargs: Any) -> Any:
        """Return actions, values and log-probabilities, as SB3's.

        Raises:
            ValueError: If an action is not finite, which has an observation or weights for a cause.
        """
        found = super().forward(*args, **kwargs)
        check_finite_actions(found[0].detach().cpu().numpy())
        return found

    def evaluate_actions(self, *args: Any, **kwargs: Any) -> Any:
        """Return values, log-probabilities and entropies of stored actions, as SB3's.

        The gradient that comes back through a log-probability is bounded. Close to the edge of the
        action box float32 has few numbers left, so that a stored action may lie many standard
        deviations beside the one that was drawn. In a narrow distribution one update can raise its
        log-probability by a hundred: PPO's ratio is infinite, its gradient NaN.

        Raises:
            ValueError: If a log-probability is not finite.
        """
        found = super().evaluate_actions(*args, **kwargs)
        if not all_finite(found[1].detach().cpu().numpy()):
            raise ValueError(
                "observations and weights must be finite to learn from, got log-probabilities "
                "with NaN or infinity"
            )
        if found[1].requires_grad:
            found[1].register_hook(_bounded)
        return found

    def _predict(self, *args: Any, **kwargs: Any) -> Any:
        found = super()._predict(*args, **kwargs)
        actions = found[0] if isinstance(found, tuple) else found  # a memory comes along
        check_finite_actions(actions.detach().cpu().numpy())
        return found

    def _get_action_dist_from_latent(self, latent_pi: th.Tensor) -> Distribution:
        return self.action_dist.proba_distribution(latent_pi)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data = {name: value for name, value in data.items() if name not in _NOT_OURS}
        data.update(
            distribution=self.distribution,
            distribution_kwargs=self.distribution_kwargs,
            squash_output=self._squashes,
            # Missing in SB3's: a policy that shares its extractor would load as one that does not.
            share_features_extractor=self.share_features_extractor,
        )
        return data


def _bounded(gradient: th.Tensor) -> th.Tensor:
    """Bound a gradient; NaN is 0 x infinity, of a ratio that PPO has clipped: no gradient."""
    return gradient.nan_to_num(nan=0.0).clamp(-_LARGEST_GRADIENT, _LARGEST_GRADIENT)


class FlowActorCriticPolicy(DensityActorCritic):
    """Conditional RealNVP for PPO and A2C; the distribution correlates and bends.

    Example:
        >>> from stable_baselines3 import PPO
        >>> model = PPO(FlowActorCriticPolicy, "Pendulum-v1", n_steps=64).learn(64)
        >>> obs = model.get_env().reset()
        >>> model.predict(obs, deterministic=True)[0].shape
        (1, 1)
    """

    default_distribution = "realnvp"


class LowRankActorCriticPolicy(DensityActorCritic):
    """Normal distribution with low-rank covariance for PPO and A2C; actions correlate.

    Example:
        >>> from stable_baselines3 import A2C
        >>> kwargs = dict(distribution_kwargs=dict(rank=1), squash_output=False)
        >>> model = A2C(LowRankActorCriticPolicy, "Pendulum-v1", policy_kwargs=kwargs)
    """

    default_distribution = "low_rank"


_POLICIES = (FlowActorCriticPolicy, LowRankActorCriticPolicy)
CnnFlowActorCriticPolicy, CnnLowRankActorCriticPolicy = for_images(*_POLICIES)
MultiInputFlowActorCriticPolicy, MultiInputLowRankActorCriticPolicy = for_dicts(*_POLICIES)
