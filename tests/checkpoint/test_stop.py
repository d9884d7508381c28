"""SIGTERM and Ctrl-C: a checkpoint, then the end that users of the command line expect."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3.common.callbacks import BaseCallback

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy import SACFlow, SeedBatch
from sb3_flowpolicy.checkpoint.store import CheckpointStore

ENV = "TunnelDiagonal-v0"
FAST: dict[str, Any] = {
    "learning_starts": 10,
    "buffer_size": 90,
    "batch_size": 8,
    "device": "cpu",
    "policy_kwargs": {"net_arch": [8]},
}


class SignalAt(BaseCallback):
    """Sends this process signals at step 33."""

    def __init__(self, *numbers: int) -> None:
        super().__init__()
        self.numbers = numbers
        self.ended = False

    def _on_step(self) -> bool:
        if self.num_timesteps == 33:
            for number in self.numbers:
                os.kill(os.getpid(), number)
        return True

    def _on_training_end(self) -> None:
        self.ended = True


class Quiet(BaseCallback):
    """Does nothing."""

    def _on_step(self) -> bool:
        return True


def newest_step(path: Path) -> int:
    return CheckpointStore(path).newest().manifest["num_timesteps"]


@pytest.fixture(autouse=True)
def handlers() -> Any:
    """Whatever a test does, handlers are to be those from before; in the main thread alone."""
    # Shells start what they run in the background with SIGINT ignored, and pytest inherits that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    yield
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


@pytest.mark.parametrize("kind", ["SACFlow", "SeedBatch"])
@pytest.mark.parametrize(
    ("number", "expected"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)]
)
def test_a_checkpoint_is_written_before_the_end(
    kind: str, number: int, expected: type[BaseException], tmp_path: Path, capfd: Any
) -> None:
    callback = SignalAt(number)
    learner: Any = (
        SACFlow("FlowPolicy", ENV, **FAST)
        if kind == "SACFlow"
        else SeedBatch("FlowPolicy", ENV, 2, **FAST)
    )
    made: Any = callback if kind == "SACFlow" else lambda seed: callback if seed else Quiet()
    with pytest.raises(expected) as stop:
        learner.learn(80, callback=made, checkpoint_every=20, checkpoint_path=tmp_path)
    if isinstance(stop.value, SystemExit):
        assert stop.value.code == 143
    assert newest_step(tmp_path) == 33
    assert callback.ended
    assert "writing a checkpoint after this step" in capfd.readouterr().err


def test_a_second_signal_does_not_wait(tmp_path: Path) -> None:
    model = SACFlow("FlowPolicy", ENV, **FAST)
    callback = SignalAt(signal.SIGINT, signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        model.learn(80, callback=callback, checkpoint_every=20, checkpoint_path=tmp_path)
    assert newest_step(tmp_path) == 20
    assert not callback.ended


def test_a_program_that_handles_signals_itself_gets_them(tmp_path: Path) -> None:
    got = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: got.append(number))
    try:
        model = SACFlow("FlowPolicy", ENV, **FAST)
        callback = SignalAt(signal.SIGTERM)
        model.learn(80, callback=callback, checkpoint_every=20, checkpoint_path=tmp_path)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert got == [signal.SIGTERM]
    assert model.num_timesteps == newest_step(tmp_path) == 33


def test_signals_that_are_ignored_stay_ignored(tmp_path: Path) -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        model = SACFlow("FlowPolicy", ENV, **FAST)
        callback = SignalAt(signal.SIGINT)
        model.learn(80, callback=callback, checkpoint_every=20, checkpoint_path=tmp_path)
    finally:
        signal.signal(signal.SIGINT, before)
    assert model.num_timesteps == 80


def test_other_threads_leave_signals_alone(tmp_path: Path) -> None:
    model = SACFlow("FlowPolicy", ENV, **FAST)
    arguments: dict[str, Any] = {"checkpoint_every": 20, "checkpoint_path": tmp_path}
    thread = threading.Thread(target=model.learn, args=(40,), kwargs=arguments)
    thread.start()
    thread.join()
    assert newest_step(tmp_path) == 40


def test_without_checkpoints_ctrl_c_is_as_ever() -> None:
    model = SACFlow("FlowPolicy", ENV, **FAST)
    with pytest.raises(KeyboardInterrupt):
        model.learn(80, callback=SignalAt(signal.SIGINT))
    assert model.num_timesteps == 33


def test_an_exception_takes_the_place_of_a_signal(tmp_path: Path) -> None:
    class Fails(SignalAt):
        def _on_step(self) -> bool:
            super()._on_step()
            if self.num_timesteps == 33:
                raise KeyError("the program's own")
            return True

    model = SACFlow("FlowPolicy", ENV, **FAST)
    checkpoints: dict[str, Any] = {"checkpoint_every": 20, "checkpoint_path": tmp_path}
    with pytest.raises(KeyError):
        model.learn(80, callback=Fails(signal.SIGTERM), **checkpoints)
    assert model.learn(20, reset_num_timesteps=False, **checkpoints).num_timesteps == 53
