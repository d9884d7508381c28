"""Kill training with SIGKILL at random moments, resume it each time, compare with a calm run.

    python tests/checkpoint/kill_and_resume.py --moments 50

trains on TunnelDiagonal-v0 in processes of their own, and compares parameters, optimizer moments,
replay buffers and logs bit for bit; only the columns of wall-clock time are left out.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import multiprocessing
import os
import random
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

AGENTS = ("SACFlow", "SeedBatch")
ENGINES = ("eager", "compiled")
SEEDS = 3
_TIMES = {"time/fps", "time/time_elapsed", "t"}
# New processes are forked from one that has imported everything, and so start at once.
_CONTEXT = multiprocessing.get_context("forkserver")
_PRELOADED = ["stable_baselines3", "sb3_flowpolicy.seeds", "flowpolicy_envs", __name__]


def main() -> int:
    """Run the kinds that were asked for and print the tally; 0 if all runs are equal."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--moments", type=int, default=50, help="kills, over all kinds")
    parser.add_argument("--agents", nargs="+", default=AGENTS, choices=AGENTS)
    parser.add_argument("--engines", nargs="+", default=ENGINES, choices=ENGINES)
    parser.add_argument("--steps", type=int, default=4000, help="environment steps of a run")
    parser.add_argument("--every", type=int, default=100, help="steps between checkpoints")
    parser.add_argument("--seed", type=int, default=0, help="decides when to kill")
    arguments = parser.parse_args()
    _CONTEXT.set_forkserver_preload(_PRELOADED)
    kinds = [(agent, engine) for engine in arguments.engines for agent in arguments.agents]
    moments, rest = divmod(arguments.moments, len(kinds))
    draw = random.Random(arguments.seed)
    unequal = kills = 0
    for index, (agent, engine) in enumerate(kinds):
        count = moments + (index < rest)
        targets = sorted(draw.randrange(1, arguments.steps) for _ in range(count))
        with tempfile.TemporaryDirectory() as scratch:
            calm, killed = Path(scratch, "calm"), Path(scratch, "killed")
            settings = (agent, engine, arguments.steps)
            start = time.monotonic()
            _run(*settings, 0, calm)
            torn = sum(_kill(*settings, arguments.every, killed, step, draw) for step in targets)
            _run(*settings, arguments.every, killed)
            differences = compare(calm, killed)
        kills += count
        unequal += bool(differences)
        verdict = f"DIFFERENT in {differences}" if differences else "equal bit for bit"
        print(
            f"{agent:9} {engine:8} {arguments.steps} steps, {count} kills, {torn} of them while a "
            f"checkpoint was being written: {verdict} ({time.monotonic() - start:.0f} s)",
            flush=True,
        )
    print(f"{kills} kills in {len(kinds)} runs, {len(kinds) - unequal} runs equal, {unequal} not")
    return int(unequal > 0)


