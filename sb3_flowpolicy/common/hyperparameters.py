"""Hyperparameters of the files that rl_zoo3 reads too: one source for every command."""

from __future__ import annotations

from importlib import resources
from typing import Any

import yaml

# What rl_zoo3 makes of a block, and the algorithm does not see.
_FOR_THE_ZOO = ("callback", "env_wrapper", "normalize")


def load_hyperparameters(algo: str, env_id: str) -> dict[str, Any]:
    """Return the block of an algorithm and environment.

    Args:
        algo: ``"sac_flow"``, ``"sac_lowrank"`` or ``"sac_gauss"``.
        env_id: Environment; one that the file does not list gets its ``default`` block.

    Returns:
        Arguments of :class:`SACFlow`, ``policy`` among them, and ``n_timesteps``.

    Raises:
        ValueError: If there is no file for the algorithm.

    Example:
        >>> load_hyperparameters("sac_flow", "TunnelDiagonal-v0")["ent_coef"]
        0.0025
    """
    folder = resources.files("zoo_hyperparams")
    names = [file.name for file in folder.iterdir()]
    # The other files are of algorithms that rl_zoo3 trains, and nobody else here.
    known = sorted(name.removesuffix(".yml") for name in names if name.startswith("sac_"))
    if algo not in known:
        raise ValueError(f"algo must be one of {known}, got {algo!r}")
    if not isinstance(env_id, str):
        raise ValueError(f"env_id must be a string, got {env_id!r}")
    blocks = yaml.safe_load((folder / f"{algo}.yml").read_text())
    block = blocks.get(env_id, blocks["default"])
    return {key: value for key, value in block.items() if key not in _FOR_THE_ZOO}
