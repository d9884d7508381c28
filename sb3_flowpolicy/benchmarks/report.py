"""Results of a benchmark as rows of a JSON file and as a text table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sb3_flowpolicy.benchmarks.timing import Benchmark, Timing

# Increase it when a field changes its meaning.
SCHEMA = 1
# One line of the table and one object under "rows" in the JSON file.
Row = dict[str, Any]


def rows(group: str, benchmark: Benchmark, timings: Sequence[Timing]) -> list[Row]:
    """Compare the timings of a benchmark with its baseline ("peer") and their limits.

    Returns:
        One row per candidate. ``rate`` is the median over the rounds, None if the candidate was
        unavailable. ``ratio`` and ``limit_fraction`` are medians of the ratios within rounds.
    """
    named = {one.name: timing for one, timing in zip(benchmark.candidates, timings, strict=True)}
    return [
        {
            "group": group,
            "contest": benchmark.title,
            "name": one.name,
            "unit": benchmark.unit,
            "rate": timing.median,
            "rates": timing.rates,
            "peer": benchmark.candidates[0].name,
            "ratio": timing.ratio_to(timings[0]),
            "limit": one.limit,
            "limit_fraction": one.limit and timing.ratio_to(named[one.limit]),
            "warm_up_seconds": timing.warm_up_seconds,
            "note": timing.note,
        }
        for one, timing in zip(benchmark.candidates, timings, strict=True)
    ]


def table(found: Sequence[Row]) -> str:
    """Lay out the rows of one benchmark as text."""
    lines = [("", "per second", "lowest-highest", "x baseline", "of limit", "warm-up")]
    for row in found:
        if row["rate"] is None:
            lines.append((row["name"], f"- ({row['note']})", "", "", "", ""))
            continue
        lines.append(
            (
                row["name"],
                f"{row['rate']:,.0f}",
                f"{min(row['rates']):,.0f}-{max(row['rates']):,.0f}",
                "-" if row["ratio"] is None else f"{row['ratio']:.2f}",
                "-" if row["limit_fraction"] is None else f"{row['limit_fraction']:.0%}",
                f"{row['warm_up_seconds']:.1f} s",
            )
        )
    # A note may extend into the columns that it leaves empty.
    columns = zip(*(line for line in lines if line[2]), strict=True)
    widths = [max(map(len, column)) for column in columns]
    widths[0] = max(len(line[0]) for line in lines)
    text = ["{group}: {contest}, {unit} per second".format(**found[0])]
    for name, *cells in lines:
        padded = [cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True)]
        text.append("  " + "  ".join([name.ljust(widths[0]), *padded]).rstrip())
    return "\n".join(text)
