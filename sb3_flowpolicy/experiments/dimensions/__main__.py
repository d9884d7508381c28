"""`python -m sb3_flowpolicy.experiments.dimensions`: the prediction as a table and a figure."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from sb3_flowpolicy.common.command_line import HelpFormatter, check_folder_of
from sb3_flowpolicy.experiments.dimensions.prediction import (
    WIDTHS,
    bound,
    correlated,
    independent,
)


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
    print(
        f"{'D':>3}{'width':>9}{'uniform':>9}{'any density':>13}{'correlated':>12}"
        f"{'independent':>13}{'gap':>7}{'progress: correlated':>22}{'independent':>13}"
    )
    rows = []
    for dims, width in WIDTHS.items():
        alone = independent(dims, width, args.survival)
        joint = correlated(dims, width, args.survival)
        best, uniform = bound(dims, args.survival), dims * math.log(2.0)
        print(
            f"{dims:3d}{width:9.4f}{uniform:9.2f}{best:13.2f}{joint.entropy:12.2f}"
            f"{alone.entropy:13.2f}{joint.entropy - alone.entropy:7.2f}{joint.progress:22.3f}"
            f"{alone.progress:13.3f}"
        )
        rows.append(
            {
                "dims": dims,
                "width": width,
                "uniform": uniform,
                "bound": best,
                "correlated": asdict(joint),
                "independent": asdict(alone),
            }
        )
    if args.json is not None:
        from sb3_flowpolicy.common.files import write_json

        write_json(args.json, {"survival": args.survival, "rows": rows})
    if args.figure is not None:
        from sb3_flowpolicy.experiments.dimensions.figure import draw

        args.figure.write_bytes(draw(rows, args.survival))


if __name__ == "__main__":
    main()
