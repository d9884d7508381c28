"""Checks of the results against the thesis's findings."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.stats import spearmanr, trim_mean

from sb3_flowpolicy.density.datasets import TRAINING_ANGLES

# Tolerance of a density's integral on the grid.
INTEGRAL_TOLERANCE = 0.01
# A gap may be negative by at most this many standard errors.
SAMPLING_ERRORS = 4.0
# Fraction of the seeds that an interquartile mean leaves out at each end.
TRIMMED = 0.25
# A criterion, the measured value, and whether the criterion holds.
Verdict = tuple[str, str, bool]


def sound(fits: pd.DataFrame) -> list[Verdict]:
    """Check that each fitted density integrates to 1 and that none beats the true density."""
    found: list[Verdict] = []
    for model, own in fits.groupby("model", sort=False):
        # numpy's min and max, unlike those of pandas, return NaN, which fails the comparison.
        low, high = own["integral_low"].to_numpy().min(), own["integral_high"].to_numpy().max()
        closest = (own["gap"] / own["gap_se"]).to_numpy().min()
        found += [
            (
                f"{model}: every fitted density integrates to 1 ± {INTEGRAL_TOLERANCE}",
                f"{low:.4f} to {high:.4f}",
                low >= 1 - INTEGRAL_TOLERANCE and high <= 1 + INTEGRAL_TOLERANCE,
            ),
            (
                f"{model}: no seed beats the entropy by more than {SAMPLING_ERRORS:.0f} errors",
                f"closest seed {closest:+.1f} standard errors from it",
                closest >= -SAMPLING_ERRORS,
            ),
        ]
    return found


def two_moons(fits: pd.DataFrame, curves: pd.DataFrame, angles: pd.DataFrame) -> list[Verdict]:
    """D1: RealNVP against MAF and NAF."""
    nll = fits.groupby("model")["nll"].apply(trim_mean, TRIMMED)
    maf, shuffled, naf, zuko = (
        nll[name] - nll["realnvp"] for name in ("maf", "maf-random", "naf", "zuko-realnvp")
    )
    lower = "RealNVP at least 0.05 nats below MAF"
    return [
        (lower, f"{-maf:+.3f} nats", maf >= 0.05),
        (f"{lower} with random orders", f"{-shuffled:+.3f} nats", shuffled >= 0.05),
        ("NAF at most 0.05 nats above RealNVP", f"{naf:+.3f} nats", naf <= 0.05),
        ("zuko's RealNVP within 0.05 nats of ours", f"{zuko:+.3f} nats", abs(zuko) <= 0.05),
    ]


def label(fits: pd.DataFrame, curves: pd.DataFrame, angles: pd.DataFrame) -> list[Verdict]:
    """D2: likelihood within 250 epochs, and classification."""
    nll, accuracy = trim_mean(fits[["nll", "accuracy"]], TRIMMED)
    epochs = curves["epoch"].max()
    return [
        (
            "at most 0.5 nats within 250 epochs",
            f"{nll:.3f} nats after at most {epochs} epochs, worst seed {fits['nll'].max():.3f}",
            nll <= 0.5 and epochs <= 250,
        ),
        (
            "at least 99 % of new points classified correctly",
            f"{accuracy:.2%}, worst seed {fits['accuracy'].min():.2%}",
            accuracy >= 0.99,
        ),
    ]


def angle(fits: pd.DataFrame, curves: pd.DataFrame, angles: pd.DataFrame) -> list[Verdict]:
    """D3: between the training angles, and outside of them."""
    nll = angles.groupby(["kind", "seed"])["nll"].mean()
    rise = trim_mean(nll["between"], TRIMMED) - trim_mean(nll["trained"], TRIMMED)
    outside = angles[angles["kind"] == "outside"]
    each = [_correlation_with_distance(own) for _, own in outside.groupby("seed")]
    correlation = trim_mean(each, TRIMMED)
    return [
        (
            "between training angles within 0.05 nats of training angles",
            f"{rise:+.4f} nats",
            abs(rise) <= 0.05,
        ),
        (
            "worsens steadily over the first radian outside: rank correlation with distance > 0.8",
            f"{correlation:.2f}, worst seed {min(each):.2f}",
            correlation > 0.8,
        ),
    ]


def _correlation_with_distance(outside: pd.DataFrame) -> float:
    """Rank correlation of NLL and distance over the first radian outside, mean of both sides."""
    correlations = []
    for distance in (outside["angle"] - TRAINING_ANGLES[-1], 2 * np.pi - outside["angle"]):
        near = distance < 1
        correlations.append(spearmanr(distance[near], outside["nll"][near]).statistic)
    return float(np.mean(correlations))


CHECKS = {"two-moons": two_moons, "two-moons-label": label, "angle-moons": angle}
