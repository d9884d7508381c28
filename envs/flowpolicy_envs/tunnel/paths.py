r"""The paths of tunnels.

Every path has a center line, a start on it and a goal region. The dynamics depend on a position
only through its distance from the center line and the length of path that remains to the goal
region (0 inside it).

In compiled code a path is a `kind`, a vector `numbers` and an array `table`:

| path | `numbers` | `table` |
|---|---|---|
| line | coupled dimensions, index of the first free dimension, goal position | empty |
| circle | radius, goal angle, half the angle of the goal region | empty |
| spline | arc at which the goal region begins | x, y and arc of each way point |
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flowpolicy_envs.tunnel.kernels import CIRCLE, LINE, SPLINE, FloatArray, locate, place

CIRCLE_TRAVEL = 2.0 / 3.0
"""Way from the start, counter-clockwise, to the middle of the goal region, in circumferences."""

GOAL_SHARE = 1.0 / 20.0
"""Length of the goal region of circle and spline, as a share of the center line."""

DEFAULT_WAYPOINTS = (
    (-0.8, -0.8),
    (0.2, -0.8),
    (0.6, -0.4),
    (-0.6, 0.4),
    (-0.2, 0.8),
    (0.8, 0.8),
)


@dataclass(frozen=True, eq=False)
class Path:
    """A center line with a start (arc 0) and a goal region.

    Attributes:
        kind: Type of the path in compiled code.
        dims: Dimension D of the world.
        numbers: Vector of parameters, see the table of this module.
        table: Array (K, 3) of way points, or (0, 3).
        first_arc: The least arc at which an episode may start.
        goal_arcs: Arcs at which the goal region begins and ends.
        ends: Arcs at which the center line begins and ends, for drawing it.
    """

    kind: int
    dims: int
    numbers: FloatArray
    table: FloatArray
    first_arc: float
    goal_arcs: tuple[float, float]
    ends: tuple[float, float]

    def point(self, arc: float) -> FloatArray:
        """Return the point (D,) of the center line at `arc`.

        Example:
            >>> circle_path(radius=0.5).point(0.0).tolist()
            [0.5, 0.0]
        """
        out = np.zeros(self.dims)
        place(self.kind, self.numbers, self.table, float(arc), out)
        return out

    def locate(self, position: Sequence[float] | FloatArray) -> tuple[float, float]:
        """Return the distance from the center line and the length of path left to the goal.

        Args:
            position: Point (D,) of the world.

        Returns:
            Both in world units, both at least 0.

        Example:
            >>> diagonal = line_path(total_dims=2, coupled_dims=2, free_dims=0, goal_position=0.9)
            >>> offset, remaining = diagonal.locate([0.5, 0.1])
            >>> round(offset, 4), round(remaining, 4)
            (0.2828, 0.8485)
        """
        return locate(self.kind, self.numbers, self.table, np.asarray(position, np.float64))

    def polyline(self, start: float, stop: float) -> FloatArray:
        """Return points (K, D) of the center line from arc `start` to `stop`, corners included."""
        arcs = np.linspace(start, stop, 2 + int((stop - start) / 0.01))
        corners = self.table[(self.table[:, 2] > start) & (self.table[:, 2] < stop), 2]
        return np.stack([self.point(arc) for arc in np.union1d(arcs, corners)])


def line_path(total_dims: int, coupled_dims: int, free_dims: int, goal_position: float) -> Path:
    """Return the line through the origin along (1, ..., 1) over the first `coupled_dims` axes.

    The last `free_dims` axes are unconstrained; positions must stay near 0 on those in between. The
    goal region begins where the line passes through `goal_position` on each coupled axis.
    """
    to_goal = goal_position * math.sqrt(coupled_dims)
    to_border = math.sqrt(coupled_dims)
    return Path(
        kind=LINE,
        dims=total_dims,
        numbers=np.array([coupled_dims, total_dims - free_dims, goal_position], np.float64),
        table=np.zeros((0, 3)),
        first_arc=-to_border,
        goal_arcs=(to_goal, to_border),
        ends=(-to_border, to_border),
    )


def circle_path(radius: float) -> Path:
    """Return the circle of `radius` about the origin, with its start at angle 0."""
    circumference = 2.0 * math.pi * radius
    goal_angle = 2.0 * math.pi * CIRCLE_TRAVEL
    half_goal = math.pi * GOAL_SHARE
    return Path(
        kind=CIRCLE,
        dims=2,
        numbers=np.array([radius, goal_angle, half_goal]),
        table=np.zeros((0, 3)),
        first_arc=-circumference / 2.0,
        goal_arcs=(radius * (goal_angle - half_goal), radius * (goal_angle + half_goal)),
        ends=(0.0, circumference),
    )


def spline_path(waypoints: Sequence[Sequence[float]] | FloatArray) -> Path:
    """Return the polyline through `waypoints` (K, 2), from the first to the last.

    Example:
        >>> spline_path([(0.0, 0.0), (0.3, 0.0), (0.3, 0.5)]).ends
        (0.0, 0.8)
    """
    points = np.asarray(waypoints, np.float64)
    steps = np.diff(points, axis=0)
    arcs = np.concatenate([[0.0], np.cumsum(np.sqrt((steps**2).sum(axis=1)))])
    length = float(arcs[-1])
    goal_arc = length * (1.0 - GOAL_SHARE)
    return Path(
        kind=SPLINE,
        dims=2,
        numbers=np.array([goal_arc]),
        table=np.column_stack([points, arcs]),
        first_arc=0.0,
        goal_arcs=(goal_arc, length),
        ends=(0.0, length),
    )
