"""Learning rates that a file can say without code: constant, or a straight line."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from sb3_flowpolicy.common.validation import is_number, number

_rate = number(0)
_CHECKS = {"start": _rate, "end": _rate, "end_fraction": number(0, 1, above=True)}


class LineToZero:
    """A rate that falls from ``initial_value`` to zero: what ``lin_3e-4`` means in rl_zoo3.

    SB3's ``LinearSchedule`` rounds differently, and a run that goes on must not.
    """

    def __init__(self, initial_value: float) -> None:
        self.initial_value = initial_value

    def __call__(self, progress_remaining: float) -> float:
        """Return the rate where ``progress_remaining`` falls from 1 to 0."""
        return progress_remaining * self.initial_value


def rate_to_spec(name: str, rate: Any) -> Any:
    """Describe a learning rate.

    Raises:
        ValueError: If it is a function of another kind.

    Example:
        >>> rate_to_spec("learning_rate", LinearSchedule(1e-3, 1e-4, 0.5))
        {'schedule': 'linear', 'start': 0.001, 'end': 0.0001, 'end_fraction': 0.5}
    """
    if isinstance(rate, FloatSchedule):
        rate = rate.value_schedule
    if isinstance(rate, ConstantSchedule):
        rate = rate.val
    if is_number(rate):
        return _rate(name, rate)
    if type(rate) is LinearSchedule:
        values = {key: _CHECKS[key](f"{name}.{key}", getattr(rate, key)) for key in _CHECKS}
        return {"schedule": "linear", **values}
    # rl_zoo3 is not to be imported for this.
    where = (type(rate).__module__, type(rate).__name__)
    if isinstance(rate, LineToZero) or where == ("rl_zoo3.utils", "SimpleLinearSchedule"):
        return {"schedule": "to_zero", "start": _rate(name, rate.initial_value)}
    raise ValueError(
        f"{name} must be a number or a LinearSchedule of stable_baselines3.common.utils for a safe "
        f"bundle to hold it, got {rate!r}: set model.learning_rate to one of these before saving"
    )


def rate_from_spec(name: str, spec: Any) -> Any:
    """Build what :func:`rate_to_spec` described.

    Raises:
        ValueError: If it describes none.
    """
    if not isinstance(spec, dict):
        return _rate(name, spec)
    if spec.get("schedule") == "linear" and set(spec) == {"schedule", *_CHECKS}:
        return LinearSchedule(*(_CHECKS[key](f"{name}.{key}", spec[key]) for key in _CHECKS))
    if spec.get("schedule") == "to_zero" and set(spec) == {"schedule", "start"}:
        return LineToZero(_rate(f"{name}.start", spec["start"]))
    raise ValueError(f"{name} must be a number or a known schedule, got {str(spec)[:80]}")
