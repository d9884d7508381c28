"""``python -m sb3_flowpolicy.benchmarks.throughput``: all rates, against baselines, in one run."""

from __future__ import annotations

import argparse
import os
import pkgutil
from collections.abc import Sequence
from pathlib import Path

import torch as th

from sb3_flowpolicy.benchmarks.timing import Row, measure, table
from sb3_flowpolicy.common.command_line import at_least, check_folder_of
from sb3_flowpolicy.common.files import write_json
from sb3_flowpolicy.common.machine import machine

# Group -> what returns its benchmarks, in the order in which they run: zuko, which changes torch
# for the whole process when imported, comes last.
GROUPS = {
    "updates": "updates:benchmarks",
    "contrib": "updates:contrib",
    "learn": "learning:benchmarks",
    "her": "learning:with_hindsight",
    "acting": "acting:benchmarks",
    "environments": "environments:benchmarks",
    "flow": "flows:benchmarks",
}
# Increase it when a field of the JSON file changes its meaning.
SCHEMA = 1

_DESCRIPTION = """\
Measure the speed of sb3_flowpolicy and of its baselines on this machine.

  updates       gradient updates per second (batch 256): SACFlow and ten stacked seeds against
                SB3's SAC (and SBX where installed) and against the matrix products alone
  contrib       gradient updates per second of TQCFlow and CrossQFlow against sb3-contrib's TQC
                and CrossQ
  learn         environment steps per second of learn(): SACFlow on TunnelDiagonal-v0 and PPOFlow
                on Pendulum-v1 and HalfCheetah against SB3's
  her           the same with hindsight experience replay and dictionary observations
  acting        calls of predict() per second: SAC and PPO, for one observation and for 100;
                steps per second of EvalCallback
  environments  steps per second of the environments, single and in batches of 64
  flow          RealNVP forward and backward against zuko's

Candidates run in turns (A B C, A B C, ...), so that other load on the machine slows all of them
alike. Rates are medians over the rounds; "x baseline" is the median of the ratios within rounds
to the first line of each table; "of limit" is the fraction of the rate of the products alone."""
_EPILOG = """\
examples:
  python -m sb3_flowpolicy.benchmarks.throughput --quick
  python -m sb3_flowpolicy.benchmarks.throughput --json throughput.json
  python -m sb3_flowpolicy.benchmarks.throughput --only updates --threads 1 --json updates.json

A full run takes about ten minutes, most of which is compilation. Between machines, compare
ratios instead of rates, and only with equal "threads"."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.benchmarks.throughput",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--json", type=Path, metavar="FILE", help="also write all results to this file")
    only = f"measure one group: {', '.join(GROUPS)}; may be repeated (default: all)"
    add("--only", action="append", choices=list(GROUPS), metavar="GROUP", help=only)
    add(
        "--threads",
        type=at_least(1),
        help=f"threads of torch (default here: {th.get_num_threads()})",
    )
    quick = "a trial of less than a minute, with few rows and short turns: do not quote its rates"
    add("--quick", action="store_true", help=quick)
    args = parser.parse_args(arguments)
    check_folder_of(parser, "--json", args.json)
    if args.threads is not None:
        th.set_num_threads(args.threads)

    rounds, turn_seconds = (5, 0.02) if args.quick else (7, 0.5)
    settings = {"quick": args.quick, "rounds": rounds, "turn_seconds": turn_seconds}
    here = machine()
    print(
        f"{here['processor']}, {os.cpu_count()} cores, {here['threads']} thread(s), "
        f"load {here['load_average']}, {rounds} rounds\n"
    )
    found: list[Row] = []
    for group in (name for name in GROUPS if name in (args.only or GROUPS)):
        benchmarks = pkgutil.resolve_name(f"sb3_flowpolicy.benchmarks.{GROUPS[group]}")
        for benchmark in benchmarks(args.quick):
            new = measure(group, benchmark, rounds, turn_seconds)
            found += new
            print(table(new), end="\n\n", flush=True)
            if args.json is not None:  # after each benchmark: an interrupted run keeps its results
                content = {"schema": SCHEMA, "machine": here, "settings": settings, "rows": found}
                write_json(args.json, content)


if __name__ == "__main__":
    main()
