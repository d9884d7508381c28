"""TensorBoard dashboard, pictures and success rates of policies."""

from sb3_flowpolicy.diagnostics.callback import PolicyDiagnosticsCallback
from sb3_flowpolicy.diagnostics.episodes import evaluate_success, rollout_figure
from sb3_flowpolicy.diagnostics.figures import correlation_figure, samples_figure

__all__ = [
    "PolicyDiagnosticsCallback",
    "correlation_figure",
    "evaluate_success",
    "rollout_figure",
    "samples_figure",
]
