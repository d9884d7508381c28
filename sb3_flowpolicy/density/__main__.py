"""`python -m sb3_flowpolicy.density`: run the density fitting chapter and report on it."""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from pathlib import Path

from sb3_flowpolicy.common.command_line import at_least

EPILOG = """examples:
  python -m sb3_flowpolicy.density list
  python -m sb3_flowpolicy.density run two-moons-label          one study, ten seeds
  python -m sb3_flowpolicy.density run --quick                  everything, as a test
  python -m sb3_flowpolicy.density run && python -m sb3_flowpolicy.density report
"""
DEFAULT_FOLDER = Path("density_results")


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.density",
        description="Fit small normalizing flows to data in the plane, as in chapter 2.1 of the "
        "thesis, and compare their held-out likelihood with the exact entropy of the data.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="list|run|report")
    actions.add_parser("list", help="show the studies and the thesis's findings")
    run = actions.add_parser("run", help="fit, measure and draw; tables and pictures go to --out")
    add = run.add_argument
    add("names", nargs="*", metavar="NAME", help="studies (default: all)")
    add("--seeds", type=at_least(1), default=10, help="number of seeds (default: 10)")
    add("--first-seed", type=at_least(0), default=0, help="first seed (default: 0)")
    add("--quick", action="store_true", help="two seeds, hardly trained, within a minute")
    report = actions.add_parser("report", help="write README.md next to the results, and print it")
    for sub in (run, report):
        folder = f"folder of the results (default: {DEFAULT_FOLDER})"
        sub.add_argument("--out", type=Path, default=DEFAULT_FOLDER, help=folder)
    args = parser.parse_args(arguments)
    # Slow imports that --help does not need.
    try:
        from sb3_flowpolicy.common.files import write_text
        from sb3_flowpolicy.common.machine import machine
        from sb3_flowpolicy.density.report import write_report
        from sb3_flowpolicy.density.run import run_studies
        from sb3_flowpolicy.density.studies import FULL, QUICK, STUDIES
    except ModuleNotFoundError as error:
        parser.exit(1, f'{error}: pip install "sb3_flowpolicy[experiments]"\n')

    if args.action == "list":
        for study in STUDIES.values():
            print(f"{study.name} ({study.claim}): {study.title}")
            print(f"  models: {', '.join(study.epochs)}")
            print(f"  thesis: {study.thesis}\n")
        return
    try:
        if args.action == "report":
            print(write_report(args.out))
            return
        begin, commit = time.monotonic(), machine()["commit"] or "unknown (no source tree)"
        run_studies(
            args.names or list(STUDIES),
            range(args.first_seed, args.first_seed + (2 if args.quick else args.seeds)),
            QUICK if args.quick else FULL,
            args.out,
        )
        took = f"{(time.monotonic() - begin) / 60:.1f} minutes"
        given = sys.argv[1:] if arguments is None else arguments
        command = shlex.join(["python", "-m", "sb3_flowpolicy.density", *given])
        write_text(args.out / "origin.txt", f"Made by `{command}` at commit {commit}, in {took}.")
        print(f"{took}; results in {args.out}, to be read with: report --out {args.out}")
    except (ValueError, OSError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
