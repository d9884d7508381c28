"""Experience of S agents: collected side by side, recorded, stored, and sampled."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch as th
from stable_baselines3.common.monitor import ResultsWriter

from sb3_flowpolicy.algorithms.engine_flow import EngineFlow
from sb3_flowpolicy.algorithms.exploration import ColoredExploration
from sb3_flowpolicy.checkpoint.logs import read_texts, write_texts
from sb3_flowpolicy.common.vec_env import step_info
from sb3_flowpolicy.engine import EngineRuntime, gsde
from sb3_flowpolicy.engine.networks import noise_shape
from sb3_flowpolicy.engine.replay import ReplayRows
from sb3_flowpolicy.engine.update import Batch
from sb3_flowpolicy.guard.finite import check_experience
from sb3_flowpolicy.seeds.setup import EnvFactory, make_vec_env

# Random numbers are drawn for this many updates or steps at once, as each call has a fixed cost.
AHEAD = 64


class SeedExperience:
    """Environments, episodes, replay buffers and random numbers of S agents.

    The agents' own buffers become views of one array, :attr:`rows`, and can be saved as usual.

    Args:
        models: The agents.
        seeds: Their seeds.
        env: Registered id, or a function that makes an environment.
        monitor_dir: Folder for ``seed_<seed>.monitor.csv``; None writes none.
        info_keywords: Further numbers to record, from the info of an episode's last step.
    """

    def __init__(
        self,
        models: Sequence[EngineFlow],
        seeds: Sequence[int],
        env: str | EnvFactory,
        monitor_dir: str | Path | None = None,
        info_keywords: Sequence[str] = (),
    ) -> None:
        self.models, self.seeds, self.info_keywords = models, seeds, tuple(info_keywords)
        self.venv = make_vec_env(env, len(seeds))
        self.obs: np.ndarray | None = None
        self.rows = ReplayRows(self._buffers())
        self._exploration = ColoredExploration()
        self._noise: dict[str, SeedNoise] = {}
        # With gSDE, the noise that several steps share.
        self._matrices: th.Tensor | None = None
        self.fit()
        # Returns and lengths of the running episodes.
        self.returns, self.lengths = np.zeros(len(seeds)), np.zeros(len(seeds), dtype=int)
        self._start = time.time()
        self._writers: list[ResultsWriter] = []
        if monitor_dir is not None:
            header: dict[str, float | str] = {"t_start": self._start}
            self._writers = [
                ResultsWriter(str(Path(monitor_dir, f"seed_{seed}")), header, self.info_keywords)
                for seed in seeds
            ]

    def _buffers(self) -> list[Any]:
        return [model.replay_buffer for model in self.models]

    def fit(self) -> None:
        """Adapt to changes of the agents since the last run.

        Raises:
            ValueError: Unless all agents have as many transitions.
        """
        buffers = self._buffers()
        if len({(buffer.pos, buffer.full) for buffer in buffers}) > 1:
            sizes = [buffer.size() for buffer in buffers]
            raise ValueError(f"replay buffers must be equally filled, got {sizes} transitions")
        # An agent that was trained on its own has its own buffer since then.
        if not self.rows.holds(buffers):
            self.rows = ReplayRows(buffers)
        first, before = self.models[0], self._noise
        shape = first.action_space.shape or ()
        of_update = noise_shape(first.actor, first.batch_size)
        self._exploration.fit(first, len(self.seeds), self.venv)
        process = self._exploration.process
        # Name -> shape, and whether it is uniform. Generators that still fit continue.
        wanted = {
            "random actions": (shape, True),
            "actions": ((1, of_update[-1]) if process is None else process.white_shape[1:], False),
            "updates": (of_update, False),
            "rows": ((first.batch_size,), True),
        }
        self._noise = {
            name: before[name]
            if name in before and before[name].shape == needed
            else SeedNoise(self.seeds, needed, stream, uniform)
            for stream, (name, (needed, uniform)) in enumerate(wanted.items())
        }

    def reset(self) -> None:
        """Begin new episodes; a batch that trains on does not repeat those it has seen."""
        step = self.models[0].num_timesteps
        seeds = [seed + step for seed in self.seeds]
        # Typed as one seed, documented as one per environment.
        self.obs, _ = self.venv.reset(seed=seeds)  # type: ignore[arg-type]
        check_experience({"observations": self.obs}, step, self._name)
        self._exploration.restart()
        self.restart_episodes()

    def restart_episodes(self) -> None:
        """Forget the running episodes: their environments were reset."""
        self.returns[:], self.lengths[:] = 0, 0

    def step(
        self, runtime: EngineRuntime
    ) -> tuple[np.ndarray, np.ndarray, dict[str, Any], dict[int, dict[str, Any]]]:
        """Step all environments once and store the transitions.

        Returns:
            Rewards (S,), which episodes ended (S,), the infos of the vectorized environment, and
            for each agent whose episode ended its last info as SB3's ``VecEnv`` returns it.
        """
        assert self.obs is not None
        first = self.models[0]
        scaled = self._act(runtime, self.obs)
        obs, rewards, terminated, truncated, infos = self.venv.step(
            first.policy.unscale_action(scaled)
        )
        step, dones, next_obs = first.num_timesteps + 1, terminated | truncated, obs
        done = np.flatnonzero(dones).tolist()
        if done:
            # The environment has been reset already: the last observation is in the info.
            next_obs = obs.copy()
            for index in done:
                next_obs[index] = infos["final_obs"][index]
            check_experience({"final observations": next_obs}, step, self._name)
        check_experience({"observations": obs, "rewards": rewards}, step, self._name)
        self._store(
            observations=self.obs,
            next_observations=next_obs,
            actions=scaled.reshape(len(scaled), -1),
            rewards=rewards,
            dones=dones,
            timeouts=truncated & ~terminated,
        )
        self.obs = obs
        self._exploration.restart(dones)
        self.returns += rewards
        self.lengths += 1
        ended = {index: step_info(infos, index, terminated, truncated) for index in done}
        for index, info in ended.items():
            info["episode"] = self._episode(index, info)
        self.returns[done], self.lengths[done] = 0, 0
        return rewards, dones, infos, ended

    def draw_matrices(self) -> None:
        """Draw new exploration matrices, with which agents that use gSDE act from now on."""
        self._matrices = self._noise["actions"].draw()[0]
        # For ``predict``: in callbacks, and after training.
        for model, noise in zip(self.models, self._matrices, strict=True):
            gsde.set_matrix(model.actor, noise)

    def _act(self, runtime: EngineRuntime, obs: np.ndarray) -> np.ndarray:
        """Return scaled actions, (S, *shape)."""
        first = self.models[0]
        random_steps = first.learning_starts if first.random_steps is None else first.random_steps
        with_gsde_first = first.use_sde and first.use_sde_at_warmup
        if first.num_timesteps < random_steps and not with_gsde_first:
            return (self._noise["random actions"].draw()[0] * 2 - 1).float().numpy()
        noise = self._noise["actions"].draw()[0] if self._matrices is None else self._matrices
        if self._exploration.process is not None:
            noise = self._exploration.process.step(noise).unsqueeze(1)
        engine = runtime.engine()
        assert engine is not None
        actions = engine.act(th.from_numpy(obs).unsqueeze(1), noise)
        return actions.squeeze(1).numpy().reshape(len(obs), *(first.action_space.shape or ()))

    def _store(self, **values: np.ndarray) -> None:
        """Append one transition per seed; each value has a leading axis S."""
        buffers = self.rows.buffers
        row = buffers[0].pos
        for name, value in values.items():
            self.rows.columns[name][row] = value
        for buffer in buffers:
            buffer.pos = (row + 1) % buffer.buffer_size
            buffer.full = buffer.full or buffer.pos == 0

    def _episode(self, index: int, info: dict[str, Any]) -> dict[str, Any]:
        """Return what SB3's ``Monitor`` says of an episode, given its last info."""
        return {
            "r": round(float(self.returns[index]), 6),
            "l": int(self.lengths[index]),
            "t": round(time.time() - self._start, 6),
            **{name: info[name] for name in self.info_keywords},
        }

    def record(self, ended: dict[int, dict[str, Any]]) -> None:
        """Record the episodes that :meth:`step` returned, as SB3's algorithms do."""
        for index, info in ended.items():
            model = self.models[index]
            model._update_info_buffer([info], np.array([True]))
            if self._writers:
                self._writers[index].write_row(info["episode"])
            model._episode_num += 1

    def minibatches(self, count: int) -> list[Batch]:
        """Draw minibatches of all agents for as many updates."""
        first, seeds = self.rows.buffers[0], len(self.seeds)
        rows = (self._noise["rows"].draw(count) * first.size()).long()
        index = rows.mul_(seeds).add_(th.arange(seeds).unsqueeze(-1))
        noise = self._noise["updates"].draw(count).transpose(1, 2).expand(-1, 2, -1, -1, -1)
        return self.rows.take(index, self.models[0].gamma, noise)

    def _name(self, index: int) -> str:
        return f"seed {self.seeds[index]}"

    def state(self) -> dict[str, Any]:
        """Return everything needed to continue, except environments and replay buffers."""
        return {
            "noise": {name: one.state() for name, one in self._noise.items()},
            "obs": self.obs,
            "exploration": self._exploration.state(),
            "episodes": {
                "returns": self.returns,
                "lengths": self.lengths,
                "start": self._start,
                "texts": read_texts(self._monitor_files()),
            },
        }

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state` returned, except the observation."""
        for name, one in self._noise.items():
            one.load_state(state["noise"][name])
        self._exploration.load_state(state["exploration"])
        episodes = state["episodes"]
        self.returns, self.lengths = episodes["returns"], episodes["lengths"]
        self._start = episodes["start"]
        write_texts(self._monitor_files(), episodes["texts"])

    def _monitor_files(self) -> dict[str, IO[str]]:
        return {str(index): one.file_handler for index, one in enumerate(self._writers)}


class SeedNoise:
    """Random numbers of S seeds, each from a generator of its own.

    A seed's numbers do not depend on the other seeds of its batch.

    Args:
        seeds: The seeds.
        shape: Shape of one draw of one seed.
        stream: Distinguishes several uses by the same seed.
        uniform: Whether to draw from [0, 1) instead of a standard normal.
    """

    def __init__(self, seeds: Sequence[int], shape: tuple[int, ...], stream: int, uniform: bool):
        self.shape = shape
        self.uniform = uniform
        states = [np.random.SeedSequence((seed, stream)).generate_state(1) for seed in seeds]
        self.generators = [th.Generator().manual_seed(int(state[0])) for state in states]
        self._pool = th.empty(0)

    def draw(self, count: int = 1) -> th.Tensor:
        """Return the next ``count`` numbers of every seed, (count, S, *shape)."""
        # Uniform numbers become indices; float32 cannot represent all of a million rows.
        draw, dtype = (th.rand, th.float64) if self.uniform else (th.randn, th.float32)
        parts = []
        while count:
            if not len(self._pool):
                numbers = [
                    draw(AHEAD, *self.shape, generator=own, dtype=dtype) for own in self.generators
                ]
                self._pool = th.stack(numbers, 1)
            part, self._pool = self._pool[:count], self._pool[count:]
            parts.append(part)
            count -= len(part)
        return parts[0] if len(parts) == 1 else th.cat(parts)

    def state(self) -> dict[str, Any]:
        """Return everything needed to continue with the same numbers."""
        states = [generator.get_state() for generator in self.generators]
        return {"generators": states, "pool": self._pool}

    def load_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state` returned."""
        for generator, saved in zip(self.generators, state["generators"], strict=True):
            generator.set_state(saved)
        self._pool = state["pool"]
