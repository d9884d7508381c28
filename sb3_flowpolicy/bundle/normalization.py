"""The statistics of ``VecNormalize``, separate from environments."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_flowpolicy.bundle.container import Arrays
from sb3_flowpolicy.common.validation import Check, flag, number

_above_zero = number(0, above=True)


def _bound(name: str, value: Any) -> float:
    """Accept infinity, too, which JSON spells "inf"."""
    return math.inf if value in ("inf", math.inf) else _above_zero(name, value)


_SETTINGS: dict[str, Check] = {
    **dict.fromkeys(("training", "norm_obs", "norm_reward"), flag),
    **dict.fromkeys(("clip_obs", "clip_reward"), _bound),
    "gamma": number(0, 1),
    "epsilon": _above_zero,
}
# Key of the statistics of observations that are arrays.
ONLY_KEY = ""


@dataclass(frozen=True)
class Normalization:
    """Running statistics, and how to apply them.

    Args:
        settings: ``VecNormalize``'s arguments.
        statistics: Mean, variance and count per observation key that is normalized; the key is
            ``""`` if observations are arrays.
        returns: The same of the discounted return.
    """

    settings: Mapping[str, Any]
    statistics: Mapping[str, RunningMeanStd]
    returns: RunningMeanStd

    @classmethod
    def of(cls, env: VecNormalize) -> Normalization:
        """Copy the present statistics of ``env``."""
        settings = {key: check(key, getattr(env, key)) for key, check in _SETTINGS.items()}
        found: Any = env.obs_rms if env.norm_obs else {}
        found = found if isinstance(found, dict) else {ONLY_KEY: found}
        return cls(settings, {key: rms.copy() for key, rms in found.items()}, env.ret_rms.copy())

    def normalize_obs(self, obs: Any) -> Any:
        """Normalize observations as ``VecNormalize`` does, an array or a dict of arrays."""
        if isinstance(obs, Mapping):
            known = self.statistics
            return {k: self._one(v, known[k]) if k in known else v for k, v in obs.items()}
        return self._one(obs, self.statistics[ONLY_KEY]) if self.statistics else obs

    def _one(self, obs: Any, rms: RunningMeanStd) -> np.ndarray:
        scaled = (np.asarray(obs) - rms.mean) / np.sqrt(rms.var + self.settings["epsilon"])
        clip = self.settings["clip_obs"]
        return np.clip(scaled, -clip, clip).astype(np.float32)

    def wrap(self, env: VecEnv) -> VecNormalize:
        """Wrap environments with these statistics."""
        keys = [key for key in self.statistics if key != ONLY_KEY]
        if not set(keys) <= set(parts_of(env.observation_space)):
            raise ValueError(f"env must have the observations {keys}, got {env.observation_space}")
        wrapped = VecNormalize(env, **self.settings, norm_obs_keys=keys or None)
        copies = {key: rms.copy() for key, rms in self.statistics.items()}
        if copies:
            wrapped.obs_rms = copies.get(ONLY_KEY, copies)  # type: ignore[assignment]
        wrapped.ret_rms = self.returns.copy()
        return wrapped


def normalization_of(
    model: OffPolicyAlgorithm, vec_normalize: VecNormalize | None = None
) -> Normalization | None:
    """Return the given statistics, those of a model's environment, those of its bundle, or None."""
    live = vec_normalize if vec_normalize is not None else model.get_vec_normalize_env()
    return Normalization.of(live) if live is not None else getattr(model, "normalization", None)


def normalization_to_spec(known: Normalization | None, arrays: Arrays) -> dict[str, Any] | None:
    """Describe statistics, and put them into ``arrays``."""
    if known is None:
        return None
    for index, rms in enumerate([*known.statistics.values(), known.returns]):
        for moment in ("mean", "var", "count"):
            value = np.asarray(getattr(rms, moment), np.float64)
            arrays[f"normalization.{index}.{moment}"] = value
    settings = {key: "inf" if value == math.inf else value for key, value in known.settings.items()}
    return {**settings, "keys": list(known.statistics)}


def normalization_from_spec(spec: Any, space: spaces.Space, arrays: Arrays) -> Normalization | None:
    """Build the statistics that :func:`normalization_to_spec` described, if any."""
    if spec is None:
        return None
    settings = {key: check(f"normalization.{key}", spec[key]) for key, check in _SETTINGS.items()}
    parts, keys = parts_of(space), spec["keys"]
    if not set(keys) <= set(parts) or bool(keys) != settings["norm_obs"]:
        raise ValueError(f"normalization.keys must be among {list(parts)}, got {keys}")
    shapes = [parts[key].shape or () for key in keys]
    found = [_statistics(index, shape, arrays) for index, shape in enumerate([*shapes, ()])]
    return Normalization(settings, dict(zip(keys, found, strict=False)), found[-1])


def _statistics(index: int, shape: tuple[int, ...], arrays: Arrays) -> RunningMeanStd:
    rms = RunningMeanStd()
    for moment, expected in (("mean", shape), ("var", shape), ("count", ())):
        name = f"normalization.{index}.{moment}"
        value = arrays[name]
        if value.shape != expected or (moment != "mean" and not (value >= 0).all()):
            raise ValueError(f"{name} must be at least 0, of shape {expected}, got {value.shape}")
        setattr(rms, moment, float(value) if moment == "count" else value)
    return rms


def parts_of(space: spaces.Space) -> dict[str, spaces.Space]:
    """Return the spaces in a Dict, or the space with an empty key."""
    return dict(space.spaces) if isinstance(space, spaces.Dict) else {ONLY_KEY: space}
