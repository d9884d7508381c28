"""All results as one self-contained HTML page, and as Markdown for the docs."""

from __future__ import annotations

import base64
import functools
import io
import shutil
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from sb3_flowpolicy.common.files import write_text
from sb3_flowpolicy.common.statistics import RESAMPLES
from sb3_flowpolicy.experiments import evidence as definitions
from sb3_flowpolicy.experiments import figures, work
from sb3_flowpolicy.experiments.evidence import Evidence
from sb3_flowpolicy.experiments.experiment import (
    NOT_MEASURED,
    NOT_REPRODUCED,
    PARTLY,
    REPRODUCED,
    Experiment,
)
from sb3_flowpolicy.experiments.manifest import EXPERIMENTS, what_is_missing
from sb3_flowpolicy.experiments.store import differences
from sb3_flowpolicy.experiments.tables import facts, markdown, results_table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MARKDOWN_HEAD = """# Experiments

Written by `python -m sb3_flowpolicy.experiments report --docs docs/results`; do not edit. The data
are in [experiments/](experiments), and
`python -m sb3_flowpolicy.experiments report --results docs/results/experiments --html report.html`
makes one page from them.

**How to read this.** {method}
"""

METHOD = (
    "Every seed is drawn and counted; none is dropped. Numbers are interquartile means over seeds "
    f"with 95 % bootstrap intervals in brackets (percentiles of {RESAMPLES} resamples). "
    "Test episodes are deterministic, at least ten per seed and measurement; on a tunnel, whose "
    "start is fixed, they are all the same episode. They use the mean, of a flow the image of the "
    "base mean, and 'most likely action' stands for `deterministic_mode=\"log_prob\"` instead. "
    "Training numbers average the episodes that ended since the last measurement, entropies 256 "
    "states of the replay buffer. "
    f"'Final' is the mean over the last {definitions.FINAL_SHARE:.0%} of the measurements, at "
    f"least {definitions.FINAL_LEAST}. A seed has solved its task 'at the end' if its final test "
    f"success is at least {definitions.SOLVED:.0%}, 'at its best' if {definitions.IN_A_ROW} "
    "measurements in a row average that; a seed that never does counts with the length of "
    "training in 'steps until solved'. Oscillations are counted as swings of at least "
    f"{definitions.OSCILLATIONS['train_return']:.0%} of the highest test return in training "
    f"return, {definitions.OSCILLATIONS['entropy']:g} nats in entropy and "
    f"{definitions.OSCILLATIONS['log_ent_coef']:g} in the logarithm of the entropy coefficient, "
    "from the first training success on; the curve with the fewest decides. Logs of unequal "
    "length are interpolated to a common grid that ends with the shortest. "
    f"Curves are drawn as means over {figures.SMOOTHED_OVER} measurements. A claim is reproduced "
    "if all lines of its rule hold, not reproduced if none does, partly reproduced otherwise. Our "
    "own experiments have no claim to reproduce; each line of their rules describes one agent."
)

_OURS_IN_WORDS = {
    REPRODUCED: "all lines hold",
    PARTLY: "some lines hold",
    NOT_REPRODUCED: "no line holds",
}


