"""Every density stays finite in every case."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch as th

from sb3_flowpolicy.benchmarks import stress
from sb3_flowpolicy.distributions import DiagGaussian, registered_distributions, registry


@pytest.mark.parametrize("name", stress.CASES)
@pytest.mark.parametrize("distribution", registered_distributions())
def test_stays_finite(distribution: str, name: str) -> None:
    outcome = stress.run_case(distribution, name, updates=20)
    assert outcome.failure == ""
    assert outcome.updates == 20


@pytest.mark.slow
@pytest.mark.parametrize("name", stress.CASES)
@pytest.mark.parametrize("distribution", registered_distributions())
def test_stays_finite_for_long(distribution: str, name: str) -> None:
    assert stress.run_case(distribution, name).failure == ""


class Careless(DiagGaussian):
    """Divides by a standard deviation that may be zero."""

    def loc_and_log_std(self, context: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return self.mu(context), self.log_std(context) * 1e3


def test_a_careless_density_is_detected(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(registry, "_REGISTRY", {"careless": Careless})
    cases = {name: stress.CASES[name] for name in ("ordinary", "observations of 1e8")}
    monkeypatch.setattr(stress, "CASES", cases)
    monkeypatch.setattr(stress, "UPDATES", 200)
    with pytest.raises(SystemExit, match="1"):
        stress.main(["--csv", str(tmp_path / "table.csv")])
    assert "of 2 cases finite" in capsys.readouterr().out
    head, *rows = (tmp_path / "table.csv").read_text().splitlines()
    assert head.startswith("distribution,case,updates,failure")
    assert len(rows) == 2
    assert "must be finite" in rows[1]
