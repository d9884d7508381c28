"""Collect the state of environments, layer by layer, and restore it in equally built ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import IO, Any

from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvWrapper

# How an environment was made, and open files; steps do not change these.
_NOT_STATE = {"class_attributes", "env_fns", "spec", "_cached_spec", "results_writer"}


def layers(env: Any) -> dict[str, Any]:
    """Name the wrappers and environments that an environment consists of, from the outside in.

    Args:
        env: SB3's ``VecEnv``, gymnasium's ``VectorEnv`` or ``Env``.

    Example:
        >>> import gymnasium as gym
        >>> list(layers(gym.make("Pendulum-v1").unwrapped))
        ['0:PendulumEnv(Pendulum-v1)']
    """
    found: dict[str, Any] = {}
    waiting = [("0", env)]
    while waiting:
        place, layer = waiting.pop(0)
        found[f"{place}:{type(layer).__name__}{_origin(layer)}"] = layer
        attributes = vars(layer)
        inside = [attributes[name] for name in ("venv", "env") if name in attributes]
        inside += attributes.get("envs", [])
        waiting += [(f"{place}.{index}", part) for index, part in enumerate(inside)]
    return found


def _origin(layer: Any) -> str:
    """Describe how gymnasium made an innermost environment, arguments included."""
    spec = vars(layer).get("spec")
    if spec is None or "env" in vars(layer):
        return ""
    plain = {
        key: value
        for key, value in sorted(getattr(spec, "kwargs", {}).items())
        if key != "render_mode" and isinstance(value, bool | int | float | str | list | tuple)
    }
    return f"({', '.join([spec.id, *(f'{key}={value}' for key, value in plain.items())])})"


def layer_states(env: Any, outside_only: bool = False) -> dict[str, dict[str, Any]]:
    """Collect what steps may change in every layer, without copying.

    ``outside_only`` omits what is inside of SB3's wrappers, which may be impossible to pickle.
    """
    return {
        name: {key: value for key, value in vars(layer).items() if key not in _NOT_STATE}
        for name, layer in layers(env).items()
        if not outside_only or isinstance(layer, VecEnvWrapper)
    }


def set_layer_states(env: Any, states: Mapping[str, Mapping[str, Any]]) -> None:
    """Restore what :func:`layer_states` returned in an environment of the same build."""
    for name, layer in layers(env).items():
        vars(layer).update(states.get(name, {}))


def check_same_build(env: Any, names: list[str]) -> None:
    """Raise ``ValueError`` unless the layers of the environment have these names."""
    if list(layers(env)) != names:
        raise ValueError(
            "env must be built and wrapped as when the checkpoint was written, expected "
            f"{' > '.join(names)}, got {' > '.join(layers(env))}"
        )


def monitor_files(env: Any) -> dict[str, IO[str]]:
    """Return the open files of SB3's ``Monitor`` wrappers, by layer."""
    return {
        name: layer.results_writer.file_handler
        for name, layer in layers(env).items()
        if isinstance(layer, Monitor) and layer.results_writer is not None
    }
