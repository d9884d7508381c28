"""`python -m sb3_flowpolicy.experiments.dimensions`: predictions, and the agents' results."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from sb3_flowpolicy.common.command_line import HelpFormatter, check_folder_of
from sb3_flowpolicy.common.files import write_json
from sb3_flowpolicy.experiments.dimensions.discovery import discovery
from sb3_flowpolicy.experiments.dimensions.prediction import FAMILIES, WIDTHS, best, bound


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.experiments.dimensions",
        description="Diagonal tunnels whose random first steps survive equally often: predict the "
        "highest entropy of independent and of correlated noise, and how often noise finds the "
        "goal. The figure shows the entropy, or with --results how many seeds find the goal and "
        "solve the task.",
        formatter_class=HelpFormatter,
    )
    survival = "probability with which a step of the policy survives"
    parser.add_argument("--survival", type=float, default=0.9, help=survival)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the results there")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="also draw them as PNG")
    results = "folder with results of diagonal-widened and diagonal-causes, to draw these instead"
    parser.add_argument("--results", type=Path, metavar="FOLDER", help=results)
    args = parser.parse_args(arguments)
    if not 0.0 < args.survival < 1.0:
        parser.error(f"--survival must be in (0, 1), got {args.survival}")
    if args.results is not None and args.figure is None:
        parser.error("--results needs --figure")
    for name in ("json", "figure"):
        check_folder_of(parser, f"--{name}", getattr(args, name))
    measured = None
    if args.figure is not None:
        # Slow imports that the table does not need.
        from sb3_flowpolicy.experiments.dimensions import figures

        try:
            measured = None if args.results is None else figures.read_results(args.results)
        except ValueError as error:
            parser.error(f"--results: {error}")
    rows = [
        {
            "dims": dims,
            "width": width,
            "uniform": dims * math.log(2.0),
            "bound": bound(dims, args.survival),
            "any": {"before_reward": discovery("any", dims, width)},
            **{
                name: best(name, dims, width, args.survival)
                | {"before_reward": discovery(name, dims, width)}
                for name in FAMILIES
            },
        }
        for dims, width in WIDTHS.items()
    ]
    table = pd.json_normalize(rows).set_index("dims")
    columns = ["width", "uniform", "bound"]
    columns += [f"{family}.{name}" for name in ("entropy", "progress") for family in FAMILIES]
    columns += [f"{family}.before_reward.goals" for family in ("any", *FAMILIES)]
    print(table[columns].to_string(float_format="{:.4f}".format))
    if args.json is not None:
        write_json(args.json, {"survival": args.survival, "rows": rows})
    if args.figure is not None:
        figure = (
            figures.prediction_figure(table, args.survival)
            if measured is None
            else figures.results_figure(table, measured)
        )
        figure.savefig(args.figure, dpi=110)


if __name__ == "__main__":
    main()
