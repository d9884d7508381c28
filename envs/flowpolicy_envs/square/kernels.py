"""Compiled mechanics, rewards and observations of the Square, for a batch of worlds at once.

Contact is rigid. A finger has no mass and moves against viscous drag: a finger whose controller
exerts the force F and whose tip moves with velocity v pushes with F - c v. So the forces on the
square follow from its own velocity, without springs or impacts: contact pushes or damps its motion.

All compiled code is in one file because numba's cache only notices changes in the file of the
function that is called.
"""

import math

import numpy as np
from numba import njit

FloatArray = np.ndarray[tuple[int, ...], np.dtype[np.float64]]

FINGERS = 4
ACTIONS = 2 * FINGERS

# Columns of `constants` (N, 12), which each episode draws.
HALF_SIDE, MASS, INERTIA, LINEAR_DAMPING, ANGULAR_DAMPING, FRICTION = range(6)
WEIGHT, STIFFNESS, DRAG, MAX_FORCE, MAX_SPEED, REACH = range(6, 12)
N_CONSTANTS = 12

# The setup of an episode (25,): the constants, with the fingers' own damping in place of the drag,
# followed by these.
KD, POSE, PLACES, GOAL_AT = 12, slice(13, 16), slice(16, 24), 24
N_SETUP = 25

# Entries of `reward_terms` (11,), see flowpolicy_envs.square.tasks.
HELD, FAILURE, OVERREACH, SAFE_REACH, EFFORT, ANGLE = range(6)
POSITION_BEFORE, POSITION_AFTER, Y_AFTER, GOAL, GOAL_RADIUS = range(6, 11)
N_REWARD_TERMS = 11

# Columns of `tallies` (N, 10), from which the metrics of an episode are computed.
N_STEPS, N_HELD, N_AFTER, SUM_X, SUM_X2, MAX_X, SUM_R, SUM_R2, MAX_R, RETURN = range(10)
N_TALLIES = 10

# Columns of `metrics` (N, 5), named in flowpolicy_envs.square.batch.
N_METRICS = 5

# Values of `ends` (N,).
GOING_ON, DROPPED, BROKEN = range(3)

N_FEATURES = 4 + ACTIONS + ACTIONS + 1
"""Position, cosine and sine of the angle, fingers, last action, timer."""

# Scratch columns of each finger in a substep: force of its controller along normal and tangent, the
# normal, both levers, share of the substep in contact, room to move, bounds of the forces.
_PUSH, _PULL, _NORMAL_X, _NORMAL_Y, _LEVER, _TANGENT_LEVER, _SHARE, _ROOM = range(8)
_LIMIT, _LEAST_RUB, _MOST_RUB = range(8, 11)
# The last row holds values derived from the constants.
_PER_DT, _PER_MASS, _PER_INERTIA, _PER_DRAG, _LINEAR, _ANGULAR, _LIFT = range(7)
SCRATCH = (FINGERS + 1, 11)

_STANDSTILL = 1e-30
"""Units or radians per second."""

_LOG_2 = math.log(2.0)

SWEEPS = 3
"""Iterations that match the contact forces to the velocity they cause. Each sweep reduces the
mismatch by a factor that `SquareConfig` keeps below 1/2."""

BREAKING = 1.02
"""A finger breaks at this distance from its start, in units of its reach. A little more than 1, so
that pressing against the edge of the reach is safe."""


# Python's error model would check each division for zero, which `SquareConfig` excludes.
_compiled = njit(cache=True, error_model="numpy")


@_compiled
def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


@_compiled
def _derive(dt: float, constants: FloatArray, derived: FloatArray) -> None:
    """Write the quotients that a substep needs into `derived`, because divisions are slow."""
    derived[_PER_DT] = 1.0 / dt
    derived[_PER_MASS] = 1.0 / constants[MASS]
    derived[_PER_INERTIA] = 1.0 / constants[INERTIA]
    derived[_PER_DRAG] = 1.0 / constants[DRAG]
    derived[_LINEAR] = 1.0 / (1.0 + dt * constants[LINEAR_DAMPING] / constants[MASS])
    derived[_ANGULAR] = 1.0 / (1.0 + dt * constants[ANGULAR_DAMPING] / constants[INERTIA])


