"""`python -m sb3_flowpolicy.diagnostics.curves`: draw test returns written by train_seeds."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sb3_flowpolicy.diagnostics.figures import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HEADER = "seed,step,test_return,std"


def read_evaluations(path: str | Path) -> np.ndarray:
    """Read an ``evaluations.csv`` as an array (rows, 4) of the columns of ``HEADER``."""
    header, *rows = Path(path).read_text().splitlines()
    if header != HEADER or not rows:
        raise ValueError(f"evaluations must start with {HEADER!r} and have rows, got {path}")
    return np.array([[float(value) for value in row.split(",")] for row in rows])


def curves_figure(evaluations: Mapping[str, np.ndarray]) -> Figure:
    """Draw each seed as a thin line and the mean over seeds as a thick one.

    Args:
        evaluations: Name of the agent -> its array of :func:`read_evaluations`.

    Example:
        >>> rows = np.array([[1, 100, 2.0, 0.1], [1, 200, 3.0, 0.1]])
        >>> len(curves_figure({"sac_flow": rows}).axes[0].lines)
        2
    """
    figure = new_figure(6.0, 3.6)
    axes = figure.add_subplot()
    for k, (name, rows) in enumerate(evaluations.items()):
        steps = np.unique(rows[:, 1])
        for seed in np.unique(rows[:, 0]):
            own = rows[rows[:, 0] == seed]
            axes.plot(own[:, 1], own[:, 2], color=f"C{k}", linewidth=0.8, alpha=0.6)
        means = [rows[rows[:, 1] == step, 2].mean() for step in steps]
        axes.plot(steps, means, color=f"C{k}", linewidth=2.2, label=name)
    axes.set(xlabel="environment steps", ylabel="test return")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    return figure


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.diagnostics.curves",
        description="Draw the test returns in files written by train_seeds --eval-freq.",
    )
    parser.add_argument("files", nargs="+", metavar="name=file.csv", help="agents and their files")
    parser.add_argument("-o", "--output", type=Path, required=True, help="picture to write")
    args = parser.parse_args(arguments)
    pairs = (entry.rpartition("=") for entry in args.files)
    evaluations = {name or Path(file).stem: read_evaluations(file) for name, _, file in pairs}
    curves_figure(evaluations).savefig(args.output, dpi=130)
    print(f"Curves: {args.output}")


if __name__ == "__main__":
    main()
