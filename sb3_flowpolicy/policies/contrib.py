"""Policy classes for sb3-contrib's TQC and CrossQ: the same arguments as theirs, and ours."""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar

from sb3_contrib.common.torch_layers import BatchRenorm1d
from sb3_contrib.crossq.policies import Actor as StockCrossQActor
from sb3_contrib.crossq.policies import CrossQPolicy
from sb3_contrib.tqc.policies import TQCPolicy
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn

from sb3_flowpolicy.policies.actor import FlowActor
from sb3_flowpolicy.policies.extractors import for_dicts, for_images
from sb3_flowpolicy.policies.off_policy import DistributionPolicy


class GaussTQCPolicy(DistributionPolicy, TQCPolicy):
    """Diagonal normal distribution: stock TQC, on our code.

    Example:
        >>> from sb3_contrib import TQC
        >>> model = TQC(GaussTQCPolicy, "Pendulum-v1", learning_starts=10).learn(20)
    """

    default_distribution = "gaussian"


class LowRankTQCPolicy(DistributionPolicy, TQCPolicy):
    """Normal distribution with low-rank covariance for TQC; actions correlate.

    Example:
        >>> from sb3_contrib import TQC
        >>> kwargs = dict(distribution_kwargs=dict(rank=1), n_quantiles=10)
        >>> model = TQC(LowRankTQCPolicy, "Pendulum-v1", policy_kwargs=kwargs)
    """

    default_distribution = "low_rank"


class FlowTQCPolicy(DistributionPolicy, TQCPolicy):
    """Conditional RealNVP for TQC; the distribution correlates and bends.

    Example:
        >>> from sb3_contrib import TQC
        >>> model = TQC(FlowTQCPolicy, "Pendulum-v1", learning_starts=10).learn(20)
    """

    default_distribution = "realnvp"


_FOR_TQC = (GaussTQCPolicy, LowRankTQCPolicy, FlowTQCPolicy)
CnnGaussTQCPolicy, CnnLowRankTQCPolicy, CnnFlowTQCPolicy = for_images(*_FOR_TQC)
MultiInputGaussTQCPolicy, MultiInputLowRankTQCPolicy, MultiInputFlowTQCPolicy = for_dicts(*_FOR_TQC)


class CrossQFlowActor(FlowActor):
    """:class:`FlowActor` with CrossQ's batch renormalisation before each hidden layer and after.

    Args:
        *args: As for :class:`FlowActor`.
        batch_norm: Whether there is any.
        batch_norm_momentum: Rate at which the statistics follow.
        batch_norm_eps: Added to variances.
        renorm_warmup_steps: Updates before the running statistics are used.
        **kwargs: As for :class:`FlowActor`.

    References:
        CrossQ: Batch Normalization in Deep Reinforcement Learning (Bhatt et al., 2024).
    """

    set_bn_training_mode = StockCrossQActor.set_bn_training_mode

    def __init__(
        self,
        *args: Any,
        batch_norm: bool = True,
        batch_norm_momentum: float = 0.01,
        batch_norm_eps: float = 0.001,
        renorm_warmup_steps: int = 100_000,
        **kwargs: Any,
    ) -> None:
        self._batch_norm: dict[str, Any] = {
            "momentum": batch_norm_momentum,
            "eps": batch_norm_eps,
            "warmup_steps": renorm_warmup_steps,
        }
        self._uses_batch_norm = batch_norm
        super().__init__(*args, **kwargs)

    def _make_latent_pi(self) -> nn.Sequential:
        if not self._uses_batch_norm:
            return super()._make_latent_pi()
        norm: Any = partial(BatchRenorm1d, **self._batch_norm)
        layers = create_mlp(
            self.features_dim, -1, self.net_arch, self.activation_fn, pre_linear_modules=[norm]
        )
        return nn.Sequential(*layers, *([norm(self.net_arch[-1])] if self.net_arch else []))

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            batch_norm=self._uses_batch_norm,
            batch_norm_momentum=self._batch_norm["momentum"],
            batch_norm_eps=self._batch_norm["eps"],
            renorm_warmup_steps=self._batch_norm["warmup_steps"],
        )
        return data


class _CrossQ(DistributionPolicy, CrossQPolicy):
    actor_class: ClassVar[type[FlowActor]] = CrossQFlowActor


class GaussCrossQPolicy(_CrossQ):
    """Diagonal normal distribution: stock CrossQ, on our code.

    Example:
        >>> from sb3_contrib import CrossQ
        >>> kwargs = dict(net_arch=[16])
        >>> model = CrossQ(GaussCrossQPolicy, "Pendulum-v1", policy_kwargs=kwargs)
    """

    default_distribution = "gaussian"


class LowRankCrossQPolicy(_CrossQ):
    """Normal distribution with low-rank covariance for CrossQ; actions correlate."""

    default_distribution = "low_rank"


class FlowCrossQPolicy(_CrossQ):
    """Conditional RealNVP for CrossQ; the distribution correlates and bends.

    Example:
        >>> from sb3_contrib import CrossQ
        >>> kwargs = dict(net_arch=[16])
        >>> model = CrossQ(FlowCrossQPolicy, "Pendulum-v1", policy_kwargs=kwargs, learning_starts=9)
        >>> _ = model.learn(20)
    """

    default_distribution = "realnvp"
