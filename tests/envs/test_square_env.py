"""The Square for agents: holding, moving, rewards, metrics, states."""

import gymnasium as gym
import numpy as np
import pytest

from flowpolicy_envs import FindGoal, Hold, Holder, Move, SquareEnv
from flowpolicy_envs.registration import SQUARE_IDS
from flowpolicy_envs.square.batch import SquareBatch
from flowpolicy_envs.square.config import DIRECTIONS, SquareConfig

INWARDS = -DIRECTIONS.ravel()
STILL = {"finger_noise": 0.0, "start_x": 0.0, "start_y": 0.0, "start_angle": 0.0}


def play(env_id, act, count, steps, **kwargs):
    """Play one episode in each of `count` worlds; return returns, lengths and the batch."""
    config = SquareConfig(**{**SQUARE_IDS[env_id], **kwargs})
    batch = SquareBatch(config, count)
    generators = [np.random.default_rng(seed) for seed in range(count)]
    batch.reset(batch.everyone, generators.__getitem__)
    rng, returns, lengths = np.random.default_rng(0), np.zeros(count), np.zeros(count, int)
    alive = np.ones(count, bool)
    for step in range(steps):
        batch.step(act(step, count, rng), alive)
        returns += batch.rewards
        lengths += alive
        alive &= ~batch.terminated
    return returns, lengths, batch


def test_the_holder_holds_and_is_rewarded():
    action = Holder()(np.zeros((100, 42)))
    returns, lengths, batch = play("SquareHold-v0", lambda *_: action, 100, 40)
    assert (lengths == 40).all()
    assert batch.success.all()
    assert returns.mean() >= 39.0
    assert returns.min() >= 38.0


def test_random_actions_drop_the_square_soon_after_the_warm_up():
    _, lengths, batch = play("SquareHold-v0", lambda _, n, rng: rng.uniform(-1, 1, (n, 8)), 200, 40)
    # Twelve steps are three seconds.
    assert (lengths <= 8 + 12).mean() >= 0.95
    assert lengths.min() > 8 or (batch.ends[lengths <= 8] == 2).all()


@pytest.mark.parametrize("max_force", [1.95, 2.4, 2.9, 6.0])
def test_joint_moves_carry_the_square(max_force):
    def carry(step, count, _):
        actions = np.tile(0.6 * INWARDS, (count, 1))
        actions[:, 0::2] += 0.7 * min(max(step - 15, 0) / 8, 1.0)
        return actions

    _, lengths, batch = play("SquareMove-v0", carry, 100, 80, max_force=max_force)
    assert (lengths == 80).all()
    assert batch.bodies[:, 0].min() > 0.2


@pytest.mark.parametrize(
    ("max_force", "fingers", "holds"),
    [
        (1.95, [0, 2], 0.0),
        (1.95, [1, 3], 0.0),
        (1.95, [0, 1, 2], 0.1),  # on a tilted square the clipped axes add up slightly
        (1.95, [0, 1, 2, 3], 1.0),
        (2.4, [0, 2], 0.0),
        (2.4, [0, 1, 2, 3], 1.0),
        (2.9, [1, 3], 0.0),
        (2.9, [0, 1, 2, 3], 1.0),
    ],
)
def test_how_many_fingers_it_takes(max_force, fingers, holds):
    action = np.zeros((4, 2))
    action[fingers] = 0.9 * INWARDS.reshape(4, 2)[fingers]
    actions = np.tile(action.ravel(), (100, 1))
    _, lengths, _ = play("SquareMove-v0", lambda *_: actions, 100, 80, max_force=max_force)
    share = (lengths == 80).mean()
    assert share == holds if holds in (0.0, 1.0) else share <= holds


def test_joint_noise_is_survived_where_independent_noise_is_not():
    """At equal noise, only coordinated fingers keep the square."""

    def independent(_, count, rng):
        return 0.65 * INWARDS + 0.15 * rng.standard_normal((count, 8))

    def joint(_, count, rng):
        return 0.65 * INWARDS + 0.15 * rng.standard_normal((count, 1)) * np.tile([1.0, 0.0], 4)

    alone, together = (
        (play("SquareMove-v0", noise, 300, 80)[1] == 80).mean() for noise in (independent, joint)
    )
    assert alone < 0.35
    assert together > 0.85


def step_once(task, action, **state):
    env = SquareEnv(task, **STILL, warm_up=0.0, weight=0.0)
    env.reset(seed=0)
    env.set_state(state)
    return env, env.step(np.asarray(action))


