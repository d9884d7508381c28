"""``python -m sb3_flowpolicy.benchmarks.stress``: train every density on hostile data.

Each case fills a replay buffer with transitions that no environment should produce, and trains on
them. The tests run the same cases for fewer updates.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch as th
from stable_baselines3.common.logger import configure

from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.benchmarks.updates import Unmoved
from sb3_flowpolicy.common.command_line import check_folder_of
from sb3_flowpolicy.common.files import replacing
from sb3_flowpolicy.distributions import registered_distributions
from sb3_flowpolicy.guard.finite import NonFiniteError
from sb3_flowpolicy.policies import FlowPolicy

N_TRANSITIONS, OBS_DIM = 1000, 5
UPDATES, UPDATES_PER_CHECK = 2000, 100


class Case(NamedTuple):
    """A condition under which training might diverge."""

    # Name of an array of the replay buffer -> what replaces it; that of the observations replaces
    # the next observations, too.
    change: Mapping[str, Callable[[np.ndarray], np.ndarray]] = MappingProxyType({})
    settings: Mapping[str, Any] = MappingProxyType({})  # additional arguments of SACFlow
    action_dim: int = 3


CASES = {
    "ordinary": Case(),
    "rewards of 1e6": Case({"rewards": lambda rewards: 1e6 * rewards}),
    "constant observations": Case({"observations": np.ones_like}),
    "observations of zero": Case({"observations": np.zeros_like}),
    "observations of 1e8": Case({"observations": lambda obs: 1e8 * obs}),
    "entropy coefficient 0": Case(settings={"ent_coef": 0.0}),
    "entropy coefficient 1e-12": Case(settings={"ent_coef": 1e-12}),
    "entropy coefficient 1e3": Case(settings={"ent_coef": 1e3}),
    "learned entropy coefficient, target 1000": Case(settings={"target_entropy": 1e3}),
    "learned entropy coefficient, target -1000": Case(settings={"target_entropy": -1e3}),
    "saturated actions": Case({"actions": np.sign}),
    "all actions the same": Case({"actions": lambda actions: np.full_like(actions, 0.3)}),
    "all actions 1": Case({"actions": np.ones_like}),
    "batch of 1": Case(settings={"batch_size": 1}),
    "one action": Case(action_dim=1),
    "one action, saturated": Case({"actions": np.sign}, action_dim=1),
    "seventeen actions": Case(action_dim=17),
    "learning rate 1e-2": Case(settings={"learning_rate": 1e-2}),
    "all at once": Case(
        {
            "observations": lambda obs: 1e8 * obs,
            "rewards": lambda rewards: 1e6 * rewards,
            "actions": np.sign,
        },
        {"learning_rate": 1e-2, "batch_size": 1},
    ),
}


class Outcome(NamedTuple):
    """Extremes over all checks of a case; ``failure`` is empty if everything stayed finite."""

    distribution: str
    case: str
    updates: int
    failure: str = ""
    largest_parameter: float = float("nan")
    largest_critic_loss: float = float("nan")
    lowest_log_prob: float = float("nan")
    highest_log_prob: float = float("nan")


def run_case(distribution: str, name: str, updates: int = UPDATES) -> Outcome:
    """Train a small agent with a density on a case, and check it every 100 updates.

    Example:
        >>> run_case("gaussian", "batch of 1", updates=100).failure
        ''
    """
    model = _model(distribution, CASES[name])
    logs, losses, largest = [], [], 0.0
    for done in range(0, updates, UPDATES_PER_CHECK):
        try:
            model.train(min(UPDATES_PER_CHECK, updates - done), model.batch_size)
            model._guard.look()
        except NonFiniteError as error:
            return Outcome(distribution, name, done, str(error))
        losses.append(model.logger.name_to_value["train/critic_loss"])
        largest = max(largest, float(np.abs(model.policy.parameters_to_vector()).max()))
        log_prob = _log_probabilities(model)
        if not log_prob.isfinite().all():
            return Outcome(distribution, name, done, "actions or log-probabilities not finite")
        logs += [log_prob.min().item(), log_prob.max().item()]
    return Outcome(distribution, name, updates, "", largest, max(losses), min(logs), max(logs))


def _model(distribution: str, case: Case) -> Any:
    settings = {"batch_size": 32, "learning_rate": 3e-4, **case.settings}
    model = SACFlow(
        FlowPolicy,
        Unmoved(OBS_DIM, case.action_dim),
        buffer_size=N_TRANSITIONS,
        compile=False,
        seed=0,
        device="cpu",
        policy_kwargs={"distribution": distribution, "net_arch": [32, 32]},
        **settings,
    )
    model.set_logger(configure(None, []))
    rng = np.random.default_rng(0)
    columns = {
        "observations": rng.normal(size=(N_TRANSITIONS, 1, OBS_DIM)),
        "next_observations": rng.normal(size=(N_TRANSITIONS, 1, OBS_DIM)),
        "actions": rng.uniform(-1, 1, (N_TRANSITIONS, 1, case.action_dim)),
        "rewards": rng.normal(size=(N_TRANSITIONS, 1)),
        "dones": (rng.random((N_TRANSITIONS, 1)) < 0.02).astype(float),
    }
    for key, column in columns.items():
        change = case.change.get(key.removeprefix("next_"), np.asarray)
        getattr(model.replay_buffer, key)[:] = change(column)
    model.replay_buffer.full = True  # type: ignore[union-attr]
    return model


@th.no_grad()
def _log_probabilities(model: Any) -> th.Tensor:
    """Score new and stored actions at observations from the buffer and far from them."""
    obs = th.as_tensor(model.replay_buffer.observations[:64, 0])
    obs = th.cat([obs, th.zeros_like(obs[:1]), th.full_like(obs[:1], 1e8)])
    actions, log_prob = model.actor.action_log_prob(obs)
    best = model.actor(obs, deterministic=True)
    stored = th.as_tensor(model.replay_buffer.actions[: len(obs), 0])
    scores = [model.actor.log_prob(obs, which) for which in (stored, actions, best)]
    outside = (th.cat([actions, best]).abs() <= 1).logical_not().any()
    return th.cat([log_prob, *scores, th.full((1,), float("nan") if outside else 0.0)])


def main(arguments: Sequence[str] | None = None) -> None:
    """Run all cases and print them; the exit status is 0 if everything stayed finite."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.benchmarks.stress",
        description=f"Train every registered density for {UPDATES} updates on hostile transitions "
        "and check that losses, parameters, optimizers, actions and log-probabilities stay finite.",
    )
    parser.add_argument("--csv", type=Path, help="also write the table to this file")
    args = parser.parse_args(arguments)
    check_folder_of(parser, "--csv", args.csv)
    th.set_num_threads(1)
    outcomes = []
    for distribution, name in product(registered_distributions(), CASES):
        outcome = run_case(distribution, name, UPDATES)
        outcomes.append(outcome)
        print(f"{distribution:16} {name:44} {outcome.failure or 'finite'}", flush=True)
    failed = sum(bool(outcome.failure) for outcome in outcomes)
    print(f"{len(outcomes) - failed} of {len(outcomes)} cases finite over {UPDATES} updates")
    if args.csv is not None:
        with replacing(args.csv) as draft:
            pd.DataFrame(outcomes).to_csv(draft, index=False, float_format="%.4g", na_rep="nan")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
