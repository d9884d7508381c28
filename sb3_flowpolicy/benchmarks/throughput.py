"""``python -m sb3_flowpolicy.benchmarks.throughput``: all rates, against peers, in one run."""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import torch as th

from sb3_flowpolicy.benchmarks.report import Row, rows, table, write_results
from sb3_flowpolicy.benchmarks.timing import MIN_ROUNDS, Progress, race
from sb3_flowpolicy.common.machine import machine

# Group -> module with its contests. In the order in which they run: zuko, which changes torch for
# the whole process when imported, comes last.
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
Measure how fast sb3_flowpolicy is next to its peers, on this machine, now.

  updates       gradient updates per second (batch 256): SACFlow and ten stacked seeds against
                SB3's SAC (and SBX where installed), and against the matrix products alone
  learn         environment steps per second of learn() on TunnelDiagonal-v0
  environments  steps per second of the environments, single and in batches of 64
  trust         steps per second of learn() with and without the training guard; calls of predict
                per second in each deterministic_mode, 64 candidates
  flow          RealNVP forward and backward against zuko's

Entrants take turns (A B C, A B C, ...), so that whatever else the machine does slows all of
them. Rates are medians over the rounds; "x peer" is the median of the ratios within rounds, to
the first line of each table; "of limit" is the fraction of the rate of the products alone."""
_EPILOG = """\
examples:
  python -m sb3_flowpolicy.benchmarks.throughput --quick
  python -m sb3_flowpolicy.benchmarks.throughput --json throughput.json
  python -m sb3_flowpolicy.benchmarks.throughput --only updates --threads 1 --json updates.json

A full run takes about ten minutes, most of them compiling. Compare ratios, not rates, between
machines, and only where "threads" agree."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark that the command line asks for.

    Args:
        arguments: Command line without the program's name. Default: that of the process.
    """
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
        for contest in module.contests(quick):
            with _Progress(contest.title) as progress:
                timings = race(contest, rounds, turn_seconds, progress=progress)
            new = rows(group, contest, timings)
            found += new
            print(table(new), end="\n\n", flush=True)
            if path is not None:  # after each contest: an interrupted run keeps what it has
                write_results(path, content, found)


class _Progress:
    """A bar where there is a terminal and tqdm (it comes with rl_zoo3), lines otherwise."""

    def __init__(self, title: str) -> None:
        self.title = title
        self._bar: Any = None
        self._last_line = -math.inf
        if sys.stderr.isatty():
            with suppress(ModuleNotFoundError):
                self._bar = import_module("tqdm").tqdm(desc=title, leave=False)

    def __enter__(self) -> Progress:
        return self._show

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def _show(self, name: str, done: int, total: int) -> None:
        if self._bar is not None:
            self._bar.total, self._bar.n = total, done
            self._bar.set_postfix_str(name)
        elif time.monotonic() - self._last_line > SECONDS_PER_LINE:
            self._last_line = time.monotonic()
            print(f"{self.title}: {done}/{total} {name}", file=sys.stderr, flush=True)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.benchmarks.throughput",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write everything here")
    parser.add_argument(
        "--only",
        action="append",
        choices=list(GROUPS),
        metavar="GROUP",
        help=f"measure one group: {', '.join(GROUPS)}; may be repeated (default: all)",
    )
    parser.add_argument(
        "--threads",
        type=int,
        default=th.get_num_threads(),
        help="threads of torch (default: torch's own, %(default)s here)",
    )
    parser.add_argument(
        "--rounds",
        type=int,
        help=f"rounds per contest, at least {MIN_ROUNDS} "
        f"(default: {ROUNDS}, with --quick {QUICK_ROUNDS})",
    )
    parser.add_argument(
        "--quick",
        action="store_true",
        help="under a minute: a try-out with few rows and short turns, numbers not to be quoted",
    )
    return parser


if __name__ == "__main__":
    main()
