from __future__ import annotations

import json
import stat
from pathlib import Path

import pytest

from sb3_flowpolicy.benchmarks import report
from sb3_flowpolicy.benchmarks.timing import Contest, Entrant, Timing, UnavailableError, Work


def nothing() -> Work:
    raise UnavailableError("never prepared here")


CONTEST = Contest(
    "a contest",
    "steps",
    [
        Entrant("peer", nothing, limit="limit"),
        Entrant("ours", nothing, limit="limit"),
        Entrant("absent", nothing),
        Entrant("limit", nothing),
    ],
)
TIMINGS = [
    Timing("peer", 1.0, [100, 200, 100]),
    Timing("ours", 20.0, [300, 600, 300]),
    Timing("absent", note="not installed, and that takes a long note to explain"),
    Timing("limit", 0.0, [600, 1200, 600]),
]


def test_rows_compare_with_peer_and_limit() -> None:
    peer, ours, absent, limit = report.rows("updates", CONTEST, TIMINGS)
    assert (peer.ratio, peer.limit_fraction) == (1, 1 / 6)
    assert (ours.rate, ours.ratio, ours.limit_fraction) == (300, 3, 0.5)
    assert (absent.rate, absent.ratio, absent.rates) == (None, None, [])
    assert (limit.limit, limit.limit_fraction) == (None, None)
    assert {row.peer for row in (peer, ours, absent, limit)} == {"peer"}


def test_without_its_peer_a_row_has_a_rate_but_no_ratio() -> None:
    timings = [Timing("peer", note="not installed"), *TIMINGS[1:]]
    ours = report.rows("updates", CONTEST, timings)[1]
    assert (ours.rate, ours.ratio) == (300, None)


def test_table() -> None:
    lines = report.table(report.rows("updates", CONTEST, TIMINGS)).splitlines()
    assert lines == [
        "updates: a contest, steps per second",
        "          per second  lowest-highest  x peer  of limit  warm-up",
        "  peer           100         100-200    1.00       17%    1.0 s",
        "  ours           300         300-600    3.00       50%   20.0 s",
        "  absent  - (not installed, and that takes a long note to explain)",
        "  limit          600       600-1,200    6.00         -    0.0 s",
    ]


def test_a_table_without_a_measured_row() -> None:
    timings = [Timing(entrant.name, note="no") for entrant in CONTEST.entrants]
    assert "- (no)" in report.table(report.rows("updates", CONTEST, timings))


def test_json_is_replaced_as_a_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "result.json"
    rows = report.rows("updates", CONTEST, TIMINGS)
    report.write_json(path, {"settings": {}}, rows)
    before = path.read_text()
    assert [row["name"] for row in json.loads(before)["rows"]] == [
        "peer",
        "ours",
        "absent",
        "limit",
    ]
    ordinary = tmp_path / "ordinary"
    ordinary.touch()
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE(ordinary.stat().st_mode)
    ordinary.unlink()

    def full(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(report.os, "replace", full)
    with pytest.raises(OSError, match="disk full"):
        report.write_json(path, {"settings": {}}, rows[:1])
    assert path.read_text() == before
    assert list(tmp_path.iterdir()) == [path]


def test_machine_says_what_a_reader_has_to_know() -> None:
    facts = report.machine()
    assert {"date", "processor", "cpu_count", "load_average", "threads", "commit"} <= facts.keys()
    assert facts["threads"] == 1
    assert facts["versions"]["torch"]
    json.dumps(facts)
