"""Hyperparameters from the YAML files that rl_zoo3 also reads."""

from __future__ import annotations

from importlib import resources
from typing import Any

import yaml

from sb3_flowpolicy.common.validation import one_of

# Entries that rl_zoo3 handles itself.
_FOR_THE_ZOO = ("callback", "env_wrapper", "normalize")


def load_hyperparameters(algo: str, env_id: str) -> dict[str, Any]:
    """Return the block of an algorithm and environment, or of ``default`` for other environments.

    Returns:
        Arguments of :class:`SACFlow`, ``policy`` among them, and ``n_timesteps``.

    Raises:
        ValueError: If ``algo`` is not ``"sac_flow"``, ``"sac_lowrank"`` or ``"sac_gauss"``.

    Example:
        >>> load_hyperparameters("sac_flow", "TunnelDiagonal-v0")["ent_coef"]
        0.0025
    """
    folder = resources.files("zoo_hyperparams")
    # The files of the other algorithms are only for rl_zoo3.
    known = sorted(f.name[:-4] for f in folder.iterdir() if f.name.startswith("sac_"))
    one_of(*known)("algo", algo)
    blocks = yaml.safe_load((folder / f"{algo}.yml").read_text())
    block = blocks.get(env_id, blocks["default"])
    return {key: value for key, value in block.items() if key not in _FOR_THE_ZOO}
