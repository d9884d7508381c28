"""Families of normal noise for the eight actions of a Square, from independent to correlated.

Reflections of the world along x and along y do not change holding and moving, so opposite fingers
share their parameters, and modes correlate only if they behave alike under both reflections. The
exception is joint motion along x and y, which correlate when a goal lies on the diagonal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

COMPONENTS = tuple(
    f"{finger}_{axis}" for finger in ("right", "top", "left", "bottom") for axis in "xy"
)
"""Names of the components of an action."""


def unit_mode(**signs: float) -> Array:
    """Return the unit vector (8,) of a joint motion of fingers.

    Example:
        >>> unit_mode(right_x=1, left_x=1)[:6].round(2).tolist()
        [0.71, 0.0, 0.0, 0.0, 0.71, 0.0]
    """
    vector = np.array([signs.get(name, 0.0) for name in COMPONENTS])
    return vector / np.linalg.norm(vector)


INWARDS = np.array([[-1.0, 0, 0, 0, 1, 0, 0, 0], [0, 0, 0, -1, 0, 0, 0, 1]])
"""Directions (2, 8) in which fingers press, along x and along y."""

MODES = {
    "squeeze": (unit_mode(right_x=-1, left_x=1), unit_mode(top_y=-1, bottom_y=1)),
    "joint x": (unit_mode(right_x=1, left_x=1), unit_mode(top_x=1, bottom_x=1)),
    "joint y": (unit_mode(top_y=1, bottom_y=1), unit_mode(right_y=1, left_y=1)),
    "turn": (unit_mode(top_x=-1, bottom_x=1), unit_mode(left_y=-1, right_y=1)),
}
"""Pairs of modes (8,) that may correlate: pressing along x and y; normal and tangential motion
along x, and along y; the two ways to turn the square."""

# Rows: normal components along x and along y, tangential ones along x and along y.
_GROUPS = np.abs([*INWARDS, MODES["joint x"][1], MODES["joint y"][1]]) > 0.0

_JOINT = 0.1
"""Scale of the joint motions where the search of a low rank begins."""


@dataclass(frozen=True)
class Family:
    """A family of noise R z with standard normal z (M,) and covariance R R^T.

    Attributes:
        root: From the parameters of the family to R (8, M).
        start: From the parameters (4,) of independent noise to those where the search begins.
        color: Exponent of the spectrum in time: 0 is white, 1 pink.
    """

    root: Callable[[Array], Array]
    start: Callable[[Array], Array]
    color: float = 0.0


def _scales(logarithms: Array) -> Array:
    return np.exp(np.clip(logarithms, -6.0, 1.5))


def independent(parameters: Array) -> Array:
    """Return the root of a diagonal covariance.

    The parameters (4,) are logarithms of the standard deviations: normal components along x and y,
    tangential components along x and y.

    Example:
        >>> independent(np.log([0.1, 0.2, 0.3, 0.4])).diagonal().round(1).tolist()
        [0.1, 0.4, 0.3, 0.2, 0.1, 0.4, 0.3, 0.2]
    """
    return np.diag(_scales(parameters) @ _GROUPS)


def rank_2(parameters: Array) -> Array:
    """Return the root (8, 10) of diag + V V^T, where V moves all fingers along x and along y.

    The parameters (8,) are those of `independent`, then two for each column of V: how far the
    fingers that press along its axis move, and how far the other two move.
    """
    columns = [
        first * MODES[name][0] + second * MODES[name][1]
        for name, (first, second) in zip(
            ("joint x", "joint y"), parameters[4:].reshape(2, 2), strict=True
        )
    ]
    return np.column_stack([independent(parameters[:4]), *columns])


def full(parameters: Array) -> Array:
    """Return the root of any covariance that suits the symmetry of the tasks.

    The parameters (13,) are, per pair of modes, the logarithms of two scales and how much the
    second mode follows the first; then how much joint motion along y follows that along x.
    """
    columns = []
    for (first, second), (log_1, log_2, lean) in zip(
        MODES.values(), parameters[:12].reshape(4, 3), strict=True
    ):
        scale_1, scale_2 = _scales(np.array([log_1, log_2]))
        columns += [scale_1 * (first + lean * second), scale_2 * second]
    columns[2] = columns[2] + parameters[12] * columns[4]
    return np.column_stack(columns)


def _start_full(parameters: Array) -> Array:
    x, y, along_x, along_y = parameters
    # All four fingers move and turn the square jointly, plus independent noise as before.
    joint_x, joint_y = [x, along_x, 1.0], [y, along_y, 1.0]
    return np.array([x, y, 0.0, *joint_x, *joint_y, x, along_y, 1.0, 0.0])


INDEPENDENT_START = np.full(4, np.log(0.15))
"""Where the search of independent noise begins."""

FAMILIES = {
    "independent": Family(independent, np.copy),
    "pink": Family(independent, np.copy, color=1.0),
    "rank 2": Family(rank_2, lambda independent: np.append(independent, np.full(4, _JOINT))),
    "full": Family(full, _start_full),
}
"""Independent noise (a diagonal Gaussian), the same with pink noise, a low-rank Gaussian as in the
thesis, and any covariance. What a flow can express includes the last."""
