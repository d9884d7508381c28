"""`python -m sb3_flowpolicy.zoo.evaluate`: success rate and picture of a model trained by the zoo.

Reads what `python -m rl_zoo3.train` wrote, with the same options to name a run.
"""

import argparse
from pathlib import Path

from sb3_flowpolicy.diagnostics import evaluate_success, rollout_figure
from sb3_flowpolicy.zoo.registration import ALGORITHMS, register


def main(arguments: list[str] | None = None) -> None:
    """Evaluate the model that the command line names, print, and write the picture.

    Args:
        arguments: Command line without the program's name. Default: that of the process.

    Raises:
        ValueError: If there is no such model.
    """
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.zoo.evaluate",
        description="Print the success rate of a trained model and draw its policy.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--algo", default="sac_flow", choices=ALGORITHMS, help="algorithm")
    parser.add_argument("--env", default="TunnelDiagonal-v0", help="environment id")
    parser.add_argument("-f", "--folder", default="logs", help="log folder of the training")
    parser.add_argument("--exp-id", type=int, default=0, help="run number, 0 for the latest")
    parser.add_argument(
        "--load-best", action="store_true", help="take the best model, not the last"
    )
    parser.add_argument(
        "-n", "--n-episodes", type=int, default=100, help="episodes per success rate"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the evaluation")
    parser.add_argument(
        "-o", "--output", type=Path, help="picture (default: policy.png in the run)"
    )
    args = parser.parse_args(arguments)

    register()
    from huggingface_sb3 import EnvironmentName
    from rl_zoo3.utils import ALGOS, create_test_env, get_model_path, get_saved_hyperparams
    from stable_baselines3.common.utils import set_random_seed

    env_name = EnvironmentName(args.env)
    try:
        _, model_path, log_path = get_model_path(
            args.exp_id, args.folder, args.algo, env_name, args.load_best
        )
    except AssertionError as error:
        raise ValueError(f"folder must hold a run of {args.algo} on {args.env}: {error}") from error
    hyperparams, stats_path = get_saved_hyperparams(str(Path(log_path, env_name)), test_mode=True)
    set_random_seed(args.seed)
    env = create_test_env(
        env_name.gym_id,
        stats_path=stats_path,
        seed=args.seed,
        should_render=False,
        hyperparams=hyperparams,
        env_kwargs={**hyperparams.pop("env_kwargs", {}), "render_mode": "rgb_array"},
    )
    model = ALGOS[args.algo].load(model_path, device="cpu")

    print(f"{args.algo} on {args.env}, {args.n_episodes} episodes each ({model_path}):")
    for name, deterministic in {"deterministic": True, "stochastic": False}.items():
        success, mean_return = evaluate_success(model, env, args.n_episodes, deterministic)
        print(f"  {name:<13} success rate {success:4.0%}   mean return {mean_return:6.2f}")
    output = args.output or Path(log_path, "policy.png")
    rollout_figure(model, env).savefig(output, dpi=120)
    print(f"Picture of the policy: {output}")
    env.close()


if __name__ == "__main__":
    main()
