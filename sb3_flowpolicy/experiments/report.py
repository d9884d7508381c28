"""All results as one self-contained HTML page, and as Markdown for the docs."""

from __future__ import annotations

import base64
import shutil
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING

from sb3_flowpolicy.common.files import write_text
from sb3_flowpolicy.experiments.experiment import NOT_MEASURED
from sb3_flowpolicy.experiments.section import METHOD, Section, png, read_results
from sb3_flowpolicy.experiments.tables import Table

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
    overview = [
        [one.experiment.claim, f"[`{name}`](#{name})", one.experiment.title, _verdict(one)]
        for one in sections
        for name in [one.experiment.name]
    ]
    table = Table(["claim", "experiment", "what it compares", "verdict"], overview)
    parts = [_MARKDOWN_HEAD.format(method=METHOD), table.markdown() + "\n"]
    for section in sections:
        images = {}
        for name, figure in section.pictures().items():
            images[name] = f"experiments/{section.experiment.name}-{name}.png"
            (docs / images[name]).write_bytes(png(figure, dpi=80))
        parts.append(_markdown(section, images))
        if section.measured and data.resolve() != results.resolve():
            _copy_data(section.evidence.folder, data / section.experiment.name)
    page = docs / "experiments.md"
    write_text(page, "\n".join(parts))
    return page


def _verdict(section: Section) -> str:
    return section.verdict_in_words + (f" ({section.reservation})" if section.reservation else "")


def _markdown(section: Section, images: dict[str, str]) -> str:
    experiment = section.experiment
    lines = [f"## {experiment.name}", ""]
    lines += [
        f"**{experiment.claim}, {experiment.source}.** {experiment.title}",
        "",
        f"*Thesis:* {experiment.thesis}",
        "",
    ]
    if experiment.notes:
        lines += [experiment.notes, ""]
    if section.table is None:
        needs = f"Needs {section.missing}. " if section.missing else ""
        lines += [f"Not run yet. {needs}Estimated at {section.estimate} on two cores.", ""]
        lines += [f"`{section.facts['command']}`", ""]
        return "\n".join(lines)
    lines += [f"**Verdict: {_verdict(section)}.**", ""]
    rows = [[text, mark, finding.measured] for text, mark, finding in section.rule]
    lines += [Table(["rule", "", "measured"], rows).markdown(), ""]
    for name, path in images.items():
        lines += [f"![{experiment.name}: {name}]({path})", ""]
    lines += [section.table.markdown(), ""]
    lines += [f"- {name}: {text}" for name, text in section.facts.items()]
    return "\n".join([*lines, ""])


def _copy_data(source: Path, target: Path) -> None:
    target.mkdir(exist_ok=True)
    for path in sorted(source.iterdir()):
        if path.suffix in (".csv", ".json", ".jsonl"):
            shutil.copyfile(path, target / path.name)
