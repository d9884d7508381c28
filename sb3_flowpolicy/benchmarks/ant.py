"""``python -m sb3_flowpolicy.benchmarks.ant``: aggressive settings on AntBulletEnv-v0.

rl_zoo3 trains SAC there with a learning rate of 7.3e-4, at which expressive policies are said to
diverge. Ours train with the same settings, except for gSDE, and must stay finite.
"""

from __future__ import annotations

import argparse
import csv
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_flowpolicy.common.files import replacing
from sb3_flowpolicy.guard.finite import NonFiniteError
from sb3_flowpolicy.seeds.batch import SeedBatch

ENV_ID = "AntBulletEnv-v0"
POLICIES = {
    "sac_flow": "FlowPolicy",
    "sac_lowrank": "LowRankPolicy",
    "sac_gauss": "GaussPolicy",
}
# rl_zoo3 2.9.2, hyperparams/sac.yml, except for learning_starts (10 000 there): ours starts the
# updates early, so that a short run has many of them.
SETTINGS: dict[str, Any] = {
    "learning_rate": 7.3e-4,
    "buffer_size": 300_000,
    "batch_size": 256,
    "ent_coef": "auto",
    "gamma": 0.98,
    "tau": 0.02,
    "train_freq": 8,
    "gradient_steps": 8,
    "learning_starts": 1000,
    "policy_kwargs": {"net_arch": [400, 300]},
    "compile": True,
}
STEPS_PER_ROW = 1000
COLUMNS = ("seed", "step", "updates", "episodes", "train_return", "max_parameter", "ent_coef")


def train(algo: str, seeds: Sequence[int], steps: int, path: Path | None) -> bool:
    """Train all seeds in lockstep and record them every 1000 steps.

    Args:
        algo: Key of ``POLICIES``.
        seeds: Seeds.
        steps: Steps per seed.
        path: CSV file, rewritten after each 1000 steps.

    Returns:
        Whether everything stayed finite.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pybullet's bindings warn about SWIG types
        import_module("pybullet_envs_gymnasium")
    batch = SeedBatch(POLICIES[algo], ENV_ID, seeds, device="cpu", **SETTINGS)
    rows: list[tuple[object, ...]] = [COLUMNS]
    done = 0
    while done < steps:
        stage = min(STEPS_PER_ROW, steps - done)
        try:
            batch.learn(stage, reset_num_timesteps=done == 0, log_interval=None)
        except NonFiniteError as error:
            print(error, flush=True)
            return False
        done += stage
        for seed, model in zip(seeds, batch.models, strict=True):
            assert model.ep_info_buffer is not None
            assert model.log_ent_coef is not None
            returns = [episode["r"] for episode in model.ep_info_buffer][-10:]
            row = (
                seed,
                done,
                model._n_updates,
                model._episode_num,
                f"{np.mean(returns):.1f}" if returns else "",
                f"{np.abs(model.policy.parameters_to_vector()).max():.3g}",
                f"{model.log_ent_coef.exp().item():.3g}",
            )
            rows.append(row)
            print(*(f"{k}={v}" for k, v in zip(COLUMNS, row, strict=True)), flush=True)
        if path is not None:
            with replacing(path) as draft, draft.open("w") as file:
                csv.writer(file, lineterminator="\n").writerows(rows)
    return True


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; the exit status is 0 if everything stayed finite."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.benchmarks.ant",
        description=f"Train several seeds on {ENV_ID} with rl_zoo3's settings for SAC (learning "
        "rate 7.3e-4, networks of 400-300) and check that everything stays finite. Needs the "
        "extra [bullet].",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--algo", choices=list(POLICIES), default="sac_flow")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--steps", type=int, default=20_000, help="steps per seed")
    parser.add_argument("--csv", type=Path, help="also write the table to this file")
    args = parser.parse_args(arguments)
    th.set_num_threads(1)
    finite = train(args.algo, args.seeds, args.steps, args.csv)
    print("all finite" if finite else "not finite")
    sys.exit(0 if finite else 1)


if __name__ == "__main__":
    main()
