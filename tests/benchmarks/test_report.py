from __future__ import annotations

import json
from pathlib import Path

from sb3_flowpolicy.benchmarks import report
from sb3_flowpolicy.benchmarks.timing import Benchmark, Candidate, Timing, UnavailableError, Work


def nothing() -> Work:
    raise UnavailableError("never prepared here")


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
    Timing("baseline", 1.0, [100, 200, 100]),
    Timing("ours", 20.0, [300, 600, 300]),
    Timing("absent", note="not installed, and that takes a long note to explain"),
    Timing("limit", 0.0, [600, 1200, 600]),
]


def test_rows_compare_with_baseline_and_limit() -> None:
    baseline, ours, absent, limit = report.rows("updates", BENCHMARK, TIMINGS)
    assert (baseline.ratio, baseline.limit_fraction) == (1, 1 / 6)
    assert (ours.rate, ours.ratio, ours.limit_fraction) == (300, 3, 0.5)
    assert (absent.rate, absent.ratio, absent.rates) == (None, None, [])
    assert (limit.limit, limit.limit_fraction) == (None, None)
    assert {row.peer for row in (baseline, ours, absent, limit)} == {"baseline"}


def test_without_its_baseline_a_row_has_a_rate_but_no_ratio() -> None:
    timings = [Timing("baseline", note="not installed"), *TIMINGS[1:]]
    ours = report.rows("updates", BENCHMARK, timings)[1]
    assert (ours.rate, ours.ratio) == (300, None)


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
    timings = [Timing(candidate.name, note="no") for candidate in BENCHMARK.candidates]
    assert "- (no)" in report.table(report.rows("updates", BENCHMARK, timings))


def test_json_file(tmp_path: Path) -> None:
    path = tmp_path / "result.json"
    report.write_results(path, {"settings": {}}, report.rows("updates", BENCHMARK, TIMINGS))
    content = json.loads(path.read_text())
    assert (content["schema"], content["settings"]) == (1, {})
    assert [row["name"] for row in content["rows"]] == ["baseline", "ours", "absent", "limit"]
    assert {row["contest"] for row in content["rows"]} == {"a benchmark"}
