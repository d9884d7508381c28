"""All results as Markdown with figures and data, for the docs."""

from __future__ import annotations

import shutil
from pathlib import Path

from sb3_flowpolicy.common.files import write_text
from sb3_flowpolicy.experiments.evidence import Evidence
from sb3_flowpolicy.experiments.section import METHOD, Section, png, read_results
from sb3_flowpolicy.experiments.tables import Table

_MARKDOWN_HEAD = """# Experiments

Written by `python -m sb3_flowpolicy.experiments report --docs docs/results`; do not edit. The data
are in [experiments/](experiments), and
`python -m sb3_flowpolicy.experiments report --results docs/results/experiments --html report.html`
makes an interactive page of them.

**How to read this.** {method}
"""


def write_docs(results: Path, docs: Path) -> Path:
    """Write ``experiments.md``, its figures, and a copy of the data.

    Args:
        results: Folder that ``run`` wrote.
        docs: Folder of the docs' results.

    Returns:
        The Markdown file.
    """
    data = docs / "experiments"
    data.mkdir(parents=True, exist_ok=True)
    parts = [_MARKDOWN_HEAD.format(method=METHOD), _overview(results)]
    for evidence in read_results(results):
        section = Section(evidence)
        images = {}
        for name, figure in section.pictures().items():
            images[name] = f"experiments/{evidence.experiment.name}-{name}.png"
            (docs / images[name]).write_bytes(png(figure, dpi=80))
        parts.append(_markdown(section, images))
        if section.measured and data.resolve() != results.resolve():
            _copy_data(evidence, data / evidence.experiment.name)
    page = docs / "experiments.md"
    write_text(page, "\n".join(parts))
    return page


def _overview(results: Path) -> str:
    rows = []
    for evidence in read_results(results):
        one = Section(evidence)
        experiment = one.experiment
        link = f"[`{experiment.name}`](#{experiment.name})"
        rows.append([experiment.claim, link, experiment.title, _verdict(one)])
    return Table(["claim", "experiment", "what it compares", "verdict"], rows).markdown() + "\n"


def _verdict(section: Section) -> str:
    return section.verdict_in_words + (f" ({section.reservation})" if section.reservation else "")


def _markdown(section: Section, images: dict[str, str]) -> str:
    experiment = section.experiment
    lines = [f"## {experiment.name}", "", f"**{experiment.claim}, {experiment.source}.** "]
    lines[-1] += f"{experiment.title}"
    lines += ["", f"*Thesis:* {experiment.thesis}", ""]
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


def _copy_data(evidence: Evidence, folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    for path in sorted(evidence.folder.iterdir()):
        if path.suffix in (".csv", ".json", ".jsonl"):
            shutil.copyfile(path, folder / path.name)
