"""The state of rl_zoo3 after registration."""

import argparse
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rl_zoo3")

from sb3_flowpolicy import CrossQFlow, PPOFlow, SACFlow, TQCFlow
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

    classes = {"sac": SACFlow, "tqc": TQCFlow, "crossq": CrossQFlow, "ppo": PPOFlow}
    expected = {name: classes[name.partition("_")[0]] for name in ALGORITHMS}
    assert {name: ALGOS[name] for name in ALGORITHMS} == expected
    assert not {ALGOS[name] for name in classes} & set(classes.values())


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@pytest.mark.parametrize("options", [{}, {"config": None}])
def test_our_file_is_the_default(algorithm, options, tmp_path):
    found = manager(algorithm, ENV_ID, str(tmp_path), **options).config
    assert Path(found) == hyperparameter_file(algorithm)


@pytest.mark.parametrize("algorithm", ["tqc_flow", "crossq_flow", "ppo_flow", "ppo_lowrank"])
@pytest.mark.parametrize("env_id", [ENV_ID, "SquareMove-v0"])
def test_other_algorithms_train_and_load_by_their_files(algorithm, env_id, tmp_path):
    steps = 512 if "ppo" in algorithm else 120
    few = {"learning_starts": 100, "buffer_size": 1000} if "ppo" not in algorithm else {}
    run = manager(
        algorithm, env_id, str(tmp_path), n_timesteps=steps, hyperparams=few, log_interval=4
    )
    model, _ = run.setup_experiment()
    run.learn(model)
    run.save_trained_model(model)
    assert model._n_updates > 0
    loaded = type(model).load(Path(run.save_path, f"{env_id}.zip"), device="cpu")
    obs = np.random.default_rng(0).uniform(-1, 1, model.observation_space.shape).astype(np.float32)
    np.testing.assert_array_equal(
        *(one.predict(obs, deterministic=True)[0] for one in (model, loaded))
    )


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
