"""A page that puts each figure next to what the thesis says, and says which claims hold."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from sb3_flowpolicy.density.results import interval, read_csv
from sb3_flowpolicy.density.studies import STUDIES, Study
from sb3_flowpolicy.density.verdicts import CHECKS, Row, Verdict, by_model, sound

# Study -> its pictures, each with a caption and with what the thesis says of it, in our words.
PICTURES = {
    "two-moons": {
        "two-moons-curves.png": (
            "Likelihood over epochs; thin: every seed, thick: interquartile mean",
            "Fig. 2.3: RealNVP and NAF are alike after some hundred epochs, MAF learns more slowly "
            "and stays 0.1 nats above; NAF starts out extremely high.",
        ),
        "two-moons-samples.png": (
            "Data and samples of all models",
            "Fig. 2.4: RealNVP fits well; a thin tail connects the moons, because it is hard to "
            "split a connected mass.",
        ),
        "two-moons-density.png": (
            "True and fitted densities; brightness is the square root of the density",
            "Fig. 2.5: scoring every pixel tells more than samples do.",
        ),
        "two-moons-layers.png": (
            "After each layer of our RealNVP, coloured by the quadrant of the noise",
            "Fig. 2.1: layer by layer, a normal distribution is stretched and wrapped into moons.",
        ),
    },
    "two-moons-label": {
        "label-curves.png": (
            "Likelihood over epochs",
            "0.5 nats are reached, and training has converged, after 250 epochs.",
        ),
        "label-samples.png": (
            "Data, samples given the label, and classification of new points by likelihood",
            "Fig. 2.7: model and data look extremely similar; scoring a point under both labels "
            "classifies it.",
        ),
    },
    "angle-moons": {
        "angles-curves.png": ("Likelihood over epochs", "Not shown there."),
        "angles-samples.png": (
            "Data and samples, coloured by angle",
            "Fig. 2.8: very similar; only the tips flatten out slightly.",
        ),
        "angles-between.png": (
            "Densities between training angles; crosses: the true tips",
            "Fig. 2.9: the half circle turns between every two pictures: the model does not "
            "fall back on the nearest angle that it was trained on.",
        ),
        "angles-outside.png": (
            "Densities all the way round; crosses: the true tips",
            "Fig. 2.10: clear half circles up to 1.57; blunter tips at 2.36; the wrong direction "
            "at 3.14; failure at 3.93 and 4.71; vaguely a half circle again at 5.50.",
        ),
        "angles-likelihood.png": (
            "Held-out likelihood over the angle; thin: every seed",
            "Generalises well near the training angles, at best roughly far away; not measured.",
        ),
        "angles.gif": ("The angle turns once round", "A sequence of pictures was linked."),
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
        f"![{caption}]({name})\n\n*{caption}.* **Thesis:** {thesis}"
        for name, (caption, thesis) in PICTURES[study.name].items()
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
