"""Any configuration works or raises ``ValueError``, or ``TypeError`` for unknown arguments."""

from __future__ import annotations

import argparse
import contextlib
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flowpolicy_envs import FindGoal, Hold, Move, SquareEnv, TunnelEnv
from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.common.command_line import assignment
from sb3_flowpolicy.common.hyperparameters import load_hyperparameters
from sb3_flowpolicy.policies import FlowPolicy, LowRankPolicy
from tests.fuzz.effort import fuzz

ANYTHING = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-3, 40)
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["auto", "auto_0.1", "hold", "line", "realnvp", "step", np.float32(0.5)])
    | st.sampled_from([np.int64(3), np.zeros(2), object(), b"x", 1j, {1}, (1, "step"), 10**400]),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.text(max_size=5) | st.integers(), inner, max_size=2)
    ),
    max_leaves=4,
)


def works_or_says_why(make: Any, *arguments: Any, **kwargs: Any) -> Any:
    """Return what was made, or None where an error explains why not."""
    try:
        return make(*arguments, **kwargs)
    except ValueError as error:
        message = str(error)
    except TypeError as error:
        message = str(error) if "unexpected keyword argument" in str(error) else ""
    assert message
    return None


TUNNEL = [
    *("path", "total_dims", "coupled_dims", "free_dims", "goal_position", "radius", "waypoints"),
    *("width", "reach", "start_noise", "dense_reward", "goal_reward", "leave_penalty"),
    *("render_mode", "render_size"),
]
SQUARE = [
    *("task", "size", "mass", "inertia", "linear_damping", "angular_damping", "friction"),
    *("weight", "kp", "kd", "finger_damping", "max_force", "max_speed", "reach"),
    *("finger_distance", "finger_noise", "start_x", "start_y", "start_angle", "warm_up"),
    *("observe", "observation_noise", "stack", "dt", "substeps", "render_mode", "render_size"),
    *("slew", "friction_cone"),
]


@fuzz(150)
@given(arguments=st.dictionaries(st.sampled_from(TUNNEL), ANYTHING, max_size=2))
def test_tunnel(arguments: dict[str, Any]) -> None:
    env = works_or_says_why(TunnelEnv, **arguments)
    if env is not None:
        assert env.observation_space.contains(env.reset(seed=0)[0])


@fuzz(150)
@given(arguments=st.dictionaries(st.sampled_from(SQUARE), ANYTHING, max_size=2))
def test_square(arguments: dict[str, Any]) -> None:
    env = works_or_says_why(SquareEnv, **arguments)
    if env is not None:
        assert env.observation_space.contains(env.reset(seed=0)[0])


@fuzz(60)
@given(task=st.sampled_from([Hold, Move, FindGoal]), value=ANYTHING)
def test_tasks(task: Any, value: Any) -> None:
    works_or_says_why(task, held=value)


CONSTRUCTOR = [*SACFlow.settings, "policy_kwargs", "verbose", "learning_rate"]


@fuzz(250)
@given(
    arguments=st.dictionaries(st.sampled_from(CONSTRUCTOR), ANYTHING, min_size=1, max_size=2),
)
@pytest.mark.filterwarnings("ignore")
def test_constructor(arguments: dict[str, Any]) -> None:
    settings = {"policy_kwargs": {"net_arch": [4]}, "buffer_size": 50, "device": "cpu", **arguments}
    if "learning_rate" in arguments and not isinstance(arguments["learning_rate"], int | float):
        del settings["learning_rate"]
    model = works_or_says_why(SACFlow, "FlowPolicy", PENDULUM, **settings)
    if model is not None:
        assert PENDULUM.action_space.contains(model.predict(np.zeros(3, np.float32))[0])


PENDULUM = gym.make("Pendulum-v1")
DENSITIES = ["gaussian", "low_rank", "full_covariance", "lattice", "realnvp", "spline"]
KWARGS = ["distribution", "distribution_kwargs", "net_arch"]


@fuzz(250)
@given(
    policy=st.sampled_from([FlowPolicy, LowRankPolicy]),
    kwargs=st.dictionaries(st.sampled_from(KWARGS), ANYTHING, max_size=2),
)
def test_policy_kwargs(policy: Any, kwargs: dict[str, Any]) -> None:
    kwargs = {"net_arch": [4], **kwargs}
    spaces = PENDULUM.observation_space, PENDULUM.action_space
    works_or_says_why(policy, *spaces, lambda _: 1e-3, **kwargs)


@fuzz(250)
@given(
    distribution=st.sampled_from(DENSITIES),
    arguments=st.dictionaries(
        st.sampled_from(["layers", "hidden", "init", "bins", "rank", "alpha", "x"]),
        ANYTHING,
        max_size=2,
    ),
)
def test_distribution_kwargs(distribution: str, arguments: dict[str, Any]) -> None:
    spaces = PENDULUM.observation_space, PENDULUM.action_space
    kwargs = {"distribution": distribution, "distribution_kwargs": arguments, "net_arch": [4]}
    works_or_says_why(FlowPolicy, *spaces, lambda _: 1e-3, **kwargs)


@fuzz(100)
@given(algo=ANYTHING | st.just("sac_flow"), env_id=st.text() | st.just("default"))
def test_hyperparameter_files(algo: Any, env_id: Any) -> None:
    block = works_or_says_why(load_hyperparameters, algo, env_id)
    assert block is None or "policy" in block


@fuzz(200)
@given(value=st.text(alphabet="[]{}:,&*!|>-'\"#0e.\n\t abc%@`?<é", max_size=30))
def test_overrides_on_the_command_line(value: str) -> None:
    for text in (value, "gamma=" + value):
        with contextlib.suppress(argparse.ArgumentTypeError):
            assignment(text)
