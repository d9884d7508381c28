"""`python -m sb3_flowpolicy.zoo.evaluate`: success rate and picture of a trained model."""

from pathlib import Path

from sb3_flowpolicy.common.command_line import at_least, run
from sb3_flowpolicy.diagnostics import evaluate_success, rollout_figure
from sb3_flowpolicy.zoo.saved_run import load_run, run_parser


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    description = "Print the success rate of a trained model and draw its policy."
    parser = run_parser("evaluate", description)
    add = parser.add_argument
    add("-n", "--n-episodes", type=at_least(1), default=100, help="episodes per success rate")
    add("-o", "--output", type=Path, help="picture (default: policy.png next to the model)")
    args = parser.parse_args(arguments)

    model, env, path = load_run(args)
    print(f"{args.algo} on {args.env}, {args.n_episodes} episodes each ({path}):")
    for name, deterministic in {"deterministic": True, "stochastic": False}.items():
        success, mean_return = evaluate_success(model, env, args.n_episodes, deterministic)
        print(f"  {name:<13} success rate {success:4.0%}   mean return {mean_return:6.2f}")
    output = args.output or path.parent / "policy.png"
    rollout_figure(model, env).savefig(output, dpi=120)
    print(f"Picture of the policy: {output}")
    env.close()


if __name__ == "__main__":
    run(main)
