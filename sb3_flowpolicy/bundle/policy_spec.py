"""The policy as JSON: classes by name, from fixed lists, and their arguments as plain values."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN
from torch import nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from sb3_flowpolicy import policies
from sb3_flowpolicy.common.validation import Check, flag, integer, number, one_of, optional
from sb3_flowpolicy.policies import DistributionPolicy
from sb3_flowpolicy.policies.deterministic import MODES as DETERMINISTIC_MODES


def _by_name(*classes: type) -> dict[str, Any]:
    return {one.__name__: one for one in classes}


# A name in a file becomes one of these, or nothing. Nothing is ever imported by name.
POLICIES: dict[str, type[DistributionPolicy]] = _by_name(
    policies.FlowPolicy,
    policies.LowRankPolicy,
    policies.GaussPolicy,
    policies.CnnFlowPolicy,
    policies.CnnLowRankPolicy,
    policies.CnnGaussPolicy,
    policies.MultiInputFlowPolicy,
    policies.MultiInputLowRankPolicy,
    policies.MultiInputGaussPolicy,
)
_CLASSES = {
    "activation_fn": _by_name(
        *(nn.ReLU, nn.Tanh, nn.ELU, nn.GELU, nn.LeakyReLU, nn.SELU, nn.SiLU, nn.Mish),
        *(nn.Softplus, nn.Softsign, nn.Sigmoid, nn.Hardtanh, nn.ReLU6, nn.CELU, nn.Identity),
    ),
    "features_extractor_class": _by_name(FlattenExtractor, NatureCNN, CombinedExtractor),
    "optimizer_class": _by_name(th.optim.Adam, th.optim.AdamW, th.optim.SGD, th.optim.RMSprop),
}


def _without_sde(name: str, value: Any) -> bool:
    # Its noise is drawn while the policy is built, which cannot be done without memory.
    if flag(name, value):
        raise ValueError(f"{name} must be False for a safe bundle, got True: use model.save()")
    return value


_PLAIN: dict[str, Check] = {
    "use_sde": _without_sde,
    "log_std_init": number(),
    "use_expln": flag,
    "clip_mean": number(0),
    "normalize_images": flag,
    "n_critics": integer(1),
    "share_features_extractor": flag,
    "deterministic_mode": one_of(*DETERMINISTIC_MODES),
    # More would take gigabytes at the first prediction.
    "deterministic_samples": integer(2, 2**16),
}
_ARGUMENTS = ("features_extractor_kwargs", "optimizer_kwargs", "distribution_kwargs")


def policy_class_name(policy_class: type) -> str:
    """Return the name of one of our policy classes.

    Raises:
        ValueError: If it is another class.
    """
    if POLICIES.get(policy_class.__name__) is not policy_class:
        raise ValueError(
            f"policy must be one of {list(POLICIES)} for a safe bundle to hold it, got "
            f"{policy_class.__qualname__}: classes of your own need model.save(), which pickles"
        )
    return policy_class.__name__


def policy_class_from_name(name: Any) -> type[DistributionPolicy]:
    """Return the policy class of this name.

    Raises:
        ValueError: If it is not in the list.
    """
    return _lookup("policy", name, POLICIES)


def kwargs_to_spec(policy_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Describe ``policy_kwargs``.

    Raises:
        ValueError: If an argument is no plain value, or a class that is in no list; the message
            names it.

    Example:
        >>> kwargs_to_spec({"net_arch": [64, 64], "activation_fn": nn.Tanh})
        {'net_arch': [64, 64], 'activation_fn': 'Tanh'}
    """
    spec = {}
    for name, value in policy_kwargs.items():
        if name in _CLASSES:
            known = _CLASSES[name]
            title = getattr(value, "__name__", str(value))
            if known.get(title) is not value:
                raise ValueError(
                    f"{name} must be one of {list(known)} for a safe bundle to hold it, got "
                    f"{value!r}: classes of your own need model.save(), which pickles"
                )
            spec[name] = title
        else:
            spec[name] = _plain(name, value)
    # What is saved can be loaded: the same checks, on what a file would say.
    kwargs_from_spec(spec)
    return spec


