"""Checks of arguments, which may come from Python, YAML or elsewhere."""

import math
import numbers
from typing import Any


def is_number(value: Any) -> bool:
    """Whether this is a real number in the range of floats, neither a boolean nor an array."""
    if not isinstance(value, numbers.Real) or isinstance(value, bool):
        return False
    try:
        float(value)
    except OverflowError:
        return False
    return True


def is_whole(value: Any) -> bool:
    """Whether this is an integer small enough for the size of an array, and not a boolean."""
    whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    return whole and abs(value) < 2**31


def check_not_negative(name: str, value: Any) -> None:
    """Raise ValueError unless `value` is a finite number of at least 0.

    Example:
        >>> check_not_negative("width", "wide")
        Traceback (most recent call last):
        ...
        ValueError: width must be finite and at least 0, got 'wide'
    """
    if not is_number(value) or not 0.0 <= value < math.inf:
        raise ValueError(f"{name} must be finite and at least 0, got {value!r}")
