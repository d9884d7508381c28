"""The manifest: every claim is there, and what it says can be run."""

from __future__ import annotations

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest

from sb3_flowpolicy.common.hyperparameters import load_hyperparameters
from sb3_flowpolicy.experiments.experiment import Experiment
from sb3_flowpolicy.experiments.manifest import EXPERIMENTS, what_is_missing
from sb3_flowpolicy.experiments.work import environment, make_plan


def test_all_claims_are_there() -> None:
    claims = {one.claim for one in EXPERIMENTS.values()}
    assert {f"E{k}" for k in range(1, 12)} <= claims


@pytest.mark.parametrize("experiment", EXPERIMENTS.values(), ids=EXPERIMENTS)
def test_entries_are_complete(experiment: Experiment) -> None:
    assert experiment.thesis
    assert experiment.checks
    names = [setting.name for setting in experiment.settings]
    assert len(set(names)) == len(names)
    for check in experiment.checks:
        assert any(check.statement.startswith(f"{name}: ") for name in names)
    if what_is_missing(experiment) is None:
        plan = make_plan(experiment)
        left_out = sum(len(setting.without) for setting in experiment.settings)
        assert len(plan.items) == len(experiment.settings) * len(experiment.agents) - left_out
        assert plan.settings()["seeds"] == list(range(1, experiment.seeds + 1))


def test_hyperparameters_are_those_of_the_zoo() -> None:
    plan = make_plan(EXPERIMENTS["sparse-fixed-entropy"])
    for item in plan.items:
        algo = {"gauss": "sac_gauss", "lowrank": "sac_lowrank", "flow": "sac_flow"}[item.agent]
        block = load_hyperparameters(algo, item.env_id)
        assert block.pop("n_timesteps") == item.steps
        assert item.hyperparameters == {**block, "ent_coef": "auto"}
    default_init = make_plan(EXPERIMENTS["circle-fixed-alpha"]).items[3]
    assert default_init.hyperparameters["policy_kwargs"]["net_arch"] == [128, 128]
    assert default_init.hyperparameters["policy_kwargs"]["distribution_kwargs"]["init"] == "default"


def test_variants_of_an_environment_keep_its_vectorized_form() -> None:
    item = make_plan(EXPERIMENTS["diagonal-dimensions"]).items[-1]
    name = environment(item)
    assert environment(item) == name
    venv = gym.make_vec(name, num_envs=2, vectorization_mode="vector_entry_point")
    assert venv.single_action_space.shape == (32,)
    venv.reset(seed=0)
    action = np.ones((2, 32), np.float32)
    for _ in range(7):
        *_, terminated, _, infos = venv.step(action)
    assert terminated.all()
    assert infos["is_success"].all() or infos["final_info"]["is_success"].all()


def test_seeds_split_into_items() -> None:
    plan = make_plan(EXPERIMENTS["circle-narrow"], seeds=5, seeds_per_item=2, first_seed=100)
    assert [item.seeds for item in plan.items[:3]] == [(100, 101), (102, 103), (104,)]
    keys = [item.key for item in plan.items]
    assert len(set(keys)) == len(keys) == 9


def test_a_worker_process_can_make_bullet_environments() -> None:
    pytest.importorskip("pybullet_envs_gymnasium")
    code = (
        "import gymnasium as gym\n"
        "from sb3_flowpolicy.experiments.further_claims import BULLET_CLAIMS\n"
        "from sb3_flowpolicy.experiments.work import environment, make_plan\n"
        "print(gym.spec(environment(make_plan(BULLET_CLAIMS[0]).items[0])).id)"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stdout.endswith("Walker2DBulletEnv-v0\n"), result.stderr
