"""Former module of the TQC and CrossQ policies: models saved with it refer to its names."""

from sb3_flowpolicy.policies.crossq import *  # noqa: F403
from sb3_flowpolicy.policies.tqc import *  # noqa: F403
