"""Checks of the results against the thesis's findings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import spearmanr

from sb3_flowpolicy.common.statistics import bootstrap_interquartile_mean
from sb3_flowpolicy.density.datasets import TRAINING_ANGLES
from sb3_flowpolicy.density.measure import Row

# Tolerance of a density's integral on the grid.
INTEGRAL_TOLERANCE = 0.01
# A gap may be negative by at most this many standard errors.
SAMPLING_ERRORS = 4.0


class Verdict(NamedTuple):
    """A criterion, the measured value, and whether the criterion holds."""

    rule: str
    seen: str
    holds: bool


def interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the interquartile mean over seeds and its 95 % bootstrap interval."""
    estimate = bootstrap_interquartile_mean(np.asarray(values, dtype=float), seed=0)
    return float(estimate.value), float(estimate.low), float(estimate.high)


def by_model(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Group rows by their model, in order of appearance."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row["model"], []).append(row)
    return groups


def sound(rows: Sequence[Row]) -> list[Verdict]:
    """Check that each fitted density integrates to 1 and that none beats the true density."""
    found = []
    for model, own in by_model(rows).items():
        # numpy's min and max, unlike Python's, return NaN, which fails the comparison.
        low = np.min([row["integral_low"] for row in own])
        high = np.max([row["integral_high"] for row in own])
        closest = np.min([row["gap"] / row["gap_se"] for row in own])
        found += [
            Verdict(
                f"{model}: every fitted density integrates to 1 ± {INTEGRAL_TOLERANCE}",
                f"{low:.4f} to {high:.4f}",
                bool(low >= 1 - INTEGRAL_TOLERANCE and high <= 1 + INTEGRAL_TOLERANCE),
            ),
            Verdict(
                f"{model}: no seed beats the entropy by more than {SAMPLING_ERRORS:.0f} errors",
                f"closest seed {closest:+.1f} standard errors from it",
                bool(closest >= -SAMPLING_ERRORS),
            ),
        ]
    return found


def two_moons(rows: Sequence[Row], curves: Sequence[Row], angles: Sequence[Row]) -> list[Verdict]:
    """D1: RealNVP against MAF and NAF."""
    nll = {model: interval([row["nll"] for row in own])[0] for model, own in by_model(rows).items()}
    above = {model: value - nll["realnvp"] for model, value in nll.items()}
    criteria = [
        ("RealNVP at least 0.05 nats below MAF", -above["maf"], above["maf"] >= 0.05),
        (
            "RealNVP at least 0.05 nats below MAF with random orders",
            -above["maf-random"],
            above["maf-random"] >= 0.05,
        ),
        ("NAF at most 0.05 nats above RealNVP", above["naf"], above["naf"] <= 0.05),
        (
            "zuko's RealNVP within 0.05 nats of ours",
            above["zuko-realnvp"],
            abs(above["zuko-realnvp"]) <= 0.05,
        ),
    ]
    return [Verdict(rule, f"{seen:+.3f} nats", holds) for rule, seen, holds in criteria]


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
            "at least 99 % of new points classified correctly",
            f"{interval(accuracy)[0]:.2%}, worst seed {min(accuracy):.2%}",
            interval(accuracy)[0] >= 0.99,
        ),
    ]


def angle(rows: Sequence[Row], curves: Sequence[Row], angles: Sequence[Row]) -> list[Verdict]:
    """D3: between the training angles, and outside of them."""
    seeds = sorted({row["seed"] for row in angles})
    of_kind = {
        (kind, seed): [row for row in angles if (row["kind"], row["seed"]) == (kind, seed)]
        for kind in ("trained", "between", "outside")
        for seed in seeds
    }
    between, trained = (
        interval([np.mean([row["nll"] for row in of_kind[kind, seed]]) for seed in seeds])[0]
        for kind in ("between", "trained")
    )
    correlations = [_correlation_with_distance(of_kind["outside", seed]) for seed in seeds]
    return [
        Verdict(
            "between training angles within 0.05 nats of training angles",
            f"{between - trained:+.4f} nats",
            abs(between - trained) <= 0.05,
        ),
        Verdict(
            "worsens steadily over the first radian outside: rank correlation with distance > 0.8",
            f"{interval(correlations)[0]:.2f}, worst seed {min(correlations):.2f}",
            interval(correlations)[0] > 0.8,
        ),
    ]


def _correlation_with_distance(outside: Sequence[Row]) -> float:
    """Rank correlation of NLL and distance over the first radian outside, mean of both sides."""
    correlations = []
    for distance in (lambda angle: angle - TRAINING_ANGLES[-1], lambda angle: 2 * np.pi - angle):
        near = [(distance(row["angle"]), row["nll"]) for row in outside]
        near = [pair for pair in near if pair[0] < 1]
        correlations.append(float(spearmanr(*zip(*near, strict=True)).statistic))
    return float(np.mean(correlations))


CHECKS = {"two-moons": two_moons, "two-moons-label": label, "angle-moons": angle}