def test_terms_of_the_holding_reward():
    coefficients = {"held": 0.0, "failure": 0.0, "angle": 0.0, "position": 0.0, "overreach": 0.0}
    away = -1.0 * INWARDS  # fingers stay away from the square, so that it does not move
    body = [0.12, -0.05, 0.2, 0.0, 0.0, 0.0]
    for name, expected in (
        ("held", 1.0),
        ("angle", -0.2),
        ("position", -0.13),
        ("overreach", -0.5),  # four of eight components at the edge
    ):
        task = Hold(**{**coefficients, name: 1.0})
        _, (_, reward, *_) = step_once(task, away, bodies=body)
        assert reward == pytest.approx(expected), name


def test_terms_of_the_moving_reward():
    body = [0.05, -0.05, 0.0, 0.0, 0.0, 0.0]
    nothing = {"held": 0.0, "failure": 0.0, "effort": 0.0, "position": 0.0, "y": 0.0}
    _, (_, reward, *_) = step_once(Move(**{**nothing, "y": 1.0}), np.zeros(8), bodies=body)
    assert reward == pytest.approx(-0.05)
    # After the warm-up the position has no cost, but the effort has.
    env, (_, reward, *_) = step_once(
        Move(**{**nothing, "position": 1.0, "effort": 1.0}), 0.6 * INWARDS
    )
    state = env.get_state()
    stretch = np.linalg.norm(state["targets"] - state["fingers"], axis=1).mean()
    assert reward == pytest.approx(-25.0 * stretch / 6.0)
    assert reward < -0.3


def test_dropping_costs_and_ends_after_the_warm_up_only():
    env = SquareEnv(Hold(failure=7.0, position=0.0, angle=0.0), warm_up=0.5)
    env.reset(seed=0)
    for timer in (0.5, 0.0):
        observation, reward, terminated, _, info = env.step(np.zeros(8))
        assert (reward, terminated, info["end_reason"]) == (0.0, False, "timeout")
        assert observation[-1] == timer
    _, reward, terminated, _, info = env.step(np.zeros(8))
    assert (reward, terminated, info["end_reason"]) == (-7.0, True, "dropped")
    assert info["is_success"] is False


def test_a_finger_pushed_out_of_its_reach_breaks():
    env = SquareEnv(**STILL, warm_up=10.0)
    env.reset(seed=0)
    # The moving square hits the finger on the right at the edge of its reach.
    env.set_state(
        {
            "bodies": [0.45, 0.0, 0.0, 4.0, 0.0, 0.0],
            "fingers": [[0.79, 0.0], [0.0, 0.4], [-0.4, 0.0], [0.0, -0.4]],
        }
    )
    _, _, terminated, _, info = env.step(np.array([1.0, *np.zeros(7)]))
    assert terminated
    assert info["end_reason"] == "broken"


def test_the_goal_is_hidden_rewarded_once_and_remembered():
    task = FindGoal(held=0.0, effort=0.0, failure=0.0, goal=3.0)
    env = SquareEnv(task, **STILL, warm_up=0.25, weight=0.0)
    env.reset(seed=0)
    env.set_state({"goals": [0.0, 0.0]})
    outcomes = [env.step(np.zeros(8)) for _ in range(3)]
    assert [reward for _, reward, *_ in outcomes] == [0.0, 3.0, 0.0]
    assert [info["is_success"] for *_, info in outcomes] == [False, True, True]
    starts = {SquareEnv(FindGoal(span=span), **STILL).reset(seed=3)[0].tobytes() for span in (0, 1)}
    assert len(starts) == 1
    goals = []
    for seed in range(100):
        env.reset(seed=seed)
        goals.append(env.get_state()["goals"])
    goals = np.array(goals)
    assert np.array_equal(goals[:, 0], goals[:, 1])
    assert 0.2 < np.abs(goals).max() <= 0.25


def test_metrics_tell_how_the_square_moved_after_the_warm_up():
    env = SquareEnv("move", **STILL, warm_up=0.5)
    env.reset(seed=0)
    positions, held = [], []
    for step in range(20):
        action = 0.65 * INWARDS + 0.3 * np.sin(step) * np.tile([1.0, 0.5], 4)
        *_, info = env.step(action)
        positions.append(env.get_state()["bodies"][:2])
        held.append(info["held"])
    after = np.array(positions[2:])
    distance = np.linalg.norm(after, axis=1)
    assert info["x_std"] == pytest.approx(after[:, 0].std())
    assert info["x_max"] == pytest.approx(np.abs(after[:, 0]).max())
    assert info["distance_std"] == pytest.approx(distance.std(), abs=1e-7)
    assert info["distance_max"] == pytest.approx(distance.max())
    assert info["held_fraction"] == pytest.approx(np.mean(held))
    assert info["x_std"] > 0.03


