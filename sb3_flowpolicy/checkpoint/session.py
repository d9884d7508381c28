"""Write checkpoints during a run, and resume a run from one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_flowpolicy.checkpoint import state
from sb3_flowpolicy.checkpoint.environments import check_same_build, layers
from sb3_flowpolicy.checkpoint.rows import RowFiles, fill
from sb3_flowpolicy.checkpoint.signals import StopSignals
from sb3_flowpolicy.checkpoint.state import Run
from sb3_flowpolicy.checkpoint.store import Checkpoint, CheckpointStore
from sb3_flowpolicy.common.validation import integer

_STATE = "state.pt"


class RunCheckpoints:
    """The checkpoints of one learner: an algorithm, or several in lockstep.

    Checkpoints are written and restored between rollouts, when the whole state of a run is in
    objects and none of it in local variables.

    Args:
        describe: Returns what a checkpoint consists of.
    """

    def __init__(self, describe: Callable[[], Run]) -> None:
        self._describe = describe
        #: Folder to write to, None until checkpoints are requested.
        self.path: Path | None = None
        #: Whether checkpoints are being written.
        self.active = False
        self._every = 1
        self._last: int | None = None
        self._store: CheckpointStore | None = None
        self._rows = RowFiles()
        self._signals = StopSignals()
        # After loading, until learning begins: the state to restore at that moment, and the step
        # at which the interrupted call of ``learn`` began.
        self._late: bytes | None = None
        self._begun = 0
        #: Environments whose state could not be saved: they begin new episodes when resumed.
        self.opaque: set[str] = set()

    @property
    def resuming(self) -> bool:
        """Whether a checkpoint was loaded and the run has not continued yet."""
        return self._late is not None

    @contextmanager
    def learning(self, path: str | Path | None, every: int | None) -> Iterator[None]:
        """Write checkpoints during a call of ``learn``, and a last one at its end.

        SIGTERM and Ctrl-C write a checkpoint, then take effect. With both arguments None, nothing
        is written.
        """
        if (path is None) != (every is None):
            raise ValueError(
                f"checkpoint_every and checkpoint_path go together, got {every} and {path}"
            )
        try:
            if path is not None and every is not None:
                self.start(path, every)
            yield
            run = self._run()
            if self._late is not None:
                # This call had ended before the run was interrupted, and its logs must show that;
                # the next call is the one to resume.
                self._begun = run.first._total_timesteps
                state.restore_late(run, self._late)
            reached = run.first.num_timesteps >= run.first._total_timesteps
            # A callback that stops learning does so in the middle of a rollout, where resuming
            # could not be exact.
            if self.active and self._last is not None and reached:
                self._write(run)
        finally:
            self.stop()
        self._signals.deliver()

    def start(self, path: str | Path, every: int) -> None:
        """Begin to write checkpoints, until :meth:`stop`.

        The first checkpoint of a new run is due at once, to report early what cannot be saved.
        """
        self._every, path = integer(1)("checkpoint_every", every), Path(path).resolve()
        if path != self.path:
            if self.active:
                raise ValueError(
                    "checkpoint_path must be one folder for a call of learn(), got "
                    f"{self.path} and {path}"
                )
            if self._store is None or self._store.path != path:  # else it was resumed from there
                store = CheckpointStore(path)
                folders = store.folders()
                if folders or path.is_file():
                    content = f"has {folders[-1].name}" if folders else "is a file"
                    raise ValueError(
                        f"checkpoint_path must be an empty folder for a new run, got {path}, which "
                        f"{content}: resume that run, or choose another folder"
                    )
                self._store, self._rows, self._last = store, RowFiles(), None
            self.path = path
        self.active = True
        self._signals.watch()

    def stop(self) -> None:
        """Stop writing checkpoints and watching signals."""
        self.active = False
        self._signals.release()

    def remaining(self, total_timesteps: int, reset_num_timesteps: bool) -> tuple[int, bool]:
        """Return the arguments with which ``learn`` continues an interrupted call to its end."""
        if not self.resuming:
            return total_timesteps, reset_num_timesteps
        end = total_timesteps + (0 if reset_num_timesteps else self._begun)
        return end - self._run().first.num_timesteps, False

    def between_rollouts(self, callbacks: Mapping[str, BaseCallback]) -> bool:
        """Restore the rest of a loaded checkpoint, and write a checkpoint if one is due.

        ``callbacks`` are those of the agents' ``learn``. Returns whether to continue: False after
        SIGTERM and Ctrl-C.
        """
        if self._late is not None:
            run = self._run(callbacks)
            state.restore_late(run, self._late)
            for agent in run.agents.values():  # may hold the start of an earlier call
                agent._num_timesteps_at_start = self._begun
            self._late = None
            self.opaque.clear()
        if not self.active:
            return True
        run = self._run(callbacks)
        now, stop = run.first.num_timesteps, self._signals.received is not None
        if self._last is not None and now < self._last:
            raise ValueError(
                "reset_num_timesteps must be False for a second run in the same checkpoint_path, "
                f"got a count of {now} where {self.path} is at {self._last}"
            )
        if stop or self._last is None or now // self._every > self._last // self._every:
            self._write(run)
        return not stop

    def load(self, checkpoint: Checkpoint) -> None:
        """Restore a checkpoint's state in agents that have been loaded."""
        run, manifest = self._run(), checkpoint.manifest
        for name, env in run.environments.items():
            check_same_build(env, manifest["layers"][name])
        parts = th.load(checkpoint.folder / _STATE, weights_only=True)
        state.restore_early(run, parts["early"])
        self._rows, ring = RowFiles(), run.ring()
        if ring is None:
            for name, agent in run.agents.items():
                path = checkpoint.folder / f"{name}.buffer.pkl"
                agent.load_replay_buffer(path, truncate_last_traj=False)
        else:
            if manifest["capacity"] != ring.capacity:
                raise ValueError(
                    "buffer_size must be as when the checkpoint was written, "
                    f"{manifest['capacity']} steps of each environment, got {ring.capacity}"
                )
            fill(ring.columns, checkpoint.rows_folder, manifest["segments"])
            for agent in run.agents.values():
                buffer: Any = agent.replay_buffer
                buffer.pos, buffer.full = manifest["pos"], manifest["full"]
            now = replace(ring, pos=manifest["pos"], full=manifest["full"])
            steps = run.first.num_timesteps // run.first.n_envs
            self._rows.note(now, steps, manifest["segments"])
        self._store = CheckpointStore(checkpoint.folder.parent, [checkpoint])
        self._last = manifest["num_timesteps"]
        self._late, self._begun = parts["late"], manifest["begun"]

    def _run(self, callbacks: Mapping[str, BaseCallback] | None = None) -> Run:
        run = self._describe()
        run.callbacks, run.opaque = dict(callbacks or {}), self.opaque
        return run

    def _write(self, run: Run) -> None:
        """Write a checkpoint, unless there is one of this step."""
        now, ring = run.first.num_timesteps, run.ring()
        if now == self._last:
            return
        assert self._store is not None
        steps = now // run.first.n_envs

        def write_files(folder: Path, prefix: Path) -> dict[str, Any]:
            for name, agent in run.agents.items():
                agent.save(folder / f"{name}.zip")
            th.save(state.collect(run), folder / _STATE)
            if ring is None:
                for name, agent in run.agents.items():
                    agent.save_replay_buffer(folder / f"{name}.buffer.pkl")
                return {}
            files = self._rows.write(ring, steps, prefix)
            facts = {"pos": ring.pos, "full": ring.full, "capacity": ring.capacity}
            return {"segments": files, **facts}

        facts = {
            "kind": run.kind,
            "agents": list(run.agents),
            "layers": {name: list(layers(env)) for name, env in run.environments.items()},
            "begun": run.first._num_timesteps_at_start,
        }
        checkpoint = self._store.write(now, facts, write_files)
        if ring is not None:
            self._rows.note(ring, steps, checkpoint.manifest["segments"])
        self._last = now


def open_checkpoint(path: str | Path, kind: str) -> Checkpoint:
    """Find the newest undamaged checkpoint of a folder; it must be of the class ``kind``."""
    checkpoint = CheckpointStore(path).newest()
    found = checkpoint.manifest["kind"]
    if found != kind:
        raise ValueError(f"path must hold checkpoints of {kind}, got {path}, of {found}")
    return checkpoint


def load_agent(
    algorithm: type[OffPolicyAlgorithm],
    checkpoint: Checkpoint,
    name: str,
    env: Any,
    device: th.device | str,
) -> Any:
    """Load an agent of a checkpoint, with an environment that is built as its own was."""
    check_same_build(env, checkpoint.manifest["layers"][name])
    path = checkpoint.folder / f"{name}.zip"
    return algorithm.load(path, env=env, device=device, force_reset=False)
