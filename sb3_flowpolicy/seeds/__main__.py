"""`python -m sb3_flowpolicy.seeds`: many seeds at once, from the zoo's hyperparameters."""

from __future__ import annotations

import argparse
import math
from functools import partial
from pathlib import Path

import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy.checkpoint import has_checkpoint
from sb3_flowpolicy.common.command_line import HelpFormatter, assignment, at_least, run
from sb3_flowpolicy.common.files import write_text
from sb3_flowpolicy.common.hyperparameters import load_hyperparameters
from sb3_flowpolicy.seeds.batch import SeedBatch

# Checkpoints of a run, besides those after each evaluation and at the end.
CHECKPOINTS = 10
_RESUME_HELP = (
    "continue the run in the folder, up to n-timesteps, with its own seeds and hyperparameters"
)


def main(arguments: list[str] | None = None) -> None:
    """Train, evaluate and save agents.

    Args:
        arguments: Command line without the program's name. Default: that of the process.

    Raises:
        ValueError: If an argument is out of range, or there is a run already in the folder.
    """
    args = _parser().parse_args(arguments)
    th.set_num_threads(args.num_threads)
    folder = Path(args.log_folder, args.algo, f"{args.env}_seeds")
    checkpoints = folder / "checkpoints"
    if args.resume:
        batch = SeedBatch.resume(checkpoints, args.env, monitor_dir=folder)
    elif has_checkpoint(checkpoints):
        raise ValueError(f"{folder} must be new, or --resume given to continue the run in it")
    else:
        batch = _new_batch(args, folder)
    total = args.n_timesteps or load_hyperparameters(args.algo, args.env)["n_timesteps"]
    evaluates = args.eval_freq is not None and args.eval_freq > 0
    every = args.eval_freq if evaluates else total
    done, first = batch.models[0].num_timesteps, True
    # A run that was interrupted before a test is tested first.
    ends = [*range(max(1, math.ceil(done / every)) * every, total, every), total]
    print(
        f"{args.algo} on {args.env}, seeds {batch.seeds}: {max(0, total - done)} steps each",
        flush=True,
    )
    for end in ends:
        if done < end:
            batch.learn(
                # The first call counts from zero, that of a resumed batch included.
                end if first else end - done,
                tb_log_name=f"{args.algo}_{args.env}",
                reset_num_timesteps=first,
                progress_bar=args.progress,
                checkpoint_every=max(1, total // CHECKPOINTS),
                checkpoint_path=checkpoints,
            )
            done, first = batch.models[0].num_timesteps, False
        returns = _test_returns(batch, args.env, args.eval_episodes)
        if evaluates:
            _record(folder / "evaluations.csv", batch.seeds, done, returns)
            print(f"  step {done:<8} test return {np.mean(returns):8.2f}", flush=True)
    for seed, model in zip(batch.seeds, batch.models, strict=True):
        model.save(folder / f"seed_{seed}.zip")
    _report(batch.seeds, returns)
    print(f"Saved to {folder}")


def _new_batch(args: argparse.Namespace, folder: Path) -> SeedBatch:
    settings = {**load_hyperparameters(args.algo, args.env), **dict(args.hyperparams)}
    settings.pop("n_timesteps", None)
    return SeedBatch(
        settings.pop("policy"),
        args.env,
        range(args.first_seed, args.first_seed + args.seeds),
        monitor_dir=folder,
        tensorboard_log=args.tensorboard_log,
        device="cpu",
        **settings,
    )


def _test_returns(batch: SeedBatch, env_id: str, n_episodes: int) -> np.ndarray:
    """Return each seed's deterministic returns, (S, n_episodes), on the same episodes."""
    returns = []
    for model in batch.models:
        env = make_vec_env(env_id, seed=0)
        rewards, _ = evaluate_policy(model, env, n_episodes, return_episode_rewards=True)
        returns.append(rewards)
        env.close()
    return np.asarray(returns)


def _record(path: Path, seeds: list[int], step: int, returns: np.ndarray) -> None:
    """Add a row per seed to the evaluations; those of a step that is repeated are replaced."""
    rows = path.read_text().splitlines() if path.exists() else ["seed,step,test_return,std"]
    rows[1:] = [row for row in rows[1:] if int(row.split(",")[1]) < step]
    rows += [
        f"{seed},{step},{row.mean():.6g},{row.std():.6g}"
        for seed, row in zip(seeds, returns, strict=True)
    ]
    write_text(path, "\n".join(rows) + "\n")


def _report(seeds: list[int], returns: np.ndarray) -> None:
    """Print the test return of each seed and of all."""
    for seed, row in zip(seeds, returns, strict=True):
        print(
            f"  seed {seed:<4} test return {row.mean():8.2f} +/- {row.std():.2f} "
            f"({len(row)} episodes)"
        )
    means = returns.mean(axis=1)
    print(f"  all       test return {np.mean(means):8.2f} +/- {np.std(means):.2f} over seeds")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.seeds",
        description="Train several seeds of an agent at once, for little more than the cost of "
        "one, with the hyperparameters that rl_zoo3 would use.",
        formatter_class=HelpFormatter,
    )
    add = parser.add_argument
    add("--algo", default="sac_flow", help="sac_flow, sac_lowrank or sac_gauss")
    add("--env", default="TunnelDiagonal-v0", help="environment id")
    add("--seeds", type=at_least(1), default=10, help="number of seeds")
    add("--first-seed", type=at_least(0), default=0, help="first of consecutive seeds")
    add("-n", "--n-timesteps", type=at_least(1), help="steps per seed (default: the file's)")
    add(
        *("-params", "--hyperparams"),
        type=partial(assignment, sign=":"),
        nargs="+",
        default=[],
        metavar="KEY:VALUE",
        help="overrides, the value in YAML",
    )
    add("-f", "--log-folder", default="logs", help="where to save agents and monitor files")
    add("-tb", "--tensorboard-log", help="TensorBoard folder, one run per seed")
    add("--eval-episodes", type=at_least(1), default=20, help="test episodes per seed at the end")
    add("--eval-freq", type=int, help="steps between tests, written to evaluations.csv")
    add(
        "--num-threads", type=at_least(1), default=1, help="torch threads; one suits small networks"
    )
    add("-P", "--progress", action="store_true", help="show a progress bar")
    add("--resume", action="store_true", help=_RESUME_HELP)
    return parser


if __name__ == "__main__":
    run(main)
