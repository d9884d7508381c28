"""Spaces as JSON, with the bounds of boxes as arrays: bit for bit, infinities included."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_flowpolicy.bundle.container import Arrays
from sb3_flowpolicy.common.validation import integer

# No robot has as many; and no product of two of them leaves an int64.
_MOST = 2**31 - 1
_count = integer(1, _MOST)


def space_to_spec(name: str, space: spaces.Space, arrays: Arrays) -> dict[str, Any]:
    """Describe a space, and put the bounds of its boxes among ``arrays``.

    Args:
        name: What to call it in messages, and its arrays.
        space: Box, Discrete, MultiBinary, MultiDiscrete, or a Dict of these.
        arrays: Receives ``{name}.low`` and ``{name}.high``.

    Raises:
        ValueError: If it is another kind of space.

    Example:
        >>> space_to_spec("observation_space", spaces.Discrete(4), {})
        {'type': 'Discrete', 'n': 4, 'start': 0}
    """
    if isinstance(space, spaces.Dict):
        entries = [
            [key, space_to_spec(f"{name}.{index}", entry, arrays)]
            for index, (key, entry) in enumerate(space.spaces.items())
            if not isinstance(entry, spaces.Dict) and isinstance(key, str)
        ]
        if len(entries) == len(space.spaces):
            return {"type": "Dict", "spaces": entries}
    if isinstance(space, spaces.Box):
        arrays[f"{name}.low"], arrays[f"{name}.high"] = space.low, space.high
        return {"type": "Box"}
    if isinstance(space, spaces.Discrete):
        return {"type": "Discrete", "n": int(space.n), "start": int(space.start)}
    if isinstance(space, spaces.MultiBinary):
        return {"type": "MultiBinary", "shape": [int(size) for size in space.shape]}
    if isinstance(space, spaces.MultiDiscrete) and space.nvec.ndim == 1 and not space.start.any():
        return {"type": "MultiDiscrete", "nvec": space.nvec.tolist()}
    raise ValueError(
        f"{name} must be a Box, Discrete, MultiBinary or flat MultiDiscrete space, or a Dict of "
        f"these, for a safe bundle to hold it, got {space}"
    )


def space_from_spec(name: str, spec: Any, arrays: Arrays) -> spaces.Space:
    """Build the space that :func:`space_to_spec` described; its arrays are taken out.

    Raises:
        ValueError: If it describes none.
    """
    kind = spec.get("type") if isinstance(spec, dict) else None
    keys = set(spec) - {"type"} if isinstance(spec, dict) else set()
    if kind == "Dict" and keys == {"spaces"} and isinstance(spec["spaces"], list):
        return _dict_space(name, spec["spaces"], arrays)
    if kind == "Box" and not keys:
        return _box(name, arrays)
    if kind == "Discrete" and keys == {"n", "start"}:
        start = integer(-_MOST, _MOST)(f"{name}.start", spec["start"])
        return spaces.Discrete(_count(f"{name}.n", spec["n"]), start=start)
    if kind == "MultiBinary" and keys == {"shape"}:
        shape = _counts(f"{name}.shape", spec["shape"])
        return spaces.MultiBinary(shape[0] if len(shape) == 1 else shape)
    if kind == "MultiDiscrete" and keys == {"nvec"}:
        return spaces.MultiDiscrete(_counts(f"{name}.nvec", spec["nvec"]))
    raise ValueError(f"{name} must describe a space, got {str(spec)[:80]}")


def _dict_space(name: str, entries: list[Any], arrays: Arrays) -> spaces.Dict:
    found = {}
    for index, entry in enumerate(entries):
        if not isinstance(entry, list) or len(entry) != 2 or not isinstance(entry[0], str):
            raise ValueError(f"{name} must list keys with their spaces, got {str(entry)[:80]}")
        if isinstance(entry[1], dict) and entry[1].get("type") == "Dict":
            raise ValueError(f"{name} must not hold a Dict in a Dict")
        found[entry[0]] = space_from_spec(f"{name}.{index}", entry[1], arrays)
    if len(found) != len(entries) or not found:
        raise ValueError(f"{name} must have different keys, at least one, got {list(found)[:5]}")
    space = spaces.Dict(found)
    if list(space.spaces) != list(found):
        raise ValueError(f"{name} must list its keys in gymnasium's order, got {list(found)[:5]}")
    return space


def _box(name: str, arrays: Arrays) -> spaces.Box:
    try:
        low, high = arrays.pop(f"{name}.low"), arrays.pop(f"{name}.high")
    except KeyError as error:
        raise ValueError(f"{name} must have the arrays low and high, {error} is missing") from None
    if low.dtype != high.dtype or low.shape != high.shape or not low.ndim:
        raise ValueError(
            f"{name} must have bounds of one type and shape, got {low.dtype} {low.shape} and "
            f"{high.dtype} {high.shape}"
        )
    if low.dtype == np.bool_ or not (low <= high).all():
        raise ValueError(f"{name} must have low <= high in numbers")
    return spaces.Box(low, high, dtype=low.dtype.type)


def _counts(name: str, values: Any) -> list[int]:
    if not isinstance(values, list) or not 1 <= len(values) <= 2**16:
        raise ValueError(f"{name} must be a list of sizes, got {str(values)[:80]}")
    return [_count(name, value) for value in values]
