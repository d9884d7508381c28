from __future__ import annotations

from sb3_flowpolicy.benchmarks import report
from sb3_flowpolicy.benchmarks.timing import Benchmark, Candidate, Timing, Work


def nothing() -> Work:
    raise ModuleNotFoundError("never prepared here")


BENCHMARK = Benchmark(
    "a benchmark",
    "steps",
    [
        Candidate("baseline", nothing, limit="limit"),
        Candidate("ours", nothing, limit="limit"),
        Candidate("absent", nothing),
        Candidate("limit", nothing),
    ],
)
TIMINGS = [
    Timing(1.0, [100, 200, 100]),
    Timing(20.0, [300, 600, 300]),
    Timing(note="not installed, and that takes a long note to explain"),
    Timing(0.0, [600, 1200, 600]),
]


def test_rows_compare_with_baseline_and_limit() -> None:
    baseline, ours, absent, limit = report.rows("updates", BENCHMARK, TIMINGS)
    assert (baseline["ratio"], baseline["limit_fraction"]) == (1, 1 / 6)
    assert (ours["rate"], ours["ratio"], ours["limit_fraction"]) == (300, 3, 0.5)
    assert (absent["rate"], absent["ratio"], absent["rates"]) == (None, None, [])
    assert (limit["limit"], limit["limit_fraction"]) == (None, None)
    found = (baseline, ours, absent, limit)
    assert [row["name"] for row in found] == ["baseline", "ours", "absent", "limit"]
    assert {(row["peer"], row["contest"]) for row in found} == {("baseline", "a benchmark")}


def test_without_its_baseline_a_row_has_a_rate_but_no_ratio() -> None:
    timings = [Timing(note="not installed"), *TIMINGS[1:]]
    ours = report.rows("updates", BENCHMARK, timings)[1]
    assert (ours["rate"], ours["ratio"]) == (300, None)


def test_table() -> None:
    lines = report.table(report.rows("updates", BENCHMARK, TIMINGS)).splitlines()
    assert lines == [
        "updates: a benchmark, steps per second",
        "            per second  lowest-highest  x baseline  of limit  warm-up",
        "  baseline         100         100-200        1.00       17%    1.0 s",
        "  ours             300         300-600        3.00       50%   20.0 s",
        "  absent    - (not installed, and that takes a long note to explain)",
        "  limit            600       600-1,200        6.00         -    0.0 s",
    ]


def test_a_table_without_a_measured_row() -> None:
    timings = [Timing(note="no") for _ in BENCHMARK.candidates]
    assert "- (no)" in report.table(report.rows("updates", BENCHMARK, timings))
