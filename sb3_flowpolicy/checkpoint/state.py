"""Convert the state of a run, without networks and replay buffer, to bytes and back."""

from __future__ import annotations

import inspect
import random
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_flowpolicy.checkpoint import environments, logs, pickling
from sb3_flowpolicy.checkpoint.rows import Ring

# Counters, and attributes that SB3's load() leaves out or creates anew.
_ATTRIBUTES = (
    "num_timesteps",
    "_n_updates",
    "_episode_num",
    "ep_info_buffer",
    "ep_success_buffer",
    "_current_progress_remaining",
    "action_space",
    "_last_obs",
    "_last_original_obs",
    "_last_episode_starts",
    "_num_timesteps_at_start",
)


@dataclass
class Run:
    """What a checkpoint consists of: one agent, or several in lockstep.

    Args:
        kind: Name of the class that can resume it.
        agents: Agents by the name of their files.
        environments: Environments by name.
        ring: Returns the contents of the replay buffer; None if it is not made of rows.
        extra: Returns further state.
        set_extra: Restores what ``extra`` returned.
        callbacks: The callback of each agent's ``learn``, while it runs.
        opaque: Environments that cannot be pickled.
    """

    kind: str
    agents: Mapping[str, OffPolicyAlgorithm]
    environments: Mapping[str, Any]
    ring: Callable[[], Ring | None]
    extra: Callable[[], dict[str, Any]]
    set_extra: Callable[[dict[str, Any]], None]
    callbacks: dict[str, BaseCallback] = field(default_factory=dict)
    opaque: set[str] = field(default_factory=set)

    @property
    def first(self) -> OffPolicyAlgorithm:
        """The first agent; all agents have taken equally many steps."""
        return next(iter(self.agents.values()))

    def known(self) -> dict[str, object]:
        """Name the objects that a resumed run has as well."""
        found: dict[str, object] = {}
        for name, env in {**self.environments, **self.callback_environments()}.items():
            found |= {f"{name}/{place}": layer for place, layer in environments.layers(env).items()}
        for name, agent in self.agents.items():
            found[name] = agent
            modules = agent.policy.named_modules()
            found |= {f"{name}/policy.{path}": module for path, module in modules}
            found[f"{name}/replay_buffer"] = agent.replay_buffer
            if hasattr(agent, "_logger"):
                found[f"{name}/logger"] = agent.logger
        for name, callback in self.all_callbacks().items():
            found[f"callback {name}"] = callback
        return found

    def all_callbacks(self) -> dict[str, BaseCallback]:
        """Name the callbacks of all agents, nested ones included, by type."""
        found: dict[str, BaseCallback] = {}
        for name, root in self.callbacks.items():
            for callback in _tree(root):
                kind = f"{name}/{type(callback).__name__}"
                count = sum(other.startswith(kind) for other in found)
                found[f"{kind} {count}"] = callback
        return found

    def callback_environments(self) -> dict[str, VecEnv]:
        """Name the environments of callbacks, such as that of ``EvalCallback``."""
        training = [id(env) for env in self.environments.values()]
        return {
            f"{name}.{key}": value
            for name, callback in self.all_callbacks().items()
            for key, value in vars(callback).items()
            if isinstance(value, VecEnv) and id(value) not in training
        }


def collect(run: Run) -> dict[str, bytes]:
    """Pickle the state of a run, in the two parts that are restored at different times.

    Environments that cannot be pickled are left out, with one warning.
    """
    return {"early": _pickle(run, _early), "late": _pickle(run, _late)}


def _pickle(run: Run, part: Callable[[Run], dict[str, Any]]) -> bytes:
    """Pickle; if that fails, leave out environments that cannot be pickled, also later on."""
    known = run.known()
    try:
        return pickling.dumps(part(run), known)
    except Exception:  # anything a user's environment raises
        for name, env in {**run.environments, **run.callback_environments()}.items():
            try:
                pickling.dumps(environments.layer_states(env), known)
            except Exception as error:
                run.opaque.add(name)
                warnings.warn(
                    f"the state of environment {env} cannot be saved ({type(error).__name__}: "
                    f"{error}): a resumed run will begin a new episode, which is not exact",
                    RuntimeWarning,
                    stacklevel=4,
                )
        return pickling.dumps(part(run), known)