@_compiled
def _substep(
    dt: float,
    constants: FloatArray,
    derived: FloatArray,
    targets: FloatArray,
    body: FloatArray,
    fingers: FloatArray,
    scratch: FloatArray,
    forces: FloatArray,
) -> None:
    """Advance one world by `dt` seconds; the arguments are those of `simulate`."""
    half, drag, top_speed = constants[HALF_SIDE], constants[DRAG], constants[MAX_SPEED]
    stiffness, max_force = constants[STIFFNESS], constants[MAX_FORCE]
    friction = constants[FRICTION]
    per_dt, per_mass, per_inertia = derived[_PER_DT], derived[_PER_MASS], derived[_PER_INERTIA]
    per_drag, linear, angular = derived[_PER_DRAG], derived[_LINEAR], derived[_ANGULAR]
    x, y = body[0], body[1]
    cos, sin = math.cos(body[2]), math.sin(body[2])
    old_vx, old_vy, old_omega = body[3], body[4], body[5]

    touching = False
    for i in range(FINGERS):
        force_x = _clip(stiffness * (targets[i, 0] - fingers[i, 0]), -max_force, max_force)
        force_y = _clip(stiffness * (targets[i, 1] - fingers[i, 1]), -max_force, max_force)
        arm_x, arm_y = fingers[i, 0] - x, fingers[i, 1] - y
        local_x, local_y = cos * arm_x + sin * arm_y, cos * arm_y - sin * arm_x
        # The nearest face, its inward normal, and the distance to it (negative inside the square).
        if abs(local_x) > abs(local_y):
            sign = math.copysign(1.0, -local_x)
            normal_x, normal_y = sign * cos, sign * sin
            gap, beside = abs(local_x) - half, abs(local_y) > half
        else:
            sign = math.copysign(1.0, -local_y)
            normal_x, normal_y = -sign * sin, sign * cos
            gap, beside = abs(local_y) - half, abs(local_x) > half
        lever = arm_x * normal_y - arm_y * normal_x
        # The tangent is the normal turned left.
        tangent_lever = arm_x * normal_x + arm_y * normal_y
        push = normal_x * force_x + normal_y * force_y
        closing = max(gap, 0.0) * per_dt
        share, limit, room = 0.0, 0.0, math.inf
        if not beside:
            # A finger that slipped in at a corner is put back on the face if its controller pulls
            # it that way. Against the controller this would add energy.
            room = gap * per_dt if gap > 0.0 or push <= 0.0 else 0.0
            recede = normal_x * old_vx + normal_y * old_vy + lever * old_omega
            approach = _clip(push * per_drag, -top_speed, top_speed) - recede
            if approach > closing:
                touching = True
                # A finger that is still approaching presses for the rest of the substep only.
                share = 1.0 - closing / approach
                # A finger cannot exceed its top speed, and neither can what it pushes or drags:
                # its force may accelerate the point of contact to that speed, not beyond.
                inert = per_dt / (per_mass + lever * lever * per_inertia)
                limit = max(top_speed - recede - closing, 0.0) * inert
                along = normal_x * old_vy - normal_y * old_vx + tangent_lever * old_omega
                inert = per_dt / (per_mass + tangent_lever * tangent_lever * per_inertia)
                scratch[i, _LEAST_RUB] = min(-top_speed - along, 0.0) * inert
                scratch[i, _MOST_RUB] = max(top_speed - along, 0.0) * inert
        scratch[i, _PUSH], scratch[i, _PULL] = push, normal_x * force_y - normal_y * force_x
        scratch[i, _NORMAL_X], scratch[i, _NORMAL_Y] = normal_x, normal_y
        scratch[i, _LEVER], scratch[i, _TANGENT_LEVER] = lever, tangent_lever
        scratch[i, _SHARE], scratch[i, _LIMIT], scratch[i, _ROOM] = share, limit, room
        forces[i, 0], forces[i, 1], forces[i, 2], forces[i, 3] = 0.0, 0.0, 0.0, 0.0

    # Implicit step: iteration matches the forces to the velocity they cause. Each sweep treats all
    # fingers alike, which preserves mirror symmetry.
    vx, vy, omega = old_vx, old_vy, old_omega
    for _ in range(SWEEPS if touching else 1):
        sum_x, sum_y, torque = 0.0, 0.0, 0.0
        for i in range(FINGERS):
            limit = scratch[i, _LIMIT]
            if limit <= 0.0:
                continue
            normal_x, normal_y = scratch[i, _NORMAL_X], scratch[i, _NORMAL_Y]
            lever, tangent_lever = scratch[i, _LEVER], scratch[i, _TANGENT_LEVER]
            recede = normal_x * vx + normal_y * vy + lever * omega
            along = normal_x * vy - normal_y * vx + tangent_lever * omega
            press = scratch[i, _SHARE] * (scratch[i, _PUSH] - drag * recede)
            press = _clip(press, 0.0, limit)
            rub = scratch[i, _PULL] - drag * along
            rub = _clip(rub, scratch[i, _LEAST_RUB], scratch[i, _MOST_RUB])
            rub = _clip(rub, -friction * press, friction * press)
            forces[i, 0], forces[i, 1] = press, rub
            forces[i, 2] = press * normal_x - rub * normal_y
            forces[i, 3] = press * normal_y + rub * normal_x
            sum_x += forces[i, 2]
            sum_y += forces[i, 3]
            torque += press * lever + rub * tangent_lever
        vx = (old_vx + dt * per_mass * sum_x) * linear
        vy = (old_vy + dt * per_mass * sum_y) * linear
        omega = (old_omega + dt * per_inertia * torque) * angular

    for i in range(FINGERS):
        normal_x, normal_y = scratch[i, _NORMAL_X], scratch[i, _NORMAL_Y]
        push, pull = scratch[i, _PUSH] * per_drag, scratch[i, _PULL] * per_drag
        speed2 = push * push + pull * pull
        if speed2 > top_speed * top_speed:
            share = top_speed / math.sqrt(speed2)
            push *= share
            pull *= share
        press, rub = forces[i, 0], forces[i, 1]
        if press > 0.0:
            if abs(rub) < friction * press:
                pull = normal_x * vy - normal_y * vx + scratch[i, _TANGENT_LEVER] * omega
            else:
                pull = _clip((scratch[i, _PULL] - rub) * per_drag, -top_speed, top_speed)
        # No finger may enter the square. A finger inside is put back on the face.
        recede = normal_x * vx + normal_y * vy + scratch[i, _LEVER] * omega
        push = min(push, recede + scratch[i, _ROOM])
        fingers[i, 0] += dt * (push * normal_x - pull * normal_y)
        fingers[i, 1] += dt * (push * normal_y + pull * normal_x)

    # Without contact the velocity decays towards subnormal numbers, which are slow to compute with.
    body[3] = vx if abs(vx) > _STANDSTILL else 0.0
    body[4] = vy if abs(vy) > _STANDSTILL else 0.0
    body[5] = omega if abs(omega) > _STANDSTILL else 0.0
    # Walls keep the center of the square in the world; no task comes near them.
    body[0] = _clip(x + dt * body[3], -1.0, 1.0)
    body[1] = _clip(y + dt * body[4], -1.0, 1.0)
    body[2] += dt * body[5]


