"""What the thesis found, asked of our results: each check says what it saw and whether it holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import spearmanr

from sb3_flowpolicy.density.datasets import TRAINING_ANGLES
from sb3_flowpolicy.density.results import interval

Row = dict[str, Any]
# A fitted density may be this far from 1 on the grid.
INTEGRAL_TOLERANCE = 0.01
# No model may be closer to the truth than minus this many standard errors.
SAMPLING_ERRORS = 4.0


@dataclass(frozen=True)
class Verdict:
    """One check.

    Args:
        rule: What should hold.
        seen: What was measured.
        holds: Whether it does.
    """

    rule: str
    seen: str
    holds: bool


def sound(rows: Sequence[Row]) -> list[Verdict]:
    """Check that every fitted density is one, and that none is better than the truth.

    Args:
        rows: Rows of a study's ``fits.csv``.

    Returns:
        Two verdicts per model.
    """
    found = []
    for model, own in by_model(rows).items():
        # numpy's extremes, unlike Python's, do not lose a NaN: it fails the comparison.
        low = np.min([row["integral_low"] for row in own])
        high = np.max([row["integral_high"] for row in own])
        found.append(
            Verdict(
                f"{model}: every fitted density integrates to 1 ± {INTEGRAL_TOLERANCE}",
                f"{low:.4f} to {high:.4f}",
                bool(low >= 1 - INTEGRAL_TOLERANCE and high <= 1 + INTEGRAL_TOLERANCE),
            )
        )
        closest = np.min([row["gap"] / row["gap_se"] for row in own])
        found.append(
            Verdict(
                f"{model}: no seed beats the entropy by more than {SAMPLING_ERRORS:.0f} errors",
                f"closest seed {closest:+.1f} standard errors from it",
                bool(closest >= -SAMPLING_ERRORS),
            )
        )
    return found


def two_moons(rows: Sequence[Row], curves: Sequence[Row], angles: Sequence[Row]) -> list[Verdict]:
    """D1: RealNVP against MAF and NAF."""
    nll = {model: interval([row["nll"] for row in own]) for model, own in by_model(rows).items()}
    ours = nll["realnvp"][0]
    return [
        Verdict(
            "RealNVP at least 0.05 nats below MAF",
            f"{ours - nll['maf'][0]:+.3f} nats",
            ours <= nll["maf"][0] - 0.05,
        ),
        Verdict(
            "RealNVP at least 0.05 nats below MAF with random orders",
            f"{ours - nll['maf-random'][0]:+.3f} nats",
            ours <= nll["maf-random"][0] - 0.05,
        ),
        Verdict(
            "NAF at most 0.05 nats above RealNVP",
            f"{nll['naf'][0] - ours:+.3f} nats",
            nll["naf"][0] <= ours + 0.05,
        ),
        Verdict(
            "zuko's RealNVP within 0.05 nats of ours",
            f"{nll['zuko-realnvp'][0] - ours:+.3f} nats",
            abs(nll["zuko-realnvp"][0] - ours) <= 0.05,
        ),
    ]


def label(rows: Sequence[Row], curves: Sequence[Row], angles: Sequence[Row]) -> list[Verdict]:
    """D2: likelihood within 250 epochs, and classification."""
    nll = [row["nll"] for row in rows]
    epochs = max(row["epoch"] for row in curves)
    accuracy = [row["accuracy"] for row in rows]
    return [
        Verdict(
            "at most 0.5 nats within 250 epochs",
            f"{interval(nll)[0]:.3f} nats after at most {epochs} epochs, worst seed {max(nll):.3f}",
            interval(nll)[0] <= 0.5 and epochs <= 250,
        ),
        Verdict(
            "at least 99 % of new points classified rightly",
            f"{interval(accuracy)[0]:.2%}, worst seed {min(accuracy):.2%}",
            interval(accuracy)[0] >= 0.99,
        ),
    ]


def angle(rows: Sequence[Row], curves: Sequence[Row], angles: Sequence[Row]) -> list[Verdict]:
    """D3: between the training angles, and outside of them."""
    of_kind = {
        kind: interval(_per_seed([row for row in angles if row["kind"] == kind]))[0]
        for kind in ("trained", "between")
    }
    steadily = [_steadiness(angles, seed) for seed in sorted({row["seed"] for row in angles})]
    difference = of_kind["between"] - of_kind["trained"]
    return [
        Verdict(
            "between training angles within 0.05 nats of training angles",
            f"{difference:+.4f} nats",
            abs(difference) <= 0.05,
        ),
        Verdict(
            "worsens steadily over the first radian outside: rank correlation with distance > 0.8",
            f"{interval(steadily)[0]:.2f}, worst seed {min(steadily):.2f}",
            interval(steadily)[0] > 0.8,
        ),
    ]


CHECKS = {"two-moons": two_moons, "two-moons-label": label, "angle-moons": angle}


def by_model(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Group rows by their model, in order of appearance."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row["model"], []).append(row)
    return groups


def _per_seed(rows: Sequence[Row]) -> list[float]:
    seeds = sorted({row["seed"] for row in rows})
    return [float(np.mean([row["nll"] for row in rows if row["seed"] == s])) for s in seeds]


def _steadiness(angles: Sequence[Row], seed: int) -> float:
    """Rank-correlate likelihood and distance over the first radian beyond, mean of both sides."""
    beyond = {
        "after the last": lambda angle: angle - TRAINING_ANGLES[-1],
        "before the first": lambda angle: 2 * np.pi - angle,
    }
    found = []
    for distance in beyond.values():
        near = [
            (distance(row["angle"]), row["nll"])
            for row in angles
            if row["seed"] == seed and row["kind"] == "outside" and distance(row["angle"]) < 1
        ]
        found.append(float(spearmanr(*zip(*near, strict=True)).statistic))
    return float(np.mean(found))
