"""The mechanics: conservation, passivity, convergence, symmetry, finite values."""

import numpy as np
import pytest

from flowpolicy_envs.registration import SQUARE_IDS
from flowpolicy_envs.square import kernels
from flowpolicy_envs.square.batch import SquareBatch
from flowpolicy_envs.square.config import DIRECTIONS, SquareConfig

PLACES = 0.4 * DIRECTIONS
INWARDS = -DIRECTIONS.ravel()
DT = 0.01
V1 = {k: v for k, v in SQUARE_IDS["SquareMove-v1"].items() if k not in ("task", "warm_up")}
# Fingers as strong as in `SquareHold-v0` keep the square away from the walls of the world.
RULES = pytest.mark.parametrize("rules", [{}, {**V1, "max_force": 6.0}], ids=["v0", "v1"])
STILL = {"finger_noise": 0.0, "start_x": 0.0, "start_y": 0.0, "start_angle": 0.0}


class World:
    """One Square without an agent: set its state, take substeps, inspect the forces."""

    def __init__(self, dt: float = DT, **constants: float) -> None:
        batch = SquareBatch(SquareConfig(**{**STILL, "dt": dt, **constants}), 1)
        batch.reset(batch.everyone, np.random.default_rng)
        self.constants = batch.constants[0]
        self.dt = dt
        self.body, self.fingers, self.targets = np.zeros(6), PLACES.copy(), PLACES.copy()
        self.forces = np.zeros((4, 4))
        self._rest = (np.zeros(kernels.SCRATCH), self.forces, np.zeros(4))

    def substep(self) -> None:
        kernels.simulate(
            self.dt,
            1,
            0,
            True,
            self.constants,
            PLACES,
            self.targets,
            np.zeros((2, 4, 2)),
            self.body,
            self.fingers,
            *self._rest,
        )

    def randomize(self, rng: np.random.Generator) -> None:
        """Any pose, speeds far above those of episodes, fingers anywhere outside the square."""
        self.body[:] = rng.uniform(-1, 1, 6) * (0.3, 0.3, np.pi, 3.0, 3.0, 10.0)
        self.targets[:] = PLACES + rng.uniform(-0.4, 0.4, (4, 2))
        for k in range(4):
            while True:
                self.fingers[k] = PLACES[k] + rng.uniform(-0.4, 0.4, 2)
                if self.gaps()[k] >= 0.0:
                    break

    def gaps(self) -> np.ndarray:
        """Distance of each finger from the square along its faces' normals, negative inside."""
        x, y, angle = self.body[:3]
        cos, sin = np.cos(angle), np.sin(angle)
        local = (self.fingers - (x, y)) @ np.array([[cos, -sin], [sin, cos]])
        return np.abs(local).max(axis=1) - self.constants[kernels.HALF_SIDE]

    def kinetic_energy(self) -> float:
        mass, inertia = self.constants[[kernels.MASS, kernels.INERTIA]]
        return 0.5 * (mass * (self.body[3:5] ** 2).sum() + inertia * self.body[5] ** 2)

    def stored_energy(self) -> float:
        """Energy stored by the controllers, which are springs with limited force."""
        stiffness, limit = self.constants[[kernels.STIFFNESS, kernels.MAX_FORCE]]
        stretch = np.abs(self.targets - self.fingers)
        bounded = np.minimum(stretch, limit / stiffness)
        return float((0.5 * stiffness * bounded**2 + limit * (stretch - bounded)).sum())


@RULES
def test_contact_never_creates_energy(rules):
    """Without controllers, fingers never accelerate the square."""
    rng, world = np.random.default_rng(0), World(**{**rules, "kp": 0.0})
    world.constants[[kernels.LINEAR_DAMPING, kernels.ANGULAR_DAMPING]] = 0.0
    touched = 0
    for _ in range(1500):
        world.randomize(rng)
        for _ in range(40):
            before = world.kinetic_energy()
            world.substep()
            assert world.kinetic_energy() <= before * (1 + 1e-12)
            touched += world.forces[:, 0].any()
    assert touched > 5000


