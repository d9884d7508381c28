"""Optuna search spaces: rl_zoo3's for SAC, TQC and PPO, plus the shape of the action distribution.

rl_zoo3 replaces the `policy_kwargs` of the YAML file by the sampled ones. Ours are merged into
them, so that weight decay, for example, stays as configured. For `--trial-id`, rl_zoo3 passes only
the parameters of the trial to the converter; the configured values are therefore stored as one.
"""

import ast
import json
import warnings
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import optuna

Sampler = Callable[["optuna.Trial", int, int, dict[str, Any]], dict[str, Any]]

FLOW_HIDDEN = {"small": [10, 10], "medium": [32, 32]}
"""Units of a coupling layer's conditioner; the thesis uses "small"."""

_KEPT = "kept_policy_kwargs"
_TUNED = ("layers", "hidden", "rank")


def convert(params: dict[str, Any], off_policy: bool = True) -> dict[str, Any]:
    """Turn the parameters of a trial into keyword arguments of the algorithm.

    Example:
        >>> params = dict(one_minus_gamma=0.02, net_arch="small", rank=3)
        >>> convert(params)["policy_kwargs"]
        {'net_arch': [64, 64], 'distribution_kwargs': {'rank': 3}}
    """
    from rl_zoo3 import hyperparams_opt

    theirs = {name: value for name, value in params.items() if name not in (_KEPT, *_TUNED)}
    kind = "offpolicy" if off_policy else "onpolicy"
    return _complete(getattr(hyperparams_opt, f"convert_{kind}_params")(theirs), params)


def _sampler(suggest: Callable[["optuna.Trial", int], None], algorithm: str = "sac") -> Sampler:
    """Extend rl_zoo3's sampler of an algorithm by `suggest`."""

    def sample(
        trial: "optuna.Trial", n_actions: int, n_envs: int, additional_args: dict[str, Any]
    ) -> dict[str, Any]:
        from rl_zoo3 import hyperparams_opt

        theirs = getattr(hyperparams_opt, f"sample_{algorithm}_params")
        hyperparams = theirs(trial, n_actions, n_envs, additional_args)
        suggest(trial, n_actions)
        trial.suggest_categorical(_KEPT, [json.dumps(_configured_policy_kwargs(trial))])
        return _complete(hyperparams, trial.params)

    return sample


def _suggest_flow(trial: "optuna.Trial", n_actions: int) -> None:
    trial.suggest_categorical("layers", [2, 4, 6])
    trial.suggest_categorical("hidden", list(FLOW_HIDDEN))


def _suggest_lowrank(trial: "optuna.Trial", n_actions: int) -> None:
    # A rank beyond the number of actions adds parameters but no covariance.
    trial.suggest_int("rank", 1, min(4, n_actions))


def _complete(hyperparams: dict[str, Any], params: dict[str, Any]) -> dict[str, Any]:
    """Merge the sampled `policy_kwargs` and distribution into the configured ones."""
    kept = json.loads(params.get(_KEPT, "{}"))
    tuned = {name: params[name] for name in _TUNED if name in params}
    if "hidden" in tuned:
        tuned["hidden"] = FLOW_HIDDEN[tuned["hidden"]]
    policy_kwargs = {**kept, **hyperparams["policy_kwargs"]}
    if tuned:
        policy_kwargs["distribution_kwargs"] = {**kept.get("distribution_kwargs", {}), **tuned}
    return {**hyperparams, "policy_kwargs": policy_kwargs}


def _configured_policy_kwargs(trial: "optuna.Trial") -> dict[str, Any]:
    """Read the YAML file's `policy_kwargs`, which rl_zoo3 stores in the study as text."""
    text = trial.study.user_attrs.get("policy_kwargs", "{}")
    try:
        return ast.literal_eval(text)
    except (SyntaxError, ValueError):
        warnings.warn(
            "policy_kwargs must be plain numbers, strings and lists to be kept while "
            f"tuning, got {text}: only the sampled ones are used",
            stacklevel=2,
        )
        return {}


SAMPLERS: dict[str, Sampler] = {
    "sac_flow": _sampler(_suggest_flow),
    "sac_lowrank": _sampler(_suggest_lowrank),
    "sac_gauss": _sampler(lambda trial, n_actions: None),
    "tqc_flow": _sampler(_suggest_flow, "tqc"),
    "ppo_flow": _sampler(_suggest_flow, "ppo"),
    "ppo_lowrank": _sampler(_suggest_lowrank, "ppo"),
}
"""For `--optimize`."""

CONVERTERS: dict[str, Callable[[dict[str, Any]], dict[str, Any]]] = {
    name: partial(convert, off_policy=not name.startswith("ppo")) for name in SAMPLERS
}
