"""Items that two experiments share: trained once, and only if they are really the same."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from sb3_flowpolicy.experiments import runner
from sb3_flowpolicy.experiments.__main__ import main
from sb3_flowpolicy.experiments.evidence import Evidence
from sb3_flowpolicy.experiments.experiment import GAUSS, LOW_RANK, Experiment
from sb3_flowpolicy.experiments.manifest import EXPERIMENTS
from sb3_flowpolicy.experiments.tables import facts
from sb3_flowpolicy.experiments.work import make_plan


@pytest.fixture
def second(tiny: Experiment, monkeypatch: pytest.MonkeyPatch) -> Experiment:
    """An experiment that calls its setting otherwise and shares one of its two agents."""
    setting = replace(tiny.settings[0], name="ring")
    agents = (replace(GAUSS, name="normal"), LOW_RANK)
    experiment = replace(tiny, name="second", settings=(setting,), agents=agents, checks=())
    monkeypatch.setitem(EXPERIMENTS, experiment.name, experiment)
    return experiment


def _at(commit: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    def machine() -> dict:
        return {"commit": commit, "versions": {"torch": "2"}}

    monkeypatch.setattr(runner, "machine", machine)


def _run_tiny(out: Path) -> None:
    """Run the first experiment, then say that it ran at a known commit."""
    assert main(["run", "tiny", "--out", str(out), "--workers", "1", "--no-progress"]) == 0
    for path in (out / "tiny").glob("*.done.json"):
        done = json.loads(path.read_text())
        done["machine"] |= {"commit": "abc", "versions": {"torch": "2"}}
        done["commits"] = ["abc"]
        path.write_text(json.dumps(done))


def test_a_shared_item_is_trained_once(
    second: Experiment,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    _run_tiny(tmp_path)
    _at("abc", monkeypatch)
    command = ["run", "second", "--out", str(tmp_path), "--workers", "1", "--no-progress"]
    assert main(command) == 0
    output = capsys.readouterr().out
    assert "Taken from tiny, which did the same: ring-normal" in output
    assert "1 finished before" in output
    there, here = tmp_path / "tiny", tmp_path / "second"
    for name in (".csv", ".details.jsonl"):
        adopted = (here / f"ring-normal{name}").read_bytes()
        assert adopted == (there / f"circle-gauss{name}").read_bytes()
    assert "adopted_from" not in json.loads((here / "ring-lowrank.done.json").read_text())
    evidence = Evidence(second, here)
    assert evidence.complete
    assert facts(evidence)["items"] == "2 of 2 finished, 1 of them in tiny, which shares them"


@pytest.mark.parametrize("commit", [None, "abc-dirty", "abd"])
def test_results_of_other_or_unknown_code_are_not_taken(
    commit: str | None, second: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _run_tiny(tmp_path)
    _at(commit, monkeypatch)
    assert _adopted(second, tmp_path) == {}


def test_a_shortened_file_is_not_taken(
    second: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _run_tiny(tmp_path)
    _at("abc", monkeypatch)
    table = tmp_path / "tiny" / "circle-gauss.csv"
    table.write_bytes(table.read_bytes()[:-10])
    assert _adopted(second, tmp_path) == {}


def _adopted(experiment: Experiment, out: Path) -> dict[str, str]:
    (out / experiment.name).mkdir()
    return runner.adopt(out / experiment.name, make_plan(experiment).items)
