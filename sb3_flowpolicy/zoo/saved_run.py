"""Load models that `rl_zoo3.train` or `sb3_flowpolicy.seeds` saved, with their environments."""

import argparse
from pathlib import Path

import yaml
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_flowpolicy.common.command_line import HelpFormatter
from sb3_flowpolicy.zoo.registration import ALGORITHMS, register


def run_parser(command: str, description: str) -> argparse.ArgumentParser:
    """Return a parser with the options that select a run, named as in `rl_zoo3.enjoy`."""
    parser = argparse.ArgumentParser(
        prog=f"python -m sb3_flowpolicy.zoo.{command}",
        description=description,
        formatter_class=HelpFormatter,
    )
    add = parser.add_argument
    add("--algo", default="sac_flow", choices=ALGORITHMS, help="algorithm")
    add("--env", default="TunnelDiagonal-v0", help="environment id")
    add("-f", "--folder", default="logs", help="log folder of the training")
    add("--exp-id", type=int, default=0, help="run number, 0 for the latest")
    add("--load-best", action="store_true", help="take the best model, not the last")
    add("--model", type=Path, help="a model's zip file, instead of a run of rl_zoo3")
    add("--seed", type=int, default=0, help="seed of the episodes")
    return parser


def load_run(args: argparse.Namespace) -> tuple[BaseAlgorithm, VecEnv, Path]:
    """Load the run that the options of `run_parser` select.

    Returns:
        The model, one environment that renders `rgb_array`, and the model's file.
    """
    register()
    from huggingface_sb3 import EnvironmentName
    from rl_zoo3.utils import ALGOS, create_test_env, get_model_path, get_saved_hyperparams
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.utils import set_random_seed

    set_random_seed(args.seed)
    if args.model is not None:
        env = make_vec_env(args.env, seed=args.seed, env_kwargs={"render_mode": "rgb_array"})
        return ALGOS[args.algo].load(args.model, device="cpu"), env, args.model
    env_name = EnvironmentName(args.env)
    _, model_path, log_path = get_model_path(
        args.exp_id, args.folder, args.algo, env_name, args.load_best
    )
    settings = Path(log_path, env_name)
    hyperparams, stats_path = get_saved_hyperparams(str(settings), test_mode=True)
    env_kwargs = hyperparams.pop("env_kwargs", {})
    # Arguments of the command line, which rl_zoo3 stores elsewhere.
    if (settings / "args.yml").is_file():
        env_kwargs |= yaml.unsafe_load((settings / "args.yml").read_text())["env_kwargs"] or {}
    env = create_test_env(
        env_name.gym_id,
        stats_path=stats_path,
        seed=args.seed,
        should_render=False,
        hyperparams=hyperparams,
        env_kwargs={**env_kwargs, "render_mode": "rgb_array"},
    )
    return ALGOS[args.algo].load(model_path, device="cpu"), env, Path(model_path)
