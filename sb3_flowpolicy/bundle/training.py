"""What further training depends on as JSON and arrays: learning rate, optimizers, replay buffer."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from sb3_flowpolicy.bundle.container import Arrays, tensor_like
from sb3_flowpolicy.bundle.policy import class_of, name_of, plain
from sb3_flowpolicy.common.validation import Check, flag, is_number, number

_rate = number(0)
_LINE: dict[str, Check] = {"start": _rate, "end": _rate, "end_fraction": number(0, 1, above=True)}


class LineToZero:
    """A rate that falls linearly from ``initial_value`` to zero, as rl_zoo3's ``lin_3e-4``.

    SB3's ``LinearSchedule`` rounds differently, so that a resumed run would change.
    """

    def __init__(self, initial_value: float) -> None:
        self.initial_value = initial_value

    def __call__(self, progress_remaining: float) -> float:
        """Return the rate for a ``progress_remaining`` that falls from 1 to 0."""
        return progress_remaining * self.initial_value


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
    if is_number(rate):
        return _rate("learning_rate", rate)
    if type(rate) is LinearSchedule:
        return {"schedule": "linear", **{key: getattr(rate, key) for key in _LINE}}
    # By name, because rl_zoo3 may not be installed.
    where = (type(rate).__module__, type(rate).__name__)
    if isinstance(rate, LineToZero) or where == ("rl_zoo3.utils", "SimpleLinearSchedule"):
        return {"schedule": "to_zero", "start": rate.initial_value}
    raise ValueError(
        "learning_rate must be a number or a LinearSchedule of stable_baselines3.common.utils for "
        f"a safe bundle to hold it, got {rate!r}: set model.learning_rate before saving"
    )


def rate_from_spec(spec: Any) -> Any:
    """Build the learning rate that :func:`rate_to_spec` described."""
    kind = spec.get("schedule") if isinstance(spec, dict) else None
    if kind == "linear":
        return LinearSchedule(*(check(key, spec[key]) for key, check in _LINE.items()))
    if kind == "to_zero":
        return LineToZero(_rate("start", spec["start"]))
    return _rate("learning_rate", spec)


# How torch computes a step (foreach, fused, ...) may differ between machines.
_BACKEND = {"params", "foreach", "fused", "capturable", "differentiable"}
_AT_LEAST_ZERO = {"step", "exp_avg_sq", "max_exp_avg_sq", "square_avg"}


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
    for key, value in optimizer_to_spec(name, optimizer, {}).items():
        check = flag if isinstance(value, bool) else number()
        for one in spec[key] if key == "betas" else [spec[key]]:
            check(f"{name}.{key}", one)
        group[key] = tuple(spec[key]) if key == "betas" else spec[key]
    pattern = _state_after_a_step(optimizer, group)
    found = {}
    for index, parameter in enumerate(group["params"]):
        names = {key: f"{name}.{index}.{key}" for key in pattern}
        if not any(one in arrays for one in names.values()):
            continue  # a parameter that was not updated yet
        found[index] = {
            key: tensor_like(parameter if pattern[key].ndim else pattern[key], one, arrays)
            for key, one in names.items()
        }
        for key in _AT_LEAST_ZERO & pattern.keys():
            if not (found[index][key] >= 0).all():
                raise ValueError(f"{names[key]} must be at least 0")
    optimizer.load_state_dict({**optimizer.state_dict(), "state": found})


def _state_after_a_step(
    optimizer: th.optim.Optimizer, group: Mapping[str, Any]
) -> dict[str, th.Tensor]:
    """Take a step with these settings, which torch checks, on one number; return the state."""
    first = group["params"][0]
    scratch = th.zeros(1, dtype=first.dtype, device=first.device, requires_grad=True)
    scratch.grad = th.zeros_like(scratch)
    settings = {key: group[key] for key in inspect.signature(type(optimizer)).parameters}
    probe = type(optimizer)(**{**settings, "params": [scratch]})
    probe.step()
    return {key: value for key, value in probe.state[scratch].items() if value is not None}


def buffer_to_spec(model: SAC) -> dict[str, Any]:
    """Describe the class of a model's replay buffer and its arguments, not its content."""
    kwargs = plain("replay_buffer_kwargs", model.replay_buffer_kwargs)
    return {"class": name_of("replay_buffer_class", model.replay_buffer_class), "kwargs": kwargs}


def buffer_from_spec(spec: dict[str, Any]) -> dict[str, Any]:
    """Return the model's attributes that :func:`buffer_to_spec` described."""
    return {
        "replay_buffer_class": class_of("replay_buffer_class", spec["class"]),
        "replay_buffer_kwargs": dict(spec["kwargs"]),
    }
