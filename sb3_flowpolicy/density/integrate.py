"""Does a fitted density integrate to one? Asked of a grid, not of its formula."""

from __future__ import annotations

import math

import torch as th

from sb3_flowpolicy.density.models import FlowModel

# The grid is even near the data and thins out beyond: x = sinh(u), which reaches +-74.
REACH = 5.0
CELLS = 800
# Points scored at once.
CHUNK = 80_000


@th.no_grad()
def integral(model: FlowModel, condition: th.Tensor, cells: int = CELLS) -> float:
    r"""Integrate a density over the plane.

    .. math:: \int p(x)\,dx = \int p(\sinh u) \cosh u_1 \cosh u_2\, du

    Near the origin, where standardised data lie, the cells are 0.0125 wide, a quarter of the
    noise of the data. A wrong log-determinant shows here, and so does mass that a flow loses
    because one of its layers does not reach all of the plane.

    Args:
        model: The density.
        condition: Its condition, shape (C,).
        cells: Grid points per axis.

    Returns:
        The integral: 1 for a density.

    Example:
        >>> import torch as th
        >>> from sb3_flowpolicy.density.models import make_model
        >>> print(f"{integral(make_model('realnvp', 0, seed=0), th.zeros(0), cells=100):.4f}")
        1.0000
    """
    u = th.linspace(-REACH, REACH, cells, dtype=th.float64)
    points = th.cartesian_prod(u.sinh(), u.sinh()).float()
    log_cell = th.cartesian_prod(u.cosh().log(), u.cosh().log()).sum(1)
    total = 0.0
    for part, log_size in zip(points.split(CHUNK), log_cell.split(CHUNK), strict=True):
        log_p = model(part, condition.expand(len(part), -1))
        total += (log_p.double() + log_size).exp().sum().item()
    return total * (2 * REACH / (cells - 1)) ** 2


@th.no_grad()
def density_picture(model: FlowModel, condition: th.Tensor, extent: float, cells: int) -> th.Tensor:
    """Score the middle of every pixel of a square picture.

    Args:
        model: The density.
        condition: Its condition, shape (C,).
        extent: The picture shows [-extent, extent] in both directions.
        cells: Pixels per side.

    Returns:
        Densities, shape (cells, cells); rows from the lowest y up, columns from the lowest x.

    Raises:
        ValueError: If the picture has no size.
    """
    if not (extent > 0 and math.isfinite(extent) and cells > 0):
        raise ValueError(f"extent and cells must be positive, got {extent} and {cells}")
    middle = ((th.arange(cells) + 0.5) / cells * 2 - 1) * extent
    y, x = th.meshgrid(middle, middle, indexing="ij")
    points = th.stack([x, y], dim=-1).reshape(-1, 2)
    scores = [model(part, condition.expand(len(part), -1)) for part in points.split(CHUNK)]
    return th.cat(scores).exp().reshape(cells, cells)
