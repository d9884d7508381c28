"""Entropy and objective against direct computation, and a case in which coordination must pay."""

import json
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("cma")

from flowpolicy_envs.square.batch import SquareBatch
from sb3_flowpolicy.experiments.coordination.__main__ import main
from sb3_flowpolicy.experiments.coordination.families import FAMILIES, INDEPENDENT_START, INWARDS
from sb3_flowpolicy.experiments.coordination.search import measure, predict, setting_of


@pytest.mark.parametrize("name", FAMILIES)
def test_families_begin_with_positive_definite_noise(name):
    family = FAMILIES[name]
    root = family.root(family.start(INDEPENDENT_START))
    assert np.linalg.eigvalsh(root @ root.T).min() > 1e-4
    is_diagonal = np.allclose(root @ root.T, np.diag(np.diag(root @ root.T)))
    assert is_diagonal == (name in ("independent", "pink"))


def test_entropy_is_that_of_squashed_noise():
    setting = setting_of("SquareHold-v0", {}, {"warm_up": 0.0, "weight": 0.0})
    setting = replace(setting, steps=20)
    batch, mean, scale = SquareBatch(setting.config, 400), 0.8, 0.4
    noise = scale * np.random.default_rng(0).standard_normal((20, 400, 8))
    means = mean * INWARDS.sum(axis=0)
    found = measure(setting, means, scale * np.eye(8), noise, batch, 0)["entropy"]

    a = np.linspace(-1, 1, 400_001)[1:-1]
    expected = 0.0
    for m in np.abs(means):
        density = np.exp(-0.5 * ((np.arctanh(a) - m) / scale) ** 2)
        density /= scale * np.sqrt(2 * np.pi) * (1 - a**2)
        inside = density > 0
        expected -= (density[inside] * np.log(density[inside])).sum() * (a[1] - a[0])
    assert found == pytest.approx(expected, abs=0.03)


def test_the_objective_of_a_safe_policy_is_its_reward_over_one_minus_gamma():
    setting = setting_of("SquareMoveX-v0", {"effort": 0.0, "y": 0.0}, {}, ent_coef=0.0)
    batch = SquareBatch(setting.config, 8)
    noise = np.zeros((setting.steps, 8, 8))
    found = measure(setting, 0.8 * INWARDS.sum(axis=0), 1e-3 * np.eye(8), noise, batch, 0)
    assert found["hazard"] == 0.0
    assert found["value"] == pytest.approx(1.0 / (1.0 - 0.9))
    assert found["kept"] == 1.0


def test_coordination_pays_where_opposed_fingers_lose_their_grip():
    setting = setting_of("SquareMoveX-v1", {}, {}, budget=150, episodes=16)
    found = predict(setting, ("independent", "full"))
    independent, full = found["independent"], found["full"]
    assert full["entropy"] > independent["entropy"] + 0.5
    assert full["x_std"] > 1.3 * independent["x_std"]
    assert min(independent["kept"], full["kept"]) > 0.6


def test_command_writes_what_it_prints(tmp_path, capsys):
    file = tmp_path / "prediction.json"
    given = "SquareMoveX-v0 --task angle=1 --set max_force=2.4 --budget 10 --episodes 4"
    main([*given.split(), "--families", "pink", "--json", str(file)])
    told = json.loads(file.read_text())
    assert list(told["families"]) == ["independent", "pink"]
    assert told["settings"]["set"] == {"max_force": 2.4}
    assert "against independent noise" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["TunnelCircle-v0"], "must be that of a Square"),
        (["SquareMoveX-v0", "--set", "max_force=-1"], "max_force must be positive"),
        (["SquareMoveX-v0", "--task", "speed=1"], "speed"),
        (["SquareMoveX-v0", "--set", "max_force"], "NAME=VALUE"),
    ],
)
def test_command_explains_bad_arguments(arguments, message, capsys):
    with pytest.raises(SystemExit):
        main(arguments)
    assert message in capsys.readouterr().err
