"""The statistics of ``VecNormalize`` without an environment: saved, loaded, and used again."""

from __future__ import annotations

import copy
import math
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from sb3_flowpolicy.bundle.container import Arrays
from sb3_flowpolicy.common.validation import Check, flag, number, or_infinity

_above_zero = number(0, above=True)
_SETTINGS: dict[str, Check] = {
    **dict.fromkeys(("training", "norm_obs", "norm_reward"), flag),
    **dict.fromkeys(("clip_obs", "clip_reward"), or_infinity(_above_zero)),
    "gamma": number(0, 1),
    "epsilon": _above_zero,
}
# Key of the statistics of observations that are arrays.
ONLY_KEY = ""


class _Spaces(gym.Env):
    """An environment that has spaces and nothing else."""

    def __init__(self, observation_space: spaces.Space, action_space: spaces.Space) -> None:
        self.observation_space, self.action_space = observation_space, action_space


class _Statistics(VecNormalize):
    """Statistics without an environment, which can be pickled more than once."""

    def __getstate__(self) -> dict[str, Any]:
        bound = ("venv", "class_attributes", "returns")
        return {name: value for name, value in vars(self).items() if name not in bound}


def of_model(
    model: OffPolicyAlgorithm, vec_normalize: VecNormalize | None = None
) -> VecNormalize | None:
    """Return the given statistics, those of a model's environment, those of its bundle, or None."""
    live = vec_normalize if vec_normalize is not None else model.get_vec_normalize_env()
    return live if live is not None else getattr(model, "normalization", None)


def wrap(known: VecNormalize, env: VecEnv) -> VecNormalize:
    """Wrap environments with a copy of statistics."""
    settings = {name: getattr(known, name) for name in (*_SETTINGS, "norm_obs_keys")}
    wrapped = VecNormalize(env, **settings)
    if known.norm_obs:
        wrapped.obs_rms = copy.deepcopy(known.obs_rms)
    wrapped.ret_rms = known.ret_rms.copy()
    return wrapped


def obs_statistics(known: VecNormalize | None) -> dict[str, RunningMeanStd]:
    """Return the statistics by observation key, which is "" if observations are arrays."""
    found: Any = known.obs_rms if known is not None and known.norm_obs else {}
    return found if isinstance(found, dict) else {ONLY_KEY: found}


def to_spec(known: VecNormalize | None, arrays: Arrays) -> dict[str, Any] | None:
    """Describe statistics, and put them into ``arrays``."""
    if known is None:
        return None
    statistics = obs_statistics(known)
    for index, rms in enumerate([*statistics.values(), known.ret_rms]):
        for moment in ("mean", "var", "count"):
            value = np.asarray(getattr(rms, moment), np.float64)
            arrays[f"normalization.{index}.{moment}"] = value
    settings = {name: check(name, getattr(known, name)) for name, check in _SETTINGS.items()}
    # JSON has no infinity.
    plain = {name: "inf" if value == math.inf else value for name, value in settings.items()}
    return {**plain, "keys": list(statistics)}


def from_spec(
    spec: Any, observation_space: spaces.Space, action_space: spaces.Space, arrays: Arrays
) -> VecNormalize | None:
    """Build the statistics that :func:`to_spec` described, if any."""
    if spec is None:
        return None
    given = {name: math.inf if spec[name] == "inf" else spec[name] for name in _SETTINGS}
    settings = {
        name: check(f"normalization.{name}", given[name]) for name, check in _SETTINGS.items()
    }
    nowhere = DummyVecEnv([lambda: _Spaces(observation_space, action_space)])
    keys = [key for key in spec["keys"] if key != ONLY_KEY]
    found = _Statistics(nowhere, **settings, norm_obs_keys=keys or None)
    for index, rms in enumerate([*obs_statistics(found).values(), found.ret_rms]):
        for moment in ("mean", "var", "count"):
            name = f"normalization.{index}.{moment}"
            value, shape = arrays[name], np.shape(getattr(rms, moment))
            if value.shape != shape or (moment != "mean" and not (value >= 0).all()):
                raise ValueError(f"{name} must be at least 0, of shape {shape}, got {value.shape}")
            setattr(rms, moment, float(value) if moment == "count" else value)
    return found


def parts_of(space: spaces.Space) -> dict[str, spaces.Space]:
    """Return the spaces in a Dict, or the space with an empty key."""
    return dict(space.spaces) if isinstance(space, spaces.Dict) else {ONLY_KEY: space}
