"""Registration of our algorithms with rl_zoo3, module by module."""

import functools
import importlib
import inspect
from collections.abc import Callable
from types import ModuleType
from typing import Any

from sb3_flowpolicy.common.hyperparameters import hyperparameter_file

_CLASSES = {
    "sac_flow": "SACFlow",
    "sac_lowrank": "SACFlow",
    "sac_gauss": "SACFlow",
    "tqc_flow": "TQCFlow",
    "crossq_flow": "CrossQFlow",
    "ppo_flow": "PPOFlow",
    "ppo_lowrank": "PPOFlow",
}
ALGORITHMS = tuple(_CLASSES)
"""Names for `--algo`. Each has a hyperparameter file, which names the policy."""

_MARK = "_knows_sb3_flowpolicy"


def register() -> None:
    """Register algorithms, environments, files and samplers with rl_zoo3 in this process.

    May be called repeatedly, and after rl_zoo3 was imported.

    Example:
        >>> register()
        >>> from rl_zoo3 import ALGOS
        >>> "sac_flow" in ALGOS
        True
    """
    for name in _PLUGS:
        plug_in(importlib.import_module(name))


def plug_in(module: ModuleType) -> None:
    """Extend one fully imported module of rl_zoo3 in place; ignore any other module."""
    plug = _PLUGS.get(module.__name__)
    if plug is not None:
        plug(module)


def _plug_into_utils(module: ModuleType) -> None:
    import flowpolicy_envs  # noqa: F401, registers the environments

    package = importlib.import_module("sb3_flowpolicy")
    module.ALGOS.update({name: getattr(package, kind) for name, kind in _CLASSES.items()})


def _plug_into_hyperparams_opt(module: ModuleType) -> None:
    from sb3_flowpolicy.zoo.samplers import CONVERTERS, SAMPLERS

    module.HYPERPARAMS_SAMPLER.update(SAMPLERS)
    module.HYPERPARAMS_CONVERTER.update(CONVERTERS)


def _plug_into_exp_manager(module: ModuleType) -> None:
    """Wrap `ExperimentManager.__init__`, which looks for default files in rl_zoo3 only."""
    init = module.ExperimentManager.__init__
    if hasattr(init, _MARK):
        return
    signature = inspect.signature(init)

    @functools.wraps(init)
    def wrapped(*args: Any, **kwargs: Any) -> None:
        call = signature.bind(*args, **kwargs)
        algorithm = call.arguments["algo"]
        if algorithm in ALGORITHMS and not call.arguments.get("config"):
            call.arguments["config"] = str(hyperparameter_file(algorithm))
        init(*call.args, **call.kwargs)

    setattr(wrapped, _MARK, True)
    module.ExperimentManager.__init__ = wrapped


_PLUGS: dict[str, Callable[[ModuleType], None]] = {
    "rl_zoo3.utils": _plug_into_utils,
    "rl_zoo3.hyperparams_opt": _plug_into_hyperparams_opt,
    "rl_zoo3.exp_manager": _plug_into_exp_manager,
}
