"""The arguments of a Square."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from flowpolicy_envs.checks import check_not_negative, is_number, is_whole
from flowpolicy_envs.square import kernels
from flowpolicy_envs.square.tasks import FindGoal, Task, as_task

Range = float | Sequence[float]
"""A number, or the two ends of an interval from which each episode draws."""

FEATURES: dict[str, slice] = {
    "position": slice(0, 2),
    "angle": slice(2, 4),
    "fingers": slice(4, 12),
    "action": slice(12, 20),
    "timer": slice(20, 21),
}
"""The parts of the complete observation."""

DIRECTIONS = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
"""Directions from the middle of the world to the fingers: right, top, left, bottom."""

# Argument -> column of the constants. All must be positive except those in _MAY_BE_ZERO.
_CONSTANTS = {
    "size": kernels.HALF_SIDE,
    "mass": kernels.MASS,
    "inertia": kernels.INERTIA,
    "linear_damping": kernels.LINEAR_DAMPING,
    "angular_damping": kernels.ANGULAR_DAMPING,
    "friction": kernels.FRICTION,
    "weight": kernels.WEIGHT,
    "kp": kernels.STIFFNESS,
    "finger_damping": kernels.DRAG,
    "max_force": kernels.MAX_FORCE,
    "max_speed": kernels.MAX_SPEED,
    "reach": kernels.REACH,
}
_MAY_BE_ZERO = ("linear_damping", "angular_damping", "friction", "weight", "kp", "kd")
_POSE = ("start_x", "start_y", "start_angle")


@dataclass(frozen=True, eq=False)
class SquareConfig:
    """Mechanics, task and observations of a Square. `SquareEnv` documents the arguments.

    Raises:
        ValueError: If an argument is outside of its range; the message names it.

    Example:
        >>> SquareConfig(stack=3).observation_space.shape
        (63,)
        >>> SquareConfig(mass=-1.0)
        Traceback (most recent call last):
        ...
        ValueError: mass must be positive, got -1.0
    """

    task: Task | str | Mapping[str, Any] = "hold"
    size: Range = 0.6
    mass: Range = 0.2
    inertia: Range = 0.012
    linear_damping: Range = 2.0
    angular_damping: Range = 0.05
    friction: Range = 0.5
    weight: Range = 3.0
    kp: Range = 25.0
    kd: Range = 0.4
    finger_damping: Range = 0.1
    max_force: Range = 6.0
    max_speed: Range = 1.0
    reach: Range = 0.4
    finger_distance: float = 0.4
    finger_noise: float = 0.02
    start_x: Range = (-0.03, 0.03)
    start_y: Range = (-0.03, 0.03)
    start_angle: Range = (-0.1, 0.1)
    warm_up: float = 2.0
    observe: Sequence[str] = tuple(FEATURES)
    observation_noise: float | Mapping[str, float] = 0.0
    stack: int = 2
    dt: float = 0.01
    substeps: int = 25
    slew: float = 0.0
    friction_cone: bool = False
    warm_steps: int = field(init=False, repr=False)
    picked: NDArray[np.int64] = field(init=False, repr=False)
    noise: NDArray[np.float64] = field(init=False, repr=False)
    _ranges: dict[str, tuple[float, float]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the arguments and derive what follows from them."""
        # The dataclass is frozen.
        object.__setattr__(self, "task", as_task(self.task))
        names = (*_CONSTANTS, "kd", *_POSE)
        ranges = {name: _checked_range(name, getattr(self, name)) for name in names}
        object.__setattr__(self, "_ranges", ranges)
        for name in (*_CONSTANTS, "kd"):
            low = ranges[name][0]
            zero = name in _MAY_BE_ZERO
            if low < 0.0 or (low == 0.0 and not zero):
                least = "at least 0" if zero else "positive"
                raise ValueError(f"{name} must be {least}, got {getattr(self, name)}")
        for name in ("finger_distance", "finger_noise", "warm_up"):
            check_not_negative(name, getattr(self, name))
        if self.finger_distance < ranges["size"][1] / 2:
            raise ValueError(
                f"finger_distance must be at least half the size, {ranges['size'][1] / 2:g}, "
                f"got {self.finger_distance}: fingers start outside the square"
            )
        if not is_number(self.dt) or not 1e-6 <= self.dt < math.inf:
            raise ValueError(f"dt must be at least 1e-6 s, got {self.dt!r}")
        if not isinstance(self.friction_cone, bool):
            raise ValueError(f"friction_cone must be True or False, got {self.friction_cone!r}")
        for name in ("stack", "substeps"):
            value = getattr(self, name)
            if not is_whole(value) or value < 1:
                raise ValueError(f"{name} must be an integer of at least 1, got {value!r}")
        check_not_negative("slew", self.slew)
        if self.slew > round(self.dt * self.substeps, 9):
            raise ValueError(
                f"slew must be at most a step, {self.dt * self.substeps:g} s, got {self.slew}"
            )
        self._check_stability()
        # Rounded first, so that 2 s / 0.25 s does not become nine steps.
        steps = math.ceil(round(self.warm_up / (self.dt * self.substeps), 9))
        object.__setattr__(self, "warm_steps", steps)
        object.__setattr__(self, "picked", _picked(self.observe))
        noise = _noise(self.observation_noise)
        object.__setattr__(self, "noise", noise[self.picked])

    def _check_stability(self) -> None:
        """Raise ValueError if a substep is too long for these constants."""
        low, high = ({name: ends[k] for name, ends in self._ranges.items()} for k in (0, 1))
        settling = self.dt * high["kp"] / (low["kd"] + low["finger_damping"])
        if settling > 1.0:
            raise ValueError(
                "dt * kp / (kd + finger_damping) must be at most 1 for the controller to settle, "
                f"got {settling:.3g}"
            )
        # The mobility of a corner that is pushed along the normal of a face.
        mobility = 1.0 / low["mass"] + (high["size"] / 2.0) ** 2 / low["inertia"]
        drag = high["kd"] + high["finger_damping"]
        coupling = kernels.FINGERS * self.dt * drag * mobility
        if coupling > 0.5:
            raise ValueError(
                "4 * dt * (kd + finger_damping) * (1 / mass + (size / 2)**2 / inertia) must be at "
                f"most 0.5 for the contact forces to converge, got {coupling:.3g}"
            )
        if self.dt * high["max_force"] * mobility > low["max_speed"]:
            raise ValueError(
                "dt * max_force * (1 / mass + (size / 2)**2 / inertia) must be at most max_speed, "
                f"or contact would be faster than fingers, got {high['max_force'] * self.dt:.3g} * "
                f"{mobility:.3g} > {low['max_speed']:.3g}"
            )

    @property
    def slew_substeps(self) -> int:
        """Number of substeps in which targets move to those of the latest action."""
        return round(self.slew / self.dt)

    @property
    def frame_width(self) -> int:
        """Number of features in one frame of the observation."""
        return len(self.picked)

    @property
    def observation_space(self) -> spaces.Box:
        """Box [-1, 1] of `stack` frames, the oldest first."""
        return spaces.Box(-1.0, 1.0, (self.stack * self.frame_width,), np.float32)

    @property
    def action_space(self) -> spaces.Box:
        """Box [-1, 1]^8."""
        return spaces.Box(-1.0, 1.0, (kernels.ACTIONS,), np.float32)

    @property
    def setup_ends(self) -> NDArray[np.float64]:
        """The smallest and the largest setup of an episode, (2, 25), see `square.kernels`."""
        ends = np.zeros((2, kernels.N_SETUP))
        for name, column in _CONSTANTS.items():
            ends[:, column] = self._ranges[name]
        ends[:, kernels.HALF_SIDE] /= 2.0
        ends[:, kernels.KD] = self._ranges["kd"]
        ends[:, kernels.POSE] = np.transpose([self._ranges[name] for name in _POSE])
        ends[:, kernels.PLACES] = self.finger_distance * DIRECTIONS.ravel()
        ends[0, kernels.PLACES] -= self.finger_noise
        ends[1, kernels.PLACES] += self.finger_noise
        if isinstance(self.task, FindGoal):
            ends[:, kernels.GOAL_AT] = -self.task.span, self.task.span
        return ends


