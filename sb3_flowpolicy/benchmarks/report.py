"""What a benchmark leaves behind: a JSON file and a table of text."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch as th

import sb3_flowpolicy
from sb3_flowpolicy.benchmarks.timing import Contest, Timing

# Raised whenever a field changes its meaning.
SCHEMA = 1
PACKAGES = ("torch", "stable_baselines3", "gymnasium", "numpy", "numba", "zuko", "sbx-rl")


@dataclass(frozen=True)
class Row:
    """One line of the table, and one object under ``"rows"`` in the JSON file.

    Args:
        group: ``"updates"``, ``"learn"``, ``"environments"`` or ``"flow"``.
        contest: Title of the contest.
        name: Who was measured.
        unit: What ``rate`` counts per second.
        rate: Median over the rounds; None where ``note`` says why there is none.
        rates: All rounds.
        peer: Whom it is compared with.
        ratio: Median over the rounds of its rate over the peer's in the same round.
        limit: Who does only what cannot be avoided; None where there is no such entrant.
        limit_fraction: Median over the rounds of its rate over the limit's.
        warm_up_seconds: Building, compiling and the first piece of work; not part of ``rate``.
        note: Why it was not measured.
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


def rows(group: str, contest: Contest, timings: Sequence[Timing]) -> list[Row]:
    """Compare the timings of a contest with its peer and their limits."""
    by_name = {timing.name: timing for timing in timings}
    peer = timings[0]
    found = []
    for entrant, timing in zip(contest.entrants, timings, strict=True):
        limit = None if entrant.limit is None else by_name[entrant.limit]
        found.append(
            Row(
                group=group,
                contest=contest.title,
                name=timing.name,
                unit=contest.unit,
                rate=timing.median,
                rates=timing.rates,
                peer=peer.name,
                ratio=timing.ratio_to(peer),
                limit=entrant.limit,
                limit_fraction=None if limit is None else timing.ratio_to(limit),
                warm_up_seconds=timing.warm_up_seconds,
                note=timing.note,
            )
        )
    return found


def table(found: Sequence[Row]) -> str:
    """Lay out the rows of one contest as text."""
    head = ("", "per second", "lowest-highest", "x peer", "of limit", "warm-up")
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
    # A note may run on into the columns that it leaves empty.
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


def machine() -> dict[str, Any]:
    """Return what a reader needs to know about where the numbers were measured."""
    return {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "platform": platform.platform(),
        "processor": _processor(),
        "cpu_count": os.cpu_count(),
        # Processes that wanted to run, averaged over a minute: above 0 means others were busy.
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "threads": th.get_num_threads(),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
        "commit": _commit(),
    }


def write_json(path: Path, content: dict[str, Any], found: Sequence[Row]) -> None:
    """Write the file at once or not at all, so that nobody ever reads half of it.

    Args:
        path: File to write; its directory exists.
        content: Machine and settings.
        found: All rows so far.
    """
    text = json.dumps(
        {"schema": SCHEMA, **content, "rows": [asdict(row) for row in found]}, indent=1
    )
    handle, temporary = tempfile.mkstemp(prefix=path.name, suffix=".tmp", dir=path.parent)
    try:
        with os.fdopen(handle, "w") as file:
            file.write(text + "\n")
        # mkstemp's files are for their owner alone; ours is an ordinary one.
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def _commit() -> str | None:
    """Return the commit of the source tree; None where the package was installed from a wheel."""
    source = Path(sb3_flowpolicy.__file__)

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(source.parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", source.name)  # the tree around may be someone else's
        return git("describe", "--always", "--dirty", "--abbrev=12")
    except (OSError, subprocess.CalledProcessError):
        return None