@RULES
def test_controllers_release_no_more_than_they_stored(rules):
    """With constant targets, the sum of kinetic and stored energy never grows."""
    rng, world = np.random.default_rng(1), World(**rules)
    world.constants[[kernels.LINEAR_DAMPING, kernels.ANGULAR_DAMPING]] = 0.0
    for _ in range(1500):
        world.randomize(rng)
        for _ in range(60):
            before = world.kinetic_energy() + world.stored_energy()
            world.substep()
            after = world.kinetic_energy() + world.stored_energy()
            assert after <= before * (1 + 1e-12)


@RULES
def test_momentum_changes_by_contact_forces_and_damping(rules):
    rng, world = np.random.default_rng(2), World(**rules)
    mass, inertia = world.constants[[kernels.MASS, kernels.INERTIA]]
    linear, angular = world.constants[[kernels.LINEAR_DAMPING, kernels.ANGULAR_DAMPING]]
    for _ in range(300):
        world.randomize(rng)
        for _ in range(20):
            old, arms = world.body.copy(), world.fingers - world.body[:2]
            world.substep()
            force = world.forces[:, 2:]
            momentum = mass * (world.body[3:5] - old[3:5])
            expected = DT * (force.sum(axis=0) - linear * world.body[3:5])
            assert momentum == pytest.approx(expected, abs=1e-12)
            torque = (arms[:, 0] * force[:, 1] - arms[:, 1] * force[:, 0]).sum()
            spin = inertia * (world.body[5] - old[5])
            assert spin == pytest.approx(DT * (torque - angular * world.body[5]), abs=1e-12)
            # Fingers push, never pull, and friction stays within its cone.
            assert (world.forces[:, 0] >= 0.0).all()
            limit = world.constants[kernels.FRICTION] * world.forces[:, 0]
            assert (np.abs(world.forces[:, 1]) <= limit + 1e-12).all()


def test_fingers_feel_the_reaction():
    """Drag times velocity is the force of the controller minus the contact force."""
    world = World(max_force=6.0)
    world.body[:3] = 0.05, -0.02, 0.08
    world.targets[:] = 0.5 * PLACES
    drag, stiffness = world.constants[[kernels.DRAG, kernels.STIFFNESS]]
    checked = 0
    for _ in range(100):
        old, gaps = world.fingers.copy(), world.gaps()
        controller = np.clip(stiffness * (world.targets - old), -6.0, 6.0)
        world.substep()
        velocity = (world.fingers - old) / DT
        residual = controller - world.forces[:, 2:] - drag * velocity
        # Excluded: fingers at top speed, whose force is limited, and arriving ones.
        slow = (world.forces[:, 0] > 0.0) & (np.abs(velocity).max(axis=1) < 0.3) & (gaps < 1e-6)
        assert np.abs(residual[slow]).max(initial=0.0) < 0.05
        checked += int(slow.sum())
    assert checked > 200


@RULES
def test_fingers_stay_outside(rules):
    rng, world = np.random.default_rng(3), World(**rules)
    for _ in range(300):
        world.randomize(rng)
        for _ in range(60):
            world.substep()
            # At a corner, a finger may slip in by what a fast square moves in a substep.
            if np.abs(world.body[3:]).max() < 2.0:
                assert world.gaps().min() > (-0.02 if rules else -0.01)


def test_a_resting_grip_presses_with_the_force_of_the_controllers():
    world = World()
    world.targets[:] = 0.25 * PLACES
    for _ in range(300):
        world.substep()
    stiffness = world.constants[kernels.STIFFNESS]
    assert world.forces[:, 0] == pytest.approx(stiffness * (0.3 - 0.1), rel=1e-3)
    assert np.abs(world.forces[:, 1]).max() < 1e-9
    assert np.abs(world.body).max() < 1e-9


def test_friction_carries_up_to_its_limit():
    """Two fingers on opposite sides pull the square sideways with mu times their pressure."""
    world = World(friction=0.5, linear_damping=0.0)
    world.targets[[1, 3]] = (0.2, 0.2), (0.2, -0.2)
    for _ in range(18):
        world.substep()
    press, rub = world.forces[[1, 3], 0], world.forces[[1, 3], 1]
    assert (press > 1.0).all()
    assert np.abs(rub) == pytest.approx(0.5 * press)
    assert world.body[3] > 0.05
    assert abs(world.body[4]) < 1e-12
    assert abs(world.body[5]) < 1e-12


