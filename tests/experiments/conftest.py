"""A tiny experiment that trains in a second, and made-up results that need no training."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sb3_flowpolicy.experiments.checks import mostly_fails, none_fails
from sb3_flowpolicy.experiments.experiment import FLOW, GAUSS, Experiment, Setting
from sb3_flowpolicy.experiments.manifest import EXPERIMENTS
from sb3_flowpolicy.experiments.runner import results_folder
from sb3_flowpolicy.experiments.store import ItemFiles
from sb3_flowpolicy.experiments.work import Plan, WorkItem, make_plan

FAST = {
    "learning_starts": 30,
    "random_steps": 30,
    "buffer_size": 500,
    "batch_size": 16,
    "ent_coef": "auto",
    "policy_kwargs": {"net_arch": [8, 8]},
}
TINY = Experiment(
    name="tiny",
    claim="T1",
    source="a test",
    title="A tiny circle",
    thesis="NF solves it, Gauss does not.",
    settings=(Setting("circle", "TunnelCircle-v0", overrides=FAST),),
    agents=(GAUSS, FLOW),
    checks=(none_fails("circle", FLOW), mostly_fails("circle", GAUSS, 0.3)),
    steps=120,
    seeds=2,
    eval_every=20,
    measures=("profile",),
    pictures_at=(0.5, 1.0),
)


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> Experiment:
    """The tiny experiment, known by its name."""
    monkeypatch.setitem(EXPERIMENTS, TINY.name, TINY)
    return TINY


MakeUp = Callable[..., Plan]


@pytest.fixture
def make_up(tmp_path: Path) -> MakeUp:
    """Write finished results of an experiment whose numbers are known."""

    def write(name: str, levels: dict[str, float] | None = None, seeds: int = 10) -> Plan:
        chosen = levels or {"gauss": 0.0}
        plan = make_plan(EXPERIMENTS[name], seeds=seeds)
        with results_folder(tmp_path, plan) as folder:
            for item in plan.items:
                level = chosen.get(item.key, chosen.get(item.agent, 1.0))
                _write_item(ItemFiles(folder, item.key), item, level)
        return plan

    return write


def _write_item(files: ItemFiles, item: WorkItem, level: float) -> None:
    steps = np.arange(item.eval_every, item.steps + 1, item.eval_every)
    done = level * np.minimum(1.0, 2.0 * steps / item.steps)
    learned = item.hyperparameters.get("ent_coef") == "auto"
    for seed in item.seeds:
        noise = np.random.default_rng(seed).normal(size=(3, len(steps)))
        table = pd.DataFrame(
            {
                "seed": seed,
                "step": steps,
                "episodes": 50,
                "train_return": done + 0.01 * noise[0],
                "train_success": done,
                "test_return": done + 0.01 * noise[1],
                "test_success": (done >= 1.0).astype(float),
                "entropy": -3.0 + level + 0.05 * noise[2],
                "ent_coef": 1 / steps if learned else 0.01,
            }
        )
        files.append_rows(table.to_dict("records"))
        way = [k / 12 for k in range(12)]
        entropy = [level * (k - 6) for k in range(12)]
        if "profile" in item.measures:
            files.append_detail({"kind": "profile", "seed": seed, "way": way, "entropy": entropy})
    if item.pictures_at:
        samples = np.random.default_rng(0).uniform(-1, 1, (2, 20, 2)).tolist()
        picture = {"steps": [0, 1], "positions": [[0.7, 0.0], [0.7, 0.1]], "samples": samples}
        trail = [[0.7, 0.0], [0.7, 0.1], [0.6, 0.2]]
        head = {"kind": "picture", "seed": item.seeds[0], "step": item.steps}
        files.append_detail({**head, **picture, "trail": trail})
    versions = {"torch": "2", "stable_baselines3": "2", "gymnasium": "1"}
    machine = {"commit": "abc", "cpu_count": 2, "processor": "p", "python": "3"}
    facts = {"steps": item.steps, "seeds": item.seeds, "cpu_seconds": 50.0}
    facts |= {"steps_per_second": 100.0, "machine": {**machine, "versions": versions}}
    files.finish({**facts, **files.fingerprint()})


def declare_whole(files: ItemFiles) -> None:
    """Note the present contents of files that a test has changed as those of the run."""
    done = json.loads(files.done.read_text())
    files.done.write_text(json.dumps({**done, **files.fingerprint()}))


def contents(folder: Path) -> dict[str, bytes]:
    """Return what was measured, by file."""
    files = [path for path in folder.iterdir() if path.suffix in (".csv", ".jsonl")]
    return {path.name: path.read_bytes() for path in files}
