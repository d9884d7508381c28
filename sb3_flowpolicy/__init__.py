"""Soft Actor-Critic policies that correlate and bend their action distribution.

Public names are resolved on first use, so that importing the package stays cheap.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_flowpolicy.algorithms.crossq_flow import CrossQFlow
    from sb3_flowpolicy.algorithms.ppo_flow import PPOFlow
    from sb3_flowpolicy.algorithms.sac_flow import SACFlow
    from sb3_flowpolicy.algorithms.tqc_flow import TQCFlow
    from sb3_flowpolicy.bundle import BundleError
    from sb3_flowpolicy.checkpoint import RunCheckpointCallback, has_checkpoint
    from sb3_flowpolicy.distributions import ActionDistribution, register_distribution
    from sb3_flowpolicy.export import export_onnx
    from sb3_flowpolicy.guard.finite import NonFiniteError
    from sb3_flowpolicy.policies import (
        CnnFlowPolicy,
        CnnGaussPolicy,
        CnnLowRankPolicy,
        FlowPolicy,
        GaussPolicy,
        LowRankPolicy,
        MultiInputFlowPolicy,
        MultiInputGaussPolicy,
        MultiInputLowRankPolicy,
    )
    from sb3_flowpolicy.policies.contrib import (
        CnnFlowTQCPolicy,
        CnnGaussTQCPolicy,
        CnnLowRankTQCPolicy,
        FlowCrossQPolicy,
        FlowTQCPolicy,
        GaussCrossQPolicy,
        GaussTQCPolicy,
        LowRankCrossQPolicy,
        LowRankTQCPolicy,
        MultiInputFlowTQCPolicy,
        MultiInputGaussTQCPolicy,
        MultiInputLowRankTQCPolicy,
    )
    from sb3_flowpolicy.policies.on_policy import (
        CnnFlowActorCriticPolicy,
        CnnLowRankActorCriticPolicy,
        FlowActorCriticPolicy,
        LowRankActorCriticPolicy,
        MultiInputFlowActorCriticPolicy,
        MultiInputLowRankActorCriticPolicy,
    )
    from sb3_flowpolicy.seeds.batch import SeedBatch

__version__ = "0.1.0"

__all__ = [
    "ActionDistribution",
    "BundleError",
    "CnnFlowActorCriticPolicy",
    "CnnFlowPolicy",
    "CnnFlowTQCPolicy",
    "CnnGaussPolicy",
    "CnnGaussTQCPolicy",
    "CnnLowRankActorCriticPolicy",
    "CnnLowRankPolicy",
    "CnnLowRankTQCPolicy",
    "CrossQFlow",
    "FlowActorCriticPolicy",
    "FlowCrossQPolicy",
    "FlowPolicy",
    "FlowTQCPolicy",
    "GaussCrossQPolicy",
    "GaussPolicy",
    "GaussTQCPolicy",
    "LowRankActorCriticPolicy",
    "LowRankCrossQPolicy",
    "LowRankPolicy",
    "LowRankTQCPolicy",
    "MultiInputFlowActorCriticPolicy",
    "MultiInputFlowPolicy",
    "MultiInputFlowTQCPolicy",
    "MultiInputGaussPolicy",
    "MultiInputGaussTQCPolicy",
    "MultiInputLowRankActorCriticPolicy",
    "MultiInputLowRankPolicy",
    "MultiInputLowRankTQCPolicy",
    "NonFiniteError",
    "PPOFlow",
    "RunCheckpointCallback",
    "SACFlow",
    "SeedBatch",
    "TQCFlow",
    "export_onnx",
    "has_checkpoint",
    "register_distribution",
]

_ELSEWHERE = {
    "ActionDistribution": "distributions",
    "BundleError": "bundle",
    "CnnFlowActorCriticPolicy": "policies.on_policy",
    "CnnFlowTQCPolicy": "policies.contrib",
    "CnnGaussTQCPolicy": "policies.contrib",
    "CnnLowRankActorCriticPolicy": "policies.on_policy",
    "CnnLowRankTQCPolicy": "policies.contrib",
    "CrossQFlow": "algorithms.crossq_flow",
    "FlowActorCriticPolicy": "policies.on_policy",
    "FlowCrossQPolicy": "policies.contrib",
    "FlowTQCPolicy": "policies.contrib",
    "GaussCrossQPolicy": "policies.contrib",
    "GaussTQCPolicy": "policies.contrib",
    "LowRankActorCriticPolicy": "policies.on_policy",
    "LowRankCrossQPolicy": "policies.contrib",
    "LowRankTQCPolicy": "policies.contrib",
    "MultiInputFlowActorCriticPolicy": "policies.on_policy",
    "MultiInputFlowTQCPolicy": "policies.contrib",
    "MultiInputGaussTQCPolicy": "policies.contrib",
    "MultiInputLowRankActorCriticPolicy": "policies.on_policy",
    "MultiInputLowRankTQCPolicy": "policies.contrib",
    "NonFiniteError": "guard",
    "PPOFlow": "algorithms.ppo_flow",
    "RunCheckpointCallback": "checkpoint",
    "SACFlow": "algorithms.sac_flow",
    "SeedBatch": "seeds.batch",
    "TQCFlow": "algorithms.tqc_flow",
    "export_onnx": "export",
    "has_checkpoint": "checkpoint",
    "register_distribution": "distributions",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = import_module(f"{__name__}.{_ELSEWHERE.get(name, 'policies')}")
    value = getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
