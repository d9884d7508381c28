"""SeedBatch: S independent agents trained in lockstep, for little more than the price of one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.utils import update_learning_rate
from stable_baselines3.sac.policies import SACPolicy

from sb3_flowpolicy.algorithms.exploration import ColoredExploration
from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.checkpoint.session import RunCheckpoints
from sb3_flowpolicy.engine import LOSSES, EngineRuntime, settings_key
from sb3_flowpolicy.guard.finite import check_experience
from sb3_flowpolicy.guard.training_guard import TrainingGuard
from sb3_flowpolicy.policies import FlowActor
from sb3_flowpolicy.seeds.episodes import SeedEpisodes
from sb3_flowpolicy.seeds.on_disk import BatchOnDisk
from sb3_flowpolicy.seeds.setup import (
    CallbackFactory,
    EnvFactory,
    check_seeds,
    check_stackable,
    copy_callback,
    make_env,
    make_progress_bar,
    make_vec_env,
    refuse,
)
from sb3_flowpolicy.seeds.storage import SeedNoise, SeedStorage

# What agents must agree on, besides the constants of their updates.
_COMMON = (
    *("batch_size", "gamma", "learning_starts", "random_steps", "train_freq", "gradient_steps"),
    *("action_noise_color", "action_noise_correlation_time", "target_update_interval"),
)
# Schedules are functions, which cannot be compared: these are the shares of training left over at
# which they are.
_SCHEDULE_AT = (1.0, 0.5, 0.0)


class SeedBatch(BatchOnDisk):
    """Train S independent :class:`SACFlow` agents in one process, by stacking their networks.

    Each seed has its own environment, replay buffer, random numbers and logs; given the same
    minibatches and noise, one stacked update equals S single ones. Memory: S replay buffers
    (buffer_size x (2 obs + action + 3) x 4 bytes each), S sets of parameters with their
    optimisers' moments, and random numbers for 64 updates ahead (64 x batch_size x (8 M + 8)
    bytes per seed).

    Args:
        policy: As for :class:`SACFlow`.
        env: Registered id, or a function that makes an environment. Where the environment has a
            vectorised form of its own, that is used.
        seeds: The seeds, or their number, which stands for 0, 1, ...
        algorithm: Class of the agents.
        monitor_dir: Folder for one ``monitor.csv`` per seed, as SB3's ``Monitor`` writes them.
        info_keywords: Numbers to note of each episode, besides return and length, from the info
            of its last step; as SB3's ``Monitor`` has it.
        **kwargs: Arguments of the agents, the same for all.

    Raises:
        ValueError: If there are no seeds, or the agents' settings cannot be stacked: training
            per episode, other replay buffers than plain ones, whatever the engine cannot do.

    Example:
        >>> batch = SeedBatch("FlowPolicy", "Pendulum-v1", seeds=3, learning_starts=20)
        >>> [model.num_timesteps for model in batch.learn(25).models]
        [25, 25, 25]
    """

    def __init__(
        self,
        policy: str | type[SACPolicy],
        env: str | EnvFactory,
        seeds: int | Iterable[int],
        algorithm: type[SACFlow] = SACFlow,
        monitor_dir: str | Path | None = None,
        info_keywords: Sequence[str] = (),
        **kwargs: Any,
    ) -> None:
        self.seeds = check_seeds(seeds)
        models = [algorithm(policy, make_env(env), seed=seed, **kwargs) for seed in self.seeds]
        self._adopt(models, self.seeds, env, monitor_dir, info_keywords)

    def _adopt(
        self,
        models: list[SACFlow],
        seeds: list[int],
        env: str | EnvFactory,
        monitor_dir: str | Path | None,
        info_keywords: Sequence[str],
    ) -> None:
        self.env, self.seeds, self._models = env, seeds, models
        first = models[0]
        check_stackable(first)
        self._storage = SeedStorage(self._buffers())
        self._runtime = EngineRuntime(models, refuse)
        self._checkpoints = RunCheckpoints(self._describe_run)
        self._exploration = ColoredExploration()
        self._episodes = SeedEpisodes(
            self._models, self.seeds, self._before_dump, monitor_dir, info_keywords
        )
        self._guard = TrainingGuard(models, seeds)
        self._losses: list[list[float]] | None = None
        self._venv = make_vec_env(env, len(seeds))
        self._obs: np.ndarray | None = None
        self._noise: dict[str, SeedNoise] = {}
        self._fit_noise()

    def _buffers(self) -> list[ReplayBuffer]:
        return [model.replay_buffer for model in self._models if model.replay_buffer is not None]

    def _fit_noise(self) -> None:
        """Make random numbers fit the agents' settings; those that do already go on."""
        first, before = self._models[0], self._noise
        assert isinstance(first.actor, FlowActor)
        noise_dim, shape = first.actor.density.noise_dim, first.action_space.shape or ()
        self._exploration.fit(first, len(self.seeds), self._venv)
        process = self._exploration.process
        white_shape = (1, noise_dim) if process is None else process.white_shape[1:]
        # Name -> shape, and whether it is uniform.
        wanted = {
            "random actions": (shape, True),
            "actions": (white_shape, False),
            "updates": ((2, first.batch_size, noise_dim), False),
            "rows": ((first.batch_size,), True),
        }
        self._noise = {
            name: before[name]
            if name in before and before[name].shape == needed
            else SeedNoise(self.seeds, needed, stream, uniform)
            for stream, (name, (needed, uniform)) in enumerate(wanted.items())
        }

    @property
    def models(self) -> list[SACFlow]:
        """The agents: ordinary models that save, load, predict and train on their own."""
        return self._models

    def learn(
        self,
        total_timesteps: int,
        callback: BaseCallback | list[BaseCallback] | CallbackFactory | None = None,
        log_interval: int | None = 4,
        tb_log_name: str = "SACFlow",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        checkpoint_every: int | None = None,
        checkpoint_path: str | Path | None = None,
    ) -> SeedBatch:
        """Train all agents; the arguments are those of :meth:`SACFlow.learn`.

        Args:
            total_timesteps: Environment steps per agent.
            callback: Callback, copied for each agent, or a function from a seed to a callback,
                for those that write files: ``lambda seed: EvalCallback(env,
                best_model_save_path=f"seed_{seed}")``. Training stops when any of them says so.
            log_interval: Episodes between two dumps of an agent's log.
            tb_log_name: Name of the TensorBoard runs, which get ``_seed<seed>`` appended.
            reset_num_timesteps: Whether to count from zero, or to go on.
            progress_bar: Whether to show one.
            checkpoint_every: Environment steps per agent between two checkpoints that
                :meth:`resume` goes on from.
            checkpoint_path: Folder for them, empty for a new run.

        Returns:
            Itself.

        Raises:
            NonFiniteError: If an environment hands out, or training arrives at, NaN or infinity;
                see :class:`~sb3_flowpolicy.guard.training_guard.TrainingGuard`.
        """
        with (
            self._checkpoints.learning(checkpoint_path, checkpoint_every),
            self._runtime.running(watched=callback is not None),
        ):
            callbacks = self._start(total_timesteps, callback, tb_log_name, reset_num_timesteps)
            self._learn(callbacks, log_interval, reset_num_timesteps, progress_bar)
        return self

    def _learn(
        self,
        callbacks: list[BaseCallback],
        log_interval: int | None,
        reset_num_timesteps: bool,
        progress_bar: bool,
    ) -> None:
        first = self._models[0]
        if not self._resumes_episodes() and (self._obs is None or reset_num_timesteps):
            # Typed as one seed, documented as one per environment.
            # Who goes on after saving must not see the same episodes again.
            seeds = [seed + first.num_timesteps for seed in self.seeds]
            self._obs, _ = self._venv.reset(seed=seeds)  # type: ignore[arg-type]
            check_experience({"observations": self._obs}, first.num_timesteps, self._who)
            self._episodes.restart()
            self._exploration.restart()
        to_go = first._total_timesteps - first.num_timesteps
        bar = make_progress_bar(to_go) if progress_bar else None
        try:
            self._run(callbacks, log_interval, bar)
            self._guard.look()
        finally:
            # Whatever happened, the agents are ordinary models again.
            if bar is not None:
                bar.close()
            self._storage.publish()
        for one in callbacks:
            one.on_training_end()

    def _run(self, callbacks: list[BaseCallback], log_interval: int | None, bar: Any) -> None:
        """Alternate between collecting and updating, as SB3 does."""
        first = self._models[0]
        assert isinstance(first.train_freq, TrainFreq)
        frequency, total = first.train_freq.frequency, first._total_timesteps
        # One callback per agent, or none at all.
        named = dict(zip(self._describe_run().agents, callbacks, strict=False))
        going = True
        while going and first.num_timesteps < total:
            if not self._checkpoints.between_rollouts(named):
                break
            for one in callbacks:
                one.on_rollout_start()
            collected = 0
            while going and collected < frequency:
                going = self._step(callbacks, log_interval)
                collected += 1
            for one in callbacks:
                one.on_rollout_end()
            if bar is not None:
                bar.update(collected)
            if going and first.num_timesteps > first.learning_starts and first.gradient_steps:
                self._train()

    def _start(
        self,
        total_timesteps: int,
        callback: BaseCallback | list[BaseCallback] | CallbackFactory | None,
        tb_log_name: str,
        reset_num_timesteps: bool,
    ) -> list[BaseCallback]:
        """Do what SB3's ``learn`` does first, for every agent."""
        callbacks = []
        for seed, model in zip(self.seeds, self._models, strict=True):
            own = copy_callback(callback, seed)
            name = f"{tb_log_name}_seed{seed}"
            total, reset = self._checkpoints.remaining(total_timesteps, reset_num_timesteps)
            # SB3 draws the first observation from the model's own environment; ours are stepped.
            _, ready = model._setup_learn(total, own, reset, name)
            if model._checkpoints.active:
                model._checkpoints.stop()
                raise ValueError(
                    "a batch is checkpointed by learn(checkpoint_every=..., checkpoint_path=...), "
                    "got a callback that does so for each agent"
                )
            ready.on_training_start({"self": model}, {})
            callbacks += [ready] if own is not None else []
        self._take_over()
        return callbacks

    def _take_over(self) -> None:
        """Make engine, storage and noise fit what was done to the agents since the last run."""
        first, models = self._models[0], self._models
        check_stackable(first)
        if any(_shared_settings(model) != _shared_settings(first) for model in models[1:]):
            raise ValueError("agents must all have the same settings, got different ones")
        # A resumed call of learn() was counted when it began.
        if not self._checkpoints.resuming:
            self._runtime.planned = first._runtime.planned
        self._guard.restart(self._checkpoints.path)
        buffers = self._buffers()
        # An agent that was trained on its own has its buffer's arrays to itself since then.
        if not self._storage.rows.holds(buffers):
            self._storage = SeedStorage(buffers)
        self._storage.synchronize()
        self._fit_noise()

    def _step(self, callbacks: list[BaseCallback], log_interval: int | None) -> bool:
        """Step all environments once; return whether to go on."""
        assert self._obs is not None
        first = self._models[0]
        scaled = self._act(self._obs)
        actions = first.policy.unscale_action(scaled)
        obs, rewards, terminated, truncated, infos = self._venv.step(actions)
        dones = terminated | truncated
        next_obs = obs
        if dones.any():
            # The environment has been reset already; what it ended with is in the info.
            next_obs = obs.copy()
            for seed in np.flatnonzero(dones).tolist():
                next_obs[seed] = infos["final_obs"][seed]
            check_experience({"final observations": next_obs}, first.num_timesteps + 1, self._who)
        columns = {"observations": obs, "rewards": rewards}
        check_experience(columns, first.num_timesteps + 1, self._who)
        self._storage.add(
            observations=self._obs,
            next_observations=next_obs,
            actions=scaled.reshape(len(scaled), -1),
            rewards=rewards,
            dones=dones,
            timeouts=truncated & ~terminated,
        )
        self._obs = obs
        self._exploration.restart(dones)
        for model in self._models:
            model.num_timesteps += 1
            model._current_progress_remaining = 1 - model.num_timesteps / model._total_timesteps
        going = True
        if callbacks:
            self._storage.publish()
            for seed, one in enumerate(callbacks):
                one.update_locals(
                    {"rewards": rewards[[seed]], "dones": dones[[seed]], "infos": [{}]}
                )
                going = one.on_step() and going
        self._episodes.step(rewards, dones, infos, log_interval)
        return going

    def _who(self, index: int) -> str:
        return f"seed {self.seeds[index]}"

    def _act(self, obs: np.ndarray) -> np.ndarray:
        """Return scaled actions, (S, *shape)."""
        first = self._models[0]
        random_steps = first.learning_starts if first.random_steps is None else first.random_steps
        if first.num_timesteps < random_steps:
            return (self._noise["random actions"].draw() * 2 - 1).float().numpy()
        noise = self._noise["actions"].draw()
        if self._exploration.process is not None:
            noise = self._exploration.process.step(noise).unsqueeze(1)
        engine = self._runtime.engine()
        assert engine is not None
        actions = engine.act(th.from_numpy(obs).unsqueeze(1), noise)
        return actions.squeeze(1).numpy().reshape(len(obs), *(first.action_space.shape or ()))

    def _train(self) -> None:
        """Update all agents ``gradient_steps`` times."""
        engine = self._runtime.engine()
        assert engine is not None
        first = self._models[0]
        rate = first.lr_schedule(first._current_progress_remaining)
        if rate != first.actor.optimizer.param_groups[0]["lr"]:
            for model in self._models:
                for optimizer in model.optimizers().values():
                    update_learning_rate(optimizer, rate)
        self._guard.before_updates()
        rows = self._noise["rows"].draw_many(first.gradient_steps)
        noise = self._noise["updates"].draw_many(first.gradient_steps).transpose(1, 2)
        batches = self._storage.gather(rows, first.gamma, noise)
        self._losses = engine.train(batches).tolist()
        for model in self._models:
            model._n_updates += first.gradient_steps
        self._guard.after_updates(LOSSES, self._losses, engine.history, batches)

    def _before_dump(self, seed: int) -> None:
        """Record what SB3 records at each update only now that somebody reads it."""
        model = self._models[seed]
        if self._losses is not None:
            rate = model.actor.optimizer.param_groups[0]["lr"]
            model.logger.record("train/learning_rate", rate)
            model.record_losses(self._losses, seed)


def _shared_settings(model: SACFlow) -> tuple[object, ...]:
    return (
        settings_key(model, model.critic_loss_coef),
        *(getattr(model, name) for name in _COMMON),
        *(model.lr_schedule(left) for left in _SCHEDULE_AT),
    )
