"""The policy as JSON: names of classes, from fixed lists, and arguments as plain values."""

from __future__ import annotations

import itertools
import json
import threading
from collections.abc import Mapping
from enum import Enum
from typing import Any

import torch as th
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, NatureCNN
from torch import nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from sb3_flowpolicy import policies
from sb3_flowpolicy.common.validation import one_of


def _by_name(*classes: type) -> dict[str, Any]:
    return {one.__name__: one for one in classes}


# Names in a file are looked up here, never imported.
_CLASSES = {
    "policy_class": _by_name(
        *(policies.FlowPolicy, policies.CnnFlowPolicy, policies.MultiInputFlowPolicy),
        *(policies.LowRankPolicy, policies.CnnLowRankPolicy, policies.MultiInputLowRankPolicy),
        *(policies.GaussPolicy, policies.CnnGaussPolicy, policies.MultiInputGaussPolicy),
    ),
    "activation_fn": _by_name(
        *(nn.ReLU, nn.Tanh, nn.ELU, nn.GELU, nn.LeakyReLU, nn.SELU, nn.SiLU, nn.Mish),
        *(nn.Softplus, nn.Softsign, nn.Sigmoid, nn.Hardtanh, nn.ReLU6, nn.CELU, nn.Identity),
    ),
    "features_extractor_class": _by_name(FlattenExtractor, NatureCNN, CombinedExtractor),
    "optimizer_class": _by_name(th.optim.Adam, th.optim.AdamW, th.optim.SGD, th.optim.RMSprop),
    "replay_buffer_class": _by_name(
        ReplayBuffer, DictReplayBuffer, NStepReplayBuffer, HerReplayBuffer
    ),
}


def name_of(argument: str, value: Any) -> str:
    """Return the name of a class, if a bundle may hold it as this argument."""
    known, name = _CLASSES[argument], getattr(value, "__name__", "")
    if known.get(name) is not value:
        raise ValueError(
            f"{argument} must be one of {list(known)} for a safe bundle to hold it, got {value!r}: "
            "your own classes need model.save(), which pickles them"
        )
    return name


def class_of(argument: str, name: str) -> Any:
    """Return the class that :func:`name_of` named."""
    one_of(*_CLASSES[argument])(argument, name)
    return _CLASSES[argument][name]


def to_spec(model: SAC) -> dict[str, Any]:
    """Describe the class and the arguments of a model's policy."""
    spec = {"policy_class": name_of("policy_class", model.policy_class)}
    policy: Any = model.policy
    for name, value in policy.up_to_date(model.policy_kwargs).items():
        spec[name] = name_of(name, value) if name in _CLASSES else plain(name, value)
    return spec


def from_spec(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Return the model's attributes that :func:`to_spec` described."""
    kwargs = {
        name: class_of(name, value) if name in _CLASSES else value for name, value in spec.items()
    }
    if kwargs.get("use_sde"):
        # Building such a policy draws noise, which the meta device cannot do.
        raise ValueError("use_sde must be False for a safe bundle, got True: use model.save()")
    return {"policy_class": kwargs.pop("policy_class"), "policy_kwargs": kwargs}


def expected_parameters(attributes: Mapping[str, Any], n_arrays: int) -> dict[str, th.Tensor]:
    """Return the state dict of a model's policy on the meta device, which takes no memory.

    Construction takes time, so it stops when there are more parameters than arrays.
    """
    policy_class, count = attributes["policy_class"], itertools.count(1)
    thread = threading.get_ident()

    def limit(*_: Any) -> None:
        if threading.get_ident() == thread and next(count) > n_arrays:
            raise ValueError(f"policy must have no more parameters than the {n_arrays} arrays")

    # SB3 moves the actor to the policy's device, which without real parameters is the CPU.
    without_memory = type(policy_class.__name__, (policy_class,), {"device": th.device("meta")})
    spaces = attributes["observation_space"], attributes["action_space"]
    handle = register_module_parameter_registration_hook(limit)
    try:
        with th.device("meta"):
            policy = without_memory(*spaces, lambda _: 0.0, **attributes["policy_kwargs"])
    finally:
        handle.remove()
    return policy.state_dict()


def plain(name: str, value: Any) -> Any:
    """Return a value as JSON would: tuples as lists, numpy's numbers and enums as Python's."""

    def convert(one: Any) -> Any:
        return one.value if isinstance(one, Enum) else one.item()

    try:
        return json.loads(json.dumps(value, allow_nan=False, default=convert))
    except (TypeError, ValueError, AttributeError, RuntimeError):
        raise ValueError(
            f"{name} must be made of finite numbers, strings, lists and dicts for a safe bundle to "
            f"hold it, got {value!r}"
        ) from None
