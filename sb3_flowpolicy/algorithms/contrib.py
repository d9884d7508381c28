"""sb3-contrib's TQC and CrossQ with our policies by name, coloured exploration and exact resume."""

from __future__ import annotations

from typing import Any, ClassVar

from sb3_contrib import TQC, CrossQ
from sb3_contrib.crossq.policies import CrossQPolicy
from sb3_contrib.tqc.policies import TQCPolicy
from stable_baselines3.common.policies import BasePolicy

from sb3_flowpolicy.algorithms.exploration import ColoredExploration
from sb3_flowpolicy.algorithms.guarded import Guarded
from sb3_flowpolicy.checkpoint import Resumable
from sb3_flowpolicy.common.settings import (
    SETTINGS,
    assertions_as_value_errors,
    by_name,
    check_policy,
    check_settings,
    flag,
    integer,
    number,
)
from sb3_flowpolicy.policies import crossq, tqc

_POLICY_BASES = {TQC: TQCPolicy, CrossQ: CrossQPolicy}

_FURTHER = {"top_quantiles_to_drop_per_net": integer(0), "policy_delay": integer(1)}

# CrossQ's, in policy_kwargs.
_NORMALIZATION = {
    "batch_norm": flag,
    "batch_norm_momentum": number(0, 1),
    "batch_norm_eps": number(0, above=True),
    "renorm_warmup_steps": integer(0),
}


class _Checked(Guarded, Resumable, ColoredExploration):
    """Says what is wrong with arguments, as SACFlow does."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        theirs, policy_base = next(
            (base, _POLICY_BASES[base]) for base in type(self).__mro__ if base in _POLICY_BASES
        )
        given = by_name(theirs, args, kwargs)
        check_settings(given, {**SETTINGS, **_FURTHER})
        check_policy(given.get("policy"), policy_base, self.policy_aliases)
        check_settings(given.get("policy_kwargs") or {}, _NORMALIZATION)
        with assertions_as_value_errors():
            super().__init__(*args, **kwargs)


class TQCFlow(_Checked, TQC):
    """Truncated Quantile Critics with action distributions that correlate and bend.

    Everything of sb3-contrib's :class:`~sb3_contrib.TQC` holds. Besides, ``action_noise_color`` and
    ``action_noise_correlation_time`` make exploration directed, see
    :class:`~sb3_flowpolicy.algorithms.exploration.ColoredExploration`, and :meth:`learn` takes
    ``checkpoint_every`` and ``checkpoint_path``. Updates are sb3-contrib's own: the fast engine is
    :class:`~sb3_flowpolicy.SACFlow`'s alone.

    Args:
        policy: ``"FlowPolicy"`` (or ``"MlpPolicy"``), ``"LowRankPolicy"``, ``"GaussPolicy"``,
            their ``Cnn...`` and ``MultiInput...`` forms, or a policy class.
        env: Environment, its registered id, or a ``VecEnv``.
        *args: Further arguments of TQC, in its order.
        **kwargs: Keyword arguments of TQC and of ``ColoredExploration``.

    Raises:
        ValueError: If an argument is out of range, or the environment's action space is no Box with
            finite bounds.

    References:
        Controlling Overestimation Bias with Truncated Mixture of Continuous Distributional Quantile
        Critics (Kuznetsov et al., 2020).

    Example:
        >>> model = TQCFlow("FlowPolicy", "Pendulum-v1", action_noise_color=1.0, learning_starts=9)
        >>> _ = model.learn(20)
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = tqc.ALIASES

    def _setup_model(self) -> None:
        super()._setup_model()
        dropped, quantiles = self.top_quantiles_to_drop_per_net, self.critic.n_quantiles
        if dropped >= quantiles:
            raise ValueError(
                "top_quantiles_to_drop_per_net must be less than n_quantiles of policy_kwargs, "
                f"got {dropped} of {quantiles}"
            )


class CrossQFlow(_Checked, CrossQ):
    """CrossQ with action distributions that correlate and bend.

    Everything of sb3-contrib's :class:`~sb3_contrib.CrossQ` holds, and what :class:`TQCFlow` adds.
    Like CrossQ it takes vectors as observations, no images or dictionaries.

    Args:
        policy: ``"FlowPolicy"`` (or ``"MlpPolicy"``), ``"LowRankPolicy"``, ``"GaussPolicy"``, or a
            policy class.
        env: Environment, its registered id, or a ``VecEnv``.
        *args: Further arguments of CrossQ, in its order.
        **kwargs: Keyword arguments of CrossQ and of ``ColoredExploration``.

    Raises:
        ValueError: If an argument is out of range, or the environment's action space is no Box with
            finite bounds.

    References:
        CrossQ: Batch Normalization in Deep Reinforcement Learning (Bhatt et al., 2024).

    Example:
        >>> kwargs = dict(net_arch=[16])
        >>> model = CrossQFlow("LowRankPolicy", "Pendulum-v1", policy_kwargs=kwargs, seed=0)
        >>> _ = model.learn(20)
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = crossq.ALIASES
