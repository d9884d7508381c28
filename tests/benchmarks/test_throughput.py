from __future__ import annotations

import json
import pkgutil
import re
import sys
from pathlib import Path

import pytest
import torch as th
from torch.utils.flop_counter import FlopCounterMode

from sb3_flowpolicy.algorithms.sac_flow import SACFlow
from sb3_flowpolicy.benchmarks import flows, updates
from sb3_flowpolicy.benchmarks.learning import stock_block, zoo_block
from sb3_flowpolicy.benchmarks.throughput import GROUPS, main
from sb3_flowpolicy.benchmarks.updates import products_alone
from sb3_flowpolicy.engine import Engine


def test_quick_run_writes_the_documented_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "quick.json"
    groups = ["learn", "her", "acting", "environments", "flow"]
    only = [word for group in groups for word in ("--only", group)]
    main(["--quick", "--json", str(path), *only])
    result = json.loads(path.read_text())
    assert result["schema"] == 1
    assert result["settings"] == {"quick": True, "rounds": 5, "turn_seconds": 0.02}
    assert result["machine"]["threads"] == 1
    assert [row["group"] for row in result["rows"]] == sorted(
        (row["group"] for row in result["rows"]), key=groups.index
    )
    fields = (
        "group contest name unit rate rates peer ratio limit limit_fraction warm_up_seconds note"
    )
    for row in result["rows"]:
        assert list(row) == fields.split()
        if row["rate"] is None:  # PyBullet has no wheels for newer Pythons
            assert "pybullet" in row["note"]
            continue
        assert len(row["rates"]) == 5
        assert min(row["rates"]) <= row["rate"] <= max(row["rates"])
        assert row["rate"] > 0
        assert row["note"] is None
        if row["name"] == row["peer"]:
            assert row["ratio"] == 1
    printed = capsys.readouterr()
    for row in result["rows"]:
        assert row["name"] in printed.out


@pytest.mark.slow
def test_quick_run_of_everything(tmp_path: Path) -> None:
    path = tmp_path / "quick.json"
    main(["--quick", "--json", str(path)])
    rows = json.loads(path.read_text())["rows"]
    assert {row["group"] for row in rows} == set(GROUPS)
    (ours,) = (row for row in rows if row["name"] == "SACFlow GaussPolicy")
    assert ours["limit"] == "products alone, GaussPolicy"
    assert ours["limit_fraction"] > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--only", "nonsense"], "invalid choice: 'nonsense' .*updates.*learn.*environments.*flow"),
        (["--json", "nowhere/at/all.json"], "--json must name a file in an existing directory"),
    ],
)
def test_bad_arguments(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as error:
        main(arguments)
    assert error.value.code == 2
    stderr = capsys.readouterr().err.replace("\n", " ")
    assert re.search(message, stderr)


def test_help_teaches(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    text = capsys.readouterr().out
    assert "examples:" in text
    assert all(group in text for group in GROUPS)


@pytest.mark.parametrize("group", GROUPS)
@pytest.mark.parametrize("quick", [True, False])
def test_benchmarks_are_well_formed(group: str, quick: bool) -> None:
    benchmarks = pkgutil.resolve_name(f"sb3_flowpolicy.benchmarks.{GROUPS[group]}")
    for benchmark in benchmarks(quick):
        names = [candidate.name for candidate in benchmark.candidates]
        assert len(set(names)) == len(names)
        assert {candidate.limit for candidate in benchmark.candidates} <= {None, *names}


@pytest.mark.parametrize("algorithm", ["sac_flow", "sac_lowrank", "sac_gauss"])
def test_zoo_blocks_are_arguments(algorithm: str) -> None:
    block = zoo_block(algorithm, "TunnelDiagonal-v0")
    assert block["random_steps"] == 2000
    assert not {"callback", "n_timesteps"} & set(block)


def test_stock_differs_only_in_what_stock_lacks() -> None:
    ours, stock = zoo_block("sac_gauss", "TunnelDiagonal-v0"), stock_block("TunnelDiagonal-v0")
    assert stock.pop("policy") == "MlpPolicy"
    assert ours.pop("policy") == "GaussPolicy"
    assert stock == {
        key: value for key, value in ours.items() if key not in ("random_steps", "critic_loss_coef")
    }


def test_prefilled_models_train() -> None:
    shape = updates.Shape(4, 3, 2)
    model = updates.prefilled(SACFlow, shape, policy="GaussPolicy", compile=False)
    work = updates.updates_of(model)
    assert work() == updates.N_CALLS * updates.N_UPDATES == model._n_updates
    assert all(part.isfinite().all() for part in model.policy.parameters())


def multiplications(call: object) -> int:
    with FlopCounterMode(display=False) as counter:
        call()  # type: ignore[operator]
    return counter.get_total_flops()


@pytest.mark.parametrize("policy", ["GaussPolicy", "LowRankPolicy", "FlowPolicy"])
@pytest.mark.parametrize("n_seeds", [1, 3])
def test_limit_does_the_products_of_an_update(policy: str, n_seeds: int) -> None:
    shape = updates.Shape(32, 5, 3)
    models = [
        updates.prefilled(SACFlow, shape, policy=policy, compile=False) for _ in range(n_seeds)
    ]
    work = products_alone([model.policy for model in models], batch_size=64, n_updates=1)
    alone = multiplications(work)
    engine = Engine(models)
    batches = engine.draw(1, 64)
    whole = multiplications(lambda: engine.train(batches))
    assert work() == n_seeds
    # The limit ignores that the first coupling needs no gradient with respect to the noise.
    assert alone == pytest.approx(whole, rel=1e-3)


def test_zuko_is_optional(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zuko", None)
    with pytest.raises(ModuleNotFoundError, match="zuko"):
        flows.benchmarks()[0].candidates[0].prepare()


def test_threads_reach_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    monkeypatch.setattr(th, "set_num_threads", seen.append)
    monkeypatch.setattr(flows, "benchmarks", lambda quick: [])
    main(["--threads", "2", "--only", "flow"])
    assert seen == [2]
