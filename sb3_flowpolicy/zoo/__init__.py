"""Plug-in for rl_zoo3: algorithms, environments, hyperparameter files and Optuna samplers.

Once the package is installed, `python -m rl_zoo3.train --algo sac_flow …` needs nothing more: the
start-up hook calls `plug_in` for us. Without the hook, `python -m sb3_flowpolicy.zoo.train …` or,
in a program, `register` do the same.
"""

from sb3_flowpolicy.zoo.registration import (
    ALGORITHMS,
    hyperparameter_file,
    plug_in,
    register,
)

__all__ = ["ALGORITHMS", "hyperparameter_file", "plug_in", "register"]
