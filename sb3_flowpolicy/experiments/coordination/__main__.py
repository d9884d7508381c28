"""`python -m sb3_flowpolicy.experiments.coordination`: what correlated noise is worth."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sb3_flowpolicy.common.command_line import assignment, check_folder_of, run
from sb3_flowpolicy.experiments.coordination.families import FAMILIES

_DESCRIPTION = """\
Predict, without training, how much an agent gains from noise that correlates between fingers.

For an environment and its constants, this searches the best policy that presses with a constant
mean plus normal noise, squashed by tanh, once per family of noise:

  independent   one standard deviation per action, as in a diagonal Gaussian
  pink          the same, correlated in time
  rank 2        a diagonal plus two joint directions, as in the low-rank policy
  full          any covariance that suits the symmetry of the task; a flow can express it

Each policy maximizes SAC's objective at its stationary rate,

  V = (mean reward + ent_coef * entropy - failure * hazard) / (1 - gamma * (1 - hazard)),

with the hazard, the probability per step of dropping the square or breaking a finger. Trained
agents also react to what they observe, so their returns are higher: the differences between
families are a prediction, the values a lower bound. If the families do not differ here, do not
expect trained policies to differ.

Columns: median actions that press along x and y, V, entropy of the squashed actions (nats), hazard
per step, share of it in which a finger breaks, reward per step and its share of the reward for
holding, and, averaged over episodes after the warm-up, standard deviation of x, maximum of |x|,
maximum distance from the middle, and the share of episodes in which the goal was found. The second
table compares with independent noise: differences of V and entropy, ratios of the others."""
_EPILOG = """\
examples:
  coordination SquareMoveX-v1
  coordination SquareMoveX-v1 --set max_force=2.4 --task effort=0.1 angle=1
  coordination SquareHold-v1 --ent-coef 0.15
  coordination SquareFindGoal-v1 --budget 1000 --json prediction.json
each after `python -m sb3_flowpolicy.experiments.`

With the default budget, a family takes about half a minute on one core. The objective is noisy:
compare searches with other --seed values before you rely on a small difference. Needs the extra
[experiments]."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.experiments.coordination",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("env", metavar="ID", help="id of a Square, for example SquareMoveX-v1")
    pairs: dict[str, Any] = {"nargs": "*", "type": assignment, "default": []}
    add("--set", metavar="ARG=VALUE", help="arguments of the environment (YAML values)", **pairs)
    add("--task", metavar="TERM=VALUE", help="coefficients of the reward", **pairs)
    add("--ent-coef", type=float, default=0.05, help="entropy coefficient (default: 0.05)")
    add("--gamma", type=float, default=0.9, help="discount factor (default: 0.9)")
    some = f"some of {', '.join(map(repr, FAMILIES))} (default: all)"
    add("--families", nargs="+", choices=FAMILIES, default=FAMILIES, metavar="NAME", help=some)
    add("--budget", type=int, default=800, help="candidates per family (default: 800)")
    add("--episodes", type=int, default=48, help="episodes per candidate (default: 48)")
    add("--seed", type=int, default=0, help="seed of the search (default: 0)")
    add("--json", type=Path, metavar="FILE", help="also write the results to this file")
    args = parser.parse_args(arguments)
    check_folder_of(parser, "--json", args.json)
    # Slow imports that --help does not need.
    import pandas as pd
    from tqdm import tqdm

    from sb3_flowpolicy.common.files import write_json
    from sb3_flowpolicy.experiments.coordination.search import predict, setting_of

    names = ("ent_coef", "gamma", "episodes", "budget", "seed")
    options = {name: getattr(args, name) for name in names}
    try:
        setting = setting_of(args.env, dict(args.task), dict(args.set), **options)
    except (ValueError, TypeError) as error:
        parser.error(str(error))
    with tqdm(total=args.budget * len({"independent", *args.families}), unit=" policies") as bar:
        families = predict(setting, args.families, bar.update)
    table = pd.DataFrame.from_dict(families, orient="index")
    others, base = table.drop("independent"), table.loc["independent"]
    differences = others[["value", "entropy"]] - base[["value", "entropy"]]
    ratios = others[["x_std", "x_max", "found"]] / base[["x_std", "x_max", "found"]]
    print(table.to_string(float_format="{:.3f}".format))
    print("\nagainst independent noise:")
    print(differences.join(ratios).to_string(float_format="{:.2f}".format))
    if args.json is not None:
        given = {"env": args.env, "set": dict(args.set), "task": dict(args.task), **options}
        write_json(args.json, {"settings": given, "families": families})


if __name__ == "__main__":
    run(main)
