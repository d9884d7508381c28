"""Which replay buffer a model wants, as JSON; what is in it stays behind."""

from __future__ import annotations

from typing import Any

from gymnasium import spaces
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.her.goal_selection_strategy import (
    KEY_TO_GOAL_STRATEGY,
    GoalSelectionStrategy,
)

from sb3_flowpolicy.common.validation import Check, flag, integer, number

_CLASSES: dict[str, type[ReplayBuffer]] = {
    one.__name__: one
    for one in (ReplayBuffer, DictReplayBuffer, NStepReplayBuffer, HerReplayBuffer)
}


def _strategy(name: str, value: Any) -> str:
    word = value.value if isinstance(value, GoalSelectionStrategy) else value
    if not isinstance(word, str) or word not in KEY_TO_GOAL_STRATEGY:
        raise ValueError(f"{name} must be one of {list(KEY_TO_GOAL_STRATEGY)}, got {value!r}")
    return word


_KWARGS: dict[str, Check] = {
    "handle_timeout_termination": flag,
    "n_steps": integer(1),
    "gamma": number(0, 1),
    "n_sampled_goal": integer(0),
    "goal_selection_strategy": _strategy,
    "copy_info_dict": flag,
}


def buffer_to_spec(model: SAC) -> dict[str, Any]:
    """Describe the class of a model's replay buffer and its arguments.

    Raises:
        ValueError: If it is none of SB3's, or has an argument that JSON cannot say.
    """
    buffer_class = model.replay_buffer_class
    title = getattr(buffer_class, "__name__", "")
    if _CLASSES.get(title) is not buffer_class:
        raise ValueError(
            f"replay_buffer_class must be one of {list(_CLASSES)} for a safe bundle to hold it, "
            f"got {buffer_class}: set model.replay_buffer_class to one of these before saving"
        )
    return {"class": title, "kwargs": _checked(model.replay_buffer_kwargs)}


def buffer_from_spec(spec: Any, space: spaces.Space) -> dict[str, Any]:
    """Return the attributes that :func:`buffer_to_spec` described.

    Raises:
        ValueError: If there is no such buffer, or it does not fit the observation space.
    """
    if not isinstance(spec, dict) or set(spec) != {"class", "kwargs"}:
        raise ValueError(f"replay_buffer must have class and kwargs, got {str(spec)[:80]}")
    title, kwargs = spec["class"], spec["kwargs"]
    if not isinstance(title, str) or title not in _CLASSES or not isinstance(kwargs, dict):
        raise ValueError(f"replay_buffer must be one of {list(_CLASSES)}, got {str(spec)[:80]}")
    if issubclass(_CLASSES[title], DictReplayBuffer) != isinstance(space, spaces.Dict):
        raise ValueError(f"replay_buffer must fit {space}, got {title}")
    return {"replay_buffer_class": _CLASSES[title], "replay_buffer_kwargs": _checked(kwargs)}


def _checked(kwargs: dict[str, Any]) -> dict[str, Any]:
    unknown = sorted(set(kwargs) - set(_KWARGS))
    if unknown:
        raise ValueError(
            f"replay_buffer_kwargs must be among {list(_KWARGS)} for a safe bundle to hold them, "
            f"got {unknown}"
        )
    return {key: _KWARGS[key](f"replay_buffer_kwargs[{key!r}]", kwargs[key]) for key in kwargs}
