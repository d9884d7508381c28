"""Small trained models, and bundles to be tampered with."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.vec_env import VecNormalize

from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.bundle.container import write_container

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
    return BitFlippingEnv(n_bits=3, continuous=True)


def make_model(policy: str = "FlowPolicy", env: Any = "Pendulum-v1", **kwargs: Any) -> SACFlow:
    settings = {"policy_kwargs": {**NET}, **FAST, **kwargs}
    return SACFlow(policy, env, **settings)


def behind_statistics(**kwargs: Any) -> VecNormalize:
    return VecNormalize(make_vec_env("Pendulum-v1", n_envs=2), **kwargs)


@pytest.fixture(scope="session")
def bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model of every kind of part: statistics, a schedule, moments, a learned temperature."""
    env = behind_statistics(clip_obs=float("inf"))
    model = make_model(env=env, policy_kwargs={**NET, "distribution_kwargs": UNUSUAL["realnvp"]})
    return model.learn(40).save_safe(tmp_path_factory.mktemp("bundle") / "model")


def parts_of(content: bytes) -> tuple[dict[str, Any], Any, bytes]:
    """Return header, configuration and data of a bundle, without checking anything."""
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    return header, json.loads(header["__metadata__"]["config"]), content[8 + length :]


def sealed(header: dict[str, Any], config: Any, data: bytes) -> bytes:
    """Put a bundle together again, with a checksum that holds."""
    text = config if isinstance(config, str) else dumps(config, sort_keys=True)
    header = {**header, "__metadata__": {**header["__metadata__"], "config": text}}
    header["__metadata__"]["checksum"] = "0" * 64
    raw = dumps(header).encode()
    raw += b" " * (-len(raw) % 8)
    start = len(raw).to_bytes(8, "little")
    digest = hashlib.sha256(start + raw + data).hexdigest().encode()
    return start + raw.replace(b"0" * 64, digest, 1) + data


def dumps(value: Any, **kwargs: Any) -> str:
    return json.dumps(value, separators=(",", ":"), **kwargs)


@pytest.fixture
def tampered(bundle: Path, tmp_path: Path) -> Callable[[Callable[[Any, dict], None]], Path]:
    """Return a function that writes a bundle whose configuration or arrays were changed."""
    from sb3_flowpolicy.bundle.container import read_container

    def tamper(change: Callable[[Any, dict], None]) -> Path:
        config, arrays = read_container(bundle)
        change(config, arrays)
        path = tmp_path / "tampered.safetensors"
        write_container(path, config, arrays)
        return path

    return tamper
