"""The forms of policy classes for images and dictionaries, and the names of all of them."""

from __future__ import annotations

from typing import Any

from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    NatureCNN,
)

_FORMS = {"Cnn": ("image", NatureCNN), "MultiInput": ("dictionary", CombinedExtractor)}


def with_forms(module: dict[str, Any], **policies: type[BasePolicy]) -> dict[str, Any]:
    """Derive the ``Cnn...`` and ``MultiInput...`` form of each class; return all by alias.

    Args:
        module: ``globals()`` of the module that defines the classes. The forms are added to it,
            because a saved model refers to its policy class by module and name.
        **policies: Alias -> class with a ``default_features_extractor_class``. The first is the
            default, which ``"MlpPolicy"`` stands for.

    Returns:
        The ``policy_aliases`` of an algorithm.

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
            module[form.__name__] = aliases[f"{prefix}{alias}"] = form
            if alias == default:
                aliases[f"{prefix}Policy"] = form
    return aliases


def check_observation_space(space: spaces.Space, extractor: type[BaseFeaturesExtractor]) -> None:
    """Raise ``ValueError`` if one of SB3's extractors cannot read the observations."""
    is_dict = isinstance(space, spaces.Dict)
    if extractor in ((FlattenExtractor, NatureCNN) if is_dict else (CombinedExtractor,)):
        raise ValueError(
            f"observation_space must {'not ' if is_dict else ''}be a Dict for {extractor.__name__} "
            f"(only MultiInput... policies take a Dict), got {space}"
        )