def kwargs_from_spec(spec: Any) -> dict[str, Any]:
    """Build the ``policy_kwargs`` that :func:`kwargs_to_spec` described.

    Raises:
        ValueError: If an argument is unknown, or not of its type.
    """
    if not isinstance(spec, dict):
        raise ValueError(f"policy_kwargs must be an object, got {str(spec)[:80]}")
    kwargs: dict[str, Any] = {}
    for name, value in spec.items():
        if name in _CLASSES:
            kwargs[name] = _lookup(name, value, _CLASSES[name])
        elif name in _PLAIN:
            kwargs[name] = _PLAIN[name](name, value)
        elif name in _ARGUMENTS:
            kwargs[name] = optional(_arguments)(name, value)
        elif name == "net_arch":
            kwargs[name] = optional(_net_arch)(name, value)
        elif name == "distribution" and isinstance(value, str | None):
            kwargs[name] = value  # the registry of densities is a list as well
        else:
            raise ValueError(f"policy_kwargs must not have {name!r} = {str(value)[:80]}")
    return kwargs


def expected_shapes(
    policy_class: type[DistributionPolicy],
    observation_space: spaces.Space,
    action_space: spaces.Box,
    kwargs: Mapping[str, Any],
    n_arrays: int,
) -> dict[str, tuple[th.Size, th.dtype]]:
    """Say which parameters such a policy has, without allocating any.

    Args:
        policy_class: One of our policies.
        observation_space: Its observation space.
        action_space: Its action space.
        kwargs: Its arguments.
        n_arrays: Number of arrays in the file: a policy of more parameters is not built.

    Returns:
        Shape and type by name, as in the policy's state dict.

    Raises:
        ValueError: If there is no such policy.
    """
    # SB3 moves the actor to the policy's device, which for want of parameters would be the CPU.
    without_memory = type(policy_class.__name__, (policy_class,), {"device": th.device("meta")})
    try:
        with th.device("meta"), _at_most_parameters(n_arrays):
            policy = without_memory(observation_space, action_space, lambda _: 0.0, **kwargs)
            state = policy.state_dict()
            return {name: (value.shape, value.dtype) for name, value in state.items()}
    # Settings of someone else's making: torch and SB3 raise whatever they come across.
    except Exception as error:
        text = str(error).strip().splitlines() or [""]
        raise ValueError(
            f"policy_kwargs must make a policy, got {type(error).__name__}: {text[0][:200]}"
        ) from error


@contextmanager
def _at_most_parameters(most: int) -> Iterator[None]:
    """Stop whatever builds more parameters than this: a billion layers take for ever."""
    count, thread = 0, threading.get_ident()

    def tally(*_: Any) -> None:
        nonlocal count
        count += threading.get_ident() == thread
        if count > most:
            raise ValueError(f"more parameters than the {most} arrays in the file")

    handle = register_module_parameter_registration_hook(tally)
    try:
        yield
    finally:
        handle.remove()


def _lookup(name: str, value: Any, known: Mapping[str, Any]) -> Any:
    if not isinstance(value, str) or value not in known:
        raise ValueError(f"{name} must be one of {list(known)}, got {str(value)[:80]!r}")
    return known[value]


def _net_arch(name: str, value: Any) -> Any:
    if isinstance(value, dict):
        if not set(value) <= {"pi", "qf"}:
            raise ValueError(f"{name} must have the keys pi and qf, got {sorted(value)[:5]}")
        return {key: _net_arch(f"{name}.{key}", units) for key, units in value.items()}
    if not isinstance(value, list) or len(value) > 1000:
        raise ValueError(f"{name} must be a list of units per layer, got {str(value)[:80]}")
    return [integer(1)(name, units) for units in value]


def _arguments(name: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{name} must be an object, got {str(value)[:80]}")
    return value


def _plain(name: str, value: Any) -> Any:
    """Return what JSON makes of a value, tuples as lists."""
    if value is None or isinstance(value, str | bool):
        return value
    if isinstance(value, list | tuple):
        return [_plain(name, one) for one in value]
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {key: _plain(f"{name}[{key!r}]", one) for key, one in value.items()}
    try:
        return number()(name, value)
    except ValueError:
        raise ValueError(
            f"{name} must be made of numbers, strings, lists and dicts for a safe bundle to hold "
            f"it, got {value!r}"
        ) from None
