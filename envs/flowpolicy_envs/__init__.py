"""Gymnasium environments that need correlated exploration.

Importing this package registers the environments and nothing else: the compiled code and the
renderer are loaded when the first environment is made.

Example:
    >>> import gymnasium as gym
    >>> import flowpolicy_envs
    >>> env = gym.make("TunnelDiagonal-v0")
    >>> observation, info = env.reset(seed=1)
    >>> observation, info
    (array([0., 0.], dtype=float32), {'is_success': False})
"""

from typing import TYPE_CHECKING, Any

from flowpolicy_envs.registration import register_envs

if TYPE_CHECKING:
    from flowpolicy_envs.square.env import SquareEnv
    from flowpolicy_envs.square.holder import Holder
    from flowpolicy_envs.square.tasks import FindGoal, Hold, Move, MoveX
    from flowpolicy_envs.square.vector import SquareVectorEnv
    from flowpolicy_envs.tunnel.env import TunnelEnv
    from flowpolicy_envs.tunnel.vector import TunnelVectorEnv

__all__ = [
    "FindGoal",
    "Hold",
    "Holder",
    "Move",
    "MoveX",
    "SquareEnv",
    "SquareVectorEnv",
    "TunnelEnv",
    "TunnelVectorEnv",
    "register_envs",
]

_LAZY = {
    **dict.fromkeys(("FindGoal", "Hold", "Move", "MoveX"), "flowpolicy_envs.square.tasks"),
    "Holder": "flowpolicy_envs.square.holder",
    "SquareEnv": "flowpolicy_envs.square.env",
    "SquareVectorEnv": "flowpolicy_envs.square.vector",
    "TunnelEnv": "flowpolicy_envs.tunnel.env",
    "TunnelVectorEnv": "flowpolicy_envs.tunnel.vector",
}


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_LAZY[name]), name)


register_envs()
