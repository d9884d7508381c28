"""What rl_zoo3 knows once we are registered."""

import argparse
from pathlib import Path

import pytest

pytest.importorskip("rl_zoo3")

from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.zoo import ALGORITHMS, hyperparameter_file, plug_in, register

ENV_ID = "TunnelDiagonal-v0"


@pytest.fixture(scope="module", autouse=True)
def _registered():
    register()
    register()  # the second time changes nothing


def manager(*arguments, **options):
    from rl_zoo3.exp_manager import ExperimentManager

    return ExperimentManager(argparse.Namespace(), *arguments, **options)


def test_algorithms():
    from rl_zoo3 import ALGOS

    assert {name: ALGOS[name] for name in ALGORITHMS} == dict.fromkeys(ALGORITHMS, SACFlow)
    assert ALGOS["sac"] is not SACFlow


def test_environments():
    import gymnasium

    assert ENV_ID in gymnasium.registry


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("options", [{}, {"config": None}])
def test_our_file_is_the_default(algorithm, options, tmp_path):
    found = manager(algorithm, ENV_ID, str(tmp_path), **options).config
    assert Path(found) == hyperparameter_file(algorithm)


def test_everything_by_keyword(tmp_path):
    found = manager(algo="sac_flow", env_id=ENV_ID, log_folder=str(tmp_path)).config
    assert Path(found) == hyperparameter_file("sac_flow")


def test_the_users_file_wins(tmp_path):
    assert manager("sac_flow", ENV_ID, str(tmp_path), config="mine.yml").config == "mine.yml"


def test_other_algorithms_keep_rl_zoo3s_file(tmp_path):
    import rl_zoo3

    found = manager("sac", ENV_ID, str(tmp_path)).config
    assert Path(found).parent == Path(rl_zoo3.__file__).parent / "hyperparams"


def test_the_constructor_is_wrapped_once():
    from rl_zoo3.exp_manager import ExperimentManager

    assert not hasattr(ExperimentManager.__init__.__wrapped__, "__wrapped__")


def test_other_modules_are_left_alone():
    before = dict(vars(argparse))
    plug_in(argparse)
    assert vars(argparse) == before