@_compiled
def _is_broken(fingers: FloatArray, starts: FloatArray, reach: float) -> bool:
    farthest = 0.0
    for i in range(FINGERS):
        for k in range(2):
            farthest = max(farthest, abs(fingers[i, k] - starts[i, k]))
    return farthest > BREAKING * reach


@_compiled
def simulate(
    dt: float,
    substeps: int,
    slew: int,
    cone: bool,
    constants: FloatArray,
    starts: FloatArray,
    targets: FloatArray,
    path: FloatArray,
    body: FloatArray,
    fingers: FloatArray,
    scratch: FloatArray,
    forces: FloatArray,
    presses: FloatArray,
) -> bool:
    """Advance one world by `substeps`, or until a finger breaks, in place.

    Args:
        dt: Seconds per substep.
        substeps: Number of substeps.
        slew: Number of substeps in which the controllers' targets move linearly from `path[0]` to
            `targets`. With 0 they jump.
        cone: Whether to compute the force with which friction can still carry the square while it
            also drags it along the plane.
        constants: Physical constants, (12,).
        starts: Starts of the fingers, (4, 2).
        targets: Targets of the fingers' controllers, (4, 2).
        path: The targets before and, overwritten, the present ones, (2, 4, 2).
        body: Position, angle and velocities x, y, theta, vx, vy, omega of the square, (6,).
        fingers: Positions, (4, 2).
        scratch: Working memory, (5, 11).
        forces: Overwritten by the contact forces on the square in the last substep, (4, 4): normal
            (inwards) and tangential force in N, then the same force along x and y.
        presses: Overwritten by each finger's mean normal force in N, (4,).

    Returns:
        Whether a finger broke.
    """
    derived = scratch[FINGERS]
    _derive(dt, constants, derived)
    presses[:] = 0.0
    derived[_LIFT] = 0.0
    aims = targets if slew == 0 else path[1]
    for k in range(substeps):
        if slew > 0:
            share = min((k + 1.0) / slew, 1.0)
            for i in range(FINGERS):
                for j in range(2):
                    aims[i, j] = path[0, i, j] + share * (targets[i, j] - path[0, i, j])
        _substep(dt, constants, derived, aims, body, fingers, scratch, forces)
        for i in range(FINGERS):
            presses[i] += forces[i, 0]
            if cone:
                most = constants[FRICTION] * forces[i, 0]
                derived[_LIFT] += math.sqrt(max(most * most - forces[i, 1] ** 2, 0.0))
        if _is_broken(fingers, starts, constants[REACH]):
            presses /= k + 1.0
            derived[_LIFT] /= k + 1.0
            return True
    presses /= substeps
    derived[_LIFT] /= substeps
    return False


