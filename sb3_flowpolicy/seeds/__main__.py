"""`python -m sb3_flowpolicy.seeds`: many seeds at once, from the zoo's hyperparameters."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
import yaml
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy.common.hyperparameters import load_hyperparameters
from sb3_flowpolicy.seeds.batch import SeedBatch


def main(arguments: list[str] | None = None) -> None:
    """Train, evaluate and save as the command line says.

    Args:
        arguments: Command line without the program's name. Default: that of the process.

    Raises:
        ValueError: If an argument is out of range.
    """
    args = _parser().parse_args(arguments)
    th.set_num_threads(args.num_threads)
    folder = Path(args.log_folder, args.algo, f"{args.env}_seeds")
    if args.resume:
        batch = SeedBatch.load(folder, args.env, monitor_dir=None)
        done = batch.models[0].num_timesteps
    else:
        batch, done = _new_batch(args, folder), 0
    total = args.n_timesteps or load_hyperparameters(args.algo, args.env)["n_timesteps"]
    print(f"{args.algo} on {args.env}, seeds {batch.seeds}: {total - done} steps each", flush=True)
    while done < total:
        stage = min(args.eval_freq or total, total - done)
        batch.learn(
            stage,
            tb_log_name=f"{args.algo}_{args.env}",
            reset_num_timesteps=not done,
            progress_bar=args.progress,
        )
        done += stage
        if args.eval_freq:
            returns = _test_returns(batch, args.env, args.eval_episodes)
            _append(folder / "evaluations.csv", batch.seeds, done, returns)
            print(f"  step {done:<8} test return {np.mean(returns):8.2f}", flush=True)
    batch.save(folder)
    _report(batch, args.env, args.eval_episodes)
    print(f"Saved to {folder}")


def _new_batch(args: argparse.Namespace, folder: Path) -> SeedBatch:
    settings = {**load_hyperparameters(args.algo, args.env), **_overrides(args.hyperparams)}
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


def _overrides(pairs: list[str]) -> dict[str, Any]:
    """Read ``key:value``, the value as YAML."""
    settings = {}
    for pair in pairs:
        key, separator, value = pair.partition(":")
        if not separator:
            raise ValueError(f"hyperparams must be of the form key:value, got {pair!r}")
        try:
            settings[key] = yaml.safe_load(value)
        # Recursion: brackets in brackets in brackets ...
        except (yaml.YAMLError, ValueError, TypeError, RecursionError) as error:
            raise ValueError(f"hyperparams must have YAML values, got {pair[:80]!r}") from error
    return settings


def _test_returns(batch: SeedBatch, env_id: str, n_episodes: int) -> np.ndarray:
    """Return each seed's deterministic returns, (S, n_episodes), on the same episodes."""
    returns = []
    for model in batch.models:
        env = make_vec_env(env_id, seed=0)
        rewards, _ = evaluate_policy(model, env, n_episodes, return_episode_rewards=True)
        returns.append(rewards)
        env.close()
    return np.asarray(returns)


def _append(path: Path, seeds: list[int], step: int, returns: np.ndarray) -> None:
    """Append a row per seed to the file of evaluations."""
    rows = [
        f"{seed},{step},{row.mean():.6g},{row.std():.6g}\n"
        for seed, row in zip(seeds, returns, strict=True)
    ]
    known = path.read_text() if path.exists() else "seed,step,test_return,std\n"
    # Written whole, then renamed: an interrupted run leaves no half rows.
    draft = path.with_suffix(".tmp")
    draft.write_text(known + "".join(rows))
    draft.replace(path)


def _report(batch: SeedBatch, env_id: str, n_episodes: int) -> None:
    """Print the test return of each seed, the best and the worst alike."""
    returns = _test_returns(batch, env_id, n_episodes)
    for seed, row in zip(batch.seeds, returns, strict=True):
        print(
            f"  seed {seed:<4} test return {row.mean():8.2f} +/- {row.std():.2f} "
            f"({n_episodes} episodes)"
        )
    means = returns.mean(axis=1)
    print(f"  all       test return {np.mean(means):8.2f} +/- {np.std(means):.2f} over seeds")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.seeds",
        description="Train several seeds of an agent at once, for little more than the price of "
        "one, with the hyperparameters that rl_zoo3 would use.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    add = parser.add_argument
    add("--algo", default="sac_flow", help="sac_flow, sac_lowrank or sac_gauss")
    add("--env", default="TunnelDiagonal-v0", help="environment id", type=_known_env)
    add("--seeds", type=int, default=10, help="number of seeds")
    add("--first-seed", type=int, default=0, help="the seeds are this one and those after it")
    add("-n", "--n-timesteps", type=int, help="steps per seed (default: the file's)")
    add("-params", "--hyperparams", nargs="+", default=[], help="overrides, as key:value")
    add("-f", "--log-folder", default="logs", help="where to save agents and monitor files")
    add("-tb", "--tensorboard-log", help="TensorBoard folder, one run per seed")
    add("--eval-episodes", type=int, default=20, help="test episodes per seed at the end")
    add("--eval-freq", type=int, help="steps between tests, written to evaluations.csv")
    add("--num-threads", type=int, default=1, help="torch threads; small networks like one best")
    add("-P", "--progress", action="store_true", help="show a progress bar")
    add("--resume", action="store_true", help="go on with the saved batch, up to n-timesteps")
    return parser


def _known_env(env_id: str) -> str:
    try:
        gym.spec(env_id)
    except gym.error.Error as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return env_id


if __name__ == "__main__":
    main()
