"""All experiments: one entry per claim."""

from __future__ import annotations

from sb3_flowpolicy.experiments.experiment import Experiment
from sb3_flowpolicy.experiments.exploration_claims import EXPLORATION_CLAIMS
from sb3_flowpolicy.experiments.further_claims import BULLET_CLAIMS, SQUARE_CLAIMS
from sb3_flowpolicy.experiments.tunnel_claims import TUNNEL_CLAIMS
from sb3_flowpolicy.experiments.work import register_env

EXPERIMENTS: dict[str, Experiment] = {
    one.name: one for one in (*BULLET_CLAIMS, *TUNNEL_CLAIMS, *SQUARE_CLAIMS, *EXPLORATION_CLAIMS)
}
"""Name to experiment, in the order of the claims."""


def what_is_missing(experiment: Experiment) -> str | None:
    """Return what an experiment needs that is not installed; None if it can run."""
    try:
        for setting in experiment.settings:
            register_env(setting.env_id)
    except ModuleNotFoundError:
        return 'PyBullet: pip install "sb3_flowpolicy[bullet]"'
    return None
