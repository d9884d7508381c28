"""The comparison of ways to act: all agents, all ways, nothing left out."""

from __future__ import annotations

import csv
from itertools import product
from pathlib import Path

import pytest

from sb3_flowpolicy.experiments import deterministic


def test_every_way_is_tested_for_every_agent(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "table.csv"
    words = "--envs TunnelHorizontal-v0 --seeds 5 6 --steps 20 --every 10 --episodes 3 --csv"
    deterministic.main([*words.split(), str(path)])
    rows = list(csv.DictReader(path.open()))
    told = [(int(row["step"]), row["way"], int(row["seed"])) for row in rows]
    assert told == list(product((10, 20), deterministic.WAYS, (5, 6)))
    assert {row["ent_coef"] for row in rows} == {"auto"}
    assert all(0 <= float(row["success"]) <= 1 for row in rows)
    assert capsys.readouterr().out.count("stochastic") == 2
