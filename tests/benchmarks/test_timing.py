from __future__ import annotations

from collections.abc import Callable

import pytest

from sb3_flowpolicy.benchmarks.timing import Contest, Entrant, Timing, UnavailableError, Work, race


class FakeClock:
    """A clock that stands still but for the work that moves it, and remembers who worked."""

    def __init__(self) -> None:
        self.now = 0.0
        self.log: list[str] = []

    def __call__(self) -> float:
        return self.now

    def entrant(self, name: str, durations: Callable[[int], float]) -> Entrant:
        """One unit of work per call; ``durations`` maps the number of the call to seconds."""

        def prepare() -> Work:
            self.now += 10
            calls = iter(range(1000))

            def work() -> float:
                self.now += durations(next(calls))
                self.log.append(name)
                return 1

            return work

        return Entrant(name, prepare)


def contest(*entrants: Entrant) -> Contest:
    return Contest("title", "units", entrants)


def test_entrants_take_turns() -> None:
    clock = FakeClock()
    entrants = [clock.entrant(name, lambda _: 1.0) for name in "ABC"]
    race(contest(*entrants), rounds=5, turn_seconds=0.5, clock=clock)
    assert "".join(clock.log) == "ABC" * 6  # the first is warm-up


def test_a_turn_repeats_its_work_until_its_time_has_passed() -> None:
    clock = FakeClock()
    (timing,) = race(contest(clock.entrant("A", lambda _: 1.0)), turn_seconds=2.5, clock=clock)
    assert len(clock.log) == 1 + 5 * 3
    assert timing.rates == [1.0] * 5


def test_warm_up_is_apart_and_the_median_ignores_a_hiccup() -> None:
    clock = FakeClock()
    slow_once = clock.entrant("A", lambda call: {0: 100.0, 2: 50.0}.get(call, 0.5))
    (timing,) = race(contest(slow_once), turn_seconds=0.1, clock=clock)
    assert timing.warm_up_seconds == 110
    assert timing.rates == [2, 1 / 50, 2, 2, 2]
    assert timing.median == 2


def test_ratio_is_taken_within_rounds() -> None:
    # Load doubles from round to round: the rates wander, their ratio does not.
    peer = Timing("peer", rates=[16, 8, 4, 2, 1])
    ours = Timing("ours", rates=[48, 24, 12, 6, 3])
    assert ours.ratio_to(peer) == 3
    assert ours.ratio_to(Timing("absent")) is None
    assert Timing("absent").ratio_to(peer) is None


def test_who_is_unavailable_leaves_a_note() -> None:
    def prepare() -> Work:
        raise UnavailableError("not installed")

    clock = FakeClock()
    entrants = [Entrant("absent", prepare), clock.entrant("A", lambda _: 1.0)]
    absent, present = race(contest(*entrants), turn_seconds=0.5, clock=clock)
    assert (absent.rates, absent.median, absent.note) == ([], None, "not installed")
    assert present.median == 1


def test_progress_reaches_the_end() -> None:
    clock, seen = FakeClock(), []
    entrants = [clock.entrant(name, lambda _: 1.0) for name in "AB"]
    race(
        contest(*entrants),
        turn_seconds=0.5,
        clock=clock,
        progress=lambda name, done, total: seen.append((name, done, total)),
    )
    assert [done for _, done, _ in seen] == list(range(13))
    assert {total for _, _, total in seen} == {12}
    assert seen[0][0] == "A: warm-up"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"rounds": 4}, "rounds must be at least 5, got 4"),
        ({"turn_seconds": 0}, "turn_seconds must be above 0, got 0"),
        ({"turn_seconds": float("nan")}, "turn_seconds must be above 0, got nan"),
    ],
)
def test_bad_arguments(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        race(contest(), **arguments)