class Section:
    """Verdict, tables and figures of one experiment."""

    def __init__(self, evidence: Evidence) -> None:
        self.evidence, self.experiment = evidence, evidence.experiment
        self.verdict, findings = evidence.judge()
        self.table = results_table(evidence) if evidence.measured else None
        self.facts = facts(evidence)
        self.missing = what_is_missing(self.experiment)
        self.steps = sum(item.all_steps for item in work.make_plan(self.experiment).items)
        # Trials must not be taken for results.
        self.reservation = (
            reservation(self.experiment, evidence.settings) if evidence.items else None
        )
        marks = {True: "holds", False: "fails", None: "open"}
        rule = [
            (check.statement, marks[finding.holds], finding.measured)
            for check, finding in zip(self.experiment.checks, findings, strict=True)
        ]
        self.rule = pd.DataFrame(rule, columns=["rule", "", "measured"])

    @property
    def verdict_in_words(self) -> str:
        """The verdict and its reservation; our own experiments have no claim to reproduce."""
        ours = self.experiment.source == "ours"
        verdict = _OURS_IN_WORDS.get(self.verdict, self.verdict) if ours else self.verdict
        return verdict + (f" ({self.reservation})" if self.reservation else "")

    def pictures(self) -> dict[str, Figure]:
        """Return the figures of measured agents by name."""
        found = {
            "outcomes": figures.outcomes_figure(self.evidence),
            "curves": figures.curves_figure(self.evidence),
            "profile": figures.profile_figure(self.evidence),
            "policies": figures.policies_figure(self.evidence),
        }
        return {name: figure for name, figure in found.items() if figure is not None}


def reservation(experiment: Experiment, settings: dict[str, Any]) -> str | None:
    """Explain why results with these settings are not the experiment's own, None if they are."""
    planned = work.make_plan(experiment)
    seeds = settings["seeds"]
    if settings["steps"] < planned.steps or len(seeds) < len(planned.seeds):
        return "trial, not a result"
    if seeds[0] != work.FIRST_SEED:
        return f"seeds from {seeds[0]} on, which are for tuning: not a result"
    together = max(len(item["seeds"]) for item in settings["items"].values())
    same = work.make_plan(
        experiment, steps=settings["steps"], seeds=len(seeds), seeds_per_item=together
    )
    found = differences(settings, same.settings())
    return f"made with other settings ({found[0]})" if found else None


def read_results(results: Path) -> list[Section]:
    """Judge the results of all experiments in a folder; raise ``ValueError`` if there are none."""

    @functools.cache
    def one(name: str) -> Evidence:
        return Evidence(EXPERIMENTS[name], results / name, one)

    found = [one(name) for name in EXPERIMENTS]
    if not any(evidence.items for evidence in found):
        raise ValueError(
            f"{results} must hold the results of at least one experiment, got none: "
            "python -m sb3_flowpolicy.experiments run NAME makes some"
        )
    return [Section(evidence) for evidence in found]


def write_report(sections: Sequence[Section], page: Path) -> None:
    """Write one HTML page that needs no other files and no network."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    loader = PackageLoader("sb3_flowpolicy.experiments", package_path="")
    templates = Environment(loader=loader, autoescape=True, undefined=StrictUndefined)
    text = templates.get_template("report.html").render(
        sections=sections,
        method=METHOD,
        not_measured=NOT_MEASURED,
        picture=lambda figure: base64.b64encode(png(figure, dpi=90)).decode(),
        date=datetime.now(timezone.utc).date().isoformat(),
    )
    page.parent.mkdir(parents=True, exist_ok=True)
    write_text(page, text)


def write_docs(sections: Sequence[Section], docs: Path) -> Path:
    """Write ``experiments.md`` into the docs' results, its figures, and a copy of the data.

    Returns:
        The page.
    """
    data = docs / "experiments"
    data.mkdir(parents=True, exist_ok=True)
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
        if section.table is not None:
            for kind, figure in section.pictures().items():
                images[kind] = f"experiments/{name}-{kind}.png"
                (docs / images[kind]).write_bytes(png(figure, dpi=80))
            source, copy = section.evidence.folder, data / name
            if copy.resolve() != source.resolve():
                unwanted = shutil.ignore_patterns(".*", "agents", "checkpoints")
                shutil.copytree(source, copy, ignore=unwanted, dirs_exist_ok=True)
        parts.append(_markdown(section, images))
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
            f"Not run yet. {needs}It takes {section.steps:,} steps.",
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


def png(figure: Any, dpi: int) -> bytes:
    """Return a figure as the bytes of a PNG file, the same for the same figure."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=dpi, format="png", metadata={"Software": None})
    return buffer.getvalue()
