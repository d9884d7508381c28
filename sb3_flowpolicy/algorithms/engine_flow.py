"""What SACFlow, TQCFlow and CrossQFlow share."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import torch as th
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import (
    GymEnv,
    MaybeCallback,
    RolloutReturn,
    TrainFreq,
    TrainFrequencyUnit,
)
from stable_baselines3.common.vec_env import VecEnv
from torch.utils._pytree import tree_map_only

from sb3_flowpolicy.algorithms import exploration
from sb3_flowpolicy.algorithms.exploration import ColoredExploration, episode_length
from sb3_flowpolicy.checkpoint.rows import Ring
from sb3_flowpolicy.checkpoint.session import RunCheckpoints, load_agent, open_checkpoint
from sb3_flowpolicy.checkpoint.state import Run
from sb3_flowpolicy.common.validation import (
    Check,
    by_name,
    check_policy,
    check_settings,
    either,
    entropy_coefficient,
    flag,
    integer,
    number,
    optional,
    train_frequency,
)
from sb3_flowpolicy.engine import LOSSES, Engine, EngineRuntime
from sb3_flowpolicy.engine.replay import COLUMNS, is_plain
from sb3_flowpolicy.engine.update import Objective
from sb3_flowpolicy.guard import NonFiniteError, TrainingGuard
from sb3_flowpolicy.guard.finite import (
    check_experience,
    check_finite,
    check_observation,
    check_step,
)
from sb3_flowpolicy.policies import FlowActor
from sb3_flowpolicy.policies.off_policy import DistributionPolicy

if TYPE_CHECKING:
    from typing_extensions import Self

# Minibatches are drawn for many updates at once, but not for all of an offline run.
MOST_DRAWN_AT_ONCE = 1000

# The critics come first: losses of the stock loop are means over several updates, which do not tell
# which loss was the first to fail.
_STOCK_LOSSES = ("critic_loss", "ent_coef", "ent_coef_loss", "actor_loss")


class EngineFlow(OffPolicyAlgorithm):
    """Mixin for SB3's off-policy algorithms, to be named before them.

    An algorithm has a :class:`~sb3_flowpolicy.guard.TrainingGuard`, which rejects what is not
    finite; :class:`~sb3_flowpolicy.checkpoint.RunCheckpoints` to resume from; a
    :class:`~sb3_flowpolicy.algorithms.exploration.ColoredExploration`; and an
    :class:`~sb3_flowpolicy.engine.EngineRuntime`, which binds it to the compiled engine while it
    learns. This class passes them what happens in SB3's training loop.

    Its arguments are those of the algorithm, and ``compile``, ``autocast``, ``action_noise_color``
    and ``action_noise_correlation_time`` of :class:`~sb3_flowpolicy.SACFlow`.
    """

    actor: Any
    critic: Any
    ent_coef_optimizer: th.optim.Adam | None
    stock: ClassVar[type[OffPolicyAlgorithm]]
    """The algorithm of SB3 or sb3-contrib that this one extends."""
    settings: ClassVar[Mapping[str, Check]] = {
        "buffer_size": integer(1),
        "learning_starts": number(0),
        "batch_size": integer(1),
        "tau": number(0, 1),
        "gamma": number(0, 1),
        "train_freq": train_frequency,
        "gradient_steps": integer(-1),
        "optimize_memory_usage": flag,
        "n_steps": integer(1),
        "ent_coef": entropy_coefficient,
        "target_update_interval": integer(1),
        "target_entropy": either("auto", number()),
        "use_sde": flag,
        "sde_sample_freq": integer(-1),
        "use_sde_at_warmup": flag,
        "stats_window_size": integer(1),
        "seed": optional(integer(0, 2**32 - 1)),
        "compile": either("auto", flag),
        "autocast": flag,
        **exploration.SETTINGS,
    }
    """Arguments of the constructor that are plain values, with their checks."""
    random_steps: int | None = None
    """Environment steps with random actions at the start; None stands for ``learning_starts``."""

    def __init__(
        self,
        *args: Any,
        compile: bool | Literal["auto"] = "auto",
        autocast: bool = False,
        action_noise_color: float = 0.0,
        action_noise_correlation_time: float | None = None,
        **kwargs: Any,
    ) -> None:
        given = by_name(self.stock, args, kwargs)
        check_settings({**given, "compile": compile, "autocast": autocast}, self.settings)
        stock_policy = self.stock.policy_aliases["MlpPolicy"]
        check_policy(given.get("policy"), stock_policy, self.policy_aliases)
        self.compile: bool | Literal["auto"] = compile
        self.autocast = autocast
        self.action_noise_color = action_noise_color
        self.action_noise_correlation_time = action_noise_correlation_time
        self._runtime = EngineRuntime([self], Engine, warn_of_stock_loop)
        self._exploration = ColoredExploration()
        self._guard = TrainingGuard([self])
        self._checkpoints = RunCheckpoints(self._describe_run)
        super().__init__(*args, **kwargs)

    def objective(self) -> Objective | None:
        """Return how the algorithm uses its critics' outputs, by its present settings.

        None if the engine does not support the algorithm's updates.
        """
        return None

    @classmethod
    def resume(cls, path: str | Path, env: GymEnv | str, device: th.device | str = "auto") -> Self:
        """Resume a run from its newest undamaged checkpoint.

        Repeat the interrupted call of :meth:`learn` with the same arguments: it continues to the
        same end, and all numbers are those of a run that was not interrupted. Checkpoints contain
        pickles: resume only those that you trust.

        Args:
            path: Folder of checkpoints.
            env: A new environment, built and wrapped as the run's own, or its id. It takes over the
                state of that one, the running episode included, and its ``Monitor`` file.
            device: Where to put the networks.

        Raises:
            ValueError: If the folder holds no undamaged checkpoint, or one of another algorithm, or
                the environment does not fit.
        """
        checkpoint = open_checkpoint(path, cls.__name__)
        venv = cls._wrap_env(maybe_make_env(env, 0))
        model = load_agent(cls, checkpoint, "model", venv, device)
        model._checkpoints.load(checkpoint)
        return model

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        checkpoint_every: int | None = None,
        checkpoint_path: str | Path | None = None,
    ) -> Self:
        """Train as in SB3, and optionally write checkpoints to resume from.

        Args:
            total_timesteps: Environment steps, in sum over environments.
            callback: Callback, list of callbacks, or function, as for SB3.
            log_interval: Episodes between two dumps of the log.
            tb_log_name: Name of the TensorBoard run. Default: the stock algorithm's name.
            reset_num_timesteps: Whether to count from zero, or to continue.
            progress_bar: Whether to show one.
            checkpoint_every: Environment steps between two checkpoints for :meth:`resume`. Ctrl-C
                and SIGTERM then write one, too, before they stop the program. Default: none.
            checkpoint_path: Folder for them, empty for a new run.

        Raises:
            ValueError: If only one of the last two is given, or the folder holds checkpoints of
                another run.
            NonFiniteError: If the environment returns, or training produces, NaN or infinity.
        """
        number(0)("total_timesteps", total_timesteps)
        with (
            self._runtime.running(watched=callback is not None),
            self._checkpoints.learning(checkpoint_path, checkpoint_every),
        ):
            super().learn(
                total_timesteps,
                callback,
                log_interval,
                tb_log_name or self.stock.__name__,
                reset_num_timesteps,
                progress_bar,
            )
            self._guard.look()
        return self

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Choose actions, as in SB3.

        While the model learns with a compiled policy, callbacks such as ``EvalCallback`` act with
        it, too, if they evaluate as many environments at once as the model learns from.
        """
        mode = getattr(self.policy, "deterministic_mode", "base") if deterministic else "base"
        is_array = isinstance(observation, np.ndarray | dict)
        if mode == "base" and is_array and self._runtime.is_running:
            engine = self._runtime.acting_engine()
            if engine is not None and engine.compiled:
                obs, is_batch = self.policy.obs_to_tensor(observation)
                check_observation(observation)
                scaled = engine.act_if_compiled(obs, deterministic)
                if scaled is not None:
                    check_finite(scaled)
                    scaled = scaled.reshape(-1, *(self.action_space.shape or ()))
                    actions = self.policy.unscale_action(scaled)
                    return (actions if is_batch else actions.squeeze(axis=0)), state
        return super().predict(observation, state, episode_start, deterministic)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """Do ``gradient_steps`` updates with minibatches of ``batch_size`` transitions.

        The numbers are those of the stock algorithm's ``train``. Models that the engine does not
        support (image observations, optimizers other than Adam, ...) use the stock loop.

        Raises:
            NonFiniteError: If a loss is not finite; weights are then as they were when the guard
                last checked them.
        """
        if gradient_steps == 0:  # SB3 would log NaN, the mean of an empty list
            return
        with self._runtime.running():
            engine = self._runtime.engine()
            if engine is None:
                self._train_with_sb3(gradient_steps, batch_size)
                return
            self._update_learning_rate(list(self.optimizers().values()))
            for start, n_updates in in_parts(gradient_steps):
                self._guard.before_updates()
                batches = engine.draw(n_updates, batch_size)
                losses = engine.train(batches, start).tolist()
                self._n_updates += n_updates
                self._guard.after_updates(LOSSES, losses, engine.history, batches)
                self.record_losses(losses, names=engine.logged)

    def _train_with_sb3(self, gradient_steps: int, batch_size: int) -> None:
        """Run the stock algorithm's loop."""
        self._guard.before_updates()
        super().train(gradient_steps, batch_size)
        logged = self.logger.name_to_value
        losses = {f"train/{name}": logged.get(f"train/{name}", 0.0) for name in _STOCK_LOSSES}
        try:
            self._guard.after_updates(_STOCK_LOSSES, [[loss] for loss in losses.values()])
        except NonFiniteError:
            for name in losses:  # or the next updates would be blamed for them
                logged.pop(name, None)
            raise

    def record_losses(
        self,
        losses: Sequence[Sequence[float]],
        seed: int = 0,
        names: Sequence[str] = LOSSES,
    ) -> None:
        """Record what SB3's ``train`` records: the engine's losses, (4, S), of one seed."""
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for key, values in zip(LOSSES, losses, strict=True):
            if key in names and (key != "ent_coef_loss" or self.ent_coef_optimizer is not None):
                self.logger.record(f"train/{key}", values[seed])

    def optimizers(self) -> dict[str, th.optim.Optimizer]:
        """Return the optimizers by name; the entropy coefficient has one only if it is learned."""
        found = {"actor": self.actor.optimizer, "critic": self.critic.optimizer}
        if self.ent_coef_optimizer is not None:
            found["ent_coef"] = self.ent_coef_optimizer
        return found

    def _setup_model(self) -> None:
        super()._setup_model()
        self._exploration.fit(self, self.n_envs, self.env)  # validates

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        *args: Any,
        **kwargs: Any,
    ) -> tuple[int, BaseCallback]:
        total, reset = self._checkpoints.remaining(total_timesteps, reset_num_timesteps)
        before = self._last_obs
        total_timesteps, callback = super()._setup_learn(total, callback, reset, *args, **kwargs)
        self._exploration.fit(self, self.n_envs, self.env)
        if self._last_obs is not before:  # environments were reset
            self._exploration.restart()
        self._guard.restart(self._checkpoints.path)
        normalized = self._vec_normalize_env is not None
        first = self._last_original_obs if normalized else self._last_obs
        check_experience({"observations": first}, self.num_timesteps)
        self._runtime.plan(self._n_updates, self._planned_updates(total_timesteps))
        return total_timesteps, callback

    def _planned_updates(self, total_timesteps: int) -> float:
        """Count the updates still to come.

        Where episodes decide, it counts those of full length: none if they have no time limit.
        """
        steps = max(0, total_timesteps - max(self.num_timesteps, self.learning_starts))
        if self.gradient_steps < 0:
            return steps
        assert isinstance(self.train_freq, TrainFreq)
        between: float = self.train_freq.frequency
        if self.train_freq.unit is TrainFrequencyUnit.EPISODE:
            between *= episode_length(self.env) or math.inf
        return steps / self.env.num_envs * self.gradient_steps / between

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, *args: Any, **kwargs: Any
    ) -> RolloutReturn:
        """Collect experience as SB3 does, after writing a checkpoint if one is due."""
        if not self._checkpoints.between_rollouts({"model": callback}):
            return RolloutReturn(0, 0, continue_training=False)
        return super().collect_rollouts(env, callback, *args, **kwargs)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        random_steps = learning_starts if self.random_steps is None else self.random_steps
        engine = noise = None
        if self.num_timesteps >= random_steps:
            engine = self._runtime.acting_engine() if self._runtime.is_running else None
            noise = self._exploration.next()
        if engine is not None and engine.compiled and not engine.networks.uses_gsde:
            obs = engine.networks.observations.pack(self._last_obs, self.device)
            if noise is not None:
                noise = noise.to(engine.networks.actor.data).unsqueeze(0)
            scaled = engine.act(obs.unsqueeze(0), noise).squeeze(0)
        elif noise is None:
            return super()._sample_action(random_steps, action_noise, n_envs)
        else:
            # As SB3 does, except that the noise is given.
            self.policy.set_training_mode(False)
            obs, _ = self.policy.obs_to_tensor(self._last_obs)  # type: ignore[arg-type]
            actor = self.policy.actor
            assert isinstance(actor, FlowActor)
            with th.no_grad():
                scaled = actor(obs, noise=noise.to(next(actor.parameters())))
        actions = scaled.cpu().numpy()
        check_finite(actions)
        actions = actions.reshape(n_envs, *(self.action_space.shape or ()))
        if action_noise is not None:
            actions = np.clip(actions + action_noise(), -1, 1)
        return self.policy.unscale_action(actions), actions

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        seen, earned = new_obs, reward
        if self._vec_normalize_env is not None:  # which would clip infinity
            seen, earned = self._vec_normalize_env.old_obs, self._vec_normalize_env.old_reward
        check_step(seen, earned, dones, infos, self.num_timesteps)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        self._exploration.restart(dones)

    def get_parameters(self) -> dict[str, dict]:
        """Return the parameters as SB3 does, as copies.

        The engine's views would bring the whole memory that they look at into a saved file.
        """
        return tree_map_only(th.Tensor, lambda one: one.detach().clone(), super().get_parameters())

    def save(self, path: Any, exclude: Any = None, include: Any = None) -> None:
        """Save as SB3 does, with a ``deterministic_mode`` that was set after construction."""
        if isinstance(self.policy, DistributionPolicy):
            self.policy_kwargs = self.policy.up_to_date(self.policy_kwargs)
        super().save(path, exclude, include)

    def _describe_run(self) -> Run:
        return Run(
            kind=type(self).__name__,
            agents={"model": self},
            environments={"model": self.env},
            ring=self._ring,
            extra=self._run_state,
            set_extra=self._load_run_state,
        )

    def _ring(self) -> Ring | None:
        buffer = self.replay_buffer
        if buffer is None or not is_plain(buffer):
            return None
        columns = {name: getattr(buffer, name) for name in COLUMNS}
        return Ring(columns, buffer.pos, buffer.full, buffer)

    def _run_state(self) -> dict[str, Any]:
        self._guard.look()  # a checkpoint is finite
        return {"exploration": self._exploration.state(), "engine": self._runtime.state()}

    def _load_run_state(self, state: dict[str, Any]) -> None:
        self._exploration.load_state(state["exploration"])
        self._runtime.load_state(state["engine"])

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_guard", "_checkpoints", "_runtime"]


def warn_of_stock_loop(reason: str) -> None:
    """Warn that the engine does not support a part of the model."""
    warnings.warn(
        f"training runs the stock loop, which is slower: the engine does not support {reason}",
        UserWarning,
        stacklevel=5,
    )


def in_parts(gradient_steps: int) -> Iterator[tuple[int, int]]:
    """Split updates into parts for which minibatches are drawn at once: start and number."""
    for start in range(0, gradient_steps, MOST_DRAWN_AT_ONCE):
        yield start, min(MOST_DRAWN_AT_ONCE, gradient_steps - start)
