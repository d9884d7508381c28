"""Save a model as a bundle, and build a model from a validated bundle."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import stable_baselines3
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.utils import check_for_correct_spaces, get_device
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

import sb3_flowpolicy
from sb3_flowpolicy.bundle import container, normalization, policy, spaces, training
from sb3_flowpolicy.bundle.container import Arrays, BundleError, tensor_like
from sb3_flowpolicy.common.validation import Check, integer, number

SUFFIX = ".safetensors"
FORMAT = 1
# Attributes with another name than the constructor's argument.
_ATTRIBUTES = {"stats_window_size": "_stats_window_size"}
_PROGRESS: dict[str, Check] = {
    **dict.fromkeys(("num_timesteps", "_total_timesteps", "_num_timesteps_at_start"), integer(0)),
    **dict.fromkeys(("_episode_num", "_n_updates"), integer(0)),
    "_current_progress_remaining": number(),
}
_SPACES = ("observation_space", "action_space")
# A replay buffer that keeps SB3 from allocating one.
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
    config, arrays = _describe(model, normalization.of_model(model, vec_normalize))
    _parse(type(model), config, arrays)  # raise now what loading would raise
    container.write(path, {**config, "made_with": made_with()}, arrays)
    return path


def load_bundle(
    cls: type[Model], path: str | Path, env: Any = None, device: th.device | str = "auto"
) -> Model:
    """Read a model without running code from the file; see :meth:`SACFlow.load_safe`.

    A file is accepted only if the model built from it would be saved with the same content.
    """
    path = Path(path)
    if not path.exists() and _with_suffix(path).exists():
        path = _with_suffix(path)
    device = get_device(device)
    with _refusing(path):
        config, arrays = container.read(path)
        attributes, state = _parse(cls, config, arrays)
    statistics = attributes["normalization"]
    if env is not None:
        env = _wrapped(cls, env, attributes)
        attributes["normalization"] = None  # from now on the environment's
    with _refusing(path):
        model: Any = cls(attributes["policy_class"], env, device=device, _init_setup_model=False)
        model.__dict__.update(attributes)
        if env is None:
            model.n_envs = 1
            # The file determines the size of a buffer, which is not needed to predict.
            model.replay_buffer = _NO_BUFFER
        model._setup_model()
        if env is None:
            model.replay_buffer = None
        model.policy.load_state_dict(state)
        name, ent_coef = _ent_coef(model)
        with th.no_grad():
            ent_coef.copy_(tensor_like(ent_coef, name, arrays))
        for name, optimizer in model.optimizers().items():
            training.load_optimizer(
                f"optimizer.{name}", optimizer, config["optimizers"][name], arrays
            )
        _check_content(config, arrays, *_describe(model, statistics))
    return model


def made_with() -> dict[str, str]:
    """Return the versions to record in a file."""
    return {
        "sb3_flowpolicy": sb3_flowpolicy.__version__,
        "stable_baselines3": stable_baselines3.__version__,
        "torch": str(th.__version__),
    }


def _describe(model: Any, statistics: VecNormalize | None) -> tuple[dict[str, Any], Arrays]:
    """Return the configuration and the arrays that describe a model completely."""
    arrays: Arrays = {
        f"policy.{name}": value.detach().cpu().numpy()
        for name, value in model.policy.state_dict().items()
    }
    name, ent_coef = _ent_coef(model)
    arrays[name] = ent_coef.detach().cpu().numpy()
    config: dict[str, Any] = {
        "format": FORMAT,
        "policy": policy.to_spec(model),
        "settings": {
            "learning_rate": training.rate_to_spec(model.learning_rate),
            **{
                name: check(name, getattr(model, _ATTRIBUTES.get(name, name)))
                for name, check in model.settings.items()
            },
        },
        "replay_buffer": {
            "class": policy.name_of("replay_buffer_class", model.replay_buffer_class),
            "kwargs": policy.plain("replay_buffer_kwargs", model.replay_buffer_kwargs),
        },
        "progress": {name: check(name, getattr(model, name)) for name, check in _PROGRESS.items()},
        "optimizers": {
            name: training.optimizer_to_spec(f"optimizer.{name}", optimizer, arrays)
            for name, optimizer in model.optimizers().items()
        },
        "normalization": normalization.to_spec(statistics, arrays),
    }
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"model must be finite, got NaN or infinity in {name}")
    for name in _SPACES:
        config[name] = spaces.to_spec(name, getattr(model, name), arrays)
    return config, arrays


def _parse(
    cls: Any, config: dict[str, Any], arrays: Arrays
) -> tuple[dict[str, Any], dict[str, th.Tensor]]:
    """Return a model's attributes and its policy's parameters, validated before building it."""
    if config["format"] != FORMAT:
        raise ValueError(f"format must be {FORMAT}, got {config['format']}: is it a newer file?")
    both = {name: spaces.from_spec(name, config[name], arrays) for name in _SPACES}
    buffer = config["replay_buffer"]
    attributes = {
        **both,
        "learning_rate": training.rate_from_spec(config["settings"]["learning_rate"]),
        "normalization": normalization.from_spec(config["normalization"], **both, arrays=arrays),
        "replay_buffer_class": policy.class_of("replay_buffer_class", buffer["class"]),
        "replay_buffer_kwargs": dict(buffer["kwargs"]),
        **policy.from_spec(config["policy"]),
    }
    for name, check in cls.settings.items():
        value = config["settings"][name]
        value = tuple(value) if isinstance(value, list) else value
        attributes[_ATTRIBUTES.get(name, name)] = check(name, value)
    number()("target_entropy", attributes["target_entropy"])  # "auto" for new models only
    for name, check in _PROGRESS.items():
        attributes[name] = check(name, config["progress"][name])
    expected = policy.expected_parameters(attributes, len(arrays))
    state = {name: tensor_like(value, f"policy.{name}", arrays) for name, value in expected.items()}
    return attributes, state


def _check_content(
    config: dict[str, Any], arrays: Arrays, again: dict[str, Any], values: Arrays
) -> None:
    """Check that nothing in the file was converted or left out when the model was built."""
    keys = sorted((config.keys() | again.keys()) - {"made_with"})
    texts = [{key: container.canonical(one.get(key)) for key in keys} for one in (config, again)]
    differing = [key for key in keys if texts[0][key] != texts[1][key]]
    differing += sorted(arrays.keys() ^ values.keys())
    for name in arrays.keys() & values.keys():
        found, expected = arrays[name], values[name]
        if found.dtype != expected.dtype or not np.array_equal(found, expected):
            differing.append(name)
    if differing:
        raise ValueError(f"{differing} must be as save_safe writes them")


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Turn all errors that a file causes, also in torch and SB3, into ``BundleError``."""
    try:
        yield
    except Exception as error:
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        text = textwrap.shorten(f"{kind}{error}", 400, placeholder=" ...")
        raise BundleError(f"{path} must be a bundle written by save_safe: {text}") from error


def _wrapped(cls: type[SAC], env: Any, attributes: dict[str, Any]) -> VecEnv:
    """Wrap the environment with the statistics that the model was trained with."""
    statistics = attributes["normalization"]
    if statistics is not None and isinstance(env, VecEnv) and unwrap_vec_normalize(env):
        raise ValueError(
            "env must come without VecNormalize: load_safe wraps it with the statistics of the "
            "bundle"
        )
    venv = cls._wrap_env(maybe_make_env(env, 0))
    check_for_correct_spaces(venv, attributes["observation_space"], attributes["action_space"])
    return venv if statistics is None else normalization.wrap(statistics, venv)


def _ent_coef(model: SAC) -> tuple[str, th.Tensor]:
    if model.log_ent_coef is None:
        return "ent_coef_tensor", model.ent_coef_tensor
    return "log_ent_coef", model.log_ent_coef


def _with_suffix(path: Path) -> Path:
    return path if path.suffix else path.with_suffix(SUFFIX)
