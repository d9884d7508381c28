"""``python -m sb3_flowpolicy.benchmarks.algorithms``: TQC, CrossQ and PPO with our policies.

Each of our policy classes is trained beside the algorithm's own policy, with the same settings.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
import warnings
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize, sync_envs_normalization
from tqdm import tqdm

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy.common.command_line import HelpFormatter
from sb3_flowpolicy.common.files import replacing
from sb3_flowpolicy.policies import crossq, on_policy, tqc

# Algorithm -> its class, and the policies to compare; "stock" is the algorithm's own.
CANDIDATES: dict[str, tuple[Any, dict[str, Any]]] = {
    "tqc": (
        TQC,
        {
            "stock": "MlpPolicy",
            "gauss": tqc.GaussTQCPolicy,
            "lowrank": tqc.LowRankTQCPolicy,
            "flow": tqc.FlowTQCPolicy,
        },
    ),
    "crossq": (
        CrossQ,
        {
            "stock": "MlpPolicy",
            "gauss": crossq.GaussCrossQPolicy,
            "lowrank": crossq.LowRankCrossQPolicy,
            "flow": crossq.FlowCrossQPolicy,
        },
    ),
    # The "-squashed" policies bound actions by tanh, the others clip them as SB3's PPO does.
    "ppo": (
        PPO,
        {
            "stock": "MlpPolicy",
            "gauss": on_policy.GaussActorCriticPolicy,
            "lowrank": on_policy.LowRankActorCriticPolicy,
            "flow": on_policy.FlowActorCriticPolicy,
            "lowrank-squashed": on_policy.LowRankActorCriticPolicy,
            "flow-squashed": on_policy.FlowActorCriticPolicy,
        },
    ),
}


class Task(NamedTuple):
    """An environment with the number of steps and the settings of each algorithm."""

    env_id: str
    steps: dict[str, int]
    settings: dict[str, dict[str, Any]]
    env_kwargs: dict[str, Any] | None = None


_OFF_POLICY = {"learning_starts": 1000, "buffer_size": 100_000, "batch_size": 256}
_NARROW = {"net_arch": {"pi": [64, 64], "qf": [128, 128]}}
TASKS = {
    "pendulum": Task(
        "Pendulum-v1",
        {"tqc": 6000, "crossq": 6000, "ppo": 60_000},
        {
            "tqc": {**_OFF_POLICY, "learning_rate": 1e-3, "policy_kwargs": _NARROW},
            "crossq": {**_OFF_POLICY, "learning_rate": 1e-3, "policy_kwargs": _NARROW},
            # rl_zoo3's, without gSDE.
            "ppo": {
                "n_envs": 4,
                "n_steps": 1024,
                "gae_lambda": 0.95,
                "gamma": 0.9,
                "n_epochs": 10,
                "learning_rate": 1e-3,
            },
        },
    ),
    "half-cheetah": Task(
        "HalfCheetahBulletEnv-v0",
        {"tqc": 20_000, "crossq": 20_000, "ppo": 150_000},
        {
            "tqc": {**_OFF_POLICY, "gamma": 0.98, "learning_rate": 1e-3, "policy_kwargs": _NARROW},
            "crossq": {**_OFF_POLICY, "gamma": 0.98, "policy_kwargs": _NARROW},
            "ppo": {
                "n_envs": 8,
                "n_steps": 512,
                "batch_size": 128,
                "gae_lambda": 0.9,
                "learning_rate": 3e-4,
                "policy_kwargs": {"net_arch": [64, 64]},
                "normalize": True,
            },
        },
    ),
    "tunnel-2": Task(
        "TunnelDiagonal-v0",
        {"ppo": 120_000},
        {
            "ppo": {
                "n_envs": 8,
                "n_steps": 64,
                "batch_size": 128,
                "n_epochs": 10,
                "gamma": 0.8,
                "gae_lambda": 0.9,
                "learning_rate": 1e-3,
                "ent_coef": 0.01,
                "policy_kwargs": {"net_arch": [32, 32]},
            },
        },
        {"total_dims": 2, "coupled_dims": 2},
    ),
}
COLUMNS = ("task", "algorithm", "policy", "seed", "step", "test_return", "test_success", "seconds")
_N_TESTS = 6


def train(task: Task, algorithm: str, policy: str, seed: int, n_episodes: int) -> list[list[Any]]:
    """Train an agent and return the last four ``COLUMNS`` of six tests of ``n_episodes`` each."""
    algorithm_class, policies = CANDIDATES[algorithm]
    settings = dict(task.settings[algorithm])
    count, normalize = settings.pop("n_envs", 1), settings.pop("normalize", False)
    policy_kwargs = dict(settings.pop("policy_kwargs", {}))
    if policy.endswith("-squashed"):
        policy_kwargs["squash_output"] = True
    venv = make_vec_env(task.env_id, count, seed, env_kwargs=task.env_kwargs)
    test_venv = make_vec_env(task.env_id, 1, 10**6 + seed, env_kwargs=task.env_kwargs)
    if normalize:
        venv = VecNormalize(venv, gamma=settings.get("gamma", 0.99))
        test_venv = VecNormalize(test_venv, training=False, norm_reward=False)
    settings |= {"policy_kwargs": policy_kwargs, "seed": seed, "device": "cpu"}
    model = algorithm_class(policies[policy], venv, **settings)
    started, rows = time.perf_counter(), []
    for _ in range(_N_TESTS):
        model.learn(task.steps[algorithm] // _N_TESTS, reset_num_timesteps=False)
        if normalize:
            sync_envs_normalization(venv, test_venv)
        outcomes: list[bool] = []

        def note(local: dict[str, Any], _: dict[str, Any], outcomes: Any = outcomes) -> None:
            if local["done"] and "is_success" in local["info"]:
                outcomes.append(bool(local["info"]["is_success"]))

        mean_return, _ = evaluate_policy(model, test_venv, n_episodes, callback=note)
        success = f"{np.mean(outcomes):.2f}" if outcomes else ""
        seconds = round(time.perf_counter() - started)
        rows.append([model.num_timesteps, f"{mean_return:.2f}", success, seconds])
    venv.close()
    test_venv.close()
    return rows


def summary(rows: Sequence[Sequence[Any]]) -> str:
    """Return a table of the last tests: mean and all seeds."""
    finals: dict[tuple[str, ...], list[str]] = {}
    last = {tuple(row[:4]): row for row in rows}
    for (task, algorithm, policy, _), row in last.items():
        finals.setdefault((task, algorithm, policy), []).append(row[6] or row[5])
    lines = ["| task | algorithm | policy | mean | seeds |", "|---|---|---|---|---|"]
    for key, values in finals.items():
        mean = np.mean([float(value) for value in values])
        lines.append(f"| {' | '.join(key)} | {mean:.2f} | {', '.join(values)} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train the runs that the command line names and the file lacks, and print a table."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.benchmarks.algorithms",
        description="Train TQC, CrossQ and PPO with their own policies and with ours, and write "
        "every test to a CSV file. Runs that are in the file are not repeated. Needs the extra "
        "[contrib], and [bullet] for half-cheetah.",
        formatter_class=HelpFormatter,
    )
    add = parser.add_argument
    add("--task", choices=list(TASKS), default="pendulum")
    add("--algorithms", choices=list(CANDIDATES), nargs="+", help="default: all of the task's")
    add("--seeds", type=int, nargs="+", default=[1, 2, 3])
    add("--episodes", type=int, default=10, help="episodes per test")
    add("--csv", type=Path, default=Path("algorithms.csv"))
    args = parser.parse_args(arguments)
    th.set_num_threads(1)
    task = TASKS[args.task]
    if "Bullet" in task.env_id:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # pybullet's bindings warn about SWIG types
            import_module("pybullet_envs_gymnasium")
    rows = list(csv.reader(args.csv.open())) if args.csv.exists() else [list(COLUMNS)]
    done = {tuple(row[:4]) for row in rows}
    runs = [
        (args.task, algorithm, policy, str(seed))
        for algorithm in args.algorithms or task.steps
        for policy in CANDIDATES[algorithm][1]
        for seed in args.seeds
    ]
    for run in tqdm([run for run in runs if run not in done], file=sys.stderr):
        found = train(task, run[1], run[2], int(run[3]), args.episodes)
        rows += [[*run, *(str(value) for value in row)] for row in found]
        with replacing(args.csv) as draft, draft.open("w") as file:
            csv.writer(file, lineterminator="\n").writerows(rows)
    print(summary([row for row in rows[1:] if row[0] == args.task]))


if __name__ == "__main__":
    main()
