"""Policy classes for CrossQ: sb3-contrib's, with a registered density."""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar

from sb3_contrib.common.torch_layers import BatchRenorm1d
from sb3_contrib.crossq.policies import Actor as StockCrossQActor
from sb3_contrib.crossq.policies import CrossQPolicy
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn

from sb3_flowpolicy.policies.actor import FlowActor
from sb3_flowpolicy.policies.off_policy import DistributionPolicy

_BATCH_NORM = ("batch_norm", "batch_norm_momentum", "batch_norm_eps", "renorm_warmup_steps")


class CrossQFlowActor(FlowActor):
    """:class:`FlowActor` with CrossQ's batch renormalization before and after each hidden layer.

    The further arguments, ``batch_norm``, ..., are those of sb3-contrib's actor.

    References:
        CrossQ: Batch Normalization in Deep Reinforcement Learning (Bhatt et al., 2024).
    """

    set_bn_training_mode = StockCrossQActor.set_bn_training_mode

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._batch_norm: dict[str, Any] = {name: kwargs.pop(name) for name in _BATCH_NORM}
        super().__init__(*args, **kwargs)

    def _make_latent_pi(self) -> nn.Sequential:
        used, momentum, eps, warmup_steps = self._batch_norm.values()
        if not used:
            return super()._make_latent_pi()
        norm: Any = partial(BatchRenorm1d, momentum=momentum, eps=eps, warmup_steps=warmup_steps)
        layers = create_mlp(
            self.features_dim, -1, self.net_arch, self.activation_fn, pre_linear_modules=[norm]
        )
        return nn.Sequential(*layers, *([norm(self.net_arch[-1])] if self.net_arch else []))

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), **self._batch_norm}


class _CrossQ(DistributionPolicy, CrossQPolicy):
    actor_class: ClassVar[type[FlowActor]] = CrossQFlowActor


class GaussCrossQPolicy(_CrossQ):
    """Diagonal normal distribution, the policy of stock CrossQ."""

    default_distribution = "gaussian"


class LowRankCrossQPolicy(_CrossQ):
    """Normal distribution with low-rank covariance, for correlated actions."""

    default_distribution = "low_rank"


class FlowCrossQPolicy(_CrossQ):
    """Conditional RealNVP, for correlated actions and curved densities.

    Example:
        >>> from sb3_contrib import CrossQ
        >>> model = CrossQ(FlowCrossQPolicy, "Pendulum-v1", policy_kwargs=dict(net_arch=[16]))
    """

    default_distribution = "realnvp"


# CrossQ takes neither images nor dictionaries.
ALIASES: dict[str, Any] = {
    "MlpPolicy": FlowCrossQPolicy,
    "FlowPolicy": FlowCrossQPolicy,
    "LowRankPolicy": LowRankCrossQPolicy,
    "GaussPolicy": GaussCrossQPolicy,
}
