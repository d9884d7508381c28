"""What arguments have to be, whatever they come as: from Python, from YAML, from anywhere."""

import math
import numbers
from typing import Any


def is_number(value: Any) -> bool:
    """Whether this is one real number that floats can hold, neither a boolean nor an array."""
    if not isinstance(value, numbers.Real) or isinstance(value, bool):
        return False
    try:
        float(value)
    except OverflowError:
        return False
    return True


def is_whole(value: Any) -> bool:
    """Whether this is one integer that arrays can be as long as, and no boolean."""
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
