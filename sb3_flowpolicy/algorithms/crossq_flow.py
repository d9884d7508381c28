"""CrossQFlow: sb3-contrib's CrossQ with our policies, colored exploration and exact resume."""

from __future__ import annotations

from typing import ClassVar

from sb3_contrib import CrossQ
from stable_baselines3.common.policies import BasePolicy

from sb3_flowpolicy.algorithms.engine_flow import EngineFlow
from sb3_flowpolicy.common.validation import integer
from sb3_flowpolicy.engine.crossq import CrossQObjective
from sb3_flowpolicy.policies import crossq


class CrossQFlow(EngineFlow, CrossQ):
    """CrossQ with action distributions that correlate and bend.

    Supports everything that sb3-contrib's :class:`~sb3_contrib.CrossQ` does, with the additions of
    :class:`~sb3_flowpolicy.TQCFlow`. Like CrossQ it takes vectors as observations, no images
    or dictionaries.

    References:
        CrossQ: Batch Normalization in Deep Reinforcement Learning (Bhatt et al., 2024).

    Example:
        >>> kwargs = dict(net_arch=[16])
        >>> model = CrossQFlow("LowRankPolicy", "Pendulum-v1", policy_kwargs=kwargs, seed=0)
        >>> _ = model.learn(20)
    """

    stock = CrossQ
    settings: ClassVar = {**EngineFlow.settings, "policy_delay": integer(1)}
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = crossq.ALIASES

    def objective(self) -> CrossQObjective:
        """Return CrossQ's objective, with the present ``policy_delay``."""
        return CrossQObjective(policy_delay=self.policy_delay)
