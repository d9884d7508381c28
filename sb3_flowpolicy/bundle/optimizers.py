"""The state of torch's optimisers as arrays and plain numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th

from sb3_flowpolicy.bundle.container import Arrays
from sb3_flowpolicy.common.validation import Check, flag, number


def _betas(name: str, value: Any) -> list[float]:
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise ValueError(f"{name} must be two numbers, got {str(value)[:80]}")
    betas = [number(0)(name, beta) for beta in value]
    if max(betas) >= 1:
        raise ValueError(f"{name} must be below 1, got {betas}")
    return betas


# What decides the numbers. How torch computes them (foreach, fused, ...) stays as it was built.
_GROUP: dict[str, Check] = {
    "lr": number(0),
    "betas": _betas,
    "eps": number(0),
    "weight_decay": number(0),
    "amsgrad": flag,
    "maximize": flag,
    "alpha": number(0),
    "momentum": number(0),
    "dampening": number(),
    "nesterov": flag,
    "centered": flag,
    "decoupled_weight_decay": flag,
}
# What the optimisers remember per parameter; those that are at least 0 are marked.
_STATE = {
    "step": True,
    "exp_avg": False,
    "exp_avg_sq": True,
    "max_exp_avg_sq": True,
    "square_avg": True,
    "grad_avg": False,
    "momentum_buffer": False,
}


def optimizer_to_spec(name: str, optimizer: th.optim.Optimizer, arrays: Arrays) -> dict[str, Any]:
    """Describe an optimiser's settings, and put its state among ``arrays``.

    Args:
        name: What to call it in messages, and its arrays.
        optimizer: Adam, AdamW, SGD or RMSprop with one group of parameters.
        arrays: Receives ``{name}.{index of the parameter}.{what}``.

    Raises:
        ValueError: If it has several groups, or remembers something else.
    """
    if len(optimizer.param_groups) != 1:
        raise ValueError(f"{name} must have one group of parameters, got {optimizer!r}")
    group = optimizer.param_groups[0]
    for index, parameter in enumerate(group["params"]):
        for key, value in optimizer.state.get(parameter, {}).items():
            if value is None:
                continue
            if key not in _STATE:
                raise ValueError(f"{name} must remember some of {list(_STATE)}, got {key!r}")
            array = th.as_tensor(value).detach().cpu().numpy()
            arrays[f"{name}.{index}.{key}"] = _checked(f"{name}.{index}.{key}", key, array)
    return {
        key: check(f"{name}.{key}", group[key]) for key, check in _GROUP.items() if key in group
    }


def load_optimizer(name: str, optimizer: th.optim.Optimizer, spec: Any, arrays: Arrays) -> None:
    """Put an optimiser into the state that :func:`optimizer_to_spec` described.

    Args:
        name: What it was called.
        optimizer: A fresh one, over the same parameters.
        spec: Its settings.
        arrays: Its state is taken out of these, without copying.

    Raises:
        ValueError: If settings or state are not those of such an optimiser.
    """
    group = optimizer.param_groups[0]
    expected = [key for key in _GROUP if key in group]
    if not isinstance(spec, dict) or set(spec) != set(expected):
        raise ValueError(f"{name} must have the settings {expected}, got {str(spec)[:80]}")
    for key in expected:
        value = _GROUP[key](f"{name}.{key}", spec[key])
        group[key] = tuple(value) if isinstance(value, list) else value
    found: dict[int, dict[str, th.Tensor]] = {}
    for index, parameter in enumerate(group["params"]):
        entries = {key: arrays.pop(f"{name}.{index}.{key}", None) for key in _STATE}
        state = {
            key: th.from_numpy(_checked(f"{name}.{index}.{key}", key, array, parameter))
            for key, array in entries.items()
            if array is not None
        }
        if state:
            found[index] = state
    kept = _kept_by(optimizer)
    for index, state in found.items():
        if set(state) != kept:
            raise ValueError(f"{name}.{index} must remember {sorted(kept)}, got {sorted(state)}")
    optimizer.load_state_dict({**optimizer.state_dict(), "state": found})


def _kept_by(optimizer: th.optim.Optimizer) -> set[str]:
    group = optimizer.param_groups[0]
    if isinstance(optimizer, th.optim.Adam):
        return {"step", "exp_avg", "exp_avg_sq", *(["max_exp_avg_sq"] * group["amsgrad"])}
    if isinstance(optimizer, th.optim.RMSprop):
        centered, momentum = ["grad_avg"] * group["centered"], group["momentum"] > 0
        return {"step", "square_avg", *centered, *(["momentum_buffer"] * momentum)}
    return {"momentum_buffer"} if group.get("momentum") else set()


def _checked(
    name: str, key: str, array: np.ndarray, parameter: th.Tensor | None = None
) -> np.ndarray:
    if parameter is not None:
        dtype = np.float32 if key == "step" else th.empty(0, dtype=parameter.dtype).numpy().dtype
        shape = () if key == "step" else tuple(parameter.shape)
        if array.dtype != dtype or array.shape != shape:
            raise ValueError(
                f"{name} must be {np.dtype(dtype)} of shape {shape}, "
                f"got {array.dtype} {array.shape}"
            )
    if not np.isfinite(array).all() or (_STATE[key] and (array < 0).any()):
        raise ValueError(f"{name} must be finite{', at least 0' * _STATE[key]}, got other numbers")
    return array
