"""What all policy classes share: the density, checks, and forms for images and dictionaries."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    NatureCNN,
)

from sb3_flowpolicy.common.validation import layer_sizes, mapping, optional
from sb3_flowpolicy.guard.finite import check_finite, check_observation

_FORMS = {"Cnn": ("image", NatureCNN), "MultiInput": ("dictionary", CombinedExtractor)}


class DensityPolicy(BasePolicy):
    """Mixin for SB3's policy classes: a registered density as the action distribution."""

    default_distribution: ClassVar[str]
    default_features_extractor_class: ClassVar[type[BaseFeaturesExtractor]] = FlattenExtractor
    share_features_extractor: bool

    def _set_density(
        self,
        observation_space: spaces.Space,
        policy_kwargs: dict[str, Any],
        distribution: str | None,
        distribution_kwargs: Mapping[str, Any] | None,
    ) -> None:
        """Set plain attributes, before SB3's constructor builds the networks."""
        extractor = policy_kwargs.setdefault(
            "features_extractor_class", self.default_features_extractor_class
        )
        is_dict = isinstance(observation_space, spaces.Dict)
        if extractor in ((FlattenExtractor, NatureCNN) if is_dict else (CombinedExtractor,)):
            raise ValueError(
                f"observation_space must {'not ' if is_dict else ''}be a Dict for "
                f"{extractor.__name__} (only MultiInput... policies take a Dict), "
                f"got {observation_space}"
            )
        self.distribution = self.default_distribution if distribution is None else distribution
        self.distribution_kwargs = dict(
            optional(mapping)("distribution_kwargs", distribution_kwargs) or {}
        )

    def predict(self, observation: Any, *args: Any, **kwargs: Any) -> Any:
        """Choose actions, as SB3's policies do.

        Raises:
            NonFiniteError: If an observation or an action is not finite.
        """
        actions, state = super().predict(observation, *args, **kwargs)
        check_observation(observation)
        check_finite(actions)
        return actions, state

    def set_training_mode(self, mode: bool) -> None:
        """Switch batch normalization and dropout; ``predict`` does so at every step."""
        # Walking through all modules each time would take longer than a small network does. Two
        # levels hold the networks, of which one may have been replaced.
        parts = [*self.children(), *(part for one in self.children() for part in one.children())]
        if self.training != mode or any(part.training != mode for part in parts):
            super().set_training_mode(mode)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            "distribution": self.distribution,
            "distribution_kwargs": self.distribution_kwargs,
            # SB3 omits it: a policy that shares its extractor would be loaded as one that does not.
            "share_features_extractor": self.share_features_extractor,
        }


def check_action_space(space: spaces.Space, bounded: bool = True) -> None:
    """Raise ``ValueError`` unless it is a Box, to which tanh can be rescaled if ``bounded``."""
    fits = isinstance(space, spaces.Box) and (
        not bounded
        or bool(np.isfinite([space.low, space.high]).all() and (space.low < space.high).all())
    )
    if not fits:
        bounds = " with finite bounds, low < high" if bounded else ""
        raise ValueError(f"action_space must be a Box{bounds}, got {space}")


def check_net_arch(net_arch: Any, required: set[str], allowed: set[str]) -> None:
    """Check the units per layer: None, a list, or a mapping with one for actor and critic each.

    Raises:
        ValueError: If a mapping lacks a ``required`` key or has one that is not ``allowed``, or a
            size is not an integer of at least 1.
    """
    if isinstance(net_arch, Mapping):
        if not required <= set(net_arch) <= allowed:
            raise ValueError(
                f"net_arch must be a dict with the keys {sorted(allowed)}, got {net_arch!r}"
            )
        for arch in net_arch.values():
            layer_sizes("net_arch", arch)
    elif net_arch is not None:
        layer_sizes("net_arch", net_arch)


def with_forms(**policies: type[BasePolicy]) -> dict[str, Any]:
    """Derive the ``Cnn...`` and ``MultiInput...`` form of each class; return all by alias.

    The first of ``policies`` is the default, for which ``"MlpPolicy"`` stands. The forms are added
    to the module that defines the class, because a saved model refers to its policy class by
    module and name.

    Example:
        >>> from sb3_flowpolicy.policies.sac import ALIASES
        >>> ALIASES["CnnGaussPolicy"].__doc__
        ':class:`GaussPolicy` for image observations.'
        >>> ALIASES["MultiInputPolicy"].__name__
        'MultiInputFlowPolicy'
    """
    default = next(iter(policies))
    aliases: dict[str, Any] = {"MlpPolicy": policies[default], **policies}
    for alias, policy in policies.items():
        for prefix, (kind, extractor) in _FORMS.items():
            attributes = {
                "default_features_extractor_class": extractor,
                "__module__": policy.__module__,
                "__doc__": f":class:`{policy.__name__}` for {kind} observations.",
            }
            form = type(f"{prefix}{policy.__name__}", (policy,), attributes)
            setattr(sys.modules[form.__module__], form.__name__, form)
            aliases[f"{prefix}{alias}"] = form
            if alias == default:
                aliases[f"{prefix}Policy"] = form
    return aliases
