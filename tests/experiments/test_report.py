"""Verdicts, tables and the page, from made-up results whose verdicts are known."""

from __future__ import annotations

import itertools
import re
import shutil
from pathlib import Path

import pytest

from sb3_flowpolicy.common import statistics
from sb3_flowpolicy.experiments.evidence import Evidence
from sb3_flowpolicy.experiments.experiment import (
    GAUSS,
    NOT_MEASURED,
    NOT_REPRODUCED,
    PARTLY,
    REPRODUCED,
)
from sb3_flowpolicy.experiments.figures import outcomes_figure
from sb3_flowpolicy.experiments.manifest import EXPERIMENTS
from sb3_flowpolicy.experiments.report import Section, read_results, write_docs, write_report
from sb3_flowpolicy.experiments.store import ItemFiles
from sb3_flowpolicy.experiments.tables import results_table
from tests.experiments.conftest import MakeUp, declare_whole


@pytest.fixture(autouse=True)
def _few_resamples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Intervals are tested elsewhere; here they would only take time."""
    monkeypatch.setattr(statistics, "RESAMPLES", 40)


def evidence(name: str, folder: Path) -> Evidence:
    return Evidence(EXPERIMENTS[name], folder / name)


@pytest.mark.parametrize(
    ("levels", "verdict"),
    [
        ({"diagonal-gauss": 0.0, "diagonal-flow": 1.04}, REPRODUCED),
        ({"diagonal-gauss": 0.0}, PARTLY),  # NF should have been better than LR
        ({"diagonal-flow": 1.04}, PARTLY),  # Gauss should have failed
        ({"gauss": 0.5}, PARTLY),  # and not on the horizontal path
        (
            {"diagonal-gauss": 1.0, "horizontal-gauss": 0.5, "lowrank": 0.0, "flow": 0.0},
            NOT_REPRODUCED,
        ),
    ],
)
def test_a_rule_is_the_sum_of_its_checks(
    levels: dict[str, float], verdict: str, make_up: MakeUp, tmp_path: Path
) -> None:
    make_up("sparse-fixed-alpha", levels)
    found, findings = evidence("sparse-fixed-alpha", tmp_path).judge()
    assert found == verdict
    counted = [finding for finding in findings if " of 10" in finding.measured]
    for finding, (path, agent) in zip(
        counted,
        itertools.product(("horizontal", "diagonal"), ("gauss", "lowrank", "flow")),
        strict=True,
    ):
        level = levels.get(f"{path}-{agent}", levels.get(agent, 1.0))
        assert finding.measured == ("10 of 10" if level >= 1.0 else "0 of 10")


def test_verdicts_of_the_circle(make_up: MakeUp, tmp_path: Path) -> None:
    levels = {"gauss": 0.95, "lowrank": 1.0, "flow": 1.05, "flow-default-init": 0.0}
    make_up("circle-fixed-alpha", levels)
    verdict, _ = evidence("circle-fixed-alpha", tmp_path).judge()
    assert verdict == REPRODUCED
    shutil.rmtree(tmp_path / "circle-fixed-alpha")
    make_up("circle-fixed-alpha", {"gauss": 1.5, "lowrank": 0.0, "flow": 0.0})
    verdict, findings = evidence("circle-fixed-alpha", tmp_path).judge()
    assert verdict == NOT_REPRODUCED
    assert findings[-1].measured == "0 of 10"


def test_what_did_not_finish_is_not_judged(make_up: MakeUp, tmp_path: Path) -> None:
    plan = make_up("circle-narrow")
    ItemFiles(tmp_path / "circle-narrow", plan.items[0].key).done.unlink()
    verdict, _ = evidence("circle-narrow", tmp_path).judge()
    assert verdict == NOT_MEASURED


def test_a_seed_that_fails_is_counted(make_up: MakeUp, tmp_path: Path) -> None:
    make_up("circle-fixed-alpha")
    files = ItemFiles(tmp_path / "circle-fixed-alpha", "circle-flow")
    table = files.read_table()
    table.loc[table["seed"] == 3, "test_success"] = 0.0
    table.to_csv(files.table, index=False)
    declare_whole(files)
    found = evidence("circle-fixed-alpha", tmp_path)
    assert found.solved("circle", "flow").sum() == 9
    assert found.steps_until_solved("circle", "flow").tolist()[2] == 60_000
    _, findings = found.judge()
    assert findings[-1].holds is False
    assert findings[-1].measured == "9 of 10"


def test_the_table_counts_both_deterministic_actions(make_up: MakeUp, tmp_path: Path) -> None:
    make_up("circle-fixed-alpha")
    files = ItemFiles(tmp_path / "circle-fixed-alpha", "circle-flow")
    table = files.read_table().assign(log_prob_return=1.0, log_prob_success=1.0)
    table.loc[table["seed"] == 3, "log_prob_success"] = 0.0
    table.to_csv(files.table, index=False)
    declare_whole(files)
    counts = results_table(evidence("circle-fixed-alpha", tmp_path)).set_index("agent")
    column = counts["by the most likely action"]
    assert (column["NF"], column["Gauss"]) == ("9 of 10", "-")


def test_oscillations_are_what_all_three_curves_do(make_up: MakeUp, tmp_path: Path) -> None:
    make_up("circle-narrow", {"gauss": 1.0})
    steady = evidence("circle-narrow", tmp_path)
    assert steady.oscillations("narrow", "gauss").max() == 0
    files = ItemFiles(tmp_path / "circle-narrow", "narrow-gauss")
    table = files.read_table()
    up = table["step"] // 6000 % 2
    table["train_return"], table["train_success"] = 2.0 * up, 0.1 + up / 2
    table["entropy"] = -4.0 + 2.0 * up
    # The entropy coefficient of the other seeds does not swing.
    table["ent_coef"] = table["ent_coef"].mask(table["seed"] <= 5, 0.01 * 3**up)
    table.to_csv(files.table, index=False)
    declare_whole(files)
    counts = evidence("circle-narrow", tmp_path).oscillations("narrow", "gauss")
    assert (counts[:5] >= 7).all()
    assert counts[5:].max() <= 1


def test_outcomes_are_counted_per_agent_and_setting(make_up: MakeUp, tmp_path: Path) -> None:
    make_up("sparse-fixed-alpha", {"diagonal-gauss": 0.0})
    figure = outcomes_figure(evidence("sparse-fixed-alpha", tmp_path))
    assert figure is not None
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert texts.count("10 of 10\n32,000 steps") == 5
    assert texts.count("0 of 10") == 1  # no steps: no seed solved it
    make_up("circle-fixed-alpha")
    assert outcomes_figure(evidence("circle-fixed-alpha", tmp_path)) is None


def test_our_experiments_reproduce_nothing(make_up: MakeUp, tmp_path: Path) -> None:
    make_up("diagonal-dimensions", {"4-dimensions-flow": 0.0})
    section = Section(evidence("diagonal-dimensions", tmp_path))
    assert section.verdict == PARTLY
    assert section.verdict_in_words == "some lines hold"
    make_up("circle-narrow")
    theirs = Section(evidence("circle-narrow", tmp_path))
    assert theirs.verdict_in_words == theirs.verdict


def test_results_are_complete_without_agents_that_a_setting_leaves_out(
    make_up: MakeUp, tmp_path: Path
) -> None:
    agents: dict[str, list[str]] = {}
    for item in make_up("diagonal-widened", seeds=1).items:
        agents.setdefault(item.setting, []).append(item.agent)
    assert "spline" in agents["12-dimensions"]
    assert agents["16-dimensions"] == ["gauss", "lowrank", "gsde"]
    assert evidence("diagonal-widened", tmp_path).complete


def test_docs_hold_tables_figures_and_data(make_up: MakeUp, tmp_path: Path) -> None:
    make_up("circle-fixed-entropy", seeds=3)
    docs = tmp_path / "docs"
    text = write_docs(read_results(tmp_path), docs).read_text()
    for link in re.findall(r"\]\((experiments/[^)]+\.png)\)", text):
        assert (docs / link).read_bytes().startswith(b"\x89PNG")
    assert len(re.findall(r"!\[circle-fixed-entropy", text)) == 3
    assert f"| circle | {GAUSS.label} | 3 |" in text
    assert "trial, not a result" in text
    # What is committed is enough to make the page again.
    again = [one for one in read_results(docs / "experiments") if one.evidence.complete]
    assert [one.experiment.name for one in again] == ["circle-fixed-entropy"]


def test_the_page_needs_no_other_file(make_up: MakeUp, tmp_path: Path) -> None:
    make_up("circle-fixed-entropy", seeds=3)
    write_report(read_results(tmp_path), tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert not re.findall(r'(?:src|href)="(?!#|data:)', text)
    assert text.count('src="data:image/png;base64,') == 3
    assert "Policies in their tunnel" in text
