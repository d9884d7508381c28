"""A page that puts each figure next to what the thesis says, and says which claims hold."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from sb3_flowpolicy.density.results import interval, read_csv
from sb3_flowpolicy.density.studies import STUDIES, Study
from sb3_flowpolicy.density.verdicts import CHECKS, Row, Verdict, by_model, sound

# Study -> its pictures, each with its place in the thesis.
PICTURES = {
    "two-moons": {
        "two-moons-curves.png": "Likelihood over epochs (Fig. 2.3); thin: every seed, thick: IQM",
        "two-moons-samples.png": "Data and samples (Fig. 2.4)",
        "two-moons-density.png": "Densities (Fig. 2.5), as brightness = square root of density",
        "two-moons-layers.png": "Layer by layer, coloured by quadrant (Fig. 2.1)",
    },
    "two-moons-label": {
        "label-curves.png": "Likelihood over epochs",
        "label-samples.png": "Data, samples (Fig. 2.7), and classification by likelihood",
    },
    "angle-moons": {
        "angles-curves.png": "Likelihood over epochs",
        "angles-samples.png": "Data and samples (Fig. 2.8); colour: angle",
        "angles-between.png": "Between training angles (Fig. 2.9); crosses: the true tips",
        "angles-outside.png": "All the way round (Fig. 2.10); trained from 0 to 2.1",
        "angles-likelihood.png": "Held-out likelihood over the angle",
        "angles.gif": "The angle turns once round",
    },
}


def write_report(folder: Path, origin: str) -> str:
    """Write ``README.md`` into a folder of results.

    Args:
        folder: Where ``run`` has left its files.
        origin: The command and the commit that made them.

    Returns:
        What was written.

    Raises:
        ValueError: If the folder holds no results.
    """
    found = [study for study in STUDIES.values() if (folder / f"{study.name}-fits.csv").exists()]
    if not found:
        raise ValueError(f"out must be a folder that `run` has written to, got {str(folder)!r}")
    parts = [
        "# Density fitting: results",
        origin,
        "Numbers are the interquartile mean over seeds with a 95 % bootstrap interval. *NLL* is "
        "the negative log-likelihood of points that neither training nor the choice of the best "
        "epoch has seen; *gap* is how far that is from the truth, measured on the same points "
        "(the Kullback-Leibler divergence, never negative but for sampling error). All in nats. "
        "Pictures show the seed with the middle NLL.",
    ]
    parts += [_section(study, folder) for study in found]
    text = "\n\n".join(parts) + "\n"
    temporary = folder / ".README.md.tmp"
    temporary.write_text(text)
    os.replace(temporary, folder / "README.md")
    return text


def verdicts(study: Study, folder: Path) -> list[Verdict]:
    """Decide a study's rules from its files."""
    fits = read_csv(folder / f"{study.name}-fits.csv")
    curves = read_csv(folder / f"{study.name}-curves.csv")
    path = folder / f"{study.name}-angles.csv"
    angles = read_csv(path) if path.exists() else []
    return [*CHECKS[study.name](fits, curves, angles), *sound(fits)]


def _section(study: Study, folder: Path) -> str:
    rows = read_csv(folder / f"{study.name}-fits.csv")
    lines = [
        f"## {study.claim} `{study.name}`: {study.title}",
        f"**The thesis:** {study.thesis}",
        f"**Entropy of the data**, the limit for every model: {rows[0]['entropy']:.3f} nats. "
        f"Seeds: {len({row['seed'] for row in rows})}.",
        _table(rows),
        "| check | seen | holds |\n|---|---|---|\n"
        + "\n".join(
            f"| {one.rule} | {one.seen} | {'yes' if one.holds else '**no**'} |"
            for one in verdicts(study, folder)
        ),
    ]
    lines += [
        f"![{caption}]({name})\n\n*{caption}.*"
        for name, caption in PICTURES[study.name].items()
        if (folder / name).exists()
    ]
    return "\n\n".join(lines)


def _table(rows: Sequence[Row]) -> str:
    lines = ["| model | NLL | gap | train NLL | NLL of each seed |", "|---|---|---|---|---|"]
    for model, own in by_model(rows).items():
        cells = [_interval([row[key] for row in own]) for key in ("nll", "gap", "train_nll")]
        each = " ".join(f"{row['nll']:.2f}" for row in own)
        lines.append(f"| {model} | {' | '.join(cells)} | {each} |")
    return "\n".join(lines)


def _interval(values: Sequence[float]) -> str:
    return "{:.3f} [{:.3f}, {:.3f}]".format(*interval(values))
