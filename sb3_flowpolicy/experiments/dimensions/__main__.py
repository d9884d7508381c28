"""`python -m sb3_flowpolicy.experiments.dimensions`: the prediction as a table and a figure."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from sb3_flowpolicy.common.command_line import HelpFormatter, check_folder_of
from sb3_flowpolicy.common.files import write_json
from sb3_flowpolicy.experiments.dimensions.prediction import FAMILIES, WIDTHS, best, bound


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.experiments.dimensions",
        description="Predict the highest entropy of independent and of correlated noise in "
        "diagonal tunnels whose random first steps survive equally often.",
        formatter_class=HelpFormatter,
    )
    survival = "probability with which a step of the policy survives"
    parser.add_argument("--survival", type=float, default=0.9, help=survival)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the results there")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="also draw them as PNG")
    args = parser.parse_args(arguments)
    if not 0.0 < args.survival < 1.0:
        parser.error(f"--survival must be in (0, 1), got {args.survival}")
    for name in ("json", "figure"):
        check_folder_of(parser, f"--{name}", getattr(args, name))
    rows = [
        {
            "dims": dims,
            "width": width,
            "uniform": dims * math.log(2.0),
            "bound": bound(dims, args.survival),
            **{name: best(name, dims, width, args.survival) for name in FAMILIES},
        }
        for dims, width in WIDTHS.items()
    ]
    table = pd.json_normalize(rows).set_index("dims")
    told = ["width", "uniform", "bound"]
    told += [f"{family}.{what}" for what in ("entropy", "progress") for family in FAMILIES]
    print(table[told].to_string(float_format="{:.4f}".format))
    if args.json is not None:
        write_json(args.json, {"survival": args.survival, "rows": rows})
    if args.figure is not None:
        _draw(table, args.figure, args.survival)


def _draw(table: pd.DataFrame, path: Path, survival: float) -> None:
    """Draw entropy and progress by number of dimensions."""
    # Slow imports that the table does not need.
    from sb3_flowpolicy.diagnostics.figures import new_figure
    from sb3_flowpolicy.experiments.experiment import GAUSS, LOW_RANK

    figure = new_figure(9.0, 3.4)
    left, right = figure.subplots(1, 2)
    for label, name, shade in (
        ("any density", "bound", "#555555"),
        ("LR (any rank), full covariance", "correlated", LOW_RANK.color),
        ("Gauss", "independent", GAUSS.color),
    ):
        entropy = table.get(f"{name}.entropy", table["bound"])
        left.plot(entropy - table["uniform"], "o-", color=shade, label=label, markersize=4)
        if name != "bound":
            right.plot(table[f"{name}.progress"], "o-", color=shade, markersize=4)
    left.set(title="highest entropy, less that of the uniform density", ylabel="nats")
    right.set(title="standard deviation of the progress of a step", ylabel="share of the reach")
    for axes in (left, right):
        axes.set_xscale("log", base=2)
        axes.set_xticks(table.index, table.index.astype(str))
        axes.minorticks_off()
        axes.set_xlabel(f"coupled dimensions; {survival:.0%} of the steps survive")
        axes.grid(color="#eeeeee")
    right.set_ylim(bottom=0.0)
    left.legend(frameon=False)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
