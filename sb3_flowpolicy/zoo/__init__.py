"""Plug-in for rl_zoo3: algorithms, environments, hyperparameter files and Optuna samplers.

`python -m rl_zoo3.train --algo sac_flow …` works once the package is installed, because the
start-up hook calls `plug_in`. Without the hook, use `python -m sb3_flowpolicy.zoo.train …` or, in a
program, `register`.
"""

from sb3_flowpolicy.common.hyperparameters import hyperparameter_file
from sb3_flowpolicy.zoo.registration import ALGORITHMS, plug_in, register

__all__ = ["ALGORITHMS", "hyperparameter_file", "plug_in", "register"]
