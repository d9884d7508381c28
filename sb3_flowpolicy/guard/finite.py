"""Reject NaN and infinity in observations, rewards and actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

# If the squares of numbers add up to less, all of them fit float32. A sum with NaN or infinity is
# not less.
_SURELY_FINITE = 1e76


class NonFiniteError(ValueError):
    """A value is NaN or infinite, or too large for float32; the message says which and where."""


def all_finite(values: np.ndarray) -> bool:
    """Whether an array is finite as float32, the type that networks work with.

    Example:
        >>> all_finite(np.array([1.0, 1e30])), all_finite(np.array([1.0, 1e300]))
        (True, False)
    """
    if values.dtype.kind != "f":
        return True
    # One pass of BLAS takes a third of the time of isfinite().all(), and this runs at every step.
    if float(np.vdot(values, values)) < _SURELY_FINITE:
        return True
    with np.errstate(over="ignore"):
        return bool(np.isfinite(values.astype(np.float32)).all())


def check_finite(values: np.ndarray, name: str = "actions") -> None:
    """Raise :class:`NonFiniteError` rather than send NaN to an environment or learn from it."""
    if not all_finite(values):
        raise NonFiniteError(
            f"observation and weights must be finite, got {name} with NaN or infinity"
        )


def check_observation(observation: Any) -> None:
    """Raise :class:`NonFiniteError` if an observation to act on is not finite."""
    _check("observation", observation, lambda at: f"at index {at}")


def check_experience(
    columns: Mapping[str, Any], step: int, who: Callable[[int], str] = "environment {}".format
) -> None:
    """Reject non-finite values from environments before they enter a replay buffer.

    Args:
        columns: Name -> array of N environments, (N, ...), or a dictionary of such arrays.
        step: Environment steps done, for the message.
        who: Names an environment by its index.

    Raises:
        NonFiniteError: If a value is NaN, infinite or too large for float32.

    Example:
        >>> columns = {"observations": np.zeros((2, 3)), "rewards": np.array([0.0, np.nan])}
        >>> check_experience(columns, 7)
        Traceback (most recent call last):
        ...
        sb3_flowpolicy.guard.finite.NonFiniteError: rewards must be finite in float32, got nan \
from environment 1 at step 7, index (1,); nothing of this step was stored
    """
    for name, value in columns.items():
        _check(name, value, lambda at: _origin(who(at[0]), step, at))


def check_step(
    observations: Any,
    rewards: np.ndarray,
    dones: Sequence[bool] | np.ndarray,
    infos: Sequence[Mapping[str, Any]],
    step: int,
) -> None:
    """Reject the result of a step of an SB3 ``VecEnv``, as :func:`check_experience` does."""
    check_experience({"observations": observations, "rewards": rewards}, step)
    for index in np.flatnonzero(dones).tolist():
        last = infos[index].get("terminal_observation")
        if last is not None:
            where = partial(_origin, f"environment {index}", step)
            _check("final observations", last, where)


def _origin(who: str, step: int, at: tuple[int, ...]) -> str:
    return f"from {who} at step {step}, index {at}; nothing of this step was stored"


def _check(name: str, value: Any, where: Callable[[tuple[int, ...]], str]) -> None:
    if isinstance(value, Mapping):
        for key, part in value.items():
            _check(f"{name}[{key!r}]", part, where)
        return
    values = np.asarray(value)
    if all_finite(values):
        return
    with np.errstate(over="ignore"):
        first = np.argwhere(~np.isfinite(values.astype(np.float32)))[0]
    at = tuple(first.tolist())
    raise NonFiniteError(f"{name} must be finite in float32, got {values[at]} {where(at)}")
