"""``python -m sb3_flowpolicy.benchmarks.throughput``: all rates, against baselines, in one run."""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

import torch as th

from sb3_flowpolicy.benchmarks.report import Row, rows, table, write_results
from sb3_flowpolicy.benchmarks.timing import MIN_ROUNDS, Progress, measure
from sb3_flowpolicy.common.machine import machine

# Group -> module with its benchmarks, in the order in which they run: zuko, which changes torch
# for the whole process when imported, comes last.
GROUPS = {
    "updates": "updates",
    "learn": "learning",
    "environments": "environments",
    "trust": "trust",
    "flow": "flows",
}
ROUNDS, TURN_SECONDS = 7, 0.5
SECONDS_PER_LINE = 5.0
QUICK_ROUNDS, QUICK_TURN_SECONDS = MIN_ROUNDS, 0.02

_DESCRIPTION = """\
Measure the speed of sb3_flowpolicy and of its baselines on this machine.

  updates       gradient updates per second (batch 256): SACFlow and ten stacked seeds against
                SB3's SAC (and SBX where installed) and against the matrix products alone
  learn         environment steps per second of learn() on TunnelDiagonal-v0
  environments  steps per second of the environments, single and in batches of 64
  trust         steps per second of learn() with and without the training guard; calls of predict
                per second in each deterministic_mode, 64 actions to choose from
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
    parser = _parser()
    args = parser.parse_args(arguments)
    if args.threads < 1:
        parser.error(f"--threads must be at least 1, got {args.threads}")
    if args.rounds is not None and args.rounds < MIN_ROUNDS:
        parser.error(f"--rounds must be at least {MIN_ROUNDS}, got {args.rounds}")
    if args.json is not None and not args.json.absolute().parent.is_dir():
        parser.error(f"--json must name a file in an existing directory, got {args.json}")
    rounds = args.rounds or (QUICK_ROUNDS if args.quick else ROUNDS)
    turn_seconds = QUICK_TURN_SECONDS if args.quick else TURN_SECONDS

    before = th.get_num_threads()
    th.set_num_threads(args.threads)
    try:
        _run(args.only or list(GROUPS), rounds, turn_seconds, args.quick, args.json)
    finally:
        th.set_num_threads(before)


def _run(
    groups: Sequence[str], rounds: int, turn_seconds: float, quick: bool, path: Path | None
) -> None:
    settings = {"quick": quick, "rounds": rounds, "turn_seconds": turn_seconds}
    content = {"machine": machine(), "settings": settings}
    print(
        f"{content['machine']['processor']}, {os.cpu_count()} cores, {th.get_num_threads()} "
        f"thread(s), load {content['machine']['load_average']}, {rounds} rounds\n"
    )
    found: list[Row] = []
    for group in (name for name in GROUPS if name in groups):
        module = import_module(f"sb3_flowpolicy.benchmarks.{GROUPS[group]}")
        for benchmark in module.benchmarks(quick):
            progress = _progress(benchmark.title)
            new = rows(
                group, benchmark, measure(benchmark, rounds, turn_seconds, progress=progress)
            )
            found += new
            print(table(new), end="\n\n", flush=True)
            if path is not None:  # after each benchmark: an interrupted run keeps its results
                write_results(path, content, found)


def _progress(title: str) -> Progress:
    """Print a line to stderr every few seconds."""
    last_line = -math.inf

    def show(name: str, done: int, total: int) -> None:
        nonlocal last_line
        if time.monotonic() - last_line > SECONDS_PER_LINE:
            last_line = time.monotonic()
            print(f"{title}: {done}/{total} {name}", file=sys.stderr, flush=True)

    return show


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.benchmarks.throughput",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--json", type=Path, metavar="FILE", help="also write all results to this file")
    add(
        "--only",
        action="append",
        choices=list(GROUPS),
        metavar="GROUP",
        help=f"measure one group: {', '.join(GROUPS)}; may be repeated (default: all)",
    )
    add(
        "--threads",
        type=int,
        default=th.get_num_threads(),
        help="threads of torch (default: torch's own, %(default)s here)",
    )
    add(
        "--rounds",
        type=int,
        help=f"rounds per benchmark, at least {MIN_ROUNDS} "
        f"(default: {ROUNDS}, with --quick {QUICK_ROUNDS})",
    )
    add(
        "--quick",
        action="store_true",
        help="a trial of less than a minute, with few rows and short turns: do not quote its rates",
    )
    return parser


if __name__ == "__main__":
    main()
