"""Demonstrations: recorded transitions that fill the replay buffer before learning starts."""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Mapping
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv

from sb3_flowpolicy.guard.finite import all_finite

KEYS = ("observations", "actions", "rewards", "next_observations", "terminations", "truncations")

# What gym.make_vec adds to the arguments of the environment in its spec.
_OF_MAKE_VEC = {"num_envs", "vectorization_mode", "autoreset_mode", "max_episode_steps"}


def record_demonstrations(
    env: gym.Env, controller: Callable[[Any], np.ndarray], n_steps: int, seed: int | None = None
) -> dict[str, np.ndarray]:
    """Record transitions of a controller, a function from an observation to an action.

    Returns:
        Arrays with ``n_steps`` rows under the keys ``observations``, ``actions``, ``rewards``,
        ``next_observations``, ``terminations`` and ``truncations``, as arguments of
        :meth:`SACFlow.add_demonstrations` or ``np.savez``.

    Example:
        >>> import gymnasium as gym
        >>> import numpy as np
        >>> demos = record_demonstrations(gym.make("Pendulum-v1"), lambda obs: np.zeros(1), 5)
        >>> demos["observations"].shape
        (5, 3)
    """
    columns: dict[str, list] = {key: [] for key in KEYS}
    obs, _ = env.reset(seed=seed)
    for _ in range(n_steps):
        action = np.asarray(controller(obs))
        next_obs, reward, terminated, truncated, _ = env.step(action)
        # Copies, as an environment may return the same array at every step.
        row = (np.array(obs), action, reward, np.array(next_obs), terminated, truncated)
        for column, value in zip(columns.values(), row, strict=True):
            column.append(value)
        obs = env.reset()[0] if terminated or truncated else next_obs
    return {key: np.asarray(column) for key, column in columns.items()}


def is_recipe(source: Any) -> bool:
    """Whether these are arguments for :func:`follow_recipe` and not demonstrations."""
    return isinstance(source, Mapping) and "controller" in source


def follow_recipe(
    env: VecEnv,
    seed: int | None,
    *,
    controller: str | Callable[[Any], np.ndarray],
    n_steps: int,
    controller_kwargs: Mapping[str, Any] | None = None,
) -> dict[str, np.ndarray]:
    """Record demonstrations in a fresh environment like the first of ``env``.

    Args:
        env: Environments that were made from registered ids.
        seed: Seed of the first reset.
        controller: Function from an observation to an action, or the import path of a class or
            function that makes one, such as ``flowpolicy_envs.Holder``.
        n_steps: Number of transitions.
        controller_kwargs: Arguments of that class or function.

    Raises:
        ValueError: If the environments were not made from an id.

    Example:
        >>> import flowpolicy_envs
        >>> from stable_baselines3.common.env_util import make_vec_env
        >>> env = make_vec_env("SquareMove-v0")
        >>> demos = follow_recipe(env, seed=0, controller="flowpolicy_envs.Holder", n_steps=80)
        >>> bool(demos["truncations"][-1]), demos["actions"].shape
        (True, (80, 8))
    """
    act: Any = controller
    if isinstance(controller, str):
        act = pkgutil.resolve_name(controller)(**(controller_kwargs or {}))
    spec = env.get_attr("spec")[0]
    if spec is None:
        raise ValueError("demonstrations can be recorded only in environments made from an id")
    # Without wrappers such as SB3's Monitor, which would count these episodes.
    kwargs = {name: value for name, value in spec.kwargs.items() if name not in _OF_MAKE_VEC}
    kwargs |= {"render_mode": None, "max_episode_steps": spec.max_episode_steps}
    fresh = gym.make(spec.id, **kwargs)
    with closing(fresh):
        return record_demonstrations(fresh, act, n_steps, seed)


def load_demonstrations(source: str | Path | Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Read and validate demonstrations, from an ``.npz`` file or from arrays.

    Raises:
        ValueError: If the file does not exist, an array is missing, empty or not finite, or
            lengths differ.
    """
    try:
        with nullcontext(source) if isinstance(source, Mapping) else np.load(source) as found:
            arrays = {key: np.asarray(found[key]) for key in KEYS}
    # On damaged files numpy, zipfile and zlib raise many types of exceptions.
    except Exception as error:
        raise ValueError(
            f"demonstrations must be arrays or an .npz file of arrays of numbers, got "
            f"{str(source)[:200]!r} ({type(error).__name__}: {error})"
        ) from error
    for key, array in arrays.items():
        if array.dtype.kind not in "biuf" or not all_finite(array):
            raise ValueError(
                f"demonstrations must be finite, got NaN, infinity or no numbers in {key} "
                f"({array.dtype})"
            )
    arrays["rewards"] = arrays["rewards"].reshape(-1)
    for key in ("terminations", "truncations"):
        arrays[key] = arrays[key].reshape(-1).astype(bool)
    lengths = {key: len(array) if array.ndim else 0 for key, array in arrays.items()}
    if len(set(lengths.values())) > 1 or not lengths["actions"]:
        raise ValueError(f"demonstrations must have equally many rows, at least 1, got {lengths}")
    return arrays


def fill_replay_buffer(
    buffer: ReplayBuffer | None, policy: BasePolicy, demonstrations: Mapping[str, np.ndarray]
) -> int:
    """Append demonstrations, as of :func:`load_demonstrations`, to a replay buffer.

    With several environments each gets a run of consecutive rows, and up to n_envs - 1 rows at
    the end are left out.

    Returns:
        Number of transitions that were added.

    Raises:
        ValueError: If the buffer cannot take them, there are too many or too few, they do not fit
            the spaces, or actions leave theirs.
    """
    if buffer is None or isinstance(buffer, DictReplayBuffer) or buffer.optimize_memory_usage:
        raise ValueError(
            "demonstrations need a replay buffer for array observations, with "
            f"optimize_memory_usage=False, got {buffer}"
        )
    n_rows, n_envs = len(demonstrations["actions"]), buffer.n_envs
    per_env = n_rows // n_envs
    if not 1 <= per_env <= buffer.buffer_size:
        raise ValueError(
            f"demonstrations must have between {n_envs} and {n_envs * buffer.buffer_size} rows, "
            f"got {n_rows}"
        )
    for key in ("observations", "next_observations", "actions"):
        space = policy.action_space if key == "actions" else policy.observation_space
        if demonstrations[key].shape[1:] != space.shape:
            raise ValueError(
                f"demonstrations must have {key} of shape (N, *{space.shape}), "
                f"got {demonstrations[key].shape}"
            )
    actions = demonstrations["actions"]
    if np.abs(policy.scale_action(actions)).max() > 1 + 1e-5:
        raise ValueError(
            f"demonstrations must have actions within {policy.action_space}, got "
            f"{actions.min()} ... {actions.max()}"
        )
    runs = {
        key: array[: per_env * n_envs].reshape(n_envs, per_env, *array.shape[1:]).swapaxes(0, 1)
        for key, array in demonstrations.items()
    }
    # n-step returns must not reach past the end of a run.
    truncations = runs["truncations"].copy()
    truncations[-1] |= ~runs["terminations"][-1]
    for t in range(per_env):
        terminated = runs["terminations"][t]
        buffer.add(
            runs["observations"][t],
            runs["next_observations"][t],
            policy.scale_action(runs["actions"][t]),
            runs["rewards"][t],
            terminated | truncations[t],
            [{"TimeLimit.truncated": bool(flag)} for flag in truncations[t] & ~terminated],
        )
    return per_env * n_envs
