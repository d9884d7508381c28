"""All results as one self-contained HTML page, and as Markdown for the docs."""

from __future__ import annotations

import base64
import shutil
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from sb3_flowpolicy.common.files import write_text
from sb3_flowpolicy.experiments.experiment import NOT_MEASURED
from sb3_flowpolicy.experiments.section import METHOD, Section, png, read_results
from sb3_flowpolicy.experiments.tables import markdown

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MARKDOWN_HEAD = """# Experiments

Written by `python -m sb3_flowpolicy.experiments report --docs docs/results`; do not edit. The data
are in [experiments/](experiments), and
`python -m sb3_flowpolicy.experiments report --results docs/results/experiments --html report.html`
makes an interactive page from them.

**How to read this.** {method}
"""


def write_report(results: Path, page: Path) -> Path:
    """Write one HTML page that needs no other files and no network.

    Raises:
        ValueError: If there are no results, or a file is corrupt.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from plotly.offline import get_plotlyjs

    loader = PackageLoader("sb3_flowpolicy.experiments", package_path="")
    templates = Environment(loader=loader, autoescape=True, undefined=StrictUndefined)
    sections = [Section(evidence) for evidence in read_results(results)]
    text = templates.get_template("report.html").render(
        sections=sections,
        method=METHOD,
        not_measured=NOT_MEASURED,
        pictures={s.experiment.name: _inline(s.pictures()) for s in sections},
        date=datetime.now(timezone.utc).date().isoformat(),
        # In contrast to our data, it contains nothing that closes a script element.
        plotly=get_plotlyjs(),
    )
    page.parent.mkdir(parents=True, exist_ok=True)
    write_text(page, text)
    return page


def _inline(figures: dict[str, Figure]) -> dict[str, str]:
    """Return figures as data URLs, except those that the page shows interactively."""
    return {
        name: "data:image/png;base64," + base64.b64encode(png(figure, dpi=90)).decode()
        for name, figure in figures.items()
        if name in ("outcomes", "policies")
    }


def write_docs(results: Path, docs: Path) -> Path:
    """Write ``experiments.md`` into the docs' results, its figures, and a copy of the data."""
    data = docs / "experiments"
    data.mkdir(parents=True, exist_ok=True)
    sections = [Section(evidence) for evidence in read_results(results)]
    overview = pd.DataFrame(
        [
            (one.claim, f"[`{one.name}`](#{one.name})", one.title, section.verdict_in_words)
            for section in sections
            for one in [section.experiment]
        ],
        columns=["claim", "experiment", "what it compares", "verdict"],
    )
    parts = [_MARKDOWN_HEAD.format(method=METHOD), markdown(overview) + "\n"]
    for section in sections:
        name, images = section.experiment.name, {}
        for kind, figure in section.pictures().items():
            images[kind] = f"experiments/{name}-{kind}.png"
            (docs / images[kind]).write_bytes(png(figure, dpi=80))
        parts.append(_markdown(section, images))
        if section.measured and data.resolve() != results.resolve():
            unwanted = shutil.ignore_patterns(".*", "agents", "checkpoints")
            shutil.copytree(results / name, data / name, ignore=unwanted, dirs_exist_ok=True)
    page = docs / "experiments.md"
    write_text(page, "\n".join(parts))
    return page


def _markdown(section: Section, images: dict[str, str]) -> str:
    experiment = section.experiment
    paragraphs = [
        f"## {experiment.name}",
        f"**{experiment.claim}, {experiment.source}.** {experiment.title}",
        f"*Thesis:* {experiment.thesis}",
        experiment.notes,
    ]
    if section.table is None:
        needs = f"Needs {section.missing}. " if section.missing else ""
        paragraphs += [
            f"Not run yet. {needs}Estimated at {section.estimate} on two cores.",
            f"`{section.facts['command']}`",
        ]
    else:
        paragraphs += [
            f"**Verdict: {section.verdict_in_words}.**",
            markdown(section.rule),
            *(f"![{experiment.name}: {kind}]({path})" for kind, path in images.items()),
            markdown(section.table),
            "\n".join(f"- {name}: {text}" for name, text in section.facts.items()),
        ]
    return "\n\n".join(filter(None, paragraphs)) + "\n"