def test_observations_are_two_frames_in_the_documented_order():
    env = SquareEnv(max_speed=0.8, warm_up=1.0)
    first, _ = env.reset(seed=1)
    assert np.array_equal(first[:21], first[21:])
    action = np.linspace(-0.7, 0.7, 8)
    second = env.step(action)[0]
    assert np.array_equal(second[:21], first[21:])
    state = env.get_state()
    x, y, angle = state["bodies"][:3]
    expected = [
        *(x, y, np.cos(angle), np.sin(angle)),
        *((state["fingers"] - state["starts"]) / 0.4).ravel(),
        *action,
        0.75,
    ]
    assert second[21:] == pytest.approx(expected, abs=1e-6)


def test_what_is_observed_can_be_chosen():
    everything = SquareEnv(stack=1).reset(seed=0)[0]
    chosen = SquareEnv(stack=3, observe=["timer", "angle"]).reset(seed=0)[0]
    assert np.array_equal(chosen, np.tile(everything[[2, 3, 20]], 3))


def test_observation_noise_has_its_standard_deviation():
    env = SquareEnv(**STILL, stack=1, observation_noise={"position": 0.05})
    seen = np.array([env.reset(seed=seed)[0] for seed in range(500)])
    assert seen[:, :2].std() == pytest.approx(0.05, rel=0.1)
    assert (seen[:, 2:] == seen[0, 2:]).all()


def test_each_episode_draws_from_intervals():
    env = SquareEnv(weight=[2.0, 4.0], size=[0.5, 0.6], kd=[0.3, 0.4])
    drawn = []
    for seed in range(200):
        env.reset(seed=seed)
        drawn.append(env.get_state()["constants"])
    weights, halves, drags = np.array(drawn)[:, [6, 0, 8]].T
    for values, low, high in ((weights, 2.0, 4.0), (halves, 0.25, 0.3), (drags, 0.4, 0.5)):
        assert low <= values.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < values.max() <= high


@pytest.mark.parametrize("env_id", SQUARE_IDS)
def test_states_are_restored_exactly(env_id):
    env = gym.make(env_id, observation_noise=0.01).unwrapped
    env.reset(seed=5)
    rng = np.random.default_rng(0)
    for _ in range(6):
        env.step(rng.uniform(-1, 1, 8))
    state = env.get_state()
    actions = rng.uniform(-1, 1, (12, 8))

    def go_on(one):
        outcomes = []
        for action in actions:
            observation, *rest = one.step(action)
            outcomes.append((observation.tobytes(), *rest))
        return [*outcomes, one.reset()[0].tobytes()]

    expected = go_on(env)
    env.set_state(state)
    assert go_on(env) == expected
    other = gym.make(env_id, observation_noise=0.01).unwrapped
    other.reset(seed=99)
    other.set_state(state)
    assert go_on(other) == expected


def test_bad_states_and_actions_are_rejected_and_change_nothing():
    env = SquareEnv()
    env.reset(seed=0)
    before = env.get_state()
    for state, message in (
        ({"body": np.zeros(6)}, "state must have entries of .*, got 'body'"),
        ({"bodies": np.zeros(5)}, r"finite bodies of shape \(6,\)"),
        ({"fingers": np.full((4, 2), np.nan)}, r"finite fingers of shape \(4, 2\)"),
    ):
        with pytest.raises(ValueError, match=message):
            env.set_state(state)
    with pytest.raises(ValueError, match=r"action must have shape \(8,\), got shape \(3,\)"):
        env.step(np.zeros(3))
    with pytest.raises(ValueError, match="actions must not contain NaN"):
        env.step(np.full(8, np.nan))
    for name, value in env.get_state().items():
        assert np.array_equal(value, before[name]), name


def test_holder_adds_noise():
    noisy, again = Holder(noise=0.1, seed=3), Holder(noise=0.1, seed=3)
    actions = noisy(np.zeros((500, 42)))
    assert np.array_equal(actions, again(np.zeros((500, 42))))
    assert (actions - Holder()(np.zeros(42))).std() == pytest.approx(0.1, rel=0.1)
    with pytest.raises(ValueError, match=r"push must be in \[0, 1\], got 1.5"):
        Holder(push=1.5)
    with pytest.raises(ValueError, match="noise must be finite and at least 0, got -1"):
        Holder(noise=-1.0)