@_compiled
def _observe(
    timer: float,
    constants: FloatArray,
    starts: FloatArray,
    actions: FloatArray,
    body: FloatArray,
    fingers: FloatArray,
    picked: np.ndarray,
    noise: FloatArray,
    features: FloatArray,
    frame: np.ndarray,
) -> None:
    """Write the `picked` (O,) features plus `noise` (O,) into `frame` (O,), within [-1, 1]."""
    features[0], features[1] = body[0], body[1]
    features[2], features[3] = math.cos(body[2]), math.sin(body[2])
    for i in range(FINGERS):
        for k in range(2):
            features[4 + 2 * i + k] = (fingers[i, k] - starts[i, k]) / constants[REACH]
    features[4 + ACTIONS : 4 + 2 * ACTIONS] = actions
    features[4 + 2 * ACTIONS] = timer
    for j in range(picked.shape[0]):
        frame[j] = _clip(features[picked[j]] + noise[j], -1.0, 1.0)


@_compiled
def _reward(
    terms: FloatArray,
    held: bool,
    failed: bool,
    warm: bool,
    constants: FloatArray,
    targets: FloatArray,
    actions: FloatArray,
    body: FloatArray,
    fingers: FloatArray,
) -> float:
    """Reward of a step, without the bonus for the goal."""
    reward = 0.0
    if held:
        reward += terms[HELD]
    if failed:
        reward -= terms[FAILURE]
    if terms[OVERREACH] > 0.0:
        beyond = 0.0
        for j in range(ACTIONS):
            beyond += max(abs(actions[j]) - terms[SAFE_REACH], 0.0)
        reward -= terms[OVERREACH] * beyond / (ACTIONS * (1.0 - terms[SAFE_REACH]))
    if terms[EFFORT] > 0.0:
        effort = 0.0
        for i in range(FINGERS):
            effort += math.sqrt(
                (targets[i, 0] - fingers[i, 0]) ** 2 + (targets[i, 1] - fingers[i, 1]) ** 2
            )
        effort *= constants[STIFFNESS] / (FINGERS * constants[MAX_FORCE])
        reward -= terms[EFFORT] * effort
    distance = math.sqrt(body[0] ** 2 + body[1] ** 2)
    reward -= terms[ANGLE] * abs(body[2])
    if warm:
        reward -= terms[POSITION_BEFORE] * distance
    else:
        reward -= terms[POSITION_AFTER] * distance + terms[Y_AFTER] * abs(body[1])
    return reward


