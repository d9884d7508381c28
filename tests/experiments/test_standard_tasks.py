"""Every candidate is trained with the published settings, no run twice, and judged by the rule."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from torch import nn

from sb3_flowpolicy.experiments.standard_tasks import __main__ as command
from sb3_flowpolicy.experiments.standard_tasks import rule, tasks, training

OTHERS = ("gauss", "lowrank", "full", "lowrank_squashed", "flow_squashed")


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    few: Any = {"learning_starts": 20, "batch_size": 16, "buffer_size": 200}
    few |= {"policy_kwargs": {"net_arch": [8]}}
    rollout = {"n_steps": 16, "batch_size": 16, "n_epochs": 1, "normalize": True}
    settings = {"sac": few, "tqc": few, "crossq": few, "ppo": rollout}
    steps = dict.fromkeys(settings, 100)
    task = tasks.TASKS["tunnel-2"]._replace(steps=steps, own_settings=settings)
    monkeypatch.setitem(tasks.TASKS, "tunnel-2", task)
    monkeypatch.setattr(training, "_TESTS", 2)


@pytest.mark.usefixtures("quick")
def test_runs_are_recorded_and_not_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "table.csv"
    options = ["--task", "tunnel-2", "--episodes", "1", "--csv", str(path), "--seeds", "3"]
    command.main([*options, "--algorithms", "tqc", "ppo", "--policies", "stock", "flow"])
    table = pd.read_csv(path)
    runs = set(table[["algorithm", "policy"]].itertuples(index=False, name=None))
    assert runs == {(algorithm, name) for algorithm in ("tqc", "ppo") for name in ("stock", "flow")}
    assert list(table["step"][:4]) == [50, 100, 50, 100]
    assert table["test_success"].between(0, 1).all()
    assert "| tunnel-2 | ppo | flow |" in capsys.readouterr().out
    trained = []
    train = training.train
    monkeypatch.setattr(training, "train", lambda *run: trained.append(run[1:4]) or train(*run))
    figure = tmp_path / "curves.png"
    command.main([*options, "--algorithms", "ppo", "--figure", str(figure)])
    assert trained == [("ppo", name, 3) for name in OTHERS]
    assert figure.stat().st_size > 10_000


def test_mistakes_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(tmp_path / "table.csv")
    for options, message in (
        (["--csv", path], "--csv must name files with results, got .*table.csv"),
        (["--csv", path, "--seeds", "-1"], "value must be an integer of at least 0"),
        (["--csv", path, "--task", "tunnel-2", "--algorithms", "tqc"], "no settings of tqc"),
        (["--csv", path, "--task", "tunnel-2", "--policies", "bent"], "stock, gauss, .* got bent"),
    ):
        with pytest.raises(SystemExit):
            command.main(options)
        assert re.search(message, capsys.readouterr().err)


def test_settings_are_those_of_rl_zoo3_without_gsde() -> None:
    tqc, ppo = (tasks.TASKS["hopper"].settings(algorithm) for algorithm in ("tqc", "ppo"))
    assert tqc["learning_rate"](0.5) == 7.3e-4 / 2
    assert (tqc["batch_size"], tqc["top_quantiles_to_drop_per_net"]) == (256, 5)
    assert tqc["policy_kwargs"] == {"net_arch": [400, 300]}
    assert (ppo["n_envs"], ppo["normalize"], ppo["clip_range"](1.0)) == (16, True, 0.4)
    assert ppo["policy_kwargs"]["activation_fn"] is nn.ReLU
    for task in ("half-cheetah", "hopper", "walker"):
        for algorithm in tasks.CANDIDATES:
            settings = tasks.TASKS[task].settings(algorithm)
            assert not {"policy", "n_timesteps"} & settings.keys()
            for name in ("use_sde", "sde_sample_freq", "use_expln", "log_std_init"):
                assert name not in {**settings, **settings["policy_kwargs"]}


def test_the_rule_tells_worse_from_not_worse() -> None:
    stock = np.array([100.0, 101.0, 99.0, 100.0])
    for factor, expected in ((0.9, "worse"), (1.0, "not worse"), (1.1, "better")):
        assert rule.verdict(rule.difference(factor * stock, stock, 100.0)) == expected
    wide = np.array([60.0, 130.0, 80.0, 120.0])
    assert rule.verdict(rule.difference(wide, stock, 100.0)) == "undecided"
    # Of negative returns the less negative ones are better.
    assert rule.verdict(rule.difference(-1.1 * stock, -stock, 100.0)) == "worse"


@pytest.mark.filterwarnings("error")
def test_seeds_that_all_succeed_give_an_interval_without_a_warning() -> None:
    found = rule.difference(np.ones(10), np.eye(10)[0])
    assert found.value == pytest.approx(0.9)
    assert found.low == pytest.approx(0.9 - 2.262 * 0.1, abs=1e-3)  # Student's t, nine degrees


def test_few_seeds_are_no_verdict_and_successes_are_not_relative() -> None:
    names = ["task", "algorithm", "policy", "seed", "step", "test_return", "test_success"]

    def table(seeds: int, success: float) -> pd.DataFrame:
        rows = [
            ("a", "ppo", name, seed, 1, 100.0 * factor + seed, success * factor)
            for name, factor in (("stock", 1.0), ("flow", 2.0))
            for seed in range(seeds)
        ]
        return pd.DataFrame(rows, columns=names)

    assert "| undecided |" in rule.summary(table(4, np.nan))
    assert "| +98% (" in rule.summary(table(5, np.nan))
    assert "| better |" in rule.summary(table(5, np.nan))
    assert "| +10% (" in rule.summary(table(5, 0.1))


def test_final_values_are_successes_where_there_is_a_goal() -> None:
    rows = [("a", "ppo", "flow", 1, step, 5.0 * step, np.nan) for step in (1, 2, 3)]
    rows += [("b", "ppo", "flow", 1, step, 9.0, 0.1 * step) for step in (1, 2, 3)]
    names = ["task", "algorithm", "policy", "seed", "step", "test_return", "test_success"]
    assert rule.finals(pd.DataFrame(rows, columns=names)).tolist() == [12.5, 0.25]
