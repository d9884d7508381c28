"""Small trained models, and bundles to be tampered with."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
import safetensors.numpy
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.bundle import container
from sb3_flowpolicy.bundle.container import canonical, checksum
from tests.reach import Reach

FAST: dict[str, Any] = {
    "learning_starts": 10,
    "buffer_size": 200,
    "batch_size": 16,
    "seed": 0,
    "device": "cpu",
}
NET = {"net_arch": [16, 16]}
UNUSUAL: dict[str, dict[str, Any]] = {
    "realnvp": {"layers": 3, "hidden": [6]},
    "low_rank": {"rank": 1},
    "lattice": {"alpha": 0.5},
    "spline": {"layers": 2, "bins": 5},
}


def multi_env() -> Any:
    return gym.wrappers.TimeLimit(Reach(), 5)


def make_model(policy: str = "FlowPolicy", env: Any = "Pendulum-v1", **kwargs: Any) -> SACFlow:
    settings = {"policy_kwargs": {**NET}, **FAST, **kwargs}
    return SACFlow(policy, env, **settings)


def behind_statistics(**kwargs: Any) -> VecNormalize:
    return VecNormalize(make_vec_env("Pendulum-v1", n_envs=2), **kwargs)


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model of every kind of part: statistics, moments, a learned entropy coefficient."""
    env = behind_statistics(clip_obs=float("inf"))
    model = make_model(env=env, policy_kwargs={**NET, "distribution_kwargs": UNUSUAL["realnvp"]})
    return model.learn(40).save_safe(tmp_path_factory.mktemp("bundle") / "model")


def parts_of(content: bytes) -> tuple[dict[str, Any], Any, bytes]:
    """Return header, configuration and data of a bundle, without checking anything."""
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    config = json.loads(header["__metadata__"]["sb3_flowpolicy"])["config"]
    return header, config, content[8 + length :]


def sealed(header: dict[str, Any], config: Any, data: bytes) -> bytes:
    """Assemble a bundle with a valid checksum, if its arrays and configuration can have one."""
    text = config if isinstance(config, str) else json.dumps(config)
    try:
        arrays = safetensors.numpy.load(assembled({**header, "__metadata__": {}}, data))
        digest = checksum(json.loads(text), arrays)
    except Exception:  # spoiled beyond that
        digest = "0" * 64
    entry = f'{{"config":{text},"sha256":"{digest}"}}'
    return assembled(
        {**header, "__metadata__": {**header["__metadata__"], "sb3_flowpolicy": entry}}, data
    )


def assembled(header: dict[str, Any], data: bytes) -> bytes:
    raw = json.dumps(header).encode()
    raw += b" " * (-len(raw) % 8)
    return len(raw).to_bytes(8, "little") + raw + data


def content_of(path: Path) -> tuple[str, dict[str, tuple]]:
    """Return what a bundle holds, apart from the versions that it was made with."""
    config, arrays = container.read(path)
    config.pop("made_with", None)
    values = {name: (one.dtype, one.shape, one.tobytes()) for name, one in arrays.items()}
    return canonical(config), values


@pytest.fixture
def tampered(bundle: Path, tmp_path: Path) -> Callable[[Callable[[Any, dict], None]], Path]:
    """Return a function that writes a bundle whose configuration or arrays were changed."""

    def tamper(change: Callable[[Any, dict], None]) -> Path:
        config, arrays = container.read(bundle)
        change(config, arrays)
        path = tmp_path / "tampered.safetensors"
        container.write(path, config, arrays)
        return path

    return tamper