def test_nothing_is_pushed_faster_than_fingers_move():
    world = World(linear_damping=0.0)
    world.targets[2] = (0.0, 0.0)
    fastest = 0.0
    for _ in range(40):
        world.substep()
        fastest = max(fastest, world.body[3])
    assert 0.9 < fastest <= 1.0 + 1e-9


@RULES
def test_a_million_random_substeps_stay_finite_and_bounded(rules):
    config = SquareConfig(task="move", warm_up=1e6, **rules)
    batch = SquareBatch(config, 100)
    rng = np.random.default_rng(4)
    generators = [np.random.default_rng(n) for n in range(100)]
    batch.reset(batch.everyone, generators.__getitem__)
    for step in range(400):
        low, high = ((-1.0, 1.0), (-1e9, 1e9))[step % 2]
        batch.step(rng.uniform(low, high, (100, 8)))
        assert np.isfinite(batch.bodies).all()
        assert np.isfinite(batch.observations).all()
        assert np.isfinite(batch.rewards).all()
        assert np.abs(batch.bodies[:, :2]).max() <= 1.0
        assert np.abs(batch.bodies[:, 3:5]).max() < 5.0
        assert np.abs(batch.bodies[:, 5]).max() < 60.0
        assert np.abs(batch.fingers).max() < 1.5
        # Broken worlds stop early.
        batch.reset(batch.terminated, generators.__getitem__)
    assert 400 * 100 * config.substeps == 1_000_000


def scripted(step: int) -> np.ndarray:
    """Grasp, carry right and up, turn: two seconds."""
    action = 0.65 * INWARDS
    if step >= 3:
        action = action + np.tile([0.4, 0.2], 4)
    if step >= 5:
        action = action + 0.2 * np.array([0, 1, -1, 0, 0, -1, 1, 0])
    return np.clip(action, -1.0, 1.0)


def trajectory(substeps: int, actions: list[np.ndarray], pose: tuple, **kwargs) -> np.ndarray:
    kwargs = {**STILL, **dict(zip(("start_x", "start_y", "start_angle"), pose, strict=True))}
    batch = SquareBatch(SquareConfig(**kwargs, dt=0.25 / substeps, substeps=substeps), 1)
    batch.reset(batch.everyone, np.random.default_rng)
    poses = []
    for action in actions:
        batch.step(action[None])
        poses.append(np.concatenate([batch.bodies[0, :3], batch.fingers[0].ravel()]))
    return np.array(poses)


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (0.03, -0.02, 0.1), (-0.03, 0.03, -0.05)])
@RULES
def test_halving_the_time_step_hardly_changes_a_trajectory(rules, pose):
    actions = [scripted(step) for step in range(8)]
    coarse, fine = (trajectory(n, actions, pose, **rules) for n in (25, 50))
    coarse[:, 3:] -= PLACES.ravel()
    fine[:, 3:] -= PLACES.ravel()
    assert np.abs(coarse[:, :2]).max() > 0.1
    assert np.abs(coarse[:, 2]).max() > 0.3
    for part in (slice(0, 2), slice(2, 3), slice(3, 11)):  # position, angle, fingers
        change = np.abs(coarse[:, part] - fine[:, part]).max()
        assert change < 0.02 * np.abs(coarse[:, part]).max()


def test_a_mirrored_action_sequence_gives_the_mirrored_trajectory():
    rng = np.random.default_rng(5)
    actions = [0.6 * INWARDS + rng.normal(0.0, 0.4, 8) for _ in range(40)]
    plain = trajectory(25, actions, (0.02, -0.01, 0.07))
    # Mirroring changes the sign of x and swaps right and left.
    flip = np.array([4, 5, 2, 3, 0, 1, 6, 7])
    signs = np.array([-1.0, 1.0] * 4)
    mirrored = trajectory(25, [(a * signs)[flip] for a in actions], (-0.02, -0.01, -0.07))
    mirrored[:, :3] *= (-1.0, 1.0, -1.0)
    mirrored[:, 3:] = (mirrored[:, 3:] * signs)[:, flip]
    assert np.abs(plain[:, 0]).max() > 0.01
    assert mirrored == pytest.approx(plain, abs=1e-9)
