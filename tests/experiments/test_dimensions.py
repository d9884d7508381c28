"""Tunnels of many dimensions: widths against the environment, predictions against samples."""

import json

import gymnasium as gym
import numpy as np
import pytest

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy.experiments.dimensions.__main__ import main
from sb3_flowpolicy.experiments.dimensions.discovery import (
    _EPISODE,
    _STEPS,
    DISTANCE,
    _value,
    chance,
    discovery,
)
from sb3_flowpolicy.experiments.dimensions.prediction import (
    FAMILIES,
    REACH,
    SURVIVAL_OF_RANDOM_STEPS,
    WIDTHS,
    _entropy,
    best,
    bound,
    survival_of,
)


@pytest.mark.parametrize("dims", WIDTHS)
def test_random_first_steps_survive_equally_often(dims):
    actions = np.random.default_rng(0).uniform(-1, 1, (200_000, dims))
    found = survival_of(actions, WIDTHS[dims])
    assert found == pytest.approx(SURVIVAL_OF_RANDOM_STEPS, abs=0.003)


def test_two_dimensions_are_the_registered_tunnel():
    config = gym.make("TunnelDiagonal-v0").unwrapped.config
    assert (config.width, config.reach) == (WIDTHS[2], REACH)


def test_survival_is_that_of_the_environment():
    count = 4000
    envs = gym.make_vec(
        "TunnelDiagonal-v0",
        num_envs=count,
        vectorization_mode="vector_entry_point",
        total_dims=8,
        coupled_dims=8,
        width=WIDTHS[8],
    )
    envs.reset(seed=0)
    actions = np.random.default_rng(0).uniform(-1, 1, (count, 8)).astype(np.float32)
    *_, terminated, _, _ = envs.step(actions)
    assert 1 - terminated.mean() == pytest.approx(SURVIVAL_OF_RANDOM_STEPS, abs=0.015)


def test_entropy_is_that_of_squashed_noise():
    scale, common = 0.4, 0.7
    noise = np.random.default_rng(0).standard_normal((200_000, 4))
    latent = common * noise[:, :1] + scale * noise[:, 1:]
    covariance = common**2 + scale**2 * np.eye(3)
    normal = 0.5 * np.linalg.slogdet(2 * np.pi * np.e * covariance)[1]
    expected = normal + np.log(1 - np.tanh(latent) ** 2).sum(axis=1).mean()
    assert _entropy(3, scale, common) == pytest.approx(expected, abs=0.02)


def test_independent_noise_in_two_dimensions_is_as_computed_by_hand():
    # The difference of two coordinates is normal, and 90 % of it within 1.645 deviations.
    scale = WIDTHS[2] / (2 * REACH) / 1.645
    found = best("independent", 2, WIDTHS[2], 0.9)["entropy"]
    assert found == pytest.approx(2 * np.log(scale * np.sqrt(2 * np.pi * np.e)), abs=0.05)


def test_correlation_is_worth_less_in_more_dimensions():
    gaps = []
    for dims in (2, 4, 8):
        alone, joint = (best(name, dims, WIDTHS[dims], 0.9) for name in FAMILIES)
        assert alone["entropy"] < joint["entropy"] < bound(dims, 0.9)
        assert alone["progress"] < joint["progress"]
        assert alone["survival"] == pytest.approx(0.9, abs=0.001)
        assert joint["survival"] == pytest.approx(0.9, abs=0.001)
        gaps.append(joint["entropy"] - alone["entropy"])
    assert gaps[0] > 2 * gaps[1] > 2 * gaps[2] > 0.5


def test_the_distance_is_that_of_the_environment():
    env = gym.make("TunnelDiagonal-v0").unwrapped
    env.reset(seed=0)
    for _ in range(int(DISTANCE)):
        assert not env.step(np.ones(2, np.float32))[2]
    assert not env.step(np.full(2, DISTANCE % 1 - 1e-4, np.float32))[2]
    *_, terminated, _, info = env.step(np.full(2, 2e-4, np.float32))
    assert terminated
    assert info["is_success"]


