import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import iterate

from flowpolicy_envs.tunnel.vector import TunnelVectorEnv

MODES = [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP]


def test_goals_are_reported_in_both_modes():
    actions = np.ones((2, 2), np.float32)
    actions[1] = 0.0
    for mode in MODES:
        envs = gym.make_vec(
            "TunnelDiagonal-v0",
            num_envs=2,
            vectorization_mode="vector_entry_point",
            autoreset_mode=mode,
        )
        envs.reset(seed=0)
        for _ in range(7):
            observations, rewards, terminations, _, infos = envs.step(actions)
        assert rewards.tolist() == [1.0, 0.0]
        assert terminations.tolist() == [True, False]
        if mode is AutoresetMode.SAME_STEP:
            assert observations[0].tolist() == [0.0, 0.0]
            assert infos["final_obs"][0] == pytest.approx([0.98, 0.98])
            assert infos["final_obs"][1] is None
            assert infos["final_info"]["is_success"].tolist() == [True, False]
            assert infos["is_success"].tolist() == [False, False]
        else:
            assert observations[0] == pytest.approx([0.98, 0.98])
            assert infos["is_success"].tolist() == [True, False]
            observations, rewards, terminations, *_ = envs.step(actions)
            assert observations[0].tolist() == [0.0, 0.0]
            assert rewards.tolist() == [0.0, 0.0]
            assert not terminations.any()


@pytest.mark.parametrize("path", ["line", "circle", "spline"])
def test_each_agent_equals_a_single_environment_with_its_seed(path):
    kwargs = {"path": path, "start_noise": 0.2, "width": 0.3, "max_episode_steps": 9}
    seeds = [5, 90, 7]
    envs = TunnelVectorEnv(3, autoreset_mode="SameStep", **kwargs)
    singles = [gym.make("Tunnel-v0", **kwargs) for _ in seeds]
    observations, _ = envs.reset(seed=seeds)
    for i, (single, seed) in enumerate(zip(singles, seeds, strict=True)):
        assert observations[i].tobytes() == single.reset(seed=seed)[0].tobytes()
    assert envs.np_random_seed == tuple(seeds)
    envs.action_space.seed(0)
    for _ in range(60):
        actions = envs.action_space.sample()
        observations, rewards, *_ = envs.step(actions)
        for i, (single, action) in enumerate(
            zip(singles, iterate(envs.action_space, actions), strict=True)
        ):
            observation, reward, terminated, truncated, _ = single.step(action)
            if terminated or truncated:
                observation, _ = single.reset()
            assert observation.tobytes() == observations[i].tobytes()
            assert reward == rewards[i]


def test_resets_continue_with_the_generators():
    envs = TunnelVectorEnv(3, start_noise=0.5)
    first, _ = envs.reset(seed=4)
    second, _ = envs.reset()
    assert not (first == second).any()
    assert np.array_equal(envs.reset(seed=4)[0], first)
    assert np.array_equal(envs.reset()[0], second)
    envs.reset(seed=[None, 5, None])
    assert len(set(envs.np_random_seed)) == 3


def test_results_are_not_overwritten():
    envs = TunnelVectorEnv(2, width=2.0)
    kept = [envs.reset(seed=0)[0], *envs.step(np.ones((2, 2)))[:4]]
    before = [array.copy() for array in kept]
    envs.step(-np.ones((2, 2)))
    for array, copy in zip(kept, before, strict=True):
        assert np.array_equal(array, copy)


def test_bad_calls():
    envs = TunnelVectorEnv(3)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"actions must have shape \(3, 2\), got shape \(2,\)"):
        envs.step(np.zeros(2))
    with pytest.raises(ValueError, match=r"actions must not contain NaN, got .* at 1"):
        envs.step(np.array([[1, 1], [0, np.nan], [1, 1]]))
    assert not envs.positions.any()
    with pytest.raises(ValueError, match="seed must have one entry per agent, 3, got"):
        envs.reset(seed=[1, 2])
    with pytest.raises(ValueError, match="must be boolean of shape"):
        envs.reset(options={"reset_mask": np.zeros(3, bool)})


def test_an_action_that_will_be_ignored_may_be_anything():
    envs = TunnelVectorEnv(2)
    envs.reset(seed=0)
    envs.step([[1.0, -1.0], [0.0, 0.0]])
    observations, *_ = envs.step([[np.nan, np.nan], [1.0, 1.0]])
    assert observations == pytest.approx(np.array([[0.0, 0.0], [0.14, 0.14]]))


def test_render_returns_a_frame_per_agent():
    envs = TunnelVectorEnv(2, render_mode="rgb_array", render_size=64)
    envs.reset(seed=0)
    envs.step([[1.0, 1.0], [0.0, 0.0]])
    frames = envs.render()
    assert frames is not None
    assert [frame.shape for frame in frames] == [(64, 64, 3)] * 2
    assert not np.array_equal(*frames)
    assert TunnelVectorEnv(2).render() is None
