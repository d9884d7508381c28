"""Rates of candidates that run in turns, so that other load on the machine affects all alike."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

# Does a piece of work and returns its amount in the benchmark's unit (updates, steps, ...).
Work = Callable[[], float]


@dataclass(frozen=True)
class Candidate:
    """Something whose rate is measured.

    Args:
        name: Label in the table.
        prepare: Builds everything and returns the work to be timed. Preparation and the first
            piece of work are the warm-up: compile and fill buffers there. If it needs a package
            that is not installed, the table says so.
        limit: Name of the candidate of the same benchmark that does the unavoidable work only.
    """

    name: str
    prepare: Callable[[], Work]
    limit: str | None = None


@dataclass(frozen=True)
class Benchmark:
    """Candidates that do the same work; the first one is the baseline for all."""

    title: str
    unit: str
    candidates: Sequence[Candidate]


@dataclass
class Timing:
    """Work per second in each round, without the warm-up; a note if the candidate cannot run."""

    warm_up_seconds: float | None = None
    rates: list[float] = field(default_factory=list)
    note: str | None = None

    @property
    def median(self) -> float | None:
        """Median rate, None without measurements."""
        return statistics.median(self.rates) if self.rates else None

    def ratio_to(self, other: Timing) -> float | None:
        """Median over rounds of this rate over the other's, measured under the same load."""
        if not self.rates or not other.rates:
            return None
        return statistics.median(a / b for a, b in zip(self.rates, other.rates, strict=True))


def measure(
    benchmark: Benchmark,
    rounds: int = 5,
    turn_seconds: float = 0.5,
    clock: Callable[[], float] = time.perf_counter,
) -> list[Timing]:
    """Prepare all candidates, then run them in turns (A B C, A B C, ...).

    Args:
        benchmark: Candidates to measure.
        rounds: Turns per candidate.
        turn_seconds: A turn repeats its work until this much time has passed.
        clock: Returns seconds.

    Returns:
        One timing per candidate, in order.

    Example:
        >>> counting = Candidate("counting", lambda: lambda: sum(range(9)))
        >>> (timing,) = measure(Benchmark("counting", "numbers", [counting]), turn_seconds=0.001)
        >>> len(timing.rates)
        5
    """
    timings, ready = [], []
    for candidate in benchmark.candidates:
        print(f"{benchmark.title}: warm-up of {candidate.name}", file=sys.stderr)
        timing, start = Timing(), clock()
        timings.append(timing)
        try:
            work = candidate.prepare()
            work()
        except ModuleNotFoundError as reason:
            timing.note = str(reason)
        else:
            timing.warm_up_seconds = clock() - start
            ready.append((timing, work))
    for done in range(rounds):
        print(f"{benchmark.title}: round {done + 1} of {rounds}", file=sys.stderr)
        for timing, work in ready:
            amount, elapsed, start = 0.0, 0.0, clock()
            while elapsed < turn_seconds:
                amount += work()
                elapsed = clock() - start
            timing.rates.append(amount / elapsed)
    return timings
