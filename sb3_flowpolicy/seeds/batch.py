"""SeedBatch: S independent agents trained in lockstep, for little more than the cost of one."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.utils import update_learning_rate

from sb3_flowpolicy.algorithms.engine_flow import EngineFlow, in_parts
from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.checkpoint.rows import Ring
from sb3_flowpolicy.checkpoint.session import RunCheckpoints, load_agent, open_checkpoint
from sb3_flowpolicy.checkpoint.state import Run
from sb3_flowpolicy.common.validation import number
from sb3_flowpolicy.common.vec_env import info_of
from sb3_flowpolicy.engine import LOSSES, Engine, EngineRuntime
from sb3_flowpolicy.engine.groups import seeds_at_once
from sb3_flowpolicy.guard.training_guard import TrainingGuard
from sb3_flowpolicy.seeds.experience import SeedExperience
from sb3_flowpolicy.seeds.setup import EnvFactory, check_seeds, check_stackable, make_env, refuse

if TYPE_CHECKING:
    from typing_extensions import Self

CallbackFactory = Callable[[int], BaseCallback]

# What agents must agree on, besides the constants of their updates.
_COMMON = (
    *("batch_size", "gamma", "learning_starts", "random_steps", "train_freq", "gradient_steps"),
    *("action_noise_color", "action_noise_correlation_time", "target_update_interval"),
    *("use_sde", "sde_sample_freq", "use_sde_at_warmup"),
)
# Schedules are functions, which cannot be compared; their values at these shares of training can.
_SCHEDULE_AT = (1.0, 0.5, 0.0)


class SeedBatch:
    """Train S independent agents in one process, by stacking their networks.

    Each seed has its own environment, replay buffer, random numbers and logs; given the same
    minibatches and noise, one stacked update equals S single ones. Memory: S replay buffers
    (buffer_size x (2 obs + action + 3) x 4 bytes each), S sets of parameters with their
    optimizers' moments, and random numbers for 64 updates ahead (64 x batch_size x (8 M + 8)
    bytes per seed, with gSDE 512 x (M + batch_size)).

    Args:
        policy: As for :class:`SACFlow`.
        env: Registered id, or a function that makes an environment. The environment's own
            vectorized form is used if it has one.
        seeds: The seeds, or their number, which stands for 0, 1, ...
        algorithm: Class of the agents, :class:`SACFlow`, :class:`TQCFlow`, or
            :class:`CrossQFlow`.
        monitor_dir: Folder for one ``monitor.csv`` per seed, as SB3's ``Monitor`` writes them.
        info_keywords: Numbers to record for each episode, besides return and length, from the info
            of its last step, as in SB3's ``Monitor``.
        **kwargs: Arguments of the agents, the same for all; ``device`` is ``"cpu"``.

    Raises:
        ValueError: If there are no seeds, or the agents' settings cannot be stacked: training
            per episode, replay buffers other than plain ones, anything the engine does not support.

    Example:
        >>> batch = SeedBatch("FlowPolicy", "Pendulum-v1", seeds=3, learning_starts=20)
        >>> [model.num_timesteps for model in batch.learn(25).models]
        [25, 25, 25]
    """

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: str | EnvFactory,
        seeds: int | Iterable[int],
        algorithm: type[EngineFlow] = SACFlow,
        monitor_dir: str | Path | None = None,
        info_keywords: Sequence[str] = (),
        **kwargs: Any,
    ) -> None:
        kwargs.setdefault("device", "cpu")
        agents = {
            f"seed_{seed}": algorithm(policy, make_env(env), seed=seed, **kwargs)
            for seed in check_seeds(seeds)
        }
        self._set_up(agents, env, monitor_dir, info_keywords)

    def _set_up(
        self,
        agents: dict[str, EngineFlow],
        env: str | EnvFactory,
        monitor_dir: str | Path | None,
        info_keywords: Sequence[str],
    ) -> None:
        self.seeds = [int(name.removeprefix("seed_")) for name in agents]
        #: The agents: ordinary models that save, load, predict and train on their own.
        self.models = list(agents.values())
        self._agents = agents
        check_stackable(self.models[0])
        self._runtime = EngineRuntime(self.models, Engine, refuse)
        self._checkpoints = RunCheckpoints(self._describe_run)
        self._losses: list[list[float]] | None = None
        self._experience = SeedExperience(self.models, self.seeds, env, monitor_dir, info_keywords)
        self._guard = TrainingGuard(self.models, self.seeds)

    @classmethod
    def resume(
        cls,
        path: str | Path,
        env: str | EnvFactory,
        algorithm: type[EngineFlow] = SACFlow,
        monitor_dir: str | Path | None = None,
        info_keywords: Sequence[str] = (),
    ) -> Self:
        """Resume a batch from its newest undamaged checkpoint, as :meth:`SACFlow.resume` does.

        Args:
            path: Folder of checkpoints that :meth:`learn` wrote.
            env: As at construction, as are the following.
            algorithm: Class of the agents.
            monitor_dir: Folder of the monitor files.
            info_keywords: Numbers to record for each episode.

        Returns:
            The batch; :meth:`learn`, called as before, continues to the same end.

        Raises:
            ValueError: If the folder holds no undamaged checkpoint of a batch, or the environment
                does not fit.
        """
        checkpoint = open_checkpoint(path, cls.__name__)
        agents = {
            name: load_agent(algorithm, checkpoint, name, algorithm._wrap_env(make_env(env)), "cpu")
            for name in checkpoint.manifest["agents"]
        }
        batch = cls.__new__(cls)
        batch._set_up(agents, env, monitor_dir, info_keywords)
        batch._checkpoints.load(checkpoint)
        return batch

    def learn(
        self,
        total_timesteps: int,
        callback: BaseCallback | list[BaseCallback] | CallbackFactory | None = None,
        log_interval: int | None = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        checkpoint_every: int | None = None,
        checkpoint_path: str | Path | None = None,
    ) -> Self:
        """Train all agents; the arguments are those of :meth:`SACFlow.learn`.

        Args:
            total_timesteps: Environment steps per agent.
            callback: Callback, copied for each agent, or a function from a seed to a callback,
                for those that write files: ``lambda seed: EvalCallback(env,
                best_model_save_path=f"seed_{seed}")``. Training stops when one returns False.
            log_interval: Episodes between two dumps of an agent's log.
            tb_log_name: Name of the TensorBoard runs; ``_seed<seed>`` is appended. Default: that
                of the algorithm.
            reset_num_timesteps: Whether to count from zero, or to continue.
            progress_bar: Whether to show one.
            checkpoint_every: Environment steps per agent between two checkpoints for
                :meth:`resume`.
            checkpoint_path: Folder for them, empty for a new run.

        Returns:
            Itself.

        Raises:
            ValueError: If ``total_timesteps`` is not a number of at least 0.
            NonFiniteError: If an environment returns, or training produces, NaN or infinity; see
                :class:`~sb3_flowpolicy.guard.training_guard.TrainingGuard`.
        """
        number(0)("total_timesteps", total_timesteps)
        with (
            self._checkpoints.learning(checkpoint_path, checkpoint_every),
            self._runtime.running(watched=callback is not None),
        ):
            callbacks = self._start(
                total_timesteps, callback, tb_log_name, reset_num_timesteps, progress_bar
            )
            self._fit()
            new = self._experience.obs is None or reset_num_timesteps
            if new and not self._resumes_episodes():
                self._experience.reset()
            self._run(callbacks, log_interval)
            self._guard.look()
            for one in callbacks.values():
                one.on_training_end()
        return self

    def _start(
        self,
        total_timesteps: int,
        callback: BaseCallback | list[BaseCallback] | CallbackFactory | None,
        tb_log_name: str | None,
        reset_num_timesteps: bool,
        progress_bar: bool,
    ) -> dict[str, BaseCallback]:
        """Do what SB3's ``learn`` does first, for every agent; return the callbacks to call."""
        callbacks = {}
        for seed, (name, model) in zip(self.seeds, self._agents.items(), strict=True):
            own = callback(seed) if callable(callback) else copy.deepcopy(callback)
            total, reset = self._checkpoints.remaining(total_timesteps, reset_num_timesteps)
            run = tb_log_name or model.stock.__name__
            bar = progress_bar and seed == self.seeds[0]
            end, ready = model._setup_learn(total, own, reset, f"{run}_seed{seed}", bar)
            if model._checkpoints.active:
                model._checkpoints.stop()
                raise ValueError(
                    "a batch is checkpointed by learn(checkpoint_every=..., checkpoint_path=...), "
                    "got a callback that does so for each agent"
                )
            ready.on_training_start({"self": model, "total_timesteps": end}, {})
            if own is not None or bar:
                callbacks[name] = ready
        return callbacks

    def _fit(self) -> None:
        """Adapt to changes of the agents since the last run."""
        first = self.models[0]
        check_stackable(first)
        if any(_shared_settings(model) != _shared_settings(first) for model in self.models):
            raise ValueError("agents must all have the same settings, got different ones")
        planned = first._planned_updates(first._total_timesteps)
        # Agents with large networks are updated in groups, by as many calls.
        count = len(self.models)
        n_groups = count // seeds_at_once(first.critic, count, first.batch_size)
        self._runtime.plan(first._n_updates * n_groups, planned * n_groups)
        self._guard.restart(self._checkpoints.path)
        self._experience.fit()

    def _run(self, callbacks: dict[str, BaseCallback], log_interval: int | None) -> None:
        """Alternate between collecting and updating, as SB3 does."""
        first = self.models[0]
        assert isinstance(first.train_freq, TrainFreq)
        going = True
        while going and first.num_timesteps < first._total_timesteps:
            if not self._checkpoints.between_rollouts(callbacks):
                break
            for one in callbacks.values():
                one.on_rollout_start()
            n_steps = first.train_freq.frequency
            keep = first.sde_sample_freq if first.sde_sample_freq > 0 else n_steps
            for step in range(n_steps):
                if first.use_sde and step % keep == 0:
                    self._experience.draw_matrices()
                going = going and self._step(callbacks, log_interval)
            for one in callbacks.values():
                one.on_rollout_end()
            if going and first.num_timesteps > first.learning_starts and first.gradient_steps:
                self._train()

    def _step(self, callbacks: dict[str, BaseCallback], log_interval: int | None) -> bool:
        """Step all environments once; return whether to continue."""
        rewards, dones, infos, ended = self._experience.step(self._runtime)
        for model in self.models:
            model.num_timesteps += 1
            model._current_progress_remaining = 1 - model.num_timesteps / model._total_timesteps
        going = True
        for k, name in enumerate(self._agents):
            if name in callbacks:
                info = ended.get(k) or info_of(infos, k)
                one = callbacks[name]
                one.update_locals({"rewards": rewards[[k]], "dones": dones[[k]], "infos": [info]})
                going = one.on_step() and going
        self._experience.record(ended)
        for k in ended:
            if log_interval is not None and self.models[k]._episode_num % log_interval == 0:
                self._dump_log(k)
        return going

    def _train(self) -> None:
        """Update all agents ``gradient_steps`` times."""
        engine = self._runtime.engine()
        assert engine is not None
        first = self.models[0]
        rate = first.lr_schedule(first._current_progress_remaining)
        if rate != first.actor.optimizer.param_groups[0]["lr"]:
            for model in self.models:
                for optimizer in model.optimizers().values():
                    update_learning_rate(optimizer, rate)
        for start, n_updates in in_parts(first.gradient_steps):
            self._guard.before_updates()
            batches = self._experience.minibatches(n_updates)
            self._losses = engine.train(batches, start).tolist()
            for model in self.models:
                model._n_updates += n_updates
            self._guard.after_updates(LOSSES, self._losses, engine.history, batches)

    def _dump_log(self, index: int) -> None:
        """Write an agent's log, after recording what SB3 records at each update."""
        model = self.models[index]
        if self._losses is not None:
            engine = self._runtime.engine()
            assert engine is not None
            rate = model.actor.optimizer.param_groups[0]["lr"]
            model.logger.record("train/learning_rate", rate)
            model.record_losses(self._losses, index, engine.logged)
        model.dump_logs()

    def _describe_run(self) -> Run:
        """Describe what a checkpoint of this batch consists of."""
        own = {name: model.env for name, model in self._agents.items()}
        return Run(
            kind=type(self).__name__,
            agents=self._agents,
            environments={"batch": self._experience.venv, **own},
            ring=self._ring,
            extra=self._extra_state,
            set_extra=self._load_extra_state,
        )

    def _ring(self) -> Ring:
        rows, buffer = self._experience.rows, self._experience.rows.buffers[0]
        return Ring(rows.columns, buffer.pos, buffer.full, rows)

    def _extra_state(self) -> dict[str, Any]:
        self._guard.look()  # before a checkpoint is written, not after
        return {
            **self._experience.state(),
            "losses": self._losses,
            "engine": self._runtime.state(),
        }

    def _load_extra_state(self, state: dict[str, Any]) -> None:
        self._losses = state["losses"]
        self._runtime.load_state(state["engine"])
        self._experience.load_state(state)
        if self._resumes_episodes():
            self._experience.obs = state["obs"]
        else:
            self._experience.restart_episodes()

    def _resumes_episodes(self) -> bool:
        """Whether the next step continues the episodes that a checkpoint interrupted."""
        return self._checkpoints.resuming and "batch" not in self._checkpoints.opaque


def _shared_settings(model: EngineFlow) -> tuple[object, ...]:
    return (
        Engine.settings_of(model),
        *(getattr(model, name, None) for name in _COMMON),
        *(model.lr_schedule(left) for left in _SCHEDULE_AT),
    )
