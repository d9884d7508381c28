"""Reinforcement learning with low-rank and normalizing-flow policies, for Stable-Baselines3.

Public names are resolved on first use, so that importing the package stays cheap.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the names of _MODULES once more, for type checkers and editors
    from sb3_flowpolicy.algorithms.crossq_flow import CrossQFlow as CrossQFlow
    from sb3_flowpolicy.algorithms.ppo_flow import PPOFlow as PPOFlow
    from sb3_flowpolicy.algorithms.sac_flow import SACFlow as SACFlow
    from sb3_flowpolicy.algorithms.tqc_flow import TQCFlow as TQCFlow
    from sb3_flowpolicy.bundle import BundleError as BundleError
    from sb3_flowpolicy.checkpoint import RunCheckpointCallback as RunCheckpointCallback
    from sb3_flowpolicy.checkpoint import has_checkpoint as has_checkpoint
    from sb3_flowpolicy.distributions import ActionDistribution as ActionDistribution
    from sb3_flowpolicy.distributions import register_distribution as register_distribution
    from sb3_flowpolicy.export import export_onnx as export_onnx
    from sb3_flowpolicy.guard import NonFiniteError as NonFiniteError
    from sb3_flowpolicy.policies.crossq import FlowCrossQPolicy as FlowCrossQPolicy
    from sb3_flowpolicy.policies.on_policy import FlowActorCriticPolicy as FlowActorCriticPolicy
    from sb3_flowpolicy.policies.on_policy import GaussActorCriticPolicy as GaussActorCriticPolicy
    from sb3_flowpolicy.policies.on_policy import (
        LowRankActorCriticPolicy as LowRankActorCriticPolicy,
    )
    from sb3_flowpolicy.policies.sac import CnnFlowPolicy as CnnFlowPolicy
    from sb3_flowpolicy.policies.sac import FlowPolicy as FlowPolicy
    from sb3_flowpolicy.policies.sac import GaussPolicy as GaussPolicy
    from sb3_flowpolicy.policies.sac import LowRankPolicy as LowRankPolicy
    from sb3_flowpolicy.policies.sac import MultiInputFlowPolicy as MultiInputFlowPolicy
    from sb3_flowpolicy.policies.tqc import FlowTQCPolicy as FlowTQCPolicy
    from sb3_flowpolicy.seeds.batch import SeedBatch as SeedBatch

__version__ = "0.1.0"

_MODULES = {
    "CrossQFlow": "algorithms.crossq_flow",
    "TQCFlow": "algorithms.tqc_flow",
    "PPOFlow": "algorithms.ppo_flow",
    "SACFlow": "algorithms.sac_flow",
    "BundleError": "bundle",
    "RunCheckpointCallback": "checkpoint",
    "has_checkpoint": "checkpoint",
    "ActionDistribution": "distributions",
    "register_distribution": "distributions",
    "export_onnx": "export",
    "NonFiniteError": "guard",
    "FlowCrossQPolicy": "policies.crossq",
    "FlowActorCriticPolicy": "policies.on_policy",
    "GaussActorCriticPolicy": "policies.on_policy",
    "LowRankActorCriticPolicy": "policies.on_policy",
    "CnnFlowPolicy": "policies.sac",
    "FlowPolicy": "policies.sac",
    "GaussPolicy": "policies.sac",
    "LowRankPolicy": "policies.sac",
    "MultiInputFlowPolicy": "policies.sac",
    "FlowTQCPolicy": "policies.tqc",
    "SeedBatch": "seeds.batch",
}
__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
