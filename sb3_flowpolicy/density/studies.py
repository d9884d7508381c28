"""The studies of the chapter, with the findings of the thesis."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from sb3_flowpolicy.density.datasets import TRAINING_ANGLES, AngleMoons, DataSet, TwoMoons


class Scale(NamedTuple):
    """Amount of computation."""

    n_validation: int = 2000  # points per seed that select the weights
    n_heldout: int = 10_000  # points per seed for the reported likelihood
    n_per_angle: int = 1000  # held-out points per seed and angle
    angle_step: float = 0.1  # radian between the angles scored outside the trained range
    cells: int = 700  # grid points per axis of each integral
    integral_angles: int = 8  # angles, over the full circle, whose densities are integrated
    shrink: int = 1  # divisor of the number of epochs
    frames: int = 63  # of the animation
    pixels: int = 300  # per side of a density picture


FULL = Scale()
# For tests of the command; the results mean nothing.
QUICK = Scale(200, 500, 50, 0.4, cells=100, integral_angles=2, shrink=50, frames=4, pixels=40)


class Study(NamedTuple):
    """An experiment of the chapter."""

    name: str
    claim: str  # number among the thesis's claims
    title: str
    data: Callable[[], DataSet]
    epochs: Mapping[str, int]  # by model; the first model is drawn in most pictures
    thesis: str  # the thesis's findings in our words; ``report`` checks them


_STUDIES = (
    Study(
        name="two-moons",
        claim="D1",
        title="Which flow fits the two moons best? (thesis 2.1.2, Fig. 2.1, 2.3-2.5)",
        data=TwoMoons,
        epochs={
            "realnvp": 1000,
            "zuko-realnvp": 1000,
            "maf": 1000,
            "maf-random": 1000,
            "naf": 600,  # a step takes several times as long
            "nsf": 500,
        },
        thesis="RealNVP and NAF reach about the same NLL, MAF ends 0.1 nats above them. NAF "
        "starts extremely high and is best after about 500 epochs. A thin bridge of probability "
        "connects the two moons.",
    ),
    Study(
        name="two-moons-label",
        claim="D2",
        title="One flow, two shapes: the moon's label as condition (thesis 2.1.3, Fig. 2.7)",
        data=lambda: TwoMoons(labeled=True),
        epochs={"realnvp": 250},
        thesis="The NLL reaches 0.5 nats within 250 epochs, less than half of the best "
        "unconditional flow's. The samples look like the data. Comparing the likelihoods of a "
        "point under both labels classifies it.",
    ),
    Study(
        name="angle-moons",
        claim="D3",
        title="Between and beyond the training angles (thesis 2.1.3, Fig. 2.8-2.10)",
        data=AngleMoons,
        epochs={"realnvp": 300},
        thesis="Samples look like the data at all 22 angles. Between the training angles the half "
        "circle turns smoothly. Outside their range it loses its shape, increasingly with the "
        "distance.",
    ),
)
STUDIES = {study.name: study for study in _STUDIES}


def angles_to_score(scale: Scale) -> dict[str, np.ndarray]:
    """Return the angles whose held-out likelihood is measured, by kind.

    ``outside`` covers the circle from the last training angle back to the first.
    """
    between = (TRAINING_ANGLES[:-1] + TRAINING_ANGLES[1:]) / 2
    outside = np.arange(2.1 + scale.angle_step, 2 * np.pi - scale.angle_step / 2, scale.angle_step)
    return {"trained": TRAINING_ANGLES, "between": between, "outside": outside}
