"""Rates of candidates that take turns, so that other load on the machine slows all of them."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import pandas as pd

# Does a piece of work and returns its amount in the benchmark's unit (updates, steps, ...).
Work = Callable[[], float]
# One line of the table and one object under "rows" in the JSON file.
Row = dict[str, Any]


class Candidate(NamedTuple):
    """Something whose rate is measured."""

    name: str
    # Builds everything and returns the work to be timed. Preparation and the first piece of work
    # are the warm-up: compile and fill buffers there.
    prepare: Callable[[], Work]
    # Name of the candidate of the same benchmark that does the unavoidable work only.
    limit: str | None = None


class Benchmark(NamedTuple):
    """Candidates that do the same work; the first one is the baseline ("peer") for all."""

    title: str
    unit: str
    candidates: Sequence[Candidate]


def measure(
    group: str,
    benchmark: Benchmark,
    rounds: int = 5,
    turn_seconds: float = 0.5,
    clock: Callable[[], float] = time.perf_counter,
) -> list[Row]:
    """Prepare all candidates, then run them in turns (A B C, A B C, ...).

    Args:
        group: Name of the group, for the rows.
        benchmark: Candidates to measure.
        rounds: Turns per candidate.
        turn_seconds: A turn repeats its work until this much time has passed.
        clock: Returns seconds.

    Returns:
        One row per candidate. ``rates`` is the work per second in each round and ``rate`` their
        median, None if the candidate needs a package that is not installed, which ``note`` then
        names. ``ratio`` and ``limit_fraction`` are medians of the ratios within rounds.

    Example:
        >>> counting = Candidate("counting", lambda: lambda: sum(range(9)))
        >>> (row,) = measure("", Benchmark("counting", "numbers", [counting]), turn_seconds=0.001)
        >>> len(row["rates"])
        5
    """
    works: dict[str, Work] = {}
    warm_up: dict[str, float] = {}
    notes: dict[str, str] = {}
    for name, prepare, _ in benchmark.candidates:
        print(f"{benchmark.title}: warm-up of {name}", file=sys.stderr)
        start = clock()
        try:
            work = prepare()
            work()
        except ModuleNotFoundError as reason:
            notes[name] = str(reason)
        else:
            works[name], warm_up[name] = work, clock() - start
    rates: dict[str, list[float]] = {one.name: [] for one in benchmark.candidates}
    for done in range(rounds):
        print(f"{benchmark.title}: round {done + 1} of {rounds}", file=sys.stderr)
        for name, work in works.items():
            amount, elapsed, start = 0.0, 0.0, clock()
            while elapsed < turn_seconds:
                amount += work()
                elapsed = clock() - start
            rates[name].append(amount / elapsed)

    def ratio(name: str, other: str | None) -> float | None:
        if other is None or not rates[name] or not rates[other]:
            return None
        return statistics.median(a / b for a, b in zip(rates[name], rates[other], strict=True))

    peer = benchmark.candidates[0].name
    return [
        {
            "group": group,
            "contest": benchmark.title,
            "name": name,
            "unit": benchmark.unit,
            "rate": statistics.median(rates[name]) if rates[name] else None,
            "rates": rates[name],
            "peer": peer,
            "ratio": ratio(name, peer),
            "limit": limit,
            "limit_fraction": ratio(name, limit),
            "warm_up_seconds": warm_up.get(name),
            "note": notes.get(name),
        }
        for name, _, limit in benchmark.candidates
    ]


def table(rows: Sequence[Row]) -> str:
    """Lay out the rows of one benchmark as text."""
    text = "{group}: {contest}, {unit} per second".format(**rows[0])
    cells = {
        row["name"]: {
            "per second": f"{row['rate']:,.0f}",
            "lowest-highest": f"{min(row['rates']):,.0f}-{max(row['rates']):,.0f}",
            "x baseline": "-" if row["ratio"] is None else f"{row['ratio']:.2f}",
            "of limit": "-" if row["limit_fraction"] is None else f"{row['limit_fraction']:.0%}",
            "warm-up": f"{row['warm_up_seconds']:.1f} s",
        }
        for row in rows
        if row["rate"] is not None
    }
    if cells:
        text += "\n" + pd.DataFrame(cells).T.to_string()
    notes = [f"\n{row['name']}: {row['note']}" for row in rows if row["rate"] is None]
    return text + "".join(notes)
