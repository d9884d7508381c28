"""Seeds, agents and environments that a batch can work with."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable
from functools import partial

import gymnasium as gym
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit

from sb3_flowpolicy.algorithms.engine_flow import EngineFlow
from sb3_flowpolicy.engine import Engine
from sb3_flowpolicy.engine.replay import is_plain

EnvFactory = Callable[[], gym.Env]


def check_seeds(seeds: int | Iterable[int]) -> list[int]:
    """Return the seeds as a list of different integers of at least 0."""
    # ``index`` accepts numpy's integers, too.
    many = seeds if isinstance(seeds, Iterable) else range(operator.index(seeds))
    listed = [operator.index(seed) for seed in many]
    if not listed or len(set(listed)) < len(listed) or min(listed) < 0:
        raise ValueError(f"seeds must be one or more different integers from 0 on, got {seeds!r}")
    return listed


def check_stackable(model: EngineFlow) -> None:
    """Raise ``ValueError`` if agents like this one cannot be trained in lockstep."""
    reason, frequency = Engine.why_unsupported(model), model.train_freq
    buffer = model.replay_buffer
    assert isinstance(frequency, TrainFreq)
    assert buffer is not None
    if isinstance(model.observation_space, gym.spaces.Dict):
        refuse("dictionary observations, which are not supported")
    if reason is not None:
        refuse(reason)
    if is_image_space(model.observation_space):
        refuse("image observations")
    if frequency.unit is not TrainFrequencyUnit.STEP or model.gradient_steps < 0:
        refuse(f"train_freq {frequency} with gradient_steps {model.gradient_steps}")
    if model.action_noise is not None:
        refuse(f"action_noise {model.action_noise}")
    if model.device.type != "cpu":
        refuse(f"device {model.device}")
    if not is_plain(buffer):
        optimized = " with optimize_memory_usage=True" if buffer.optimize_memory_usage else ""
        refuse(f"{type(buffer).__name__}{optimized}")


def refuse(reason: str) -> None:
    """Raise ``ValueError`` with the reason why agents cannot be stacked."""
    raise ValueError(
        "agents must act and learn in lockstep, on the CPU, with plain replay buffers and a fixed "
        f"number of updates per step, got {reason}"
    )


def make_env(env: str | EnvFactory) -> gym.Env:
    """Make one environment from its id or factory."""
    return gym.make(env) if isinstance(env, str) else env()


def make_vec_env(env: str | EnvFactory, count: int) -> VectorEnv:
    """Make the environment's own vectorized form, or ``count`` of them stepped one by one.

    An episode that ends is followed by the next one in the same step.
    """
    mode = AutoresetMode.SAME_STEP
    if isinstance(env, str) and gym.spec(env).vector_entry_point is not None:
        form = "vector_entry_point"
        return gym.make_vec(env, num_envs=count, vectorization_mode=form, autoreset_mode=mode)
    return SyncVectorEnv([partial(make_env, env)] * count, autoreset_mode=mode)
