"""``python -m sb3_flowpolicy.benchmarks.ant``: aggressive settings on a real task, without NaN.

rl_zoo3 trains SAC on AntBulletEnv-v0 with a learning rate of 7.3e-4, where expressive policies are
said to fail. Here they get the same settings, but for what they cannot do: gSDE.
"""

from __future__ import annotations

import argparse
import csv
import sys
import warnings
from collections.abc import Sequence
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from sb3_flowpolicy.guard.finite import NonFiniteError
from sb3_flowpolicy.seeds.batch import SeedBatch

ENV_ID = "AntBulletEnv-v0"
POLICIES = {
    "sac_flow": "FlowPolicy",
    "sac_lowrank": "LowRankPolicy",
    "sac_gauss": "GaussPolicy",
}
# rl_zoo3 2.9.2, hyperparams/sac.yml. Ours: learning_starts, 10 000 there, so that nearly all of a
# short run are updates.
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
STEPS_BETWEEN_LOOKS = 1000
COLUMNS = ("seed", "step", "updates", "episodes", "train_return", "max_parameter", "ent_coef")


def train(algo: str, seeds: Sequence[int], steps: int, path: Path | None) -> bool:
    """Train all seeds in lockstep, look at them every 1000 steps, and write down what was seen.

    Args:
        algo: Key of ``POLICIES``.
        seeds: Seeds.
        steps: Steps per seed.
        path: CSV file to write, anew at each look.

    Returns:
        Whether everything stayed finite.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pybullet's bindings warn about SWIG types
        import_module("pybullet_envs_gymnasium")
    batch = SeedBatch(POLICIES[algo], ENV_ID, seeds, device="cpu", **SETTINGS)
    rows: list[list[object]] = []
    done = 0
    while done < steps:
        stage = min(STEPS_BETWEEN_LOOKS, steps - done)
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
            largest = float(np.abs(model.policy.parameters_to_vector()).max())
            row = (
                seed,
                done,
                model._n_updates,
                model._episode_num,
                f"{np.mean(returns):.1f}" if returns else "",
                f"{largest:.3g}",
                f"{model.log_ent_coef.exp().item():.3g}",
            )
            rows.append(list(row))
            print(*(f"{k}={v}" for k, v in zip(COLUMNS, row, strict=True)), flush=True)
        if path is not None:
            _write(path, rows)
    return True


def _write(path: Path, rows: Sequence[Sequence[object]]) -> None:
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([COLUMNS, *rows])
    draft = path.with_suffix(".tmp")
    draft.write_text(text.getvalue())
    draft.replace(path)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run what the command line asks for; the exit status says whether all stayed finite.

    Args:
        arguments: Command line without the program's name. Default: that of the process.
    """
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.benchmarks.ant",
        description=f"Train several seeds on {ENV_ID} with rl_zoo3's settings for SAC (learning "
        "rate 7.3e-4, networks of 400-300) and say whether all stayed finite. Needs the extra "
        "[bullet].",
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
