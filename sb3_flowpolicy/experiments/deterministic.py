"""``python -m sb3_flowpolicy.experiments.deterministic``: ways of acting deterministically."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import torch as th

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy.common.command_line import HelpFormatter
from sb3_flowpolicy.common.files import replacing
from sb3_flowpolicy.common.hyperparameters import load_hyperparameters
from sb3_flowpolicy.experiments.measures import DeterministicEpisodes, own_random_numbers
from sb3_flowpolicy.policies.deterministic import MODES
from sb3_flowpolicy.seeds.batch import SeedBatch

WAYS = (*MODES, "stochastic")
COLUMNS = ("env", "ent_coef", "seed", "step", "way", "success", "return")


def compare(
    env: str, seeds: Sequence[int], steps: int, every: int, episodes: int
) -> list[dict[str, object]]:
    """Train ``sac_flow`` and test each agent in each way of acting: rows of ``COLUMNS``.

    The entropy coefficient is learned. The environment has to report success.
    """
    settings = {**load_hyperparameters("sac_flow", env), "ent_coef": "auto"}
    del settings["n_timesteps"]
    batch = SeedBatch(settings.pop("policy"), env, seeds, device="cpu", **settings)
    tests = DeterministicEpisodes(env, len(seeds), episodes)
    rows: list[dict[str, object]] = []
    for step in range(every, steps + 1, every):
        batch.learn(every, reset_num_timesteps=step == every, log_interval=None)
        for way in WAYS:
            for model in batch.models:
                model.policy.deterministic_mode = way if way in MODES else "base"  # type: ignore[assignment]
            with own_random_numbers(step, *seeds):
                found = tests.run(batch.models, tuple(seeds), deterministic=way in MODES)
            for seed, (mean, success) in zip(seeds, found, strict=True):
                values = (env, settings["ent_coef"], seed, step, way, success, round(mean, 4))
                rows.append(dict(zip(COLUMNS, values, strict=True)))
        tested = pd.DataFrame(rows[-len(WAYS) * len(seeds) :])
        success = tested.pivot(index="way", columns="seed", values="success").loc[list(WAYS)]
        print(f"{env}, step {step}: success per seed\n{success}", flush=True)
    tests.close()
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Compare the ways on the environments of the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.experiments.deterministic",
        description="Train sac_flow and test it in four ways: the base mean, the best of 64 "
        "candidates by density, the best by the critics, and with exploration.",
        formatter_class=HelpFormatter,
    )
    parser.add_argument("--envs", nargs="+", default=["TunnelHorizontal-v0", "TunnelDiagonal-v0"])
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(101, 111)))
    parser.add_argument("--steps", type=int, default=60_000, help="steps per seed")
    parser.add_argument("--every", type=int, default=10_000, help="steps between two tests")
    parser.add_argument("--episodes", type=int, default=100, help="episodes per test and seed")
    parser.add_argument("--csv", type=Path, help="also write the table to this file")
    args = parser.parse_args(arguments)
    th.set_num_threads(1)
    rows: list[dict[str, object]] = []
    for env in args.envs:
        rows += compare(env, args.seeds, args.steps, args.every, args.episodes)
        if args.csv is not None:
            with replacing(args.csv) as draft:
                pd.DataFrame(rows).to_csv(draft, index=False)


if __name__ == "__main__":
    main()