@pytest.mark.parametrize("survival", [1.0, 0.97])
def test_chance_is_that_of_a_random_walk(survival):
    rng = np.random.default_rng(0)
    there = rng.normal(0.0, 0.6, (200_000, 40)).cumsum(1) >= DISTANCE
    expected = (there.any(1) * survival ** (there.argmax(1) + 1)).mean()
    assert chance(0.6, survival) == pytest.approx(expected, rel=0.03)


def test_the_value_is_the_discounted_sum_of_entropy_and_penalty():
    # The settings of TunnelDiagonal-v0: coefficient 0.0025, penalty 0.1, discount 0.8.
    entropy, survival = -1.5, 0.9
    reached = 0.8 ** np.arange(400) * survival ** np.arange(400)
    expected = (reached * (0.0025 * entropy - 0.1 * (1 - survival))).sum()
    assert _value({"entropy": entropy, "survival": survival}) == pytest.approx(expected)


def test_goals_are_those_of_simulated_noise():
    found = discovery("correlated", 2, WIDTHS[2])
    rng, count = np.random.default_rng(0), 40_000
    place, running, goals, steps = np.zeros(count), np.ones(count, bool), 0, 0
    for _ in range(_EPISODE):
        steps += running.sum()
        shared, own = rng.standard_normal((count, 1)), rng.standard_normal((count, 2))
        actions = np.tanh(found["common"] * shared + found["scale"] * own)
        place += actions.mean(axis=1)
        offsets = np.linalg.norm(actions - actions.mean(axis=1, keepdims=True), axis=1)
        running &= (offsets <= WIDTHS[2] / (2 * REACH)) & (place >= -1 / REACH)
        goals += (running & (place >= DISTANCE)).sum()
        running &= place < DISTANCE
    assert found["goals"] == pytest.approx(_STEPS / steps * goals, rel=0.15)


def test_correlated_noise_finds_the_goal_up_to_four_dimensions():
    goals = [discovery("correlated", dims, WIDTHS[dims])["goals"] for dims in (2, 4, 8)]
    assert goals[0] > goals[1] > 1 > goals[2]
    for dims, goal in zip((2, 4, 8), goals, strict=True):
        assert discovery("any", dims, WIDTHS[dims])["goals"] > goal
    assert all(discovery("independent", dims, WIDTHS[dims])["goals"] < 1e-9 for dims in (2, 4, 8))


@pytest.mark.parametrize("results", [True, False])
def test_the_command_draws_results(results, make_up, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        "sb3_flowpolicy.experiments.dimensions.__main__.WIDTHS", {2: WIDTHS[2], 3: WIDTHS[3]}
    )
    if results:
        make_up("diagonal-widened")
        make_up("diagonal-causes")
    command = ["--figure", str(tmp_path / "p.png"), "--results", str(tmp_path)]
    if results:
        main(command)
        assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")
    else:
        with pytest.raises(SystemExit):
            main(command)
        assert (
            "--results: no complete results of diagonal-widened or diagonal-causes"
            in capsys.readouterr().err
        )


def test_the_command_writes_what_it_prints(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(
        "sb3_flowpolicy.experiments.dimensions.__main__.WIDTHS", {2: WIDTHS[2], 3: WIDTHS[3]}
    )
    main(["--json", str(tmp_path / "p.json"), "--figure", str(tmp_path / "p.png")])
    rows = json.loads((tmp_path / "p.json").read_text())["rows"]
    assert [row["dims"] for row in rows] == [2, 3]
    assert f"{rows[0]['independent']['entropy']:.4f}" in capsys.readouterr().out
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")


def test_the_command_refuses_a_certain_survival(capsys):
    with pytest.raises(SystemExit):
        main(["--survival", "1"])
    assert "--survival must be in (0, 1), got 1.0" in capsys.readouterr().err
