"""A policy class's forms for images and for dictionaries, as SB3 names them."""

from __future__ import annotations

from typing import Any, TypeVar

from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    NatureCNN,
)

Policy = TypeVar("Policy", bound=BasePolicy)


def for_images(*policies: type[Policy]) -> tuple[type[Policy], ...]:
    """Return each class with ``Cnn`` before its name and SB3's ``NatureCNN`` in front.

    Args:
        *policies: Classes with a ``default_features_extractor_class``.

    Example:
        >>> from sb3_flowpolicy import GaussPolicy
        >>> (policy,) = for_images(GaussPolicy)
        >>> policy.__name__, policy.__doc__
        ('CnnGaussPolicy', ':class:`GaussPolicy` for image observations.')
    """
    return tuple(_with(policy, "Cnn", "image", NatureCNN) for policy in policies)


def for_dicts(*policies: type[Policy]) -> tuple[type[Policy], ...]:
    """Return each class with ``MultiInput`` before its name and SB3's ``CombinedExtractor``.

    Args:
        *policies: Classes with a ``default_features_extractor_class``.
    """
    extractor = CombinedExtractor
    return tuple(_with(policy, "MultiInput", "dictionary", extractor) for policy in policies)


def check_observation_space(space: spaces.Space, extractor: type[BaseFeaturesExtractor]) -> None:
    """Check that SB3's extractors are given what they can read; others know for themselves.

    Raises:
        ValueError: If the space is a dictionary and the extractor is for arrays, or the reverse.

    Example:
        >>> check_observation_space(spaces.Dict({}), NatureCNN)
        Traceback (most recent call last):
        ...
        ValueError: observation_space must be no Dict for NatureCNN (Dicts take a MultiInput... ...
    """
    is_dict = isinstance(space, spaces.Dict)
    if is_dict and extractor in (FlattenExtractor, NatureCNN):
        wanted = "no Dict for"
    elif not is_dict and extractor is CombinedExtractor:
        wanted = "a Dict for"
    else:
        return
    raise ValueError(
        f"observation_space must be {wanted} {extractor.__name__} (Dicts take a MultiInput... "
        f"policy, all else one without), got {space}"
    )


def _with(
    policy: type[Policy], prefix: str, kind: str, extractor: type[BaseFeaturesExtractor]
) -> type[Policy]:
    attributes: dict[str, Any] = {
        "default_features_extractor_class": extractor,
        # Where pickles of a model look for the class.
        "__module__": policy.__module__,
        "__doc__": f":class:`{policy.__name__}` for {kind} observations.",
    }
    return type(f"{prefix}{policy.__name__}", (policy,), attributes)
