"""Spaces as JSON, with the bounds of boxes as arrays: exact, infinities included."""

from __future__ import annotations

from typing import Any

from gymnasium import spaces

from sb3_flowpolicy.bundle.container import Arrays
from sb3_flowpolicy.common.validation import integer

# The product of two sizes fits an int64.
_count = integer(1, 2**31 - 1)


def space_to_spec(name: str, space: spaces.Space, arrays: Arrays) -> dict[str, Any]:
    """Describe a space, and put the bounds of boxes into ``arrays``.

    Example:
        >>> space_to_spec("observation_space", spaces.Discrete(4), {})
        {'type': 'Discrete', 'n': 4, 'start': 0}
    """
    if isinstance(space, spaces.Dict):
        parts = enumerate(space.spaces.items())
        # Pairs, because JSON objects have no order.
        entries = [[key, space_to_spec(f"{name}.{i}", part, arrays)] for i, (key, part) in parts]
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


def space_from_spec(name: str, spec: dict[str, Any], arrays: Arrays) -> spaces.Space:
    """Build the space that :func:`space_to_spec` described."""
    kind = spec["type"]
    if kind == "Dict":
        parts = enumerate(spec["spaces"])
        return spaces.Dict(
            {key: space_from_spec(f"{name}.{i}", part, arrays) for i, (key, part) in parts}
        )
    if kind == "Box":
        low, high = arrays[f"{name}.low"], arrays[f"{name}.high"]
        return spaces.Box(low, high, dtype=low.dtype.type)
    if kind == "Discrete":
        return spaces.Discrete(_count(f"{name}.n", spec["n"]), start=spec["start"])
    if kind == "MultiBinary":
        shape = [_count(f"{name}.shape", size) for size in spec["shape"]]
        return spaces.MultiBinary(shape[0] if len(shape) == 1 else shape)
    if kind == "MultiDiscrete":
        return spaces.MultiDiscrete([_count(f"{name}.nvec", n) for n in spec["nvec"]])
    raise ValueError(f"{name} must describe a space, got {spec}")
