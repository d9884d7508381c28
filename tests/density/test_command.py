"""The quick form of the command, its files, its report and its errors."""

from __future__ import annotations

import re
from pathlib import Path

import pandas as pd
import pytest
from PIL import Image

from sb3_flowpolicy.density.__main__ import main
from sb3_flowpolicy.density.report import PICTURES
from sb3_flowpolicy.density.studies import FULL, STUDIES, Study, angles_to_score
from sb3_flowpolicy.density.verdicts import angle, label, sound, two_moons

Row = dict[str, object]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("density") / "results"
    main(["run", "--quick", "--out", str(out)])
    return out


@pytest.mark.parametrize("study", STUDIES.values(), ids=STUDIES)
def test_quick_run_leaves_rows_for_every_model_and_seed(folder: Path, study: Study) -> None:
    rows = pd.read_csv(folder / f"{study.name}-fits.csv")
    assert list(zip(rows["model"], rows["seed"], strict=True)) == [
        (model, seed) for model in study.epochs for seed in (0, 1)
    ]
    for _, row in rows.iterrows():
        assert row["nll"] > row["entropy"]
        # The gap is the distance to the true density on the same points.
        assert row["gap"] == pytest.approx(row["nll"] - row["entropy"], abs=6 * row["gap_se"])
        # zuko's NAF loses mass before long training.
        if row["model"] != "naf":
            assert row["integral_low"] == pytest.approx(1, abs=0.02)
    curves = pd.read_csv(folder / f"{study.name}-curves.csv")
    assert set(curves["model"]) == set(study.epochs)
    assert not curves.isna().any(axis=None)


@pytest.mark.parametrize("study", PICTURES)
def test_quick_run_leaves_pictures(folder: Path, study: str) -> None:
    for name in PICTURES[study]:
        with Image.open(folder / name) as image:
            assert min(image.size) > 100
            assert len(image.convert("RGB").getcolors(1 << 20)) > 10
    assert not list(folder.glob(".*"))


def test_the_animation_moves(folder: Path) -> None:
    with Image.open(folder / "angles.gif") as image:
        assert image.n_frames == 4


def test_report_shows_every_study_and_check(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["report", "--out", str(folder)])
    text = (folder / "README.md").read_text()
    assert text in capsys.readouterr().out
    assert "python -m sb3_flowpolicy.density run --quick" in text
    for study in STUDIES.values():
        assert study.thesis in text
        for picture in PICTURES[study.name]:
            assert f"({picture})" in text
    # Two hardly trained seeds cannot satisfy all criteria.
    assert "| **no** |" in text


def test_list_names_every_study(capsys: pytest.CaptureFixture[str]) -> None:
    main(["list"])
    printed = capsys.readouterr().out
    for study in STUDIES.values():
        assert study.name in printed
        assert study.thesis in printed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "list|run|report"),
        (["run", "three-moons"], "studies must be among .*two-moons.*, got .*three-moons"),
        (["run", "--seeds", "0"], "--seeds: value must be an integer of at least 1"),
        (["report", "--out", "nowhere"], "out must be a folder that `run` has written to"),
    ],
)
def test_errors_say_what_was_expected(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as error:
        main(arguments)
    assert error.value.code == 2
    assert re.search(message, capsys.readouterr().err)


def test_angles_between_are_not_trained_and_outside_is_outside() -> None:
    kinds = angles_to_score(FULL)
    assert len(kinds["trained"]) == 22
    assert len(kinds["between"]) == 21
    assert min(abs(a - b) for a in kinds["trained"] for b in kinds["between"]) > 0.04
    assert kinds["outside"].min() > 2.15
    assert kinds["outside"].max() < 6.25


def fit_row(model: str, nll: float, **changes: object) -> Row:
    row = {"model": model, "seed": 0, "nll": nll, "gap": 0.1, "gap_se": 0.01}
    return {**row, "integral_low": 1.0, "integral_high": 1.0, "accuracy": 1.0, **changes}


@pytest.mark.parametrize(
    ("change", "holds"),
    [
        ({}, [True, True]),
        ({"integral_low": 0.98}, [False, True]),
        ({"integral_high": 1.02}, [False, True]),
        ({"gap": -0.05}, [True, False]),
        ({"gap": float("nan")}, [True, False]),
        ({"integral_low": float("nan")}, [False, True]),
    ],
)
def test_soundness_catches_wrong_densities(change: Row, holds: list[bool]) -> None:
    rows = [fit_row("maf", 1.2), fit_row("maf", 1.2, **change)]
    assert [held for *_, held in sound(pd.DataFrame(rows))] == holds


def test_verdicts_follow_the_numbers() -> None:
    nll = {"realnvp": 1.1, "maf": 1.2, "maf-random": 1.12, "naf": 1.16, "zuko-realnvp": 1.12}
    rows = pd.DataFrame([fit_row(model, value) for model, value in nll.items()])
    nothing, curves = pd.DataFrame(), pd.DataFrame({"epoch": [250]})
    assert [holds for *_, holds in two_moons(rows, curves, nothing)] == [True, False, False, True]
    good = pd.DataFrame([fit_row("realnvp", 0.49)])
    assert [holds for *_, holds in label(good, curves, nothing)] == [True, True]
    bad = pd.DataFrame([fit_row("realnvp", 0.51, accuracy=0.98)])
    assert [holds for *_, holds in label(bad, curves, nothing)] == [False, False]


@pytest.mark.parametrize(("rise", "holds"), [(1.0, True), (-1.0, False)])
def test_angle_verdicts_follow_the_numbers(rise: float, holds: bool) -> None:
    rows: list[Row] = [{"seed": 0, "kind": "trained", "angle": 1.0, "nll": -0.3}]
    rows += [{"seed": 0, "kind": "between", "angle": 1.05, "nll": -0.3 if holds else 0.0}]
    for step in (0.1, 0.2, 0.3):
        for at in (2.1 + step, 6.2832 - step):
            rows.append({"seed": 0, "kind": "outside", "angle": at, "nll": rise * step})
    nothing = pd.DataFrame()
    assert [held for *_, held in angle(nothing, nothing, pd.DataFrame(rows))] == [holds, holds]
