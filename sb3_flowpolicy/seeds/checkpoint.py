"""A batch of seeds on disk: ordinary SB3 files per agent, and the random numbers of all."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch as th

from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.seeds.setup import EnvFactory, make_env

_BATCH_FILE = "batch.pt"


def write_batch(
    folder: str | Path, seeds: Sequence[int], models: Sequence[SACFlow], noise: dict[str, Any]
) -> None:
    """Write agents, replay buffers and random numbers; what is there last makes it complete."""
    Path(folder).mkdir(parents=True, exist_ok=True)
    for seed, model in zip(seeds, models, strict=True):
        model.save(Path(folder, f"seed_{seed}.zip"))
        model.save_replay_buffer(Path(folder, f"seed_{seed}.buffer.pkl"))
    partial = Path(folder, f"{_BATCH_FILE}.partial")
    th.save({"seeds": list(seeds), "noise": noise}, partial)
    partial.replace(Path(folder, _BATCH_FILE))


def read_batch(
    folder: str | Path, env: str | EnvFactory, algorithm: type[SACFlow]
) -> tuple[list[int], list[SACFlow], dict[str, Any]]:
    """Read what :func:`write_batch` wrote.

    Returns:
        Seeds, agents with their replay buffers, and the states of the random numbers.

    Raises:
        ValueError: If the folder holds no complete batch.
    """
    if not Path(folder, _BATCH_FILE).is_file():
        raise ValueError(f"folder must hold a saved batch, got {folder}")
    saved = th.load(Path(folder, _BATCH_FILE), weights_only=True)
    models = []
    for seed in saved["seeds"]:
        path = Path(folder, f"seed_{seed}.zip")
        model = algorithm.load(path, env=make_env(env), device="cpu")
        model.load_replay_buffer(Path(folder, f"seed_{seed}.buffer.pkl"))
        models.append(model)
    return saved["seeds"], models, saved["noise"]
