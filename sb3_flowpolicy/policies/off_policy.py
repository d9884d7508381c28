"""What our policy classes for SAC, TQC and CrossQ have in common."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule

from sb3_flowpolicy.distributions.base import positive_int
from sb3_flowpolicy.guard.finite import all_finite, check_observation
from sb3_flowpolicy.policies.actor import FlowActor
from sb3_flowpolicy.policies.deterministic import (
    DETERMINISTIC_DEFAULTS,
    best_actions,
    check_settings,
)
from sb3_flowpolicy.policies.extractors import check_observation_space


class DistributionPolicy(BasePolicy):
    """Mixin for off-policy policy classes: a registered density as the action distribution.

    To be named before ``SACPolicy``, or the class of another algorithm that is built like SAC.

    Args:
        observation_space: Observation space.
        action_space: Box with finite bounds, of any shape.
        lr_schedule: Learning rate schedule.
        distribution: Name of a registered density. Default: the policy class's own.
        distribution_kwargs: Arguments of the density, for example ``dict(layers=4)``.
        deterministic_mode: What ``predict(..., deterministic=True)`` does: ``"base"`` takes the
            image of the base mean, ``"log_prob"`` the most likely of several candidates, ``"q"``
            the best by the critics. May be set afterwards as well.
        deterministic_samples: Number of candidates, at least 2; the base mean is one of them.
        **policy_kwargs: Everything that the algorithm's own policy class takes: ``net_arch``,
            ``activation_fn``, ``features_extractor_class``, ``optimizer_kwargs``, ``n_critics``,
            ``share_features_extractor``, ...

    Raises:
        ValueError: If the action space is no bounded Box, the density, one of its arguments or
            the mode is unknown, or ``use_sde=True`` is asked of anything but the diagonal normal
            distribution (whose actor is then SB3's own). Plain algorithms refuse such an
            action space themselves, with an ``AssertionError``, before they build the policy.
    """

    default_distribution: ClassVar[str]
    default_features_extractor_class: ClassVar[type[BaseFeaturesExtractor]] = FlattenExtractor
    actor_class: ClassVar[type[FlowActor]] = FlowActor
    # Of the algorithm's own policy class.
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
        bounded = (
            isinstance(action_space, spaces.Box)
            and np.isfinite([action_space.low, action_space.high]).all()
        )
        bounded = bounded and (action_space.low < action_space.high).all()
        if not bounded:
            raise ValueError(
                f"action_space must be a Box with finite bounds, low < high, got {action_space}"
            )
        # Plain attributes before super().__init__(), which builds the actor.
        self.distribution = self.default_distribution if distribution is None else distribution
        if not isinstance(distribution_kwargs, Mapping | None):
            raise ValueError(f"distribution_kwargs must be a dict, got {distribution_kwargs!r}")
        self.distribution_kwargs = dict(distribution_kwargs or {})
        if not all(isinstance(name, str) for name in self.distribution_kwargs):
            raise ValueError(
                f"distribution_kwargs must have strings as keys, got {distribution_kwargs!r}"
            )
        check_net_arch(policy_kwargs.get("net_arch"), "qf", both=True)
        for name in {"n_critics", "n_quantiles"} & set(policy_kwargs):
            positive_int(name, policy_kwargs[name])
        extractor = policy_kwargs.setdefault(
            "features_extractor_class", self.default_features_extractor_class
        )
        check_observation_space(observation_space, extractor)
        policies = [base for base in type(self).__mro__ if issubclass(base, BasePolicy)]
        theirs = next(base for base in policies if not issubclass(base, DistributionPolicy))
        unknown = sorted(set(policy_kwargs) - set(inspect.signature(theirs).parameters))
        if unknown:
            raise ValueError(
                f"policy_kwargs must be {theirs.__name__}'s, distribution or distribution_kwargs, "
                f"got {unknown}; arguments of the density go into distribution_kwargs"
            )
        if policy_kwargs.get("use_sde") and self.distribution != "gaussian":
            raise ValueError(
                "use_sde must be False unless distribution is 'gaussian': gSDE is a linear noise "
                f"of its own, got use_sde=True with {self.distribution!r}"
            )
        self._uses_sde = bool(policy_kwargs.get("use_sde"))
        self.deterministic_samples = deterministic_samples
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
        check_settings(mode, self.deterministic_samples, self._uses_sde)
        self._deterministic_mode = mode

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        parts = observation if isinstance(observation, dict) else {"": observation}
        check_observation({key: part.detach().cpu().numpy() for key, part in parts.items()})
        if deterministic and self.deterministic_mode != "base":
            assert isinstance(self.actor, FlowActor)  # anything else allows "base" only
            mode, n_candidates = self.deterministic_mode, self.deterministic_samples
            actions = best_actions(self.actor, self.critic, observation, mode, n_candidates)
        else:
            actions = super()._predict(observation, deterministic)  # type: ignore[safe-super]
        check_finite_actions(actions.detach().cpu().numpy())
        return actions

    def set_training_mode(self, mode: bool) -> None:
        """Switch batch normalisation and dropout; ``predict`` asks for it at every step."""
        # Walking through all modules each time would take longer than a small network does.
        if not self.training == self.actor.training == self.critic.training == mode:
            super().set_training_mode(mode)

    def up_to_date(self, policy_kwargs: Mapping[str, Any]) -> dict[str, Any]:
        """Return ``policy_kwargs`` with what was set after construction."""
        before = {**DETERMINISTIC_DEFAULTS, **policy_kwargs}
        now = self._deterministic_settings()
        changed = {name: value for name, value in now.items() if value != before[name]}
        return {**policy_kwargs, **changed}

    def _deterministic_settings(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in DETERMINISTIC_DEFAULTS}

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            distribution=self.distribution,
            distribution_kwargs=self.distribution_kwargs,
            **self._deterministic_settings(),
            # Missing in SB3's: a policy that shares its extractor would load as one that does not.
            share_features_extractor=self.share_features_extractor,
        )
        return data


def check_net_arch(net_arch: Any, critic: str, both: bool) -> None:
    """Check that these are units per layer; torch's messages would not say.

    Args:
        net_arch: Units of each layer, of actor and critic alike or of each.
        critic: What the algorithm calls its critic.
        both: Whether a mapping must tell of both, or may leave one without layers.

    Raises:
        ValueError: If they are not.
    """
    if net_arch is None:
        return
    archs = [net_arch]
    if isinstance(net_arch, Mapping):
        keys, known = set(net_arch), {"pi", critic}
        if keys != known if both else not keys <= known:
            raise ValueError(f"net_arch must have the keys 'pi' and {critic!r}, got {[*net_arch]}")
        archs = list(net_arch.values())
    for arch in archs:
        if not isinstance(arch, list | tuple):
            raise ValueError(f"net_arch must be a list of units per layer, got {arch!r}")
        for units in arch:
            positive_int("net_arch", units)


def check_finite_actions(actions: np.ndarray) -> None:
    """Raise ``ValueError`` rather than send NaN to an environment, as stock SAC does."""
    if not all_finite(actions):
        raise ValueError(
            "observation and weights must be finite for an action to be, got actions with NaN"
        )