@_compiled
def _tally(held: bool, warm: bool, body: FloatArray, tallies: FloatArray) -> None:
    tallies[N_STEPS] += 1.0
    if held:
        tallies[N_HELD] += 1.0
    if warm:
        return
    x, r2 = body[0], body[0] ** 2 + body[1] ** 2
    tallies[N_AFTER] += 1.0
    tallies[SUM_X] += x
    tallies[SUM_X2] += x * x
    tallies[MAX_X] = max(tallies[MAX_X], abs(x))
    tallies[SUM_R] += math.sqrt(r2)
    tallies[SUM_R2] += r2
    tallies[MAX_R] = max(tallies[MAX_R], math.sqrt(r2))


@_compiled
def _measure(tallies: FloatArray, metrics: FloatArray) -> None:
    after = max(tallies[N_AFTER], 1.0)
    metrics[0] = tallies[N_HELD] / max(tallies[N_STEPS], 1.0)
    # Rounding can make the difference of two equal numbers negative.
    metrics[1] = math.sqrt(max(tallies[SUM_X2] / after - (tallies[SUM_X] / after) ** 2, 0.0))
    metrics[2] = tallies[MAX_X]
    metrics[3] = math.sqrt(max(tallies[SUM_R2] / after - (tallies[SUM_R] / after) ** 2, 0.0))
    metrics[4] = tallies[MAX_R]


@_compiled
def reset_batch(
    chosen: np.ndarray,
    uniform: FloatArray,
    least: FloatArray,
    most: FloatArray,
    goals: FloatArray,
    picked: np.ndarray,
    noise: FloatArray,
    features: FloatArray,
    constants: FloatArray,
    starts: FloatArray,
    bodies: FloatArray,
    fingers: FloatArray,
    targets: FloatArray,
    actions: FloatArray,
    presses: FloatArray,
    tallies: FloatArray,
    metrics: FloatArray,
    held: np.ndarray,
    found: np.ndarray,
    success: np.ndarray,
    ends: np.ndarray,
    observations: np.ndarray,
) -> None:
    """Start episodes in the `chosen` (N,) worlds.

    `uniform` (N, 25) in [0, 1) interpolates their setups between `least` and `most` (25,).
    """
    width = picked.shape[0]
    for n in range(chosen.shape[0]):
        if not chosen[n]:
            continue
        setup = least + uniform[n] * (most - least)
        constants[n] = setup[:N_CONSTANTS]
        constants[n, DRAG] += setup[KD]
        bodies[n, :3] = setup[POSE]
        bodies[n, 3:] = 0.0
        starts[n] = setup[PLACES].reshape(FINGERS, 2)
        goals[n] = setup[GOAL_AT]
        fingers[n] = starts[n]
        targets[n] = starts[n]
        actions[n] = 0.0
        presses[n] = 0.0
        tallies[n] = 0.0
        metrics[n] = 0.0
        held[n] = False
        found[n] = False
        success[n] = False
        ends[n] = GOING_ON
        row = observations[n]
        _observe(
            1.0,
            constants[n],
            starts[n],
            actions[n],
            bodies[n],
            fingers[n],
            picked,
            noise[n],
            features,
            row[:width],
        )
        for j in range(width, row.shape[0]):
            row[j] = row[j - width]


