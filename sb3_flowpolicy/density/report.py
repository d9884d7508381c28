"""A page with the tables, the figures, the thesis's findings, and the checks of its claims."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from sb3_flowpolicy.common.files import write_text
from sb3_flowpolicy.common.statistics import interquartile_mean
from sb3_flowpolicy.density.studies import STUDIES, Study
from sb3_flowpolicy.density.verdicts import CHECKS, sound

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
        "label-samples.png": (
            "Data, samples given the label, and classification of new points by likelihood",
            "Fig. 2.7: model and data look extremely similar; scoring a point under both labels "
            "classifies it.",
        ),
    },
    "angle-moons": {
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


def write_report(folder: Path) -> str:
    """Write ``README.md`` into a folder that ``run`` has written to, and return the text."""
    found = [study for study in STUDIES.values() if (folder / f"{study.name}-fits.csv").exists()]
    if not found:
        raise ValueError(f"out must be a folder that `run` has written to, got {str(folder)!r}")
    origin = folder / "origin.txt"
    parts = [
        "# Density fitting: results",
        origin.read_text() if origin.exists() else "",
        "Numbers are the interquartile mean over seeds with a 95 % bootstrap interval, in nats. "
        "*NLL* is the negative log-likelihood of points that were used neither for training nor "
        "for choosing the best epoch. *Gap* is its distance to that of the true density on the "
        "same points: the Kullback-Leibler divergence, negative only by sampling error. Pictures "
        "show the seed with the median NLL.",
    ]
    text = "\n\n".join([*parts, *(_section(study, folder) for study in found)]) + "\n"
    write_text(folder / "README.md", text)
    return text


def _section(study: Study, folder: Path) -> str:
    fits = pd.read_csv(folder / f"{study.name}-fits.csv")
    curves = pd.read_csv(folder / f"{study.name}-curves.csv")
    path = folder / f"{study.name}-angles.csv"
    angles = pd.read_csv(path) if path.exists() else pd.DataFrame()
    models = ["| model | NLL | gap | train NLL | NLL of each seed |", "|---|---|---|---|---|"]
    for model, own in fits.groupby("model", sort=False):
        cells = [_interval(own[name]) for name in ("nll", "gap", "train_nll")]
        each = " ".join(f"{nll:.2f}" for nll in own["nll"])
        models.append(f"| {model} | {' | '.join(cells)} | {each} |")
    criteria = ["| criterion | measured | holds |", "|---|---|---|"]
    for rule, seen, holds in (*CHECKS[study.name](fits, curves, angles), *sound(fits)):
        criteria.append(f"| {rule} | {seen} | {'yes' if holds else '**no**'} |")
    parts = [
        f"## {study.claim} `{study.name}`: {study.title}",
        f"**The thesis:** {study.thesis}",
        f"**Entropy of the data**, the lower limit of the NLL: {fits['entropy'][0]:.3f} nats. "
        f"Seeds: {fits['seed'].nunique()}.",
        "\n".join(models),
        "\n".join(criteria),
    ]
    parts += [
        f"![{caption}]({name})\n\n*{caption}.* **Thesis:** {thesis}"
        for name, (caption, thesis) in PICTURES[study.name].items()
        if (folder / name).exists()
    ]
    return "\n\n".join(parts)


def _interval(values: pd.Series) -> str:
    mean = interquartile_mean(values.to_numpy(), seed=0)
    return f"{mean.value:.3f} [{mean.low:.3f}, {mean.high:.3f}]"
