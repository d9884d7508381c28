"""Rates of entrants that take turns, so that a busy machine is busy for all of them."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

# A median of fewer is not worth quoting.
MIN_ROUNDS = 5

# Does a piece of work and returns how much it was, in the contest's unit (updates, steps, ...).
Work = Callable[[], float]
Clock = Callable[[], float]
# (what comes next, how many of all turns are done) -> None
Progress = Callable[[str, int, int], None]


class UnavailableError(Exception):
    """Raised by an entrant that cannot take part; its message becomes a note in the table."""


@dataclass(frozen=True)
class Entrant:
    """Something whose rate is measured.

    Args:
        name: What it is called in the table.
        prepare: Builds everything and returns the work to be timed. Compiling, filling buffers
            and so on belong here or in the first call of the work: neither is timed as work.
        limit: Name of the entrant of the same contest that only does what cannot be avoided.
    """

    name: str
    prepare: Callable[[], Work]
    limit: str | None = None


@dataclass(frozen=True)
class Contest:
    """Entrants that do the same work; the first one is the peer that all are compared with."""

    title: str
    unit: str
    entrants: Sequence[Entrant]


@dataclass
class Timing:
    """What was measured of one entrant.

    Args:
        name: The entrant's name.
        warm_up_seconds: Duration of preparation and of the first piece of work.
        rates: Work per second, one number per round; empty where the entrant was unavailable.
        note: Why it was.
    """

    name: str
    warm_up_seconds: float | None = None
    rates: list[float] = field(default_factory=list)
    note: str | None = None

    @property
    def median(self) -> float | None:
        """The median rate, None where nothing was measured."""
        return statistics.median(self.rates) if self.rates else None

    def ratio_to(self, other: Timing) -> float | None:
        """Median over rounds of this rate over the other's: both in a round met the same load."""
        if not self.rates or not other.rates:
            return None
        return statistics.median(a / b for a, b in zip(self.rates, other.rates, strict=True))


def race(
    contest: Contest,
    rounds: int = MIN_ROUNDS,
    turn_seconds: float = 0.5,
    clock: Clock = time.perf_counter,
    progress: Progress = lambda name, done, total: None,
) -> list[Timing]:
    """Let the entrants of a contest work in turns: A B C, A B C, ...

    Args:
        contest: Who takes part.
        rounds: Number of rounds, at least 5.
        turn_seconds: An entrant repeats its work until this time has passed, above 0.
        clock: Seconds since whenever.
        progress: Called before each turn, and at the end.

    Returns:
        One timing per entrant, in their order.

    Raises:
        ValueError: If ``rounds`` or ``turn_seconds`` is out of range.

    Example:
        >>> counting = Entrant("counting", lambda: lambda: sum(range(9)))
        >>> contest = Contest("how far", "numbers", [counting])
        >>> [timing.name for timing in race(contest, turn_seconds=0.001)]
        ['counting']
    """
    if rounds < MIN_ROUNDS:
        raise ValueError(f"rounds must be at least {MIN_ROUNDS}, got {rounds}")
    if not turn_seconds > 0:
        raise ValueError(f"turn_seconds must be above 0, got {turn_seconds}")
    timings = [Timing(entrant.name) for entrant in contest.entrants]
    total = (1 + rounds) * len(timings)
    ready: list[tuple[Timing, Work]] = []
    for done, (entrant, timing) in enumerate(zip(contest.entrants, timings, strict=True)):
        progress(f"{entrant.name}: warm-up", done, total)
        start = clock()
        try:
            work = entrant.prepare()
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
