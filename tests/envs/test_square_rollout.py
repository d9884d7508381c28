"""The compiled episodes, the slewed targets and the friction cone."""

import numpy as np
import pytest

from flowpolicy_envs.registration import SQUARE_IDS
from flowpolicy_envs.square.batch import SquareBatch
from flowpolicy_envs.square.config import DIRECTIONS, SquareConfig
from flowpolicy_envs.square.tasks import FindGoal, MoveX
from flowpolicy_envs.square.vector import SquareVectorEnv

INWARDS = -DIRECTIONS.ravel()
STILL = {"finger_noise": 0.0, "start_x": 0.0, "start_y": 0.0, "start_angle": 0.0}


@pytest.mark.parametrize("rules", [{}, {"slew": 0.2, "friction_cone": True, "friction": 1.0}])
@pytest.mark.parametrize("task", [MoveX(angle=1.0), FindGoal(radius=0.2)])
def test_a_roll_out_equals_stepping_the_environment(task, rules):
    arguments = {"task": task, "max_force": 1.95, "warm_up": 1.0, **rules}
    count, steps, mean = 12, 30, 0.8 * INWARDS
    # From hardly any noise in the first world to much in the last.
    noise = np.random.default_rng(0).standard_normal((steps, count, 8))
    noise *= np.linspace(0.0, 0.4, count)[:, None]
    batch = SquareBatch(SquareConfig(**arguments), count)
    generators = [np.random.default_rng(n) for n in range(count)]
    batch.reset(batch.everyone, generators.__getitem__)
    out = batch.roll_out(mean, noise)

    envs = SquareVectorEnv(count, **arguments)
    envs.reset(seed=0)  # starts ended worlds anew, which is ignored from there on
    running = np.ones(count, bool)
    for t in range(steps):
        assert (out.taken[t] == running).all()
        actions = np.tanh(mean + noise[t])
        _, rewards, terminated, _, infos = envs.step(actions)
        assert out.rewards[t, running] == pytest.approx(rewards[running], abs=1e-9)
        assert (out.rewards[t, ~running] == 0.0).all()
        assert (out.failed[t] == (terminated & running)).all()
        expected = np.log(1.0 - actions**2).sum(axis=1)
        assert out.log_slopes[t] == pytest.approx(expected, abs=1e-9)
        ending = running & (terminated | (t == steps - 1))
        for name, column in zip(("x_std", "x_max"), (1, 2), strict=True):
            assert batch.metrics[ending, column] == pytest.approx(infos[name][ending], abs=1e-9)
        assert (batch.success[ending] == infos["is_success"][ending]).all()
        running = running & ~terminated
    assert 0 < running.sum() < count


def grip(*targets, steps=6, **arguments):
    """Return a world after `steps` of each of the targets."""
    batch = SquareBatch(SquareConfig(**{**STILL, "warm_up": 100.0, **arguments}), 1)
    batch.reset(batch.everyone, np.random.default_rng)
    for target in targets:
        for _ in range(steps):
            batch.step([target])
    return batch


ROUGH = {"max_force": 1.95, "friction": 1.0, "weight": 6.0}
SHEAR = np.array([0, 1, 1, 0, 0, -1, -1, 0])
"""All fingers pull along their faces, in such directions that nothing moves or turns."""


@pytest.mark.parametrize("cone", [False, True])
def test_fingers_that_pull_against_each_other_lose_their_grip_only_with_the_cone(cone):
    sheared = grip(0.6 * INWARDS, 0.6 * INWARDS + 0.15 * SHEAR, friction_cone=cone, **ROUGH)
    assert np.abs(sheared.bodies[0, :3]).max() < 0.02
    assert sheared.presses.sum() > 7.0
    assert sheared.held.item() is not cone


@pytest.mark.parametrize("cone", [False, True])
def test_fingers_that_move_jointly_keep_their_grip(cone):
    shifted = 0.6 * INWARDS + 0.15 * np.tile([1.0, 0.0], 4)
    moved = grip(0.6 * INWARDS, shifted, friction_cone=cone, **ROUGH)
    assert moved.bodies[0, 0] > 0.03
    assert moved.held.item() is True


def test_the_cone_leaves_the_whole_friction_without_tangential_force():
    for weight, held in ((5.99, True), (6.01, False)):
        arguments = {"max_force": 1.5, "friction": 1.0, "friction_cone": True, "weight": weight}
        assert grip(0.6 * INWARDS, steps=40, **arguments).held.item() is held


def test_targets_move_linearly_during_the_slew():
    """A free finger stays behind a target that moves steadily."""
    arguments = {**STILL, "kp": 25.0, "kd": 0.4, "max_force": 50.0, "max_speed": 40.0, "mass": 10.0,
                 "inertia": 1.0, "weight": 0.0, "substeps": 10}  # fmt: skip
    away = 0.5 * DIRECTIONS.ravel()
    jumped = grip(away, steps=1, **arguments).fingers
    slewed = grip(away, steps=1, slew=0.1, **arguments).fingers
    start = 0.4 * DIRECTIONS
    # A substep halves the distance to the target, which has moved by 0.02 before.
    assert np.abs(jumped - start).sum() == pytest.approx(4 * 0.2, rel=0.01)
    assert np.abs(slewed - start).sum() == pytest.approx(4 * (0.2 - 0.02), rel=0.01)


@pytest.mark.parametrize("env_id", ["SquareHold-v1", "SquareMoveX-v1"])
@pytest.mark.parametrize("idle", range(4))
def test_three_fingers_do_not_carry_the_square(env_id, idle):
    arguments = {k: v for k, v in SQUARE_IDS[env_id].items() if k not in ("task", "warm_up")}
    world = grip(0.9 * INWARDS, steps=8, **arguments)
    assert world.held.item() is True
    three = 0.9 * INWARDS.reshape(4, 2)
    three[idle] *= -1.0
    held = []
    for _ in range(12):
        world.step([three.ravel()])
        held.append(world.held.item())
    assert not any(held[2:])
