"""Compiled geometry and dynamics of the Tunnel, for a batch of agents at once.

Plain numbers describe a path, because compiled code accepts them fastest: `kind` is the type of the
path, `numbers` and `table` are its parameters (see `flowpolicy_envs.tunnel.paths`). The *arc* of a
point of the path is the signed length of path between the start and the point.

All compiled code is in one file because numba's cache only notices changes in the file of the
function that is called.
"""

import math

import numpy as np
from numba import njit

FloatArray = np.ndarray[tuple[int, ...], np.dtype[np.float64]]

LINE, CIRCLE, SPLINE = 0, 1, 2

TOLERANCE = 1e-9
"""Nine steps of 0.1 add up to a little less than 0.9, and the agent must not fail by rounding. The
tolerance is far above the error of thousands of additions and far below any sensible width."""


@njit(cache=True)
def place(kind: int, numbers: FloatArray, table: FloatArray, arc: float, out: FloatArray) -> None:
    """Write the point of the center line at `arc` into `out` (D,)."""
    if kind == LINE:
        coupled = int(numbers[0])
        out[:] = 0.0
        out[:coupled] = arc / math.sqrt(coupled)
    elif kind == CIRCLE:
        radius = numbers[0]
        out[0] = radius * math.cos(arc / radius)
        out[1] = radius * math.sin(arc / radius)
    else:
        last = table.shape[0] - 2
        k = 0
        while k < last and table[k + 1, 2] < arc:
            k += 1
        share = (arc - table[k, 2]) / (table[k + 1, 2] - table[k, 2])
        out[0] = table[k, 0] + share * (table[k + 1, 0] - table[k, 0])
        out[1] = table[k, 1] + share * (table[k + 1, 1] - table[k, 1])


@njit(cache=True)
def _locate_line(numbers: FloatArray, position: FloatArray) -> tuple[float, float]:
    coupled, bound, goal_position = int(numbers[0]), int(numbers[1]), numbers[2]
    mean = 0.0
    for j in range(coupled):
        mean += position[j]
    mean /= coupled
    # Projecting off (1, ..., 1) leaves the deviation from the mean.
    square = 0.0
    for j in range(coupled):
        square += (position[j] - mean) ** 2
    offset = math.sqrt(square)
    for j in range(coupled, bound):
        offset = max(offset, abs(position[j]))
    return offset, (goal_position - mean) * math.sqrt(coupled)


@njit(cache=True)
def _locate_circle(numbers: FloatArray, position: FloatArray) -> tuple[float, float]:
    radius, goal_angle, half_goal = numbers[0], numbers[1], numbers[2]
    offset = abs(math.sqrt(position[0] ** 2 + position[1] ** 2) - radius)
    turn = math.atan2(position[1], position[0]) - goal_angle
    turn -= 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)
    return offset, radius * (abs(turn) - half_goal)


@njit(cache=True)
def _locate_spline(
    numbers: FloatArray, table: FloatArray, position: FloatArray
) -> tuple[float, float]:
    nearest, arc = math.inf, 0.0
    for k in range(table.shape[0] - 1):
        from_x, from_y = position[0] - table[k, 0], position[1] - table[k, 1]
        along_x, along_y = table[k + 1, 0] - table[k, 0], table[k + 1, 1] - table[k, 1]
        length = table[k + 1, 2] - table[k, 2]
        share = (from_x * along_x + from_y * along_y) / (length * length)
        share = min(max(share, 0.0), 1.0)
        distance = math.sqrt((from_x - share * along_x) ** 2 + (from_y - share * along_y) ** 2)
        if distance < nearest:
            nearest, arc = distance, table[k, 2] + share * length
    return nearest, numbers[0] - arc


@njit(cache=True)
def locate(
    kind: int, numbers: FloatArray, table: FloatArray, position: FloatArray
) -> tuple[float, float]:
    """Distance of `position` (D,) from the center line, and length of path to the goal region.

    The second is 0 in the goal region and, on a circle, counted along the shorter way round.
    """
    if kind == LINE:
        offset, remaining = _locate_line(numbers, position)
    elif kind == CIRCLE:
        offset, remaining = _locate_circle(numbers, position)
    else:
        offset, remaining = _locate_spline(numbers, table, position)
    return offset, max(remaining, 0.0)


@njit(cache=True)
def _is_outside(kind: int, numbers: FloatArray, position: FloatArray) -> bool:
    """Whether `position` (D,) has left the world along a dimension that is not free."""
    bound = int(numbers[1]) if kind == LINE else position.shape[0]
    farthest = 0.0
    for j in range(bound):
        farthest = max(farthest, abs(position[j]))
    return farthest > 1.0 + TOLERANCE


@njit(cache=True)
def _observe(kind: int, numbers: FloatArray, position: FloatArray, out: np.ndarray) -> None:
    dims = position.shape[0]
    for j in range(dims):
        out[j] = position[j]
    if kind == CIRCLE:
        out[dims] = numbers[0]
        out[dims + 1] = math.sqrt(position[0] ** 2 + position[1] ** 2)


@njit(cache=True)
def reset_batch(
    kind: int,
    numbers: FloatArray,
    table: FloatArray,
    arcs: FloatArray,
    chosen: np.ndarray,
    positions: FloatArray,
    remaining: FloatArray,
    observations: np.ndarray,
) -> None:
    """Put the `chosen` (N,) agents on the center line at `arcs` (N,), in place."""
    for i in range(positions.shape[0]):
        if chosen[i]:
            place(kind, numbers, table, arcs[i], positions[i])
            remaining[i] = locate(kind, numbers, table, positions[i])[1]
            _observe(kind, numbers, positions[i], observations[i])


@njit(cache=True)
def step_batch(
    kind: int,
    numbers: FloatArray,
    table: FloatArray,
    half_width: float,
    reach: float,
    dense_reward: float,
    goal_reward: float,
    leave_penalty: float,
    actions: FloatArray,
    active: np.ndarray,
    positions: FloatArray,
    remaining: FloatArray,
    observations: np.ndarray,
    rewards: FloatArray,
    terminated: np.ndarray,
    success: np.ndarray,
) -> int:
    """Move the `active` (N,) agents by `actions` (N, D) and reward them, in place.

    Inactive agents stay, get no reward and do not terminate.

    Returns:
        -1, or the index of the first active agent whose action contains NaN. In that case
        nothing has been changed.
    """
    count, dims = actions.shape
    for i in range(count):
        if active[i]:
            for j in range(dims):
                if math.isnan(actions[i, j]):
                    return i
    for i in range(count):
        rewards[i] = 0.0
        terminated[i] = False
        success[i] = False
        if not active[i]:
            continue
        for j in range(dims):
            positions[i, j] += reach * min(max(actions[i, j], -1.0), 1.0)
        offset, left = locate(kind, numbers, table, positions[i])
        # The tunnel is open at its end: with a wall there, any action would be safe at the wall.
        # This does not matter beyond the goal.
        outside = left > TOLERANCE and _is_outside(kind, numbers, positions[i])
        for j in range(dims):
            positions[i, j] = min(max(positions[i, j], -1.0), 1.0)
        if outside or offset > half_width + TOLERANCE:
            # Progress is not rewarded here, or leaping ahead out of the tunnel would pay off.
            rewards[i] -= leave_penalty
            terminated[i] = True
        else:
            rewards[i] += dense_reward * (remaining[i] - left)
            if left <= TOLERANCE:
                rewards[i] += goal_reward
                terminated[i] = True
                success[i] = True
        remaining[i] = left
        _observe(kind, numbers, positions[i], observations[i])
    return -1
