"""What the agent is paid for: one small object per task, every coefficient an argument."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from flowpolicy_envs.checks import check_not_negative
from flowpolicy_envs.square import kernels


@dataclass(frozen=True)
class Task:
    """Coefficients that all tasks share. Rewards are per step of the agent.

    Args:
        held: Paid while the square is held.
        failure: Subtracted when the square drops or a finger breaks.
        angle: Subtracted per radian that the square is turned, either way.

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
        """Return the coefficients as the compiled reward reads them, (11,)."""
        terms = np.zeros(kernels.N_REWARD_TERMS)
        terms[kernels.HELD] = self.held
        terms[kernels.FAILURE] = self.failure
        terms[kernels.ANGLE] = self.angle
        return terms


@dataclass(frozen=True)
class Hold(Task):
    """Hold the square still in the middle of the world (thesis 3.3.2).

    Args:
        position: Subtracted per world unit between the square and the middle, at all times.
        overreach: Subtracted in proportion to how far the actions go beyond `safe_reach`,
            averaged over their eight components; in full if all of them are at -1 or 1.
        safe_reach: What is no overreach, as a share of the reach, in [0, 1).

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
        """Return the coefficients as the compiled reward reads them, (11,)."""
        terms = super().terms()
        terms[[kernels.POSITION_BEFORE, kernels.POSITION_AFTER]] = self.position
        terms[kernels.OVERREACH] = self.overreach
        terms[kernels.SAFE_REACH] = self.safe_reach
        return terms


@dataclass(frozen=True)
class Move(Task):
    """Hold the square with little force; where to is left to the agent (thesis 3.3.3).

    Args:
        effort: Subtracted times the force that controllers ask for before it is limited, as a
            share of the limit, averaged over the fingers at the end of the step.
        position: Subtracted per world unit between the square and the middle during the warm-up.
        y: Subtracted per world unit of the square's |y| after the warm-up.
    """

    effort: float = 0.05
    position: float = 0.5
    y: float = 0.0

    def terms(self) -> NDArray[np.float64]:
        """Return the coefficients as the compiled reward reads them, (11,)."""
        terms = super().terms()
        terms[kernels.EFFORT] = self.effort
        terms[kernels.POSITION_BEFORE] = self.position
        terms[kernels.Y_AFTER] = self.y
        return terms


@dataclass(frozen=True)
class MoveX(Move):
    """Move the square along x only (thesis 3.3.3, "Narrowing the tunnel")."""

    y: float = 0.5


@dataclass(frozen=True)
class FindGoal(Move):
    """Find a hidden goal on the diagonal while holding the square (thesis 3.4).

    The goal (u, u) is drawn anew for each episode, u uniform in [-span, span]. It is not observed.

    Args:
        goal: Paid once per episode, when the square's middle comes within `radius` of the goal
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

    def terms(self) -> NDArray[np.float64]:
        """Return the coefficients as the compiled reward reads them, (11,)."""
        terms = super().terms()
        terms[kernels.GOAL] = self.goal
        terms[kernels.GOAL_RADIUS] = self.radius
        return terms


TASKS: dict[str, type[Task]] = {
    "hold": Hold,
    "move": Move,
    "move_x": MoveX,
    "find_goal": FindGoal,
}
"""Names by which a task with default coefficients can be asked for, from YAML for example."""


def as_task(task: "Task | str") -> Task:
    """Return the task, or the one with that name.

    Raises:
        ValueError: If it is neither a task nor the name of one.

    Example:
        >>> as_task("move_x")
        MoveX(held=1.0, failure=10.0, angle=0.0, effort=0.05, position=0.5, y=0.5)
    """
    if isinstance(task, Task):
        return task
    if not isinstance(task, str) or task not in TASKS:
        raise ValueError(f"task must be a Task or one of {tuple(TASKS)}, got {task!r}")
    return TASKS[task]()
