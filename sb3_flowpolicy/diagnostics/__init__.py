"""Looking at policies: TensorBoard dashboards, pictures, success rates."""

from sb3_flowpolicy.diagnostics.callback import PolicyDiagnosticsCallback
from sb3_flowpolicy.diagnostics.figures import correlation_figure, samples_figure
from sb3_flowpolicy.diagnostics.rollout import evaluate_success, rollout_figure

__all__ = [
    "PolicyDiagnosticsCallback",
    "correlation_figure",
    "evaluate_success",
    "rollout_figure",
    "samples_figure",
]
