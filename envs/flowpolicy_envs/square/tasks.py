"""The tasks, whose arguments are the coefficients of the reward."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowpolicy_envs.checks import check_not_negative
from flowpolicy_envs.square import kernels

# Coefficient -> column of the reward terms.
_COLUMNS = {
    "held": kernels.HELD,
    "failure": kernels.FAILURE,
    "overreach": kernels.OVERREACH,
    "safe_reach": kernels.SAFE_REACH,
    "effort": kernels.EFFORT,
    "angle": kernels.ANGLE,
    "position": kernels.POSITION_BEFORE,
    "y": kernels.Y_AFTER,
    "goal": kernels.GOAL,
    "radius": kernels.GOAL_RADIUS,
}


@dataclass(frozen=True)
class Task:
    """Coefficients that all tasks share. Rewards are per step of the agent.

    Args:
        held: Added while the square is held.
        failure: Subtracted when the square drops or a finger breaks.
        angle: Subtracted per radian of the absolute angle of the square.

    Raises:
        ValueError: If a coefficient is negative or not finite.
    """

    held: float = 1.0
    failure: float = 10.0
    angle: float = 0.0

    def __post_init__(self) -> None:
        """Check the coefficients."""
        for field in fields(self):
            check_not_negative(field.name, getattr(self, field.name))

    def terms(self) -> NDArray[np.float64]:
        """Return the coefficients in the order of the compiled reward, (11,)."""
        terms = np.zeros(kernels.N_REWARD_TERMS)
        for name, column in _COLUMNS.items():
            terms[column] = getattr(self, name, 0.0)
        return terms


@dataclass(frozen=True)
class Hold(Task):
    """Hold the square still in the middle of the world (thesis 3.3.2).

    Args:
        position: Subtracted per world unit between the square and the middle.
        overreach: Subtracted in proportion to the excess of the actions over `safe_reach`, averaged
            over their eight components; in full if all of them are -1 or 1.
        safe_reach: Largest action without penalty, as a share of the reach, in [0, 1).

    Example:
        >>> Hold(position=1.0).angle
        0.2
        >>> Hold(safe_reach=1.0)
        Traceback (most recent call last):
        ...
        ValueError: safe_reach must be less than 1, got 1.0
    """

    angle: float = 0.2
    position: float = 0.5
    overreach: float = 0.1
    safe_reach: float = 0.8

    def __post_init__(self) -> None:
        """Check the coefficients."""
        super().__post_init__()
        if self.safe_reach >= 1.0:
            raise ValueError(f"safe_reach must be less than 1, got {self.safe_reach}")

    def terms(self) -> NDArray[np.float64]:
        """Return the coefficients in the order of the compiled reward, (11,)."""
        terms = super().terms()
        terms[kernels.POSITION_AFTER] = self.position
        return terms


@dataclass(frozen=True)
class Move(Task):
    """Hold the square with little force; the agent may move it anywhere (thesis 3.3.3).

    Args:
        effort: Coefficient, subtracted, of the force that the controllers request before it is
            limited, as a share of the limit, averaged over the fingers at the end of the step.
        position: Subtracted per world unit between the square and the middle during the warm-up.
        y: Subtracted per world unit of |y| of the square after the warm-up.
    """

    effort: float = 0.05
    position: float = 0.5
    y: float = 0.0


@dataclass(frozen=True)
class MoveX(Move):
    """Move the square along x only (thesis 3.3.3, "Narrowing the tunnel")."""

    y: float = 0.5


@dataclass(frozen=True)
class FindGoal(Move):
    """Find a hidden goal on the diagonal while holding the square (thesis 3.4).

    Each episode draws the goal (u, u), with u uniform in [-span, span]. It is not observed.

    Args:
        goal: Added once per episode, when the center of the square is within `radius` of the goal
            after the warm-up.
        radius: World units.
        span: World units, at most 1.
    """

    position: float = 0.0
    goal: float = 10.0
    radius: float = 0.06
    span: float = 0.25

    def __post_init__(self) -> None:
        """Check the coefficients."""
        super().__post_init__()
        if self.radius == 0.0:
            raise ValueError(f"radius must be positive, got {self.radius}")
        if self.span > 1.0:
            raise ValueError(f"span must be at most 1, got {self.span}")


TASKS: dict[str, type[Task]] = {
    "hold": Hold,
    "move": Move,
    "move_x": MoveX,
    "find_goal": FindGoal,
}
"""Names of the tasks with default coefficients, for YAML files for example."""


def as_task(task: "Task | str | Mapping[str, Any]") -> Task:
    """Return the task itself, the task of this name, or the one that a mapping describes.

    Args:
        task: A task, one of the names in `TASKS`, or a mapping with a `name` and coefficients, as
            YAML files have it.

    Raises:
        ValueError: If it is none of these, or a coefficient is out of its range.
        TypeError: If the task has no such coefficient.

    Example:
        >>> as_task("move_x")
        MoveX(held=1.0, failure=10.0, angle=0.0, effort=0.05, position=0.5, y=0.5)
        >>> as_task({"name": "move_x", "angle": 0.3}).angle
        0.3
    """
    if isinstance(task, Task):
        return task
    coefficients = dict(task) if isinstance(task, Mapping) else {"name": task}
    name = coefficients.pop("name", None)
    if not isinstance(name, str) or name not in TASKS:
        raise ValueError(
            f"task must be a Task, one of {tuple(TASKS)}, or a mapping with such a name, "
            f"got {task!r}"
        )
    return TASKS[name](**coefficients)
