from __future__ import annotations

from collections.abc import Callable

import pytest

from sb3_flowpolicy.benchmarks.timing import (
    Benchmark,
    Candidate,
    Timing,
    Work,
    measure,
)


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


def benchmark(*candidates: Candidate) -> Benchmark:
    return Benchmark("title", "units", candidates)


def test_candidates_take_turns() -> None:
    clock = FakeClock()
    candidates = [clock.candidate(name, lambda _: 1.0) for name in "ABC"]
    measure(benchmark(*candidates), rounds=5, turn_seconds=0.5, clock=clock)
    assert "".join(clock.log) == "ABC" * 6  # the first is warm-up


def test_a_turn_repeats_its_work_until_its_time_has_passed() -> None:
    clock = FakeClock()
    (timing,) = measure(
        benchmark(clock.candidate("A", lambda _: 1.0)), turn_seconds=2.5, clock=clock
    )
    assert len(clock.log) == 1 + 5 * 3
    assert timing.rates == [1.0] * 5


def test_warm_up_is_separate_and_the_median_ignores_an_outlier() -> None:
    clock = FakeClock()
    slow_once = clock.candidate("A", lambda call: {0: 100.0, 2: 50.0}.get(call, 0.5))
    (timing,) = measure(benchmark(slow_once), turn_seconds=0.1, clock=clock)
    assert timing.warm_up_seconds == 110
    assert timing.rates == [2, 1 / 50, 2, 2, 2]
    assert timing.median == 2


def test_ratio_is_taken_within_rounds() -> None:
    # Load doubles from round to round: the rates change, their ratio does not.
    baseline = Timing(rates=[16, 8, 4, 2, 1])
    ours = Timing(rates=[48, 24, 12, 6, 3])
    assert ours.ratio_to(baseline) == 3
    assert ours.ratio_to(Timing()) is None
    assert Timing().ratio_to(baseline) is None


def test_an_unavailable_candidate_leaves_a_note() -> None:
    def prepare() -> Work:
        raise ModuleNotFoundError("not installed")

    clock = FakeClock()
    candidates = [Candidate("absent", prepare), clock.candidate("A", lambda _: 1.0)]
    absent, present = measure(benchmark(*candidates), turn_seconds=0.5, clock=clock)
    assert (absent.rates, absent.median, absent.note) == ([], None, "not installed")
    assert present.median == 1


def test_progress_reaches_the_end(capsys: pytest.CaptureFixture[str]) -> None:
    clock = FakeClock()
    measure(benchmark(*(clock.candidate(name, lambda _: 1.0) for name in "AB")), clock=clock)
    lines = capsys.readouterr().err.splitlines()
    assert lines[:2] == ["title: warm-up of A", "title: warm-up of B"]
    assert lines[2:] == [f"title: round {i} of 5" for i in range(1, 6)]
