from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from sb3_flowpolicy.benchmarks.timing import Benchmark, Candidate, Row, Work, measure, table


class FakeClock:
    """A clock that only work advances, with a log of the candidates that worked."""

    def __init__(self) -> None:
        self.now = 0.0
        self.log: list[str] = []

    def __call__(self) -> float:
        return self.now

    def candidate(self, name: str, durations: Callable[[int], float]) -> Candidate:
        """One unit of work per call; ``durations`` maps the number of the call to seconds."""

        def prepare() -> Work:
            self.now += 10
            calls = iter(range(1000))

            def work() -> float:
                self.now += durations(next(calls))
                self.log.append(name)
                return 1

            return work

        return Candidate(name, prepare)


def rows(*candidates: Candidate, clock: FakeClock, **kwargs: Any) -> list[Row]:
    return measure("group", Benchmark("title", "units", candidates), clock=clock, **kwargs)


def test_candidates_take_turns() -> None:
    clock = FakeClock()
    candidates = [clock.candidate(name, lambda _: 1.0) for name in "ABC"]
    rows(*candidates, rounds=5, turn_seconds=0.5, clock=clock)
    assert "".join(clock.log) == "ABC" * 6  # the first is warm-up


def test_a_turn_repeats_its_work_until_its_time_has_passed() -> None:
    clock = FakeClock()
    (row,) = rows(clock.candidate("A", lambda _: 1.0), turn_seconds=2.5, clock=clock)
    assert len(clock.log) == 1 + 5 * 3
    assert row["rates"] == [1.0] * 5


def test_warm_up_is_separate_and_the_median_ignores_an_outlier() -> None:
    clock = FakeClock()
    slow_once = clock.candidate("A", lambda call: {0: 100.0, 2: 50.0}.get(call, 0.5))
    (row,) = rows(slow_once, turn_seconds=0.1, clock=clock)
    assert row["warm_up_seconds"] == 110
    assert row["rates"] == [2, 1 / 50, 2, 2, 2]
    assert row["rate"] == 2


def test_ratios_are_taken_within_rounds() -> None:
    clock = FakeClock()
    # Load doubles from round to round: the rates change, their ratios do not.
    baseline, ours, limit = (
        clock.candidate(name, lambda call, seconds=seconds: seconds * 2**call)
        for name, seconds in (("baseline", 3.0), ("ours", 1.0), ("limit", 0.5))
    )
    ours = ours._replace(limit="limit")
    found = rows(baseline, ours, limit, turn_seconds=0.1, clock=clock)
    assert [row["ratio"] for row in found] == [1, 3, 6]
    assert [row["limit_fraction"] for row in found] == [None, 0.5, None]
    assert {(row["peer"], row["contest"]) for row in found} == {("baseline", "title")}


def absent() -> Work:
    raise ModuleNotFoundError("not installed")


def test_an_unavailable_candidate_leaves_a_note() -> None:
    clock = FakeClock()
    candidates = [Candidate("absent", absent), clock.candidate("A", lambda _: 1.0)]
    missing, present = rows(*candidates, turn_seconds=0.5, clock=clock)
    assert (missing["rates"], missing["rate"], missing["note"]) == ([], None, "not installed")
    assert (present["rate"], present["ratio"]) == (1, None)


def test_progress_reaches_the_end(capsys: pytest.CaptureFixture[str]) -> None:
    clock = FakeClock()
    rows(*(clock.candidate(name, lambda _: 1.0) for name in "AB"), clock=clock)
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["title: warm-up of A", "title: warm-up of B"]
    assert lines[2:] == [f"title: round {i} of 5" for i in range(1, 6)]


def test_table() -> None:
    clock = FakeClock()
    candidates = [clock.candidate("slow", lambda _: 1.0), clock.candidate("fast", lambda _: 0.25)]
    candidates[0] = candidates[0]._replace(limit="fast")
    lines = table(rows(*candidates, Candidate("absent", absent), clock=clock)).splitlines()
    assert lines == [
        "group: title, units per second",
        "     per second lowest-highest x baseline of limit warm-up",
        "slow          1            1-1       1.00      25%  11.0 s",
        "fast          4            4-4       4.00        -  10.2 s",
        "absent: not installed",
    ]
    assert table(rows(Candidate("absent", absent), clock=clock)).endswith("absent: not installed")
