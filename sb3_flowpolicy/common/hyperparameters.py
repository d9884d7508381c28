"""Hyperparameters from the YAML files that rl_zoo3 also reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

import zoo_hyperparams
from sb3_flowpolicy.common.validation import one_of

# Entries that rl_zoo3 handles itself.
_FOR_THE_ZOO = ("callback", "env_wrapper", "normalize")


def hyperparameter_file(algorithm: str) -> Path:
    """Return the path of the YAML file that rl_zoo3 reads without `-conf`.

    Example:
        >>> hyperparameter_file("sac_flow").name
        'sac_flow.yml'
    """
    return Path(zoo_hyperparams.__path__[0], f"{algorithm}.yml")


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
    # The files of the other algorithms are only for rl_zoo3.
    one_of("sac_flow", "sac_gauss", "sac_lowrank")("algo", algo)
    blocks = yaml.safe_load(hyperparameter_file(algo).read_text())
    block = blocks.get(env_id, blocks["default"])
    return {key: value for key, value in block.items() if key not in _FOR_THE_ZOO}
