"""Learning rate and optimizers as JSON and arrays, for further training."""

from __future__ import annotations

import inspect
from typing import Any

import torch as th
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from sb3_flowpolicy.bundle.container import Arrays, tensor_like
from sb3_flowpolicy.common.validation import Check, number

_rate = number(0)
_LINE: dict[str, Check] = {"start": _rate, "end": _rate, "end_fraction": number(0, 1, above=True)}


def rate_to_spec(rate: Any) -> Any:
    """Describe a learning rate; ``ValueError`` if it is an arbitrary function.

    Example:
        >>> rate_to_spec(LinearSchedule(1e-3, 1e-4, 0.5))
        {'schedule': 'linear', 'start': 0.001, 'end': 0.0001, 'end_fraction': 0.5}
    """
    if isinstance(rate, FloatSchedule):
        rate = rate.value_schedule
    if isinstance(rate, ConstantSchedule):
        rate = rate.val
    if not callable(rate):
        return _rate("learning_rate", rate)
    if type(rate) is LinearSchedule:
        return {"schedule": "linear", **{key: getattr(rate, key) for key in _LINE}}
    raise ValueError(
        "learning_rate must be a number or a LinearSchedule of stable_baselines3.common.utils for "
        f"a safe bundle to hold it, got {rate!r}: set model.learning_rate before saving"
    )


def rate_from_spec(spec: Any) -> Any:
    """Build the learning rate that :func:`rate_to_spec` described."""
    if isinstance(spec, dict):
        return LinearSchedule(*(check(key, spec[key]) for key, check in _LINE.items()))
    return _rate("learning_rate", spec)


# How torch computes a step (foreach, fused, ...) may differ between machines.
_BACKEND = {"params", "foreach", "fused", "capturable", "differentiable"}


def optimizer_to_spec(name: str, optimizer: th.optim.Optimizer, arrays: Arrays) -> dict[str, Any]:
    """Describe an optimizer's settings, and put its state into ``arrays``.

    The arrays are named ``{name}.{index of the parameter}.{entry of the state}``.
    """
    (group,) = optimizer.param_groups  # one, as SB3 builds them
    for index, parameter in enumerate(group["params"]):
        for key, value in optimizer.state.get(parameter, {}).items():
            if value is not None:
                arrays[f"{name}.{index}.{key}"] = th.as_tensor(value).detach().cpu().numpy()
    arguments = inspect.signature(type(optimizer)).parameters
    settings = {key: group[key] for key in arguments if key in group and key not in _BACKEND}
    if "betas" in settings:
        settings["betas"] = list(settings["betas"])
    return settings


def load_optimizer(name: str, optimizer: th.optim.Optimizer, spec: Any, arrays: Arrays) -> None:
    """Put a new optimizer into the state that :func:`optimizer_to_spec` described."""
    group = optimizer.param_groups[0]
    settings: dict[str, Any] = {
        key: tuple(value) if key == "betas" else value for key, value in spec.items()
    }
    group.update(settings)
    # A step on one number makes torch check the settings and create the entries of its state.
    scratch = th.zeros_like(group["params"][0].flatten()[:1], requires_grad=True)
    scratch.grad = th.zeros_like(scratch)
    probe = type(optimizer)([scratch], **settings)
    probe.step()
    pattern = {key: one for key, one in probe.state[scratch].items() if one is not None}
    found = {}
    for index, parameter in enumerate(group["params"]):
        names = {key: f"{name}.{index}.{key}" for key in pattern}
        if any(one in arrays for one in names.values()):  # else it was not updated yet
            found[index] = {
                key: tensor_like(parameter if pattern[key].ndim else pattern[key], one, arrays)
                for key, one in names.items()
            }
    optimizer.load_state_dict({**optimizer.state_dict(), "state": found})
