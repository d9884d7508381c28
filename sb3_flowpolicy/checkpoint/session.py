"""Writing checkpoints while a run goes on, and taking one up again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import stable_baselines3
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_flowpolicy.checkpoint import segments, state
from sb3_flowpolicy.checkpoint.environments import check_same_build, layers
from sb3_flowpolicy.checkpoint.segments import RowFiles
from sb3_flowpolicy.checkpoint.signals import StopSignals
from sb3_flowpolicy.checkpoint.state import Run
from sb3_flowpolicy.checkpoint.store import Checkpoint, CheckpointStore

_STATE = "state.pt"


class Checkpoints:
    """Writes checkpoints of a run between its rollouts, where the next thing is a new step.

    Args:
        run: The run.
        path: Folder for its checkpoints.
        resumption: What the run was resumed from, if it was.

    Raises:
        ValueError: If the folder holds another run's checkpoints.
    """

    def __init__(self, run: Run, path: str | Path, resumption: Resumption | None = None) -> None:
        self.run = run
        self.path = Path(path)
        self.every = 1
        self.signals = StopSignals()
        self.active = False
        self._last: int | None = None
        if resumption is not None and resumption.store.path.resolve() == self.path.resolve():
            self._store, self._rows = resumption.store, resumption.rows
            self._last = run.first.num_timesteps
            return
        self._store, self._rows = CheckpointStore(path), RowFiles()
        if self._store.folders():
            raise ValueError(
                f"checkpoint_path must be an empty folder for a new run, got {path}, which holds "
                f"{self._store.folders()[-1].name}: resume that run, or choose another folder"
            )

    def start(self, checkpoint_every: int) -> None:
        """Begin; a new run's first checkpoint is due at once: if it fails, then not later.

        Args:
            checkpoint_every: Environment steps between two checkpoints, at least 1.
        """
        self.every = check_every(checkpoint_every)
        self.active = True
        self.signals.watch()

    def between_rollouts(self, callbacks: Mapping[str, BaseCallback]) -> bool:
        """Write a checkpoint if it is time.

        Args:
            callbacks: The callback of each agent's ``learn``.

        Returns:
            Whether to go on: False after SIGTERM and Ctrl-C.
        """
        self.run.callbacks = dict(callbacks)
        now, stop = self.run.first.num_timesteps, self.signals.received is not None
        if self._last is not None and now < self._last:
            raise ValueError(
                "reset_num_timesteps must be False for a second run in the same checkpoint_path, "
                f"got a count of {now} where {self.path} is at {self._last}"
            )
        if stop or self._last is None or now // self.every > self._last // self.every:
            self.write()
        return not stop

    def finish(self) -> None:
        """Write the last checkpoint of a call of ``learn`` that has reached its end.

        Where a callback stopped it, that was in the middle of a rollout: going on from there could
        not be exact.
        """
        first = self.run.first
        if self._last is not None and first.num_timesteps >= first._total_timesteps:
            self.write()

    def stop(self) -> None:
        """Write no more, and watch no signals any more."""
        self.active = False
        self.signals.release()
        self.run.callbacks = {}

    def write(self) -> None:
        """Write a checkpoint now, unless this step has one."""
        now = self.run.first.num_timesteps
        if now != self._last:
            self._store.write(now, _facts(self.run), self._write_files)
            self._last = now

    def _write_files(self, folder: Path, new_rows: Path) -> dict[str, Any]:
        run = self.run
        for name, agent in run.agents.items():
            agent.save(folder / f"{name}.zip")
        th.save(state.collect(run), folder / _STATE)
        found = run.ring()
        if found is None:
            for name, agent in run.agents.items():
                agent.save_replay_buffer(folder / f"{name}.buffer.pkl")
            return {}
        source, ring = found
        steps = run.first.num_timesteps // run.first.n_envs
        files = self._rows.update(source, ring, steps, new_rows)
        facts = {"pos": ring.pos, "full": ring.full, "capacity": ring.capacity}
        return {"segments": segments.to_json(files), **facts}


@dataclass
class Resumption:
    """A run that was resumed, until it learns again.

    Args:
        run: The run.
        store: Where its checkpoints are.
        rows: The files that hold its replay buffer.
        late: State to put back once learning has begun.
        begun: Environment steps at which the interrupted call of ``learn`` began.
    """

    run: Run
    store: CheckpointStore
    rows: RowFiles
    late: bytes
    begun: int

    def remaining(self, total_timesteps: int, reset_num_timesteps: bool) -> int:
        """Return how many steps the interrupted call of ``learn``, made again, has to go."""
        end = total_timesteps + (0 if reset_num_timesteps else self.begun)
        return end - self.run.first.num_timesteps

    def restore(self, callbacks: Mapping[str, BaseCallback]) -> None:
        """Put the rest of the state back: the next thing is a new step."""
        self.run.callbacks = dict(callbacks)
        state.restore_late(self.run, self.late)


class Resumes(Protocol):
    """Whatever learns and can be resumed: an algorithm, or a batch of them."""

    _checkpoints: Checkpoints | None
    _resumption: Resumption | None

    def _describe_run(self) -> Run: ...


def start_checkpoints(owner: Resumes, path: str | Path | None, every: int | None) -> None:
    """Write checkpoints from now on, until :func:`finishing` ends.

    Args:
        owner: What learns.
        path: Folder for them.
        every: Environment steps between two of them. With both None, nothing is done.

    Raises:
        ValueError: If ``every`` is below 1 or only one of the two is given, or the folder holds
            another run's checkpoints.
    """
    if path is None and every is None:
        return
    if path is None or every is None:
        raise ValueError(
            f"checkpoint_every and checkpoint_path go together, got {every} and {path}"
        )
    if owner._checkpoints is None or owner._checkpoints.path.resolve() != Path(path).resolve():
        check_every(every)
        if owner._checkpoints is not None and owner._checkpoints.active:
            raise ValueError(
                "checkpoint_path must be one folder for a call of learn(), got "
                f"{owner._checkpoints.path} and {path}"
            )
        owner._checkpoints = Checkpoints(owner._describe_run(), path, owner._resumption)
    else:
        owner._checkpoints.run = owner._describe_run()  # the environment may be another by now
    owner._checkpoints.start(every)


@contextmanager
def finishing(owner: Resumes) -> Iterator[None]:
    """End the checkpoints that are started inside with a last one, and obey SIGTERM and Ctrl-C."""
    try:
        yield
        if owner._resumption is not None:
            # This call had ended before, and its logs are to show it; the next was interrupted.
            owner._resumption.begun = owner._resumption.run.first._total_timesteps
            owner._resumption.restore({})
        if owner._checkpoints is not None and owner._checkpoints.active:
            owner._checkpoints.finish()
    finally:
        if owner._checkpoints is not None:
            owner._checkpoints.stop()
    if owner._checkpoints is not None:
        owner._checkpoints.signals.deliver()


def between_rollouts(owner: Resumes, callbacks: Mapping[str, BaseCallback]) -> bool:
    """Put back what waits for this moment, write what is due, and return whether to go on."""
    if owner._resumption is not None:
        owner._resumption.restore(callbacks)
        owner._resumption = None
    checkpoints = owner._checkpoints
    if checkpoints is None or not checkpoints.active:
        return True
    return checkpoints.between_rollouts(callbacks)


def open_checkpoint(path: str | Path, kind: str) -> tuple[CheckpointStore, Checkpoint]:
    """Find the newest undamaged checkpoint of a folder.

    Raises:
        ValueError: If there is none, or something else must resume it than ``kind``.
    """
    store = CheckpointStore(path)
    checkpoint = store.newest()
    found = checkpoint.manifest["kind"]
    if found != kind:
        raise ValueError(f"path must hold checkpoints of {kind}, got {path}, of {found}")
    return store, checkpoint


def load_agent(
    algorithm: type[OffPolicyAlgorithm],
    checkpoint: Checkpoint,
    name: str,
    env: Any,
    device: th.device | str = "auto",
) -> Any:
    """Load an agent for a run that goes on.

    Raises:
        ValueError: If the environment is not built as it was, or has other spaces.
    """
    check_same_build(env, checkpoint.manifest["layers"][name])
    path = checkpoint.folder / f"{name}.zip"
    try:
        return algorithm.load(path, env=env, device=device, force_reset=False)
    except ValueError as error:
        raise ValueError(f"env must be that of {checkpoint.folder}: {error}") from error


def take_up(run: Run, store: CheckpointStore, checkpoint: Checkpoint) -> Resumption:
    """Put a checkpoint's state into a run whose agents have been loaded.

    Raises:
        ValueError: If environments are not built as they were.
    """
    manifest = checkpoint.manifest
    for name, env in run.environments.items():
        check_same_build(env, manifest["layers"][name])
    parts = th.load(checkpoint.folder / _STATE, weights_only=True)
    state.restore_early(run, parts["early"])
    rows = RowFiles()
    found = run.ring()
    if found is None:
        for name, agent in run.agents.items():
            path = checkpoint.folder / f"{name}.buffer.pkl"
            agent.load_replay_buffer(path, truncate_last_traj=False)
    else:
        source, ring = found
        if manifest["capacity"] != ring.capacity:
            raise ValueError(
                f"buffer_size must be as when the checkpoint was written, {manifest['capacity']} "
                f"steps of each environment, got {ring.capacity}"
            )
        files = segments.from_json(manifest["segments"])
        segments.fill(ring.columns, checkpoint.rows_folder, files)
        source.pos, source.full = manifest["pos"], manifest["full"]
        rows = RowFiles(source, files, run.first.num_timesteps // run.first.n_envs)
    return Resumption(run, store, rows, parts["late"], manifest["begun"])


def check_every(checkpoint_every: int) -> int:
    """Return ``checkpoint_every``, or raise ``ValueError`` if it is below 1."""
    whole = isinstance(checkpoint_every, int) and not isinstance(checkpoint_every, bool)
    if not whole or checkpoint_every < 1:
        raise ValueError(f"checkpoint_every must be at least 1, got {checkpoint_every!r}")
    return checkpoint_every


def _facts(run: Run) -> dict[str, Any]:
    return {
        "kind": run.kind,
        "agents": list(run.agents),
        "layers": {name: list(layers(env)) for name, env in run.environments.items()},
        "begun": run.first._num_timesteps_at_start,
        "versions": {"torch": th.__version__, "stable_baselines3": stable_baselines3.__version__},
    }
