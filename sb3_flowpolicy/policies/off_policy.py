"""What the policy classes for SAC, TQC and CrossQ have in common."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule

from sb3_flowpolicy.common.validation import integer, one_of
from sb3_flowpolicy.policies.actor import FlowActor
from sb3_flowpolicy.policies.base import DensityPolicy, check_action_space, check_net_arch
from sb3_flowpolicy.policies.deterministic import DETERMINISTIC_DEFAULTS, MODES, best_actions


class DistributionPolicy(DensityPolicy):
    """Mixin for off-policy policy classes: a registered density as the action distribution.

    Put it before ``SACPolicy``, ``TQCPolicy`` or ``CrossQPolicy`` among the base classes.

    Args:
        observation_space: As for SB3.
        action_space: Box with finite bounds, of any shape.
        lr_schedule: As for SB3.
        distribution: Name of a registered density. Default: that of the policy class.
        distribution_kwargs: Arguments of the density, for example ``dict(layers=4)``.
        deterministic_mode: How ``predict(..., deterministic=True)`` chooses an action: ``"base"``
            takes the image of the base mean, ``"log_prob"`` the most likely of several candidates,
            ``"q"`` the best according to the critics. Can be changed later.
        deterministic_samples: Number of candidates, at least 2; the base mean is one of them.
        **policy_kwargs: Arguments of the algorithm's own policy class.

    Raises:
        ValueError: If the action space is not a bounded Box, or if ``use_sde=True`` with any
            density but the diagonal normal distribution (whose actor is then SB3's own).
    """

    actor_class: ClassVar[type[FlowActor]] = FlowActor
    # Attributes of the algorithm's own policy class.
    actor: Any
    critic: Any
    net_args: dict[str, Any]

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        *,
        distribution: str | None = None,
        distribution_kwargs: Mapping[str, Any] | None = None,
        deterministic_mode: str = DETERMINISTIC_DEFAULTS["deterministic_mode"],
        deterministic_samples: int = DETERMINISTIC_DEFAULTS["deterministic_samples"],
        **policy_kwargs: Any,
    ) -> None:
        check_action_space(action_space)
        check_net_arch(policy_kwargs.get("net_arch"), {"pi", "qf"}, {"pi", "qf"})
        for name in {"n_critics", "n_quantiles"} & set(policy_kwargs):
            integer(1)(name, policy_kwargs[name])
        self._set_density(observation_space, policy_kwargs, distribution, distribution_kwargs)
        self._uses_sde = bool(policy_kwargs.get("use_sde"))
        if self._uses_sde and self.distribution != "gaussian":
            raise ValueError(
                "use_sde must be False unless distribution is 'gaussian', because gSDE replaces "
                f"the density, got use_sde=True with {self.distribution!r}: use GaussPolicy"
            )
        self.deterministic_samples = integer(2)("deterministic_samples", deterministic_samples)
        self.deterministic_mode = deterministic_mode
        super().__init__(observation_space, action_space, lr_schedule, **policy_kwargs)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """Build the actor."""
        if self._uses_sde:
            return super().make_actor(features_extractor)  # type: ignore[misc]
        net_args = self._update_features_extractor(self.net_args, features_extractor)
        actor = self.actor_class(
            **net_args,
            distribution=self.distribution,
            distribution_kwargs=self.distribution_kwargs,
        )
        return actor.to(self.device)

    @property
    def deterministic_mode(self) -> str:
        """How a deterministic action is chosen: ``"base"``, ``"log_prob"`` or ``"q"``."""
        return self._deterministic_mode

    @deterministic_mode.setter
    def deterministic_mode(self, mode: str) -> None:
        modes = ("base",) if self._uses_sde else MODES
        self._deterministic_mode = one_of(*modes)("deterministic_mode", mode)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        if self._uses_sde:
            return super()._predict(observation, deterministic)  # type: ignore[safe-super]
        if not deterministic or self.deterministic_mode == "base":
            return self.actor.act(observation, deterministic)
        mode, n_candidates = self.deterministic_mode, self.deterministic_samples
        return best_actions(self.actor, self.critic, observation, mode, n_candidates)

    def up_to_date(self, policy_kwargs: Mapping[str, Any]) -> dict[str, Any]:
        """Return ``policy_kwargs`` with the deterministic settings that were changed later."""
        before = {**DETERMINISTIC_DEFAULTS, **policy_kwargs}
        now = {name: getattr(self, name) for name in DETERMINISTIC_DEFAULTS}
        return {**policy_kwargs, **{k: value for k, value in now.items() if value != before[k]}}

    def _get_constructor_parameters(self) -> dict[str, Any]:
        settings = {name: getattr(self, name) for name in DETERMINISTIC_DEFAULTS}
        return {**super()._get_constructor_parameters(), **settings}
