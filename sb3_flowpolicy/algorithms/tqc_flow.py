"""TQCFlow: sb3-contrib's TQC with our policies, colored exploration and exact resume."""

from __future__ import annotations

from typing import ClassVar

from sb3_contrib import TQC
from stable_baselines3.common.policies import BasePolicy

from sb3_flowpolicy.algorithms.engine_flow import EngineFlow
from sb3_flowpolicy.common.validation import integer
from sb3_flowpolicy.engine.tqc import TQCObjective
from sb3_flowpolicy.policies import tqc


class TQCFlow(EngineFlow, TQC):
    """Truncated Quantile Critics with action distributions that correlate and bend.

    Supports everything that sb3-contrib's :class:`~sb3_contrib.TQC` does. Policies have the names
    of those of :class:`~sb3_flowpolicy.SACFlow`, whose arguments ``compile``, ``autocast``,
    ``action_noise_color`` and ``action_noise_correlation_time`` are also accepted; :meth:`learn`
    takes ``checkpoint_every`` and ``checkpoint_path``. Updates equal sb3-contrib's number by number
    and run on the engine.

    References:
        Controlling Overestimation Bias with Truncated Mixture of Continuous Distributional Quantile
        Critics (Kuznetsov et al., 2020).

    Example:
        >>> model = TQCFlow("FlowPolicy", "Pendulum-v1", action_noise_color=1.0, learning_starts=9)
        >>> _ = model.learn(20)
    """

    stock = TQC
    settings: ClassVar = {**EngineFlow.settings, "top_quantiles_to_drop_per_net": integer(0)}
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = tqc.ALIASES

    def _setup_model(self) -> None:
        super()._setup_model()
        dropped, quantiles = self.top_quantiles_to_drop_per_net, self.critic.n_quantiles
        if dropped >= quantiles:  # nothing would be left to train on
            raise ValueError(
                "top_quantiles_to_drop_per_net must be less than n_quantiles of policy_kwargs, "
                f"got {dropped} of {quantiles}"
            )

    def objective(self) -> TQCObjective:
        """Return TQC's objective, with the present ``top_quantiles_to_drop_per_net``."""
        return TQCObjective(self.top_quantiles_to_drop_per_net)
