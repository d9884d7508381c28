"""Reject NaN and infinity in what environments return and policies are shown."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

# Squares of numbers that float32 holds stay below; NaN compares false, so does infinity.
_SURELY_FINITE = 1e76


ENVIRONMENT = "environment {}".format


class NonFiniteError(ValueError):
    """A value is NaN or infinite, or too large for float32.

    Args:
        message: What happened, and what to do about it.
        tensor: Name of the value: a loss, a parameter, ``"rewards"``, ...
        value: NaN or infinity.
        step: Environment steps done.
        update: Update in which it happened, from 1; None if it was not in an update.
        seed: Seed of the agent; None if it has none.
        batch: Summary of the minibatch of that update, by column: ``"low"`` and ``"high"`` of the
            finite values, how many are ``"not_finite"``, and the ``"row"`` of the first of these,
            or else of the largest; empty if the minibatch is not known.
        restored: Number of updates before the weights that were restored; None if none were.
    """

    def __init__(
        self,
        message: str,
        tensor: str = "",
        value: float = float("nan"),
        step: int | None = None,
        update: int | None = None,
        seed: int | None = None,
        batch: Mapping[str, Mapping[str, float]] | None = None,
        restored: int | None = None,
    ) -> None:
        super().__init__(message)
        self.tensor, self.value, self.step, self.update = tensor, value, step, update
        self.seed, self.batch, self.restored = seed, dict(batch or {}), restored


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


def check_observation(observation: Any) -> None:
    """Raise :class:`NonFiniteError` if an observation to act on is not finite."""
    for name, values in _arrays("observation", observation):
        if not all_finite(values):
            at, value = _first(values)
            raise NonFiniteError(
                f"{name} must be finite in float32, got {value} at index {at}", name, value
            )


def check_experience(columns: Mapping[str, Any], step: int, who: Callable[[int], str]) -> None:
    """Reject non-finite values from environments before they enter a replay buffer.

    Args:
        columns: Name -> array of N environments, (N, ...), or a dictionary of such arrays.
        step: Environment steps done, for the message.
        who: Names an environment by its index.

    Raises:
        NonFiniteError: If a value is NaN, infinite or too large for float32.

    Example:
        >>> columns = {"observations": np.zeros((2, 3)), "rewards": np.array([0.0, np.nan])}
        >>> check_experience(columns, 7, ENVIRONMENT)
        Traceback (most recent call last):
        ...
        sb3_flowpolicy.guard.finite.NonFiniteError: rewards must be finite in float32, got nan \
from environment 1 at step 7; nothing of this step was stored
    """
    for column, value in columns.items():
        if isinstance(value, np.ndarray) and all_finite(value):
            continue
        for name, values in _arrays(column, value):
            if not all_finite(values):
                at, number = _first(values)
                element = f", element {at[1] if len(at) == 2 else at[1:]}," if len(at) > 1 else ""
                raise NonFiniteError(
                    f"{name} must be finite in float32, got {number} from {who(at[0])}{element} "
                    f"at step {step}; nothing of this step was stored",
                    name,
                    number,
                    step,
                )


def check_step(
    observations: Any,
    rewards: np.ndarray,
    dones: Sequence[bool] | np.ndarray,
    infos: Sequence[Mapping[str, Any]],
    step: int,
) -> None:
    """Reject the result of a step of an SB3 ``VecEnv`` if any of it is not finite.

    Args:
        observations: Observations, the first of the next episode where one ended.
        rewards: Rewards, (N,).
        dones: Which episodes ended, (N,).
        infos: Infos, with a ``terminal_observation`` where one ended.
        step: Environment steps done, for the message.

    Raises:
        NonFiniteError: As :func:`check_experience`.
    """
    # The ordinary step takes as few calls as possible: between two updates the cache is cold.
    ordinary = type(observations) is np.ndarray and observations.dtype.kind == "f"
    seen = observations.ravel() if ordinary else rewards
    if not float(seen.dot(seen)) + float(rewards.dot(rewards)) < _SURELY_FINITE or not ordinary:
        columns = {"observations": observations, "rewards": rewards}
        check_experience(columns, step, ENVIRONMENT)
    if not any(dones):
        return
    for index, (done, info) in enumerate(zip(dones, infos, strict=True)):
        if done and info.get("terminal_observation") is not None:
            last = info["terminal_observation"]
            parts = last if isinstance(last, Mapping) else {"": last}
            one = {key: np.asarray(part)[None] for key, part in parts.items()}
            who = f"environment {index}"
            check_experience({"final observations": one}, step, lambda _, who=who: who)  # type: ignore[misc]


def _arrays(name: str, value: Any) -> Iterator[tuple[str, np.ndarray]]:
    if isinstance(value, Mapping):
        for key, part in value.items():
            yield f"{name}[{key!r}]" if key else name, np.asarray(part)
    else:
        yield name, np.asarray(value)


def _first(values: np.ndarray) -> tuple[tuple[int, ...], float]:
    """Return the index of the first non-finite value, and the value."""
    with np.errstate(over="ignore"):
        bad = ~np.isfinite(values.astype(np.float32))
    at = tuple(int(i) for i in np.argwhere(bad)[0])
    return at, float(values[at])