def train(
    agent: str,
    engine: str,
    steps: int,
    every: int,
    folder: Path,
    seed: int = 1,
    tell: Callable[[int], None] = lambda step: None,
) -> None:
    """Train, or go on training, and write what has come out.

    Args:
        agent: ``"SACFlow"`` or ``"SeedBatch"``.
        engine: ``"eager"`` or ``"compiled"``.
        steps: Environment steps of the whole run.
        every: Steps between checkpoints; 0 for none.
        folder: Where checkpoints, logs and the outcome go.
        seed: Seed of a single agent.
        tell: Called with the number of steps, every tenth step.
    """
    import gymnasium as gym
    import torch as th
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.logger import configure
    from stable_baselines3.common.monitor import Monitor

    import flowpolicy_envs  # noqa: F401, registers the environments
    from sb3_flowpolicy import SACFlow, SeedBatch
    from sb3_flowpolicy.checkpoint import has_checkpoint

    class Tell(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps % 10 == 0:
                tell(self.num_timesteps)
            return True

    th.set_num_threads(1)
    path = folder / "checkpoints"
    again = has_checkpoint(path)
    settings: dict[str, Any] = {
        "learning_starts": 200,
        "buffer_size": steps // 2,
        "batch_size": 64,
        "policy_kwargs": {"net_arch": [16, 16]},
        "compile": engine == "compiled",
        "device": "cpu",
    }
    checkpoints = {"checkpoint_every": every, "checkpoint_path": path} if every else {}
    if agent == "SACFlow":
        env = Monitor(gym.make("TunnelDiagonal-v0"), str(folder / "monitor"))
        model = (
            SACFlow.resume(path, env)
            if again
            else SACFlow("FlowPolicy", env, seed=seed, **settings)
        )
        model.set_logger(configure(str(folder / "log_0"), ["csv"]))
        model.learn(steps, callback=Tell(), **checkpoints)
        models = [model]
    else:
        monitors = folder / "monitors"
        env_id = "TunnelDiagonal-v0"
        batch = (
            SeedBatch.resume(path, env_id, monitor_dir=monitors)
            if again
            else SeedBatch("FlowPolicy", env_id, SEEDS, monitor_dir=monitors, **settings)
        )
        for index, model in enumerate(batch.models):
            model.set_logger(configure(str(folder / f"log_{index}"), ["csv"]))
        batch.learn(steps, callback=Tell(), **checkpoints)
        models = batch.models
    th.save([outcome(model) for model in models], folder / "outcome.pt")


def compare(one: Path, other: Path) -> list[str]:
    """Name what differs between two finished runs."""
    import torch as th

    differences = []
    outcomes = [th.load(folder / "outcome.pt", weights_only=True) for folder in (one, other)]
    for index, (left, right) in enumerate(zip(*outcomes, strict=True)):
        for key in left.keys() | right.keys():
            values = left.get(key), right.get(key)
            if any(value is None for value in values) or not th.equal(*values):
                differences.append(f"agent {index}: {key}")
    logs = sorted(path.relative_to(one) for path in one.rglob("*.csv"))
    differences += [str(log) for log in logs if log_rows(one / log) != log_rows(other / log)]
    if not logs or any(len(log_rows(one / log)) < 2 for log in logs):
        differences.append("nothing was logged")
    return differences


def outcome(model: Any) -> dict[str, Any]:
    """Flatten everything that training has changed: name -> tensor."""
    import torch as th

    found = {}
    optimizers = {"actor": model.actor.optimizer, "critic": model.critic.optimizer}
    if model.ent_coef_optimizer is not None:
        optimizers["ent_coef"] = model.ent_coef_optimizer
    for name, value in model.policy.state_dict().items():
        found[f"parameters {name}"] = value
    learned = model.log_ent_coef
    found["ent_coef"] = model.ent_coef_tensor if learned is None else learned.detach()
    for name, optimizer in optimizers.items():
        for index, state in optimizer.state_dict()["state"].items():
            found |= {f"optimizer {name} {index} {key}": value for key, value in state.items()}
    buffer = model.replay_buffer
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        if hasattr(buffer, name):
            found[f"buffer {name}"] = th.from_numpy(getattr(buffer, name))
    for name in ("num_timesteps", "_n_updates", "_episode_num"):
        found[name] = th.tensor(getattr(model, name))
    found["buffer position"] = th.tensor([buffer.pos, buffer.full])
    return {name: value.clone() for name, value in found.items()}


def log_rows(path: Path) -> list[dict[str, str]]:
    """Read a log, without the columns of wall-clock time; the order of columns is not its own."""
    with path.open() as file:
        lines = [line for line in file if not line.startswith("#")]
    return [
        {key: value for key, value in row.items() if key not in _TIMES and value}
        for row in csv.DictReader(lines)
    ]


def _in_a_process(reports: Any, *arguments: Any) -> None:
    null = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(null, stream)
    train(*arguments, tell=reports.send)


def _start(*arguments: Any) -> tuple[Any, Any]:
    """Begin to train; return the process and the connection on which it tells its steps."""
    reports, theirs = _CONTEXT.Pipe(duplex=False)
    process = _CONTEXT.Process(target=_in_a_process, args=(theirs, *arguments))
    process.start()
    theirs.close()
    return process, reports


def _run(agent: str, engine: str, steps: int, every: int, folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    process, reports = _start(agent, engine, steps, every, folder)
    with reports:
        _wait_for(reports, steps + 1)
    process.join()
    if process.exitcode != 0:
        raise RuntimeError(f"training was to end with 0, but ended with {process.exitcode}")


def _kill(
    agent: str, engine: str, steps: int, every: int, folder: Path, step: int, draw: random.Random
) -> bool:
    """Train until ``step``, and a little longer, then kill; whether a checkpoint was torn."""
    folder.mkdir(exist_ok=True)
    process, reports = _start(agent, engine, steps, every, folder)
    with reports:
        _wait_for(reports, step)
        # Some moments fall into the writing of a checkpoint, which takes that long.
        time.sleep(draw.uniform(0, 0.1))
        process.kill()
    process.join()
    if process.exitcode != -9:
        raise RuntimeError(f"training was to be killed, but ended with {process.exitcode}")
    return any(name.startswith(".partial") for name in os.listdir(folder / "checkpoints"))


def _wait_for(reports: Any, step: int) -> None:
    """Return when training has reached ``step`` or ended."""
    with contextlib.suppress(EOFError):
        while reports.recv() < step:
            pass


if __name__ == "__main__":
    raise SystemExit(main())