@_compiled
def step_batch(
    requests: FloatArray,
    active: np.ndarray,
    dt: float,
    substeps: int,
    slew: int,
    cone: bool,
    warm_steps: float,
    reward_terms: FloatArray,
    goals: FloatArray,
    path: FloatArray,
    scratch: FloatArray,
    forces: FloatArray,
    rewards: FloatArray,
    terminated: np.ndarray,
    picked: np.ndarray,
    noise: FloatArray,
    features: FloatArray,
    constants: FloatArray,
    starts: FloatArray,
    bodies: FloatArray,
    fingers: FloatArray,
    targets: FloatArray,
    actions: FloatArray,
    presses: FloatArray,
    tallies: FloatArray,
    metrics: FloatArray,
    held: np.ndarray,
    found: np.ndarray,
    success: np.ndarray,
    ends: np.ndarray,
    observations: np.ndarray,
) -> int:
    """Request targets `requests` (N, 8) in the `active` (N,) worlds, simulate and reward.

    Inactive worlds stand still, get no reward and do not terminate.

    Returns:
        -1, or the index of the first active world whose request contains NaN. In that case
        nothing has been changed.
    """
    count, width = requests.shape[0], picked.shape[0]
    for n in range(count):
        if active[n]:
            for j in range(ACTIONS):
                if math.isnan(requests[n, j]):
                    return n
    for n in range(count):
        rewards[n] = 0.0
        terminated[n] = False
        if not active[n]:
            continue
        reach = constants[n, REACH]
        for i in range(FINGERS):
            for k in range(2):
                action = _clip(requests[n, 2 * i + k], -1.0, 1.0)
                actions[n, 2 * i + k] = action
                path[0, i, k] = targets[n, i, k]
                targets[n, i, k] = starts[n, i, k] + reach * action
        broken = simulate(
            dt,
            substeps,
            slew,
            cone,
            constants[n],
            starts[n],
            targets[n],
            path,
            bodies[n],
            fingers[n],
            scratch,
            forces,
            presses[n],
        )
        press = 0.0
        for i in range(FINGERS):
            press += presses[n, i]
        # Friction that drags the square along its plane cannot carry it at the same time.
        lift = scratch[FINGERS, _LIFT] if cone else constants[n, FRICTION] * press
        held[n] = lift >= constants[n, WEIGHT]
        # The warm-up ends when the timer that the agent saw before this step is 0.
        warm = tallies[n, N_STEPS] < warm_steps
        _tally(held[n], warm, bodies[n], tallies[n])
        if broken:
            ends[n] = BROKEN
        elif not (warm or held[n]):
            ends[n] = DROPPED
        terminated[n] = ends[n] != GOING_ON
        rewards[n] = _reward(
            reward_terms,
            held[n],
            terminated[n],
            warm,
            constants[n],
            targets[n],
            actions[n],
            bodies[n],
            fingers[n],
        )
        _measure(tallies[n], metrics[n])
        searching = not (warm or terminated[n] or found[n])
        if reward_terms[GOAL_RADIUS] > 0.0:
            off_x, off_y = bodies[n, 0] - goals[n, 0], bodies[n, 1] - goals[n, 1]
            if searching and off_x * off_x + off_y * off_y <= reward_terms[GOAL_RADIUS] ** 2:
                found[n] = True
                rewards[n] += reward_terms[GOAL]
            success[n] = found[n]
        else:
            success[n] = searching
        tallies[n, RETURN] += rewards[n]
        row = observations[n]
        for j in range(row.shape[0] - width):
            row[j] = row[j + width]
        timer = 0.0
        if tallies[n, N_STEPS] < warm_steps:
            timer = 1.0 - tallies[n, N_STEPS] / warm_steps
        _observe(
            timer,
            constants[n],
            starts[n],
            actions[n],
            bodies[n],
            fingers[n],
            picked,
            noise[n],
            features,
            row[row.shape[0] - width :],
        )
    return -1


@_compiled
def roll_out(
    means: FloatArray,
    noise: FloatArray,
    active: np.ndarray,
    taken: np.ndarray,
    failed: np.ndarray,
    gathered: FloatArray,
    log_slopes: FloatArray,
    rewards: FloatArray,
    terminated: np.ndarray,
    step_arguments: tuple,
) -> None:
    """Step the `active` (N,) worlds until they end, with the actions tanh(u), in place.

    In step t, u is the sum of `means` (8,) and `noise` (T, N, 8). Overwritten, each (T, N), are
    `taken` by whether the world was still active, `failed` by whether it ended, `gathered` by the
    rewards, and `log_slopes` by the sum over the components of log(1 - tanh(u)^2).
    `step_arguments` are those of `step_batch` from `dt` on, `rewards` and `terminated` among them.
    """
    steps, count = noise.shape[0], noise.shape[1]
    requests = np.zeros((count, ACTIONS))
    for t in range(steps):
        for n in range(count):
            taken[t, n] = active[n]
            log_slope = 0.0
            for j in range(ACTIONS):
                u = means[j] + noise[t, n, j]
                requests[n, j] = math.tanh(u)
                # log(1 - tanh(u)^2) without cancellation.
                size = abs(u)
                log_slope += 2.0 * (_LOG_2 - size - math.log1p(math.exp(-2.0 * size)))
            log_slopes[t, n] = log_slope
        step_batch(requests, active, *step_arguments)
        for n in range(count):
            gathered[t, n], failed[t, n] = rewards[n], terminated[n]
            if terminated[n]:
                active[n] = False
