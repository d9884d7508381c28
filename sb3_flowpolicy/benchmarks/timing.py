"""Rates of candidates that run in turns, so that other load on the machine affects all alike."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

# The fewest rounds whose median is worth quoting.
MIN_ROUNDS = 5

# Does a piece of work and returns its amount in the benchmark's unit (updates, steps, ...).
Work = Callable[[], float]
Clock = Callable[[], float]
# (next candidate, number of turns done, number of turns in total) -> None
Progress = Callable[[str, int, int], None]


class UnavailableError(Exception):
    """Raised by a candidate that cannot run here; its message becomes a note in the table."""


@dataclass(frozen=True)
class Candidate:
    """Something whose rate is measured.

    Args:
        name: Label in the table.
        prepare: Builds everything and returns the work to be timed. Preparation and the first
            piece of work are the warm-up: compile and fill buffers there.
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
    """Measurements of one candidate.

    Args:
        name: The candidate's name.
        warm_up_seconds: Duration of preparation and of the first piece of work.
        rates: Work per second, one number per round; empty if the candidate was unavailable.
        note: Why it was unavailable.
    """

    name: str
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
    rounds: int = MIN_ROUNDS,
    turn_seconds: float = 0.5,
    clock: Clock = time.perf_counter,
    progress: Progress = lambda name, done, total: None,
) -> list[Timing]:
    """Prepare all candidates, then run them in turns (A B C, A B C, ...).

    Args:
        benchmark: Candidates to measure.
        rounds: Turns per candidate, at least 5.
        turn_seconds: A turn repeats its work until this much time has passed.
        clock: Returns seconds.
        progress: Called before each turn and at the end.

    Returns:
        One timing per candidate, in order.

    Example:
        >>> counting = Candidate("counting", lambda: lambda: sum(range(9)))
        >>> benchmark = Benchmark("counting", "numbers", [counting])
        >>> [timing.name for timing in measure(benchmark, turn_seconds=0.001)]
        ['counting']
    """
    if rounds < MIN_ROUNDS:
        raise ValueError(f"rounds must be at least {MIN_ROUNDS}, got {rounds}")
    if not turn_seconds > 0:
        raise ValueError(f"turn_seconds must be above 0, got {turn_seconds}")
    timings = [Timing(candidate.name) for candidate in benchmark.candidates]
    total = (1 + rounds) * len(timings)
    ready: list[tuple[Timing, Work]] = []
    for done, (candidate, timing) in enumerate(zip(benchmark.candidates, timings, strict=True)):
        progress(f"{candidate.name}: warm-up", done, total)
        start = clock()
        try:
            work = candidate.prepare()
            work()
        except UnavailableError as reason:
            timing.note = str(reason)
            continue
        timing.warm_up_seconds = clock() - start
        ready.append((timing, work))
    done = len(timings)
    for _ in range(rounds):
        for timing, work in ready:
            progress(timing.name, done, total)
            timing.rates.append(_rate(work, turn_seconds, clock))
            done += 1
    progress("", total, total)
    return timings


def _rate(work: Work, seconds: float, clock: Clock) -> float:
    amount, start = 0.0, clock()
    while True:
        amount += work()
        elapsed = clock() - start
        if elapsed >= seconds:
            return amount / elapsed
