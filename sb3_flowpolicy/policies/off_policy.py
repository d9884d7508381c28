"""What the policy classes for SAC, TQC and CrossQ have in common."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule

from sb3_flowpolicy.common.validation import mapping, one_of, optional
from sb3_flowpolicy.distributions.base import is_whole, positive_int
from sb3_flowpolicy.guard.finite import all_finite, check_observation
from sb3_flowpolicy.policies.actor import FlowActor
from sb3_flowpolicy.policies.deterministic import DETERMINISTIC_DEFAULTS, MODES, best_actions
from sb3_flowpolicy.policies.extractors import check_observation_space


class DistributionPolicy(BasePolicy):
    """Mixin for off-policy policy classes: a registered density as the action distribution.

    Put it before ``SACPolicy``, ``TQCPolicy`` or ``CrossQPolicy`` among the base classes.

    Args:
        observation_space: Observation space.
        action_space: Box with finite bounds, of any shape.
        lr_schedule: Learning rate schedule.
        distribution: Name of a registered density. Default: that of the policy class.
        distribution_kwargs: Arguments of the density, for example ``dict(layers=4)``.
        deterministic_mode: How ``predict(..., deterministic=True)`` chooses an action: ``"base"``
            takes the image of the base mean, ``"log_prob"`` the most likely of several candidates,
            ``"q"`` the best according to the critics. Can be changed later.
        deterministic_samples: Number of candidates, at least 2; the base mean is one of them.
        **policy_kwargs: Arguments of the algorithm's own policy class: ``net_arch``,
            ``activation_fn``, ``features_extractor_class``, ``optimizer_kwargs``, ``n_critics``,
            ``share_features_extractor``, ...

    Raises:
        ValueError: If the action space is not a bounded Box; if the density, one of its arguments
            or the mode is unknown; or if ``use_sde=True`` with any density but the diagonal normal
            distribution (whose actor is then SB3's own). Algorithms reject such action spaces
            themselves, with an ``AssertionError``, before they build the policy.
    """

    default_distribution: ClassVar[str]
    default_features_extractor_class: ClassVar[type[BaseFeaturesExtractor]] = FlattenExtractor
    actor_class: ClassVar[type[FlowActor]] = FlowActor
    # Attributes of the algorithm's own policy class.
    actor: Any
    critic: Any
    actor_kwargs: dict[str, Any]
    net_args: dict[str, Any]
    share_features_extractor: bool

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
        if not (
            isinstance(action_space, spaces.Box)
            and np.isfinite([action_space.low, action_space.high]).all()
            and (action_space.low < action_space.high).all()
        ):
            raise ValueError(
                f"action_space must be a Box with finite bounds, low < high, got {action_space}"
            )
        check_net_arch(policy_kwargs.get("net_arch"), "qf", both=True)
        for name in {"n_critics", "n_quantiles"} & set(policy_kwargs):
            positive_int(name, policy_kwargs[name])
        extractor = policy_kwargs.setdefault(
            "features_extractor_class", self.default_features_extractor_class
        )
        check_observation_space(observation_space, extractor)
        # Plain attributes before super().__init__(), which builds the actor.
        self.distribution = self.default_distribution if distribution is None else distribution
        self.distribution_kwargs = dict(
            optional(mapping)("distribution_kwargs", distribution_kwargs) or {}
        )
        self._uses_sde = bool(policy_kwargs.get("use_sde"))
        if self._uses_sde and self.distribution != "gaussian":
            raise ValueError(
                "use_sde must be False unless distribution is 'gaussian', because gSDE replaces "
                f"the density, got use_sde=True with {self.distribution!r}"
            )
        self.deterministic_samples = positive_int(
            "deterministic_samples", deterministic_samples, least=2
        )
        self.deterministic_mode = deterministic_mode
        super().__init__(observation_space, action_space, lr_schedule, **policy_kwargs)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """Build the actor; called once, by the algorithm's policy class."""
        if self.actor_kwargs["use_sde"]:
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
        one_of(*MODES)("deterministic_mode", mode)
        if mode != "base" and self._uses_sde:
            raise ValueError(f'deterministic_mode must be "base" with use_sde=True, got {mode!r}')
        self._deterministic_mode = mode

    def predict(self, observation: Any, *args: Any, **kwargs: Any) -> Any:
        """Choose actions, as SB3's policies do.

        Raises:
            ValueError: If an observation or an action is not finite.
        """
        actions, state = super().predict(observation, *args, **kwargs)
        check_observation(observation)
        check_finite_actions(actions)
        return actions, state

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        if not deterministic or self.deterministic_mode == "base":
            return super()._predict(observation, deterministic)  # type: ignore[safe-super]
        mode, n_candidates = self.deterministic_mode, self.deterministic_samples
        return best_actions(self.actor, self.critic, observation, mode, n_candidates)

    def set_training_mode(self, mode: bool) -> None:
        """Switch batch normalization and dropout; ``predict`` does so at every step."""
        # Walking through all modules each time would take longer than a small network does.
        if not self.training == self.actor.training == self.critic.training == mode:
            super().set_training_mode(mode)

    def up_to_date(self, policy_kwargs: Mapping[str, Any]) -> dict[str, Any]:
        """Return ``policy_kwargs`` with the deterministic settings that were changed later."""
        before = {**DETERMINISTIC_DEFAULTS, **policy_kwargs}
        now = self._deterministic_settings()
        return {**policy_kwargs, **{k: value for k, value in now.items() if value != before[k]}}

    def _deterministic_settings(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in DETERMINISTIC_DEFAULTS}

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            "distribution": self.distribution,
            "distribution_kwargs": self.distribution_kwargs,
            **self._deterministic_settings(),
            # SB3 omits it: a policy that shares its extractor would be loaded as one that does not.
            "share_features_extractor": self.share_features_extractor,
        }


def check_net_arch(net_arch: Any, critic: str, both: bool) -> None:
    """Raise ``ValueError`` unless ``net_arch`` is None or holds the units of each layer.

    Args:
        net_arch: A list for actor and critic alike, or a mapping with one for each.
        critic: Key of the critic in the mapping.
        both: Whether the mapping must have both keys.
    """
    archs = net_arch if isinstance(net_arch, Mapping) else {"pi": net_arch, critic: net_arch}
    missing = {"pi", critic} - set(archs) if both else set()
    if net_arch is not None and (
        missing
        or not set(archs) <= {"pi", critic}
        or not all(isinstance(arch, list | tuple) for arch in archs.values())
        or not all(is_whole(units) and units >= 1 for arch in archs.values() for units in arch)
    ):
        raise ValueError(
            "net_arch must be a list of units per layer, each at least 1, or a dict of such lists "
            f"with the keys 'pi' and {critic!r}, got {net_arch!r}"
        )


def check_finite_actions(actions: np.ndarray) -> None:
    """Raise ``ValueError`` rather than send NaN to an environment."""
    if not all_finite(actions):
        raise ValueError("observation and weights must be finite, got actions with NaN or infinity")
