"""A model and its bundle: what is written, and what has to hold before any of it is believed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
import stable_baselines3
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import check_for_correct_spaces, get_device
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnv,
    VecNormalize,
    unwrap_vec_normalize,
)

import sb3_flowpolicy
from sb3_flowpolicy.bundle.container import Arrays, BundleError, read_container, write_container
from sb3_flowpolicy.bundle.normalization import (
    normalization_from_spec,
    normalization_of,
    normalization_to_spec,
)
from sb3_flowpolicy.bundle.optimizers import load_optimizer, optimizer_to_spec
from sb3_flowpolicy.bundle.policy_spec import (
    expected_shapes,
    kwargs_from_spec,
    kwargs_to_spec,
    policy_class_from_name,
    policy_class_name,
)
from sb3_flowpolicy.bundle.replay_spec import buffer_from_spec, buffer_to_spec
from sb3_flowpolicy.bundle.schedules import rate_from_spec, rate_to_spec
from sb3_flowpolicy.bundle.space_specs import space_from_spec, space_to_spec
from sb3_flowpolicy.common.validation import Check, integer, number
from sb3_flowpolicy.policies import DistributionPolicy

SUFFIX = ".safetensors"
FORMAT = 1
_KEYS = {
    "action_space",
    "format",
    "made_with",
    "normalization",
    "observation_space",
    "optimizers",
    "policy",
    "policy_kwargs",
    "progress",
    "replay_buffer",
    "settings",
}
# Where the attribute is not called like the argument.
_ATTRIBUTES = {"stats_window_size": "_stats_window_size"}
_PROGRESS: dict[str, Check] = {
    "num_timesteps": integer(0),
    "_total_timesteps": integer(0),
    "_num_timesteps_at_start": integer(0),
    "_episode_num": integer(0),
    "_n_updates": integer(0),
    "_current_progress_remaining": number(),
}
# Stands in for a replay buffer where none is wanted.
_NO_BUFFER: Any = object()

Model = TypeVar("Model", bound=SAC)


def save_bundle(model: SAC, path: str | Path, vec_normalize: VecNormalize | None = None) -> Path:
    """Write a model without pickling anything; see :meth:`SACFlow.save_safe`."""
    path = _with_suffix(Path(path))
    if model.action_noise is not None:
        raise ValueError(
            f"action_noise must be None for a safe bundle, got {model.action_noise}: set "
            "model.action_noise = None before saving, and set it again after loading"
        )
    arrays: Arrays = {
        f"policy.{name}": value.detach().cpu().numpy()
        for name, value in model.policy.state_dict().items()
    }
    arrays["temperature"] = _temperature(model).detach().cpu().numpy()
    optimizers = {
        name: optimizer_to_spec(f"optimizer.{name}", optimizer, arrays)
        for name, optimizer in _optimizers(model).items()
    }
    policy_name, policy = policy_class_name(model.policy_class), model.policy
    assert isinstance(policy, DistributionPolicy)
    known = normalization_of(model, vec_normalize)
    spec = None if known is None else normalization_to_spec("normalization", known, arrays)
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"model must be finite to be worth sharing, got NaN or inf in {name}")
    config = {
        "format": FORMAT,
        "made_with": _made_with(),
        "observation_space": space_to_spec("observation_space", model.observation_space, arrays),
        "action_space": space_to_spec("action_space", model.action_space, arrays),
        "policy": policy_name,
        "policy_kwargs": kwargs_to_spec(policy.up_to_date(model.policy_kwargs)),
        "settings": {
            "learning_rate": rate_to_spec("learning_rate", model.learning_rate),
            **{
                name: check(name, _attribute(model, name))
                for name, check in model.settings.items()  # type: ignore[attr-defined]
            },
        },
        "replay_buffer": buffer_to_spec(model),
        "progress": {name: check(name, getattr(model, name)) for name, check in _PROGRESS.items()},
        "optimizers": optimizers,
        "normalization": spec,
    }
    write_container(path, config, arrays)
    return path


def load_bundle(
    cls: type[Model], path: str | Path, env: Any = None, device: th.device | str = "auto"
) -> Model:
    """Read a model without executing anything that the file says; see ``SACFlow.load_safe``."""
    path = Path(path)
    if not path.exists() and _with_suffix(path).exists():
        path = _with_suffix(path)
    device = get_device(device)
    config, arrays = read_container(path)
    try:
        parts = _parse(config, arrays, cls.settings)  # type: ignore[attr-defined]
    except (ValueError, MemoryError) as error:
        raise BundleError(f"{path} must hold a model of {cls.__name__}: {error}") from error
    if env is not None:
        env = _wrapped(cls, env, parts)
    try:
        return _build(cls, parts, config, arrays, env, device)
    # Settings of someone else's making: torch and SB3 raise whatever they come across.
    except Exception as error:
        text = f"{type(error).__name__}: {error}"
        raise BundleError(f"{path} must hold a model of {cls.__name__}: {text}") from error


def _parse(config: Any, arrays: Arrays, settings: Mapping[str, Check]) -> dict[str, Any]:
    """Turn a configuration into checked attributes; takes what it uses out of ``arrays``."""
    if not isinstance(config, dict) or config.get("format") != FORMAT:
        got = config.get("format") if isinstance(config, dict) else type(config).__name__
        raise ValueError(f"format must be {FORMAT}, got {str(got)[:80]}: is it of a later version?")
    _expect_keys("the settings", config, _KEYS)
    _expect_keys("settings", config["settings"], {"learning_rate", *settings})
    _expect_keys("progress", config["progress"], set(_PROGRESS))
    _expect_keys("made_with", config["made_with"], set(_made_with()))
    if not all(isinstance(version, str) for version in config["made_with"].values()):
        raise ValueError(f"made_with must name versions, got {str(config['made_with'])[:80]}")
    n_arrays = len(arrays)
    action_space = space_from_spec("action_space", config["action_space"], arrays)
    space = space_from_spec("observation_space", config["observation_space"], arrays)
    if not isinstance(action_space, spaces.Box):
        raise ValueError(f"action_space must be a Box, got {action_space}")
    parts: dict[str, Any] = {
        "observation_space": space,
        "action_space": action_space,
        "policy_class": policy_class_from_name(config["policy"]),
        "policy_kwargs": kwargs_from_spec(config["policy_kwargs"]),
        "learning_rate": rate_from_spec("learning_rate", config["settings"]["learning_rate"]),
    }
    for name, check in settings.items():
        value = config["settings"][name]
        if name == "train_freq":
            # A plain number would mean steps, but is not what is saved.
            value = tuple(value) if isinstance(value, list) else ()
        parts[_ATTRIBUTES.get(name, name)] = check(name, value)
    # By the time of saving, "auto" has become a number.
    number()("target_entropy", parts["target_entropy"])
    for name, check in _PROGRESS.items():
        parts[name] = check(name, config["progress"][name])
    parts.update(buffer_from_spec(config["replay_buffer"], space))
    parts["normalization"] = None
    if config["normalization"] is not None:
        spec = config["normalization"]
        parts["normalization"] = normalization_from_spec("normalization", spec, space, arrays)
    shapes = expected_shapes(
        parts["policy_class"], space, action_space, parts["policy_kwargs"], n_arrays
    )
    for name, (shape, dtype) in shapes.items():
        array = arrays.get(f"policy.{name}")
        if array is None or array.shape != tuple(shape) or _type(array) != dtype:
            got = "none" if array is None else f"{array.dtype} {array.shape}"
            raise ValueError(f"policy.{name} must be {dtype} of shape {tuple(shape)}, got {got}")
        if not np.isfinite(array).all():
            raise ValueError(f"policy.{name} must be finite, got NaN or infinity")
    parts["_policy_names"] = list(shapes)
    return parts


def _build(
    cls: type[Model], parts: dict[str, Any], config: Any, arrays: Arrays, env: Any, device: Any
) -> Model:
    state = {name: th.from_numpy(arrays.pop(f"policy.{name}")) for name in parts["_policy_names"]}
    attributes = {key: value for key, value in parts.items() if not key.startswith("_policy_")}
    model = cls(
        policy=parts["policy_class"],
        env=env,
        device=device,
        _init_setup_model=False,
    )
    model.__dict__.update(attributes)
    if env is not None:
        model.__dict__["normalization"] = None  # the environment knows, and goes on learning
    else:
        model.n_envs = 1
        # To act, no buffer is needed, and the file decides how large one would be.
        model.replay_buffer = _NO_BUFFER
    model._setup_model()
    if env is None:
        model.replay_buffer = None
    model.policy.load_state_dict(state)
    for name, value in model.policy.state_dict().items():
        if not th.equal(value.cpu(), state[name]):
            raise ValueError(f"policy.{name} must be what it is shared with")
    temperature = arrays.pop("temperature", None)
    expected = _temperature(model)
    if temperature is None or temperature.shape != expected.shape or temperature.dtype != "float32":
        raise ValueError(f"temperature must be float32 of shape {tuple(expected.shape)}")
    if not np.isfinite(temperature).all():
        raise ValueError(f"temperature must be finite, got {temperature}")
    with th.no_grad():
        expected.copy_(th.from_numpy(temperature))
    optimizers = _optimizers(model)
    _expect_keys("optimizers", config["optimizers"], set(optimizers))
    for name, optimizer in optimizers.items():
        spec = config["optimizers"][name]
        load_optimizer(f"optimizer.{name}", optimizer, spec, arrays)
    if arrays:
        raise ValueError(f"arrays must all belong to the model, got {sorted(arrays)[:5]} besides")
    return model


def _wrapped(cls: type[SAC], env: Any, parts: dict[str, Any]) -> VecEnv:
    """Put the environment behind the statistics that the model was trained with."""
    env = gym.make(env) if isinstance(env, str) else env
    known = parts["normalization"]
    if known is not None:
        if isinstance(env, VecEnv) and unwrap_vec_normalize(env) is not None:
            raise ValueError(
                "env must come without VecNormalize: the bundle brings statistics of its own, and "
                "wraps env with them"
            )
        if not isinstance(env, VecEnv):
            single = Monitor(env)
            env = DummyVecEnv([lambda: single])
        env = known.wrap(env)
    env = cls._wrap_env(env)
    check_for_correct_spaces(env, parts["observation_space"], parts["action_space"])
    return env


def _temperature(model: SAC) -> th.Tensor:
    return model.ent_coef_tensor if model.log_ent_coef is None else model.log_ent_coef


def _optimizers(model: SAC) -> dict[str, th.optim.Optimizer]:
    found = {"actor": model.actor.optimizer, "critic": model.critic.optimizer}
    if model.ent_coef_optimizer is not None:
        found["ent_coef"] = model.ent_coef_optimizer
    return found


def _made_with() -> dict[str, str]:
    return {
        "sb3_flowpolicy": sb3_flowpolicy.__version__,
        "stable_baselines3": stable_baselines3.__version__,
        "torch": str(th.__version__),
    }


def _with_suffix(path: Path) -> Path:
    """Add our suffix where there is none, as SB3 adds ``.zip``."""
    return path if path.suffix else path.with_suffix(SUFFIX)


def _expect_keys(name: str, found: Any, expected: set[str]) -> None:
    if not isinstance(found, dict):
        raise ValueError(f"{name} must be an object, got {str(found)[:80]}")
    if set(found) != expected:
        missing, unknown = sorted(expected - set(found)), sorted(set(found) - expected)
        raise ValueError(f"{name}: {missing} missing, {str(unknown)[:80]} unknown")


def _type(array: np.ndarray) -> th.dtype:
    return th.from_numpy(np.empty(0, array.dtype)).dtype


def _attribute(model: SAC, name: str) -> Any:
    return getattr(model, _ATTRIBUTES.get(name, name))
