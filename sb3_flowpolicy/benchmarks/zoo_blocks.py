"""The hyperparameters of the shipped files, as arguments of SACFlow and of SB3's SAC."""

from __future__ import annotations

from typing import Any

from sb3_flowpolicy.common.hyperparameters import load_hyperparameters

# What SB3's SAC does not have.
_OURS = ("random_steps", "critic_loss_coef")


def zoo_block(algorithm: str, env_id: str) -> dict[str, Any]:
    """Return the arguments with which SACFlow trains on an environment.

    Args:
        algorithm: ``"sac_flow"``, ``"sac_lowrank"`` or ``"sac_gauss"``.
        env_id: Environment that the file lists.

    Example:
        >>> zoo_block("sac_gauss", "TunnelDiagonal-v0")["policy_kwargs"]["net_arch"]
        [16, 16]
    """
    block = load_hyperparameters(algorithm, env_id)
    del block["n_timesteps"]
    return block


def stock_block(env_id: str) -> dict[str, Any]:
    """Return the same settings as arguments of SB3's SAC with its Gaussian policy."""
    block = zoo_block("sac_gauss", env_id)
    return {key: value for key, value in block.items() if key not in _OURS} | {
        "policy": "MlpPolicy"
    }
