"""Batched environments as SB3's VecEnv."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.vec_env import VecEnv, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

import flowpolicy_envs  # noqa: F401, registers the environments


def make_batched_env(
    env_id: str, n_envs: int = 1, seed: int | None = None, **env_kwargs: Any
) -> VecMonitor:
    """Make several environments that are stepped by one compiled call, for any SB3 algorithm.

    Args:
        env_id: Id of an environment with a vectorized form, such as any of ``flowpolicy_envs``.
        n_envs: Number of environments.
        seed: Seed of the first environment; the others get the seeds after it.
        **env_kwargs: Arguments of the environment.

    Example:
        >>> import flowpolicy_envs
        >>> env = make_batched_env("SquareHold-v0", n_envs=3, seed=1)
        >>> env.reset().shape
        (3, 42)
    """
    venv = gym.make_vec(
        env_id,
        num_envs=n_envs,
        vectorization_mode="vector_entry_point",
        autoreset_mode=AutoresetMode.SAME_STEP,
        **env_kwargs,
    )
    batched = BatchedVecEnv(venv)
    batched.seed(seed)
    return VecMonitor(batched)


class BatchedVecEnv(VecEnv):
    """SB3's ``VecEnv`` around gymnasium's ``VectorEnv`` that resets in the same step."""

    def __init__(self, venv: VectorEnv) -> None:
        mode = venv.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(f"venv must reset in the same step, got autoreset_mode {mode}")
        self.venv = venv
        observation_space: Any = venv.single_observation_space
        super().__init__(venv.num_envs, observation_space, venv.single_action_space)

    def reset(self) -> np.ndarray:
        """Reset all environments and return their observations, (N, ...)."""
        seeds = self._seeds if any(seed is not None for seed in self._seeds) else None
        obs, infos = self.venv.reset(seed=seeds)  # type: ignore[arg-type]
        self.reset_infos = [info_of(infos, i) for i in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Take the step."""
        obs, rewards, terminated, truncated, batch = self.venv.step(self._actions)
        dones = terminated | truncated
        infos = [step_info(batch, i, terminated, truncated) for i in range(self.num_envs)]
        for i in np.flatnonzero(dones).tolist():
            self.reset_infos[i] = info_of(batch, i)
        return obs, np.asarray(rewards, np.float32), dones, infos

    def close(self) -> None:
        """Close the environments."""
        self.venv.close()

    def get_images(self) -> list[np.ndarray | None]:
        """Return a picture of each environment."""
        images: Any = self.venv.render()
        return list(images or [None] * self.num_envs)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return the attribute once per environment."""
        return [getattr(self.venv, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Raise ``NotImplementedError``: the environments share their attributes."""
        raise NotImplementedError(f"batched environments share {attr_name}: make them anew")

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Raise ``NotImplementedError``: there are no single environments to call."""
        raise NotImplementedError(f"batched environments cannot call {method_name} one by one")

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return False for each environment: wrappers apply to the whole batch."""
        return [False for _ in self._get_indices(indices)]


def step_info(
    batch: dict[str, Any], i: int, terminated: np.ndarray, truncated: np.ndarray
) -> dict[str, Any]:
    """Return one environment's info of a step, as SB3's ``VecEnv`` does.

    Args:
        batch: Infos of a step of gymnasium's ``VectorEnv`` that resets in the same step.
        i: Index of the environment.
        terminated: Which episodes terminated, (N,).
        truncated: Which episodes were truncated, (N,).
    """
    if terminated[i] or truncated[i]:
        info = info_of(batch.get("final_info", {}), i)
        info["terminal_observation"] = batch["final_obs"][i]
    else:
        info = info_of(batch, i)
    info["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
    return info


def info_of(infos: dict[str, Any], i: int) -> dict[str, Any]:
    """Return one environment's part of a batch's infos.

    Example:
        >>> infos = {"x": np.array([1.0, 2.0]), "_x": np.array([True, False])}
        >>> info_of(infos, 0), info_of(infos, 1)
        ({'x': 1.0}, {})
    """
    return {
        name: values[i].item() if isinstance(values[i], np.generic) else values[i]
        for name, values in infos.items()
        if isinstance(values, np.ndarray)
        and not name.startswith(("_", "final_"))
        and (f"_{name}" not in infos or infos[f"_{name}"][i])
    }
