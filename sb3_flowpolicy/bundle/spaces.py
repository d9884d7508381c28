"""Spaces as JSON, with the bounds of boxes as arrays, which hold infinities exactly."""

from __future__ import annotations

from typing import Any

from gymnasium import spaces

from sb3_flowpolicy.bundle.container import Arrays


def to_spec(name: str, space: spaces.Space, arrays: Arrays) -> dict[str, Any]:
    """Describe a space, and put the bounds of boxes into ``arrays``.

    Example:
        >>> arrays = {}
        >>> to_spec("action_space", spaces.Box(-1, 1, (2,)), arrays), list(arrays)
        ({'type': 'Box'}, ['action_space.low', 'action_space.high'])
    """
    if isinstance(space, spaces.Dict):
        parts = enumerate(space.spaces.items())
        # Pairs keep the order of the keys; JSON objects have none.
        entries = [[key, to_spec(f"{name}.{i}", part, arrays)] for i, (key, part) in parts]
        return {"type": "Dict", "spaces": entries}
    if not isinstance(space, spaces.Box):
        raise ValueError(
            f"{name} must be a Box, or a Dict of boxes, for a safe bundle to hold it, got {space}"
        )
    arrays[f"{name}.low"], arrays[f"{name}.high"] = space.low, space.high
    return {"type": "Box"}


def from_spec(name: str, spec: dict[str, Any], arrays: Arrays) -> spaces.Space:
    """Build the space that :func:`to_spec` described."""
    if spec["type"] == "Dict":
        parts = enumerate(spec["spaces"])
        return spaces.Dict(
            {key: from_spec(f"{name}.{i}", part, arrays) for i, (key, part) in parts}
        )
    if spec["type"] != "Box":
        raise ValueError(f"{name} must be a Box or a Dict, got {spec}")
    low, high = arrays[f"{name}.low"], arrays[f"{name}.high"]
    return spaces.Box(low, high, dtype=low.dtype.type)
