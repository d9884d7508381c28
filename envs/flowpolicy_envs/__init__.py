"""Gymnasium environments that need correlated exploration.

Importing this package only registers the environments. The compiled code and the renderer are
loaded when the first environment is made.

Example:
    >>> import gymnasium as gym
    >>> import flowpolicy_envs
    >>> env = gym.make("TunnelDiagonal-v0")
    >>> observation, info = env.reset(seed=1)
    >>> observation, info
    (array([0., 0.], dtype=float32), {'is_success': False})
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from flowpolicy_envs.registration import register_envs

if TYPE_CHECKING:  # the names of _MODULES once more, for type checkers and editors
    from flowpolicy_envs.square.env import SquareEnv as SquareEnv
    from flowpolicy_envs.square.holder import Holder as Holder
    from flowpolicy_envs.square.tasks import FindGoal as FindGoal
    from flowpolicy_envs.square.tasks import Hold as Hold
    from flowpolicy_envs.square.tasks import Move as Move
    from flowpolicy_envs.square.tasks import MoveX as MoveX
    from flowpolicy_envs.square.vector import SquareVectorEnv as SquareVectorEnv
    from flowpolicy_envs.tunnel.env import TunnelEnv as TunnelEnv
    from flowpolicy_envs.tunnel.vector import TunnelVectorEnv as TunnelVectorEnv

_MODULES = {
    **dict.fromkeys(("FindGoal", "Hold", "Move", "MoveX"), "square.tasks"),
    "Holder": "square.holder",
    "SquareEnv": "square.env",
    "SquareVectorEnv": "square.vector",
    "TunnelEnv": "tunnel.env",
    "TunnelVectorEnv": "tunnel.vector",
}
__all__ = sorted([*_MODULES, "register_envs"])


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


register_envs()
