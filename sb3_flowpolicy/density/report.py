"""A page with each figure, the thesis's finding about it, and the checks of its claims."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sb3_flowpolicy.common.files import write_text
from sb3_flowpolicy.density.measure import Row
from sb3_flowpolicy.density.results import read_csv
from sb3_flowpolicy.density.studies import STUDIES, Study
from sb3_flowpolicy.density.verdicts import CHECKS, by_model, interval, sound

# Study -> picture -> caption, and the thesis's finding in our words.
PICTURES = {
    "two-moons": {
        "two-moons-curves.png": (
            "NLL over epochs; thin: every seed, thick: interquartile mean",
            "Fig. 2.3: RealNVP and NAF are alike after some hundred epochs, MAF learns more slowly "
            "and stays 0.1 nats above; NAF starts extremely high.",
        ),
        "two-moons-samples.png": (
            "Data and samples of all models",
            "Fig. 2.4: RealNVP fits well; a thin tail connects the moons, because a flow "
            "can hardly split a connected mass.",
        ),
        "two-moons-density.png": (
            "True and fitted densities; brightness is the square root of the density",
            "Fig. 2.5: the density at every pixel shows more than samples.",
        ),
        "two-moons-layers.png": (
            "Samples after each layer of our RealNVP, colored by the quadrant of the noise",
            "Fig. 2.1: the layers stretch and bend a normal distribution into moons.",
        ),
    },
    "two-moons-label": {
        "label-curves.png": (
            "NLL over epochs",
            "Training converges to 0.5 nats within 250 epochs.",
        ),
        "label-samples.png": (
            "Data, samples given the label, and classification of new points by likelihood",
            "Fig. 2.7: model and data look extremely similar; scoring a point under both labels "
            "classifies it.",
        ),
    },
    "angle-moons": {
        "angles-curves.png": ("NLL over epochs", "Not shown."),
        "angles-samples.png": (
            "Data and samples, colored by angle",
            "Fig. 2.8: very similar; only the tips are slightly flatter.",
        ),
        "angles-between.png": (
            "Densities between training angles; crosses: the true tips",
            "Fig. 2.9: the half circle turns from picture to picture; the model does not repeat "
            "the nearest training angle.",
        ),
        "angles-outside.png": (
            "Densities over the full circle; crosses: the true tips",
            "Fig. 2.10: clear half circles up to 1.57; blunter tips at 2.36; a wrong direction "
            "at 3.14; no half circle at 3.93 and 4.71; vaguely a half circle again at 5.50.",
        ),
        "angles-likelihood.png": (
            "Held-out NLL over the angle; thin: every seed",
            "Generalizes well near the training angles, at best roughly far away; not measured.",
        ),
        "angles.gif": ("A full turn of the angle", "A link to a sequence of pictures."),
    },
}


def write_report(folder: Path, origin: str) -> str:
    """Write ``README.md`` into a folder of results.

    Args:
        folder: Folder that ``run`` has written to.
        origin: The command and the commit of the results.

    Returns:
        The text.
    """
    found = [study for study in STUDIES.values() if (folder / f"{study.name}-fits.csv").exists()]
    if not found:
        raise ValueError(f"out must be a folder that `run` has written to, got {str(folder)!r}")
    parts = [
        "# Density fitting: results",
        origin,
        "Numbers are the interquartile mean over seeds with a 95 % bootstrap interval, in nats. "
        "*NLL* is the negative log-likelihood of points that were used neither for training nor "
        "for choosing the best epoch. *Gap* is its distance to that of the true density on the "
        "same points: the Kullback-Leibler divergence, negative only by sampling error. Pictures "
        "show the seed with the median NLL.",
    ]
    parts += [_section(study, folder) for study in found]
    text = "\n\n".join(parts) + "\n"
    write_text(folder / "README.md", text)
    return text


def _section(study: Study, folder: Path) -> str:
    rows = read_csv(folder / f"{study.name}-fits.csv")
    curves = read_csv(folder / f"{study.name}-curves.csv")
    path = folder / f"{study.name}-angles.csv"
    angles = read_csv(path) if path.exists() else []
    verdicts = [*CHECKS[study.name](rows, curves, angles), *sound(rows)]
    lines = [
        f"## {study.claim} `{study.name}`: {study.title}",
        f"**The thesis:** {study.thesis}",
        f"**Entropy of the data**, the lower limit of the NLL: {rows[0]['entropy']:.3f} nats. "
        f"Seeds: {len({row['seed'] for row in rows})}.",
        _table(rows),
        "| criterion | measured | holds |\n|---|---|---|\n"
        + "\n".join(
            f"| {one.rule} | {one.seen} | {'yes' if one.holds else '**no**'} |" for one in verdicts
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