def restore_early(run: Run, pickled: bytes) -> None:
    """Restore attributes and environments; begin new episodes where that is not possible."""
    known = run.known()
    state = pickling.loads(pickled, known)
    for name, agent in run.agents.items():
        vars(agent).update(state["agents"][name])
    for name, env in run.environments.items():
        environments.set_layer_states(env, state["environments"][name])
        logs.write_texts(environments.monitor_files(env), state["monitors"][name])
    run.opaque.clear()
    run.opaque.update(state["opaque"])
    for name in run.opaque & set(run.agents):
        agent = run.agents[name]
        agent._last_obs = None
        if agent.seed is not None and agent.env is not None:
            # Otherwise it would repeat its first episodes.
            agent.env.seed(agent.seed + agent.num_timesteps)
    if run.opaque & set(run.environments):
        warnings.warn(
            "resuming begins new episodes, as the environment could not be saved: the run "
            "continues, but not exactly as it would have",
            RuntimeWarning,
            stacklevel=4,
        )


def restore_late(run: Run, pickled: bytes) -> None:
    """Restore what the beginning of ``learn`` resets: random numbers, clocks, callbacks, logs."""
    known = run.known()
    state = pickling.loads(pickled, known)
    for name, agent in run.agents.items():
        mine = state["agents"][name]
        agent.start_time = time.time_ns() - mine["elapsed"]
        agent._num_timesteps_at_start = mine["begun"]
        if agent.action_noise is not None:  # in place: the running loop holds this object
            vars(agent.action_noise).update(mine["action_noise"])
        logs.set_log_state(agent.logger, mine["log"], agent.num_timesteps)
    for name, env in run.callback_environments().items():
        if list(environments.layers(env)) == list(state["environments"].get(name, ())):
            environments.set_layer_states(env, state["environments"][name])
    for name, callback in run.all_callbacks().items():
        vars(callback).update(state["callbacks"].get(name, {}))
    run.set_extra(state["extra"])
    _set_random_state(state["random"])


def _early(run: Run) -> dict[str, Any]:
    return {
        "agents": {
            name: {key: vars(agent)[key] for key in _ATTRIBUTES if key in vars(agent)}
            for name, agent in run.agents.items()
        },
        "environments": {
            name: environments.layer_states(env, outside_only=name in run.opaque)
            for name, env in run.environments.items()
        },
        "monitors": {
            name: logs.read_texts(environments.monitor_files(env))
            for name, env in run.environments.items()
        },
        "opaque": sorted(run.opaque),
    }


def _late(run: Run) -> dict[str, Any]:
    return {
        "agents": {
            name: {
                "elapsed": time.time_ns() - agent.start_time,
                "begun": agent._num_timesteps_at_start,
                "action_noise": {} if agent.action_noise is None else vars(agent.action_noise),
                "log": logs.log_state(agent.logger),
            }
            for name, agent in run.agents.items()
        },
        "environments": {
            name: environments.layer_states(env, outside_only=name in run.opaque)
            for name, env in run.callback_environments().items()
        },
        "callbacks": {
            name: _callback_state(callback) for name, callback in run.all_callbacks().items()
        },
        "extra": run.extra(),
        "random": _random_state(),
    }


def _callback_state(callback: BaseCallback) -> dict[str, Any]:
    """Collect a callback's counters and records: attributes made of numbers, text and arrays.

    Leaves out attributes named like constructor arguments: these are settings, which may change.
    """
    constructors = [kind.__init__ for kind in type(callback).__mro__]  # type: ignore[misc]
    settings = {name for one in constructors for name in inspect.signature(one).parameters}
    return {
        key: value
        for key, value in vars(callback).items()
        if key not in settings and pickling.is_data(value)
    }


def _tree(root: BaseCallback) -> Iterator[BaseCallback]:
    yield root
    for key, value in vars(root).items():
        if key == "parent":
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, BaseCallback):
                yield from _tree(child)


def _random_state() -> dict[str, Any]:
    cuda = th.cuda.get_rng_state_all() if th.cuda.is_initialized() else []
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),  # noqa: NPY002 - SB3's buffers draw from it
        "torch": th.get_rng_state(),
        "cuda": cuda,
    }


def _set_random_state(state: dict[str, Any]) -> None:
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])  # noqa: NPY002
    th.set_rng_state(state["torch"])
    if state["cuda"] and len(state["cuda"]) == th.cuda.device_count():
        th.cuda.set_rng_state_all(state["cuda"])
