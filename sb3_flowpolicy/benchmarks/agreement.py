"""``python -m sb3_flowpolicy.benchmarks.agreement``: a batch of seeds against separate runs.

Trains the same seeds in one SeedBatch and one by one, and draws the success rate and the entropy
of both. Random numbers differ, so curves agree in distribution, not point by point.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.benchmarks.learning import zoo_block
from sb3_flowpolicy.diagnostics.figures import draw_seeds, new_figure
from sb3_flowpolicy.policies import FlowActor
from sb3_flowpolicy.seeds.batch import SeedBatch

ENV = "TunnelDiagonal-v0"
COLUMNS = ("how", "seed", "step", "success", "entropy")
STEPS_PER_ROW = 1000


class Recorder(BaseCallback):
    """Record the success of the last 100 episodes and the entropy at the start position."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[tuple[int, float, float]] = []

    def _on_training_start(self) -> None:
        self.model.recorded = self.rows  # type: ignore[attr-defined]

    def _on_step(self) -> bool:
        if self.num_timesteps % STEPS_PER_ROW == 0:
            actor = self.model.policy.actor
            assert isinstance(actor, FlowActor)
            with th.random.fork_rng(devices=[]):
                entropy = actor.entropy(th.zeros(1, 2), n_samples=2000).item()
            outcomes = self.model.ep_success_buffer or [0.0]
            self.rows.append((self.num_timesteps, float(np.mean(outcomes)), entropy))
        return True


def main(arguments: list[str] | None = None) -> None:
    """Train both ways, write ``agreement.csv`` and ``agreement.png``, print the summary."""
    parser = argparse.ArgumentParser(
        prog="python -m sb3_flowpolicy.benchmarks.agreement",
        description="Compare a batch of seeds with separate runs of the same seeds.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("--seeds", type=int, default=10, help="number of seeds")
    parser.add_argument("-n", "--n-timesteps", type=int, default=30_000, help="steps per seed")
    parser.add_argument("-o", "--output", type=Path, default=Path("."), help="folder for results")
    args = parser.parse_args(arguments)
    th.set_num_threads(1)
    settings = {"env": ENV, "device": "cpu", **zoo_block("sac_flow", ENV)}

    batch = SeedBatch(seeds=args.seeds, **settings)
    batch.learn(args.n_timesteps, callback=Recorder())
    rows: list[tuple] = []
    for seed, model in zip(batch.seeds, batch.models, strict=True):
        rows += [("batch", seed, *row) for row in model.recorded]  # type: ignore[attr-defined]
    for seed in range(args.seeds):
        recorder = Recorder()
        SACFlow(seed=seed, **settings).learn(args.n_timesteps, callback=recorder)
        rows += [("separate", seed, *row) for row in recorder.rows]
        print(f"seed {seed} done", flush=True)
    args.output.mkdir(parents=True, exist_ok=True)
    with open(args.output / "agreement.csv", "w", newline="") as file:
        csv.writer(file).writerows([COLUMNS, *rows])
    _draw(rows, args.output / "agreement.png")
    _summarize(rows)


def _curves(rows: list[tuple], how: str, column: int) -> tuple[np.ndarray, np.ndarray]:
    """Return steps (T,) and values (S, T) of the batch or of the separate runs."""
    chosen = [row for row in rows if row[0] == how]
    steps = np.unique([row[2] for row in chosen])
    return steps, np.array([row[column] for row in chosen]).reshape(-1, len(steps))


def _draw(rows: list[tuple], path: Path) -> None:
    figure = new_figure(9, 3.2)
    columns = {3: "success (last 100 episodes)", 4: "entropy, nats"}
    for axes, (column, label) in zip(figure.subplots(1, 2), columns.items(), strict=True):
        for how, color in {"batch": "tab:blue", "separate": "tab:orange"}.items():
            steps, values = _curves(rows, how, column)
            draw_seeds(axes, steps, values, color, f"{how}, mean")
        axes.set(xlabel="steps per seed", ylabel=label)
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=110)


def _summarize(rows: list[tuple]) -> None:
    for how in ("batch", "separate"):
        steps, success = _curves(rows, how, 3)
        solved = [steps[np.argmax(curve >= 0.9)] for curve in success if (curve >= 0.9).any()]
        _, entropy = _curves(rows, how, 4)
        print(
            f"{how:<9} solved {len(solved)} of {len(success)}, "
            f"median steps to 90 %: {np.median(solved) if solved else float('nan'):.0f}, "
            f"final entropy {entropy[:, -1].mean():.2f} +/- {entropy[:, -1].std():.2f}"
        )


if __name__ == "__main__":
    main()