def _checked_range(name: str, value: Range) -> tuple[float, float]:
    """Return `value` as the ends of an interval."""
    try:
        ends = np.atleast_1d(np.asarray(value, np.float64))
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} must be a number or [low, high], got {value!r}") from None
    if ends.shape not in ((1,), (2,)) or not np.isfinite(ends).all() or ends[0] > ends[-1]:
        raise ValueError(f"{name} must be a finite number or [low, high], got {value!r}")
    return float(ends[0]), float(ends[-1])


def _picked(observe: Sequence[str]) -> NDArray[np.int64]:
    """Return the indices of the observed features."""
    names = list(observe) if isinstance(observe, Collection) else []
    known = all(isinstance(name, str) and name in FEATURES for name in names)
    if isinstance(observe, str) or not names or not known:
        raise ValueError(f"observe must name some of {tuple(FEATURES)}, got {observe!r}")
    every = np.arange(kernels.N_FEATURES)
    return np.concatenate([every[FEATURES[name]] for name in FEATURES if name in names])


def _noise(noise: float | Mapping[str, float]) -> NDArray[np.float64]:
    """Return the standard deviation of the noise of each feature, (21,)."""
    by_name = noise if isinstance(noise, Mapping) else dict.fromkeys(FEATURES, noise)
    scales = np.zeros(kernels.N_FEATURES)
    for name, scale in by_name.items():
        if name not in FEATURES:
            raise ValueError(f"observation_noise must be for {tuple(FEATURES)}, got {name!r}")
        check_not_negative("observation_noise", scale)
        scales[FEATURES[name]] = scale
    return scales
