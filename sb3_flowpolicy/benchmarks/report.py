"""Results of a benchmark as a JSON file and as a text table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sb3_flowpolicy.benchmarks.timing import Benchmark, Timing
from sb3_flowpolicy.common.files import write_json

# Increase it when a field changes its meaning.
SCHEMA = 1


@dataclass(frozen=True)
class Row:
    """One line of the table, and one object under ``"rows"`` in the JSON file.

    Args:
        group: ``"updates"``, ``"learn"``, ``"environments"``, ``"trust"`` or ``"flow"``.
        contest: Title of the benchmark.
        name: Candidate.
        unit: What ``rate`` counts per second.
        rate: Median over the rounds; None if the candidate was unavailable, see ``note``.
        rates: All rounds.
        peer: Baseline, the first candidate of the benchmark.
        ratio: Median over the rounds of the rate over the baseline's in the same round.
        limit: Candidate that does the unavoidable work only, None without one.
        limit_fraction: Median over the rounds of the rate over the limit's.
        warm_up_seconds: Building, compiling and the first piece of work; not part of ``rate``.
        note: Why the candidate was unavailable.
    """

    group: str
    contest: str
    name: str
    unit: str
    rate: float | None
    rates: list[float]
    peer: str
    ratio: float | None
    limit: str | None
    limit_fraction: float | None
    warm_up_seconds: float | None
    note: str | None


def rows(group: str, benchmark: Benchmark, timings: Sequence[Timing]) -> list[Row]:
    """Compare the timings of a benchmark with its baseline and their limits."""
    by_name = {timing.name: timing for timing in timings}
    baseline = timings[0]
    found = []
    for candidate, timing in zip(benchmark.candidates, timings, strict=True):
        limit = None if candidate.limit is None else by_name[candidate.limit]
        found.append(
            Row(
                group=group,
                contest=benchmark.title,
                name=timing.name,
                unit=benchmark.unit,
                rate=timing.median,
                rates=timing.rates,
                peer=baseline.name,
                ratio=timing.ratio_to(baseline),
                limit=candidate.limit,
                limit_fraction=None if limit is None else timing.ratio_to(limit),
                warm_up_seconds=timing.warm_up_seconds,
                note=timing.note,
            )
        )
    return found


def table(found: Sequence[Row]) -> str:
    """Lay out the rows of one benchmark as text."""
    head = ("", "per second", "lowest-highest", "x baseline", "of limit", "warm-up")
    lines = [head]
    for row in found:
        if row.rate is None:
            lines.append((row.name, f"- ({row.note})", "", "", "", ""))
            continue
        lines.append(
            (
                row.name,
                f"{row.rate:,.0f}",
                f"{min(row.rates):,.0f}-{max(row.rates):,.0f}",
                "-" if row.ratio is None else f"{row.ratio:.2f}",
                "-" if row.limit_fraction is None else f"{row.limit_fraction:.0%}",
                f"{row.warm_up_seconds:.1f} s",
            )
        )
    # A note may extend into the columns that it leaves empty.
    measured = [line for line in lines if line[2]]
    widths = [max(len(line[0]) for line in lines)]
    widths += [max(len(line[i]) for line in measured) for i in range(1, len(head))]
    first = found[0]
    text = [f"{first.group}: {first.contest}, {first.unit} per second"]
    for line in lines:
        cells = [line[0].ljust(widths[0])]
        cells += [cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True)]
        text.append("  " + "  ".join(cells).rstrip())
    return "\n".join(text)


def write_results(path: Path, content: dict[str, Any], found: Sequence[Row]) -> None:
    """Write machine and settings (``content``) and all rows so far."""
    write_json(path, {"schema": SCHEMA, **content, "rows": [asdict(row) for row in found]})
