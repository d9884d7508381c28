"""Results that are not what they should be are refused, or marked."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sb3_flowpolicy.experiments.__main__ import main
from sb3_flowpolicy.experiments.evidence import Evidence
from sb3_flowpolicy.experiments.experiment import GAUSS, NOT_MEASURED, Experiment
from sb3_flowpolicy.experiments.manifest import EXPERIMENTS
from sb3_flowpolicy.experiments.report import reservation
from sb3_flowpolicy.experiments.store import ItemFiles
from sb3_flowpolicy.experiments.work import make_plan
from tests.experiments.conftest import MakeUp, declare_whole

NAME = "circle-narrow"


def test_changed_results_stop_the_run_and_the_report(
    make_up: MakeUp, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_up(NAME, seeds=2)
    run = ["run", NAME, "--seeds", "2", "--out", str(tmp_path), "--no-progress"]
    assert main(run) == 0
    table = tmp_path / NAME / "narrow-flow.csv"
    text = table.read_text()
    for changed in (text.replace("500,50,", "500,51,", 1), text[: text.index("\n") + 1], ""):
        table.write_text(changed)
        for command in (run, ["report", "--results", str(tmp_path)]):
            assert main(command) == 1
            error = capsys.readouterr().err
            assert "narrow-flow.csv and " in error
            assert f"bytes written to them, got {len(changed)} and " in error
    table.unlink()
    assert main(run) == 1


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("settings", {"steps": None}, r"must hold 'steps' \(int\)"),
        ("settings", {"schema": 99}, "must be of schema 1, got 99"),
        ("settings", {"experiment": "move"}, "named after its experiment, 'move', got 'circle-"),
        ("narrow-flow.done", {"machine": None}, r"must hold 'machine' \(dict\)"),
        ("narrow-flow.done", {"key": "narrow-gauss"}, "must be of narrow-flow, got 'narrow-gauss'"),
        ("narrow-flow.done", {"seeds": [9, 1]}, r"seeds \[1, 2\], got 120000 of \[9, 1\]"),
        ("narrow-flow.done", {"steps": 5000}, r"of 120000 steps of .*, got 5000 of \[1, 2\]"),
    ],
)
def test_files_of_something_else_are_refused(
    file: str, change: dict[str, Any], message: str, make_up: MakeUp, tmp_path: Path
) -> None:
    make_up(NAME, seeds=2)
    path = tmp_path / NAME / f"{file}.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(ValueError, match=rf"{file}\.json .*{message}"):
        Evidence(EXPERIMENTS[NAME], tmp_path / NAME)


def test_results_that_are_not_the_experiments_own_are_marked() -> None:
    experiment = EXPERIMENTS[NAME]

    def said(**changes: Any) -> str | None:
        return reservation(experiment, make_plan(experiment, **changes).settings())

    assert said() is None
    assert said(seeds=12) is None
    assert said(seeds_per_item=4) is None
    assert said(steps=100) == "trial, not a result"
    assert said(first_seed=100) == "seeds from 100 on, which are for tuning: not a result"
    other = make_plan(experiment).settings()
    other["items"]["narrow-flow"]["hyperparameters"]["gamma"] = 0.5
    assert reservation(experiment, other) == (
        "made with other settings (items.narrow-flow.hyperparameters.gamma: there 0.5, now 0.8)"
    )


def test_an_agent_that_was_added_later_leaves_the_claim_open(
    make_up: MakeUp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_up(NAME, seeds=2)
    grown = replace(
        EXPERIMENTS[NAME], agents=(*EXPERIMENTS[NAME].agents, replace(GAUSS, name="late"))
    )
    monkeypatch.setitem(EXPERIMENTS, NAME, grown)
    evidence = Evidence(grown, tmp_path / NAME)
    assert evidence.judge()[0] == NOT_MEASURED
    assert reservation(grown, evidence.settings) == "trial, not a result"


def test_what_was_not_measured_leaves_the_claim_open(make_up: MakeUp, tmp_path: Path) -> None:
    make_up("circle-fixed-entropy")
    for path in (tmp_path / "circle-fixed-entropy").glob("*.details.jsonl"):
        path.unlink()
        declare_whole(ItemFiles(path.parent, path.name.removesuffix(".details.jsonl")))
    experiment = EXPERIMENTS["circle-fixed-entropy"]
    verdict, findings = Evidence(experiment, tmp_path / experiment.name).judge()
    assert verdict == NOT_MEASURED
    assert findings[2].measured == "profile of gauss on circle was not measured"


def test_three_times_the_bar_reaches_the_bar(make_up: MakeUp, tmp_path: Path) -> None:
    """0.8 + 0.8 + 0.8 is less than 2.4 in floating point."""
    make_up(NAME, seeds=2)
    files = ItemFiles(tmp_path / NAME, "narrow-flow")
    files.read_table().assign(test_success=0.8).to_csv(files.table, index=False)
    declare_whole(files)
    evidence = Evidence(EXPERIMENTS[NAME], tmp_path / NAME)
    assert evidence.solved("narrow", "flow").all()
    assert evidence.solved_once("narrow", "flow").all()
    assert evidence.steps_until_solved("narrow", "flow").tolist() == [1500, 1500]


def test_seeds_that_learn_nothing_are_not_steady(make_up: MakeUp, tmp_path: Path) -> None:
    make_up(NAME, {"flow": 0.0})
    _, findings = Evidence(EXPERIMENTS[NAME], tmp_path / NAME).judge()
    assert [finding.holds for finding in findings] == [False, True, False]
    assert "0 of 10 ever succeed in training" in findings[2].measured


def test_a_renamed_folder_and_strangers_are_left_alone(
    tiny: Experiment, make_up: MakeUp, tmp_path: Path
) -> None:
    """Beside the experiment's folder, whatever else lies there."""
    (tmp_path / ".vscode").mkdir()
    (tmp_path / ".vscode" / "settings.json").write_text('{"editor.fontSize": // comment\n 12}')
    make_up("tiny", seeds=2)
    (tmp_path / "tiny").rename(tmp_path / "mine")
    make_up("tiny", seeds=2)
    assert main(["run", "tiny", "--out", str(tmp_path), "--no-progress"]) == 0
    shutil.copytree(tmp_path / "mine", tmp_path / NAME)
    assert main(["report", "--results", str(tmp_path)]) == 1
