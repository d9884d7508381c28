"""Checks of arguments, combined into tables: name of an argument -> check."""

from __future__ import annotations

import inspect
import math
import numbers
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

#: Returns the value, numbers as Python's own, or raises ``ValueError`` with the name it is given.
Check = Callable[[str, Any], Any]

# The largest integer up to which JSON numbers are exact.
_ANY = 2**53


def integer(least: int, most: int = _ANY) -> Check:
    """Accept integers from ``least`` to ``most``, not booleans."""

    def check(name: str, value: Any) -> int:
        whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
        if not whole or not least <= value <= most:
            bounds = f"of at least {least}" if most == _ANY else f"from {least} to {most}"
            raise ValueError(f"{name} must be an integer {bounds}, got {value!r}")
        return int(value)

    return check


def layer_sizes(name: str, value: Any, least: int = 0) -> tuple[int, ...]:
    """Accept lists and tuples of ``least`` or more integers, each at least 1."""
    if not isinstance(value, list | tuple) or len(value) < least:
        some = "one or more layer sizes" if least else "layer sizes"
        raise ValueError(f"{name} must be a list of {some}, got {value!r}")
    return tuple(integer(1)(name, size) for size in value)


def number(least: float = -math.inf, most: float = math.inf, above: bool = False) -> Check:
    """Accept finite numbers from ``least`` (or ``above`` it) to ``most``, not booleans."""

    def check(name: str, value: Any) -> float:
        real = isinstance(value, numbers.Real) and not isinstance(value, bool)
        try:
            finite = real and math.isfinite(value)
        except OverflowError:  # an integer beyond floats
            finite = False
        if not real:
            expected = "a number"
        elif not finite:
            expected = "finite"
        elif value < least or (above and value == least):
            expected = f"{'above' if above else 'at least'} {least:g}"
        elif value > most:
            expected = f"at most {most:g}"
        else:
            return int(value) if isinstance(value, numbers.Integral) else float(value)
        raise ValueError(f"{name} must be {expected}, got {value!r}")

    return check


def flag(name: str, value: Any) -> bool:
    """Accept True and False, numpy's as well."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} must be True or False, got {value!r}")
    return bool(value)


def one_of(*words: str) -> Check:
    """Accept any of these words."""

    def check(name: str, value: Any) -> str:
        if not isinstance(value, str) or value not in words:
            raise ValueError(f"{name} must be one of {words}, got {value!r}")
        return value

    return check


def _or(check: Check, accepts: Callable[[Any], bool], also: str) -> Check:
    """Also accept the values that ``accepts`` names; messages call them ``also``."""

    def extended(name: str, value: Any) -> Any:
        if accepts(value):
            return value
        try:
            return check(name, value)
        except ValueError as error:
            message = str(error).replace(" must be ", f" must be {also} or ", 1)
            raise ValueError(message) from None

    return extended


def optional(check: Check) -> Check:
    """Also accept None."""
    return _or(check, lambda value: value is None, "None")


def either(choice: str, check: Check) -> Check:
    """Also accept one word."""
    return _or(check, lambda value: isinstance(value, str) and value == choice, f'"{choice}"')


def or_schedule(check: Check) -> Check:
    """Also accept a function of the remaining progress."""
    return _or(check, callable, "a function")


def or_infinity(check: Check) -> Check:
    """Also accept infinity."""
    return lambda name, value: value if value == math.inf else check(name, value)


def entropy_coefficient(name: str, value: Any) -> str | float:
    """Accept a number of at least 0, ``"auto"``, or ``"auto_0.1"`` with an initial value."""
    if not isinstance(value, str):
        return number(0)(name, value)
    word, mark, start = value.partition("_")
    try:
        if word == "auto" and (not mark or 0 < float(start) < math.inf):
            return value
    except ValueError:
        pass
    raise ValueError(f'{name} must be a number, "auto" or "auto_0.1", got {value!r}')


def train_frequency(name: str, value: Any) -> int | tuple[int, str]:
    """Accept a number of steps, or a pair such as ``(1, "episode")``."""
    if not isinstance(value, tuple) or len(value) != 2:
        return integer(1)(name, value)
    unit = getattr(value[1], "value", value[1])  # SB3's TrainFreq holds an enum
    return integer(1)(name, value[0]), one_of("step", "episode")(name, unit)


def mapping(name: str, value: Any) -> Mapping[str, Any]:
    """Accept dicts with strings as keys."""
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise ValueError(f"{name} must be a dict with strings as keys, got {value!r}")
    return value


# Further arguments of every algorithm.
_FURTHER: dict[str, Check] = {
    "policy_kwargs": optional(mapping),
    "replay_buffer_kwargs": optional(mapping),
    "verbose": lambda name, value: value if isinstance(value, bool) else integer(0)(name, value),
    "learning_rate": or_schedule(number(0)),
}


def check_settings(settings: Mapping[str, Any], table: Mapping[str, Check]) -> None:
    """Check the arguments of an algorithm that the table, or :data:`_FURTHER`, lists.

    Raises:
        ValueError: If one is of another type or out of range; the message names it.

    Example:
        >>> check_settings({"gamma": 0.9, "policy_kwargs": {}}, {"gamma": number(0, 1)})
        >>> check_settings({"gamma": "high"}, {"gamma": number(0, 1)})
        Traceback (most recent call last):
        ...
        ValueError: gamma must be a number, got 'high'
    """
    for name, check in {**table, **_FURTHER}.items():
        if name in settings:
            check(name, settings[name])


def by_name(algorithm: type, args: Iterable[Any], kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Return the positional and keyword arguments of a constructor by name.

    Example:
        >>> from stable_baselines3 import SAC
        >>> by_name(SAC, ["MlpPolicy", "Pendulum-v1"], {"gamma": 0.9})
        {'policy': 'MlpPolicy', 'env': 'Pendulum-v1', 'gamma': 0.9}
    """
    return {**dict(zip(inspect.signature(algorithm).parameters, args, strict=False)), **kwargs}


def check_policy(policy: Any, base: type, names: Iterable[str]) -> None:
    """Check that a policy is one of an algorithm's names, or a class of its kind.

    Example:
        >>> from sb3_contrib.tqc.policies import TQCPolicy
        >>> from sb3_flowpolicy import FlowPolicy
        >>> check_policy(FlowPolicy, TQCPolicy, ["FlowPolicy"])  # doctest: +NORMALIZE_WHITESPACE
        Traceback (most recent call last):
        ...
        ValueError: policy must be one of ['FlowPolicy'] or subclass TQCPolicy, got the class
        FlowPolicy of another algorithm; pass the name 'FlowPolicy'
    """
    known = list(names)
    if not (issubclass(policy, base) if isinstance(policy, type) else policy in known):
        got = getattr(policy, "__name__", repr(policy))
        if got in known:
            got = f"the class {got} of another algorithm; pass the name {got!r}"
        raise ValueError(f"policy must be one of {known} or subclass {base.__name__}, got {got}")
