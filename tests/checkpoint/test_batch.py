"""SeedBatch checkpoints: all agents go on, with their running episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from stable_baselines3.common.envs import IdentityEnvBox
from stable_baselines3.common.logger import configure

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy import SACFlow, SeedBatch
from sb3_flowpolicy.checkpoint import RunCheckpointCallback
from tests.checkpoint.broken_runs import BreakAt, BrokenError, differences
from tests.checkpoint.kill_and_resume import log_rows

FAST: dict[str, Any] = {
    "learning_starts": 20,
    "buffer_size": 90,
    "batch_size": 8,
    "policy_kwargs": {"net_arch": [8]},
}
SEEDS = [3, 5]


def short_pendulum() -> gym.Env:
    return gym.make("Pendulum-v1", max_episode_steps=7)


def learn(batch: SeedBatch, folder: Path, step: int | None, **checkpoints: Any) -> list[BreakAt]:
    callbacks = [BreakAt(step or 1000) for _ in SEEDS]
    for seed, model in zip(SEEDS, batch.models, strict=True):
        model.set_logger(configure(str(folder / f"log{seed}"), ["csv"]))
    try:
        batch.learn(150, callback=lambda seed: callbacks[SEEDS.index(seed)], **checkpoints)
    except BrokenError:
        assert step is not None
    return callbacks


FLOW = {"policy": "FlowPolicy"}
GSDE = {"policy": "GaussPolicy", "use_sde": True}


@pytest.mark.parametrize(
    ("env", "settings"),
    [
        ("TunnelDiagonal-v0", FLOW),
        ("SquareHold-v0", FLOW),
        (short_pendulum, FLOW),
        (short_pendulum, GSDE),
    ],
    ids=["Tunnel", "Square", "sync", "gSDE"],
)
def test_resumed_batch_is_the_undisturbed_one(
    env: Any, settings: dict[str, Any], tmp_path: Path
) -> None:
    settings = {"env": env, "seeds": SEEDS, **FAST, **settings}
    calm = SeedBatch(monitor_dir=tmp_path / "calm", **settings)
    learn(calm, tmp_path / "calm", None)
    folder = tmp_path / "broken"
    checkpoints: dict[str, Any] = {"checkpoint_every": 20, "checkpoint_path": folder / "run"}
    batch = SeedBatch(monitor_dir=folder, **settings)
    learn(batch, folder, 67, **checkpoints)
    for step in (128, None, None):
        batch = SeedBatch.resume(folder / "run", env, monitor_dir=folder)
        counters = learn(batch, folder, step, **checkpoints)
        if step is not None:
            assert [one.seen for one in counters] == [128, 127]  # the first has stopped the second
    for seed, one, other in zip(SEEDS, calm.models, batch.models, strict=True):
        assert one._n_updates == 130
        assert differences(one, other) == []
        for log in (f"log{seed}/progress.csv", f"seed_{seed}.monitor.csv"):
            if env != "SquareHold-v0":  # whose episodes are too long to end
                assert log_rows(tmp_path / "calm" / log) == log_rows(folder / log) != []


def test_several_calls_of_learn(tmp_path: Path) -> None:
    env = "TunnelDiagonal-v0"
    checkpoints: dict[str, Any] = {"checkpoint_every": 20, "checkpoint_path": tmp_path}
    calm = SeedBatch("FlowPolicy", env, SEEDS, **FAST).learn(60)
    calm.learn(50, reset_num_timesteps=False)
    batch = SeedBatch("FlowPolicy", env, SEEDS, **FAST).learn(60, **checkpoints)
    with pytest.raises(BrokenError):
        batch.learn(50, callback=BreakAt(93), reset_num_timesteps=False, **checkpoints)
    batch = SeedBatch.resume(tmp_path, env).learn(60, **checkpoints)
    assert batch.models[0].num_timesteps == 80
    batch.learn(50, reset_num_timesteps=False, **checkpoints)
    for one, other in zip(calm.models, batch.models, strict=True):
        assert differences(one, other) == []


def test_an_agent_of_a_checkpoint_is_small_and_ordinary(tmp_path: Path) -> None:
    for count in (1, 6):
        batch = SeedBatch("FlowPolicy", "Pendulum-v1", count, **FAST)
        batch.learn(30, checkpoint_every=30, checkpoint_path=tmp_path / str(count))
    alone, one_of_six = (next(tmp_path.glob(f"{n}/*-30/seed_0.zip")) for n in (1, 6))
    assert one_of_six.stat().st_size < 1.1 * alone.stat().st_size
    assert SACFlow.load(one_of_six).num_timesteps == 30


def test_environments_that_cannot_be_pickled_begin_a_new_episode(tmp_path: Path) -> None:
    class Locked(gym.Wrapper):
        def __init__(self, env: gym.Env) -> None:
            super().__init__(env)
            self.generator = (value for value in range(3))

    def env() -> gym.Env:
        return Locked(IdentityEnvBox(eps=0.5))

    batch = SeedBatch("GaussPolicy", env, 2, **FAST)
    with pytest.warns(RuntimeWarning, match="cannot be saved"):
        batch.learn(40, checkpoint_every=40, checkpoint_path=tmp_path)
    with pytest.warns(RuntimeWarning, match="resuming begins new episodes"):
        batch = SeedBatch.resume(tmp_path, env)
    batch.learn(60)
    assert [model.num_timesteps for model in batch.models] == [60, 60]


def test_wrong_use_is_refused(tmp_path: Path) -> None:
    batch = SeedBatch("FlowPolicy", "TunnelDiagonal-v0", 2, **FAST)
    callback = RunCheckpointCallback(20, tmp_path / "callback")
    with pytest.raises(ValueError, match=r"learn\(checkpoint_every=\.\.\., checkpoint_path"):
        batch.learn(30, callback=callback)
    batch.learn(20, checkpoint_every=20, checkpoint_path=tmp_path / "run")
    with pytest.raises(ValueError, match=r"checkpoints of SACFlow, got .* of SeedBatch"):
        SACFlow.resume(tmp_path / "run", "TunnelDiagonal-v0")
    with pytest.raises(ValueError, match="env must be built and wrapped"):
        SeedBatch.resume(tmp_path / "run", "Pendulum-v1")
