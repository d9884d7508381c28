"""`python -m sb3_flowpolicy.diagnostics.curves`: draw the test returns of seeds."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sb3_flowpolicy.diagnostics.figures import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def curves_figure(files: Mapping[str, str | Path]) -> Figure:
    """Draw each seed as a thin line and the mean over seeds as a thick one.

    Args:
        files: Name of the agent -> its ``evaluations.csv``.

    Raises:
        ValueError: If a file lacks a column.
    """
    figure = new_figure(6.0, 3.6)
    axes = figure.add_subplot()
    for k, (name, file) in enumerate(files.items()):
        rows = np.genfromtxt(file, delimiter=",", names=True)
        returns = [rows["test_return"][rows["seed"] == seed] for seed in np.unique(rows["seed"])]
        steps = np.unique(rows["step"])
        axes.plot(steps, np.transpose(returns), color=f"C{k}", linewidth=0.8, alpha=0.4)
        axes.plot(steps, np.mean(returns, 0), color=f"C{k}", linewidth=2.2, label=name)
    axes.set(xlabel="environment steps", ylabel="test return")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    return figure


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.diagnostics.curves",
        description="Draw the test returns in files written by sb3_flowpolicy.seeds --eval-freq.",
    )
    parser.add_argument("files", nargs="+", metavar="name=file.csv", help="agents and their files")
    parser.add_argument("-o", "--output", type=Path, required=True, help="picture to write")
    args = parser.parse_args(arguments)
    pairs = (entry.rpartition("=") for entry in args.files)
    files = {name or Path(file).stem: file for name, _, file in pairs}
    curves_figure(files).savefig(args.output, dpi=130)
    print(f"Curves: {args.output}")


if __name__ == "__main__":
    main()
