"""What ``VecNormalize`` has learned about observations and rewards, apart from environments."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_flowpolicy.bundle.container import Arrays
from sb3_flowpolicy.common.validation import Check, flag, number

_above_zero = number(0, above=True)


def _bound(name: str, value: Any) -> float:
    """A clip may be infinite, which JSON cannot say in numbers."""
    return math.inf if value in ("inf", math.inf) else _above_zero(name, value)


_SETTINGS: dict[str, Check] = {
    "training": flag,
    "norm_obs": flag,
    "norm_reward": flag,
    "clip_obs": _bound,
    "clip_reward": _bound,
    "gamma": number(0, 1),
    "epsilon": _above_zero,
}
# VecNormalize's statistics of plain observations have no key.
_ONLY = ""


@dataclass(frozen=True)
class Normalization:
    """Running statistics and how they are used.

    Args:
        settings: ``VecNormalize``'s arguments.
        statistics: Mean, variance and count per observation key that is normalised; the key is
            ``""`` where observations are arrays.
        returns: The same of the discounted return.
    """

    settings: Mapping[str, Any]
    statistics: Mapping[str, RunningMeanStd]
    returns: RunningMeanStd

    @classmethod
    def of(cls, env: VecNormalize) -> Normalization:
        """Copy what ``env`` knows now."""
        settings = {key: check(key, getattr(env, key)) for key, check in _SETTINGS.items()}
        found: Any = env.obs_rms if env.norm_obs else {}
        found = found if isinstance(found, dict) else {_ONLY: found}
        return cls(settings, {key: rms.copy() for key, rms in found.items()}, env.ret_rms.copy())

    def normalize_obs(self, obs: Any) -> Any:
        """Do to observations what ``VecNormalize`` does.

        Args:
            obs: An array, or a dict of arrays; of one environment or of several.

        Returns:
            float32 for what is normalised, the rest as it came.
        """
        if isinstance(obs, Mapping):
            known = self.statistics
            return {k: self._one(v, known[k]) if k in known else v for k, v in obs.items()}
        return self._one(obs, self.statistics[_ONLY]) if self.statistics else obs

    def _one(self, obs: Any, rms: RunningMeanStd) -> np.ndarray:
        scaled = (np.asarray(obs) - rms.mean) / np.sqrt(rms.var + self.settings["epsilon"])
        clip = self.settings["clip_obs"]
        return np.clip(scaled, -clip, clip).astype(np.float32)

    def wrap(self, env: VecEnv) -> VecNormalize:
        """Put environments behind these statistics.

        Raises:
            ValueError: If they observe something of another shape.
        """
        parts = _parts(env.observation_space)
        for key, rms in self.statistics.items():
            if key not in parts or parts[key].shape != rms.mean.shape:
                shapes = {name: known.mean.shape for name, known in self.statistics.items()}
                raise ValueError(
                    f"env must have observations of the shapes that were normalised, {shapes}, got "
                    f"{env.observation_space}"
                )
        keys = [key for key in self.statistics if key != _ONLY] or None
        wrapped = VecNormalize(env, **self.settings, norm_obs_keys=keys)
        copies = {key: rms.copy() for key, rms in self.statistics.items()}
        if copies:
            wrapped.obs_rms = copies.get(_ONLY, copies)  # type: ignore[assignment]
        wrapped.ret_rms = self.returns.copy()
        return wrapped


def normalization_of(model: SAC, vec_normalize: VecNormalize | None = None) -> Normalization | None:
    """Return what is known about a model's observations.

    Args:
        model: A model, behind ``VecNormalize`` or not.
        vec_normalize: Statistics that go before the model's own.

    Returns:
        These, those of the model's environment, those that came with its bundle, or None.
    """
    live = vec_normalize if vec_normalize is not None else model.get_vec_normalize_env()
    return Normalization.of(live) if live is not None else getattr(model, "normalization", None)


def normalization_to_spec(name: str, known: Normalization, arrays: Arrays) -> dict[str, Any]:
    """Describe statistics, and put them among ``arrays``."""
    for index, rms in enumerate([*known.statistics.values(), known.returns]):
        arrays[f"{name}.{index}.mean"] = np.asarray(rms.mean, np.float64)
        arrays[f"{name}.{index}.var"] = np.asarray(rms.var, np.float64)
        arrays[f"{name}.{index}.count"] = np.asarray(rms.count, np.float64)
    settings = {key: "inf" if value == math.inf else value for key, value in known.settings.items()}
    return {**settings, "keys": list(known.statistics)}


def normalization_from_spec(
    name: str, spec: Any, space: spaces.Space, arrays: Arrays
) -> Normalization:
    """Build what :func:`normalization_to_spec` described.

    Args:
        name: What it was called.
        spec: The description.
        space: The model's observation space.
        arrays: The statistics are taken out of these.

    Raises:
        ValueError: If settings are out of range, or statistics do not fit the space.
    """
    if not isinstance(spec, dict) or set(spec) != {*_SETTINGS, "keys"}:
        raise ValueError(f"{name} must have {[*_SETTINGS, 'keys']}, got {str(spec)[:80]}")
    settings = {key: check(f"{name}.{key}", spec[key]) for key, check in _SETTINGS.items()}
    parts = _parts(space)
    keys = spec["keys"]
    if not isinstance(keys, list) or not all(isinstance(k, str) and k in parts for k in keys):
        raise ValueError(f"{name}.keys must be among {list(parts)}, got {str(keys)[:80]}")
    if len(set(keys)) != len(keys) or bool(keys) != settings["norm_obs"]:
        raise ValueError(f"{name}.keys must be what norm_obs normalises, got {keys[:5]}")
    shapes = [parts[key].shape for key in keys]
    found = [
        _statistics(f"{name}.{index}", shape, arrays) for index, shape in enumerate([*shapes, ()])
    ]
    return Normalization(settings, dict(zip(keys, found, strict=False)), found[-1])


def _parts(space: spaces.Space) -> dict[str, spaces.Space]:
    return dict(space.spaces) if isinstance(space, spaces.Dict) else {_ONLY: space}


def _statistics(name: str, shape: tuple[int, ...] | None, arrays: Arrays) -> RunningMeanStd:
    rms = RunningMeanStd(shape=shape or ())
    rms.mean, rms.var = (_moment(f"{name}.{key}", shape, arrays) for key in ("mean", "var"))
    rms.count = float(_moment(f"{name}.count", (), arrays))
    if (rms.var < 0).any() or rms.count < 0:
        raise ValueError(f"{name} must have a variance and a count of at least 0")
    return rms


def _moment(name: str, shape: tuple[int, ...] | None, arrays: Arrays) -> np.ndarray:
    value = arrays.pop(name, None)
    if value is None or value.dtype != np.float64 or value.shape != shape:
        got = "none" if value is None else f"{value.dtype} {value.shape}"
        raise ValueError(f"{name} must be float64 of shape {shape}, got {got}")
    if not np.isfinite(value).all():
        raise ValueError(f"{name} must be finite, got NaN or infinity")
    return value
