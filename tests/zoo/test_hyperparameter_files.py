"""The YAML files: complete, readable by rl_zoo3, and a fair comparison of policies."""

from copy import deepcopy

import pytest
import yaml

from flowpolicy_envs.registration import SQUARE_IDS, TUNNEL_IDS
from sb3_flowpolicy.zoo import ALGORITHMS, hyperparameter_file

SAC = {"sac_flow": "FlowPolicy", "sac_lowrank": "LowRankPolicy", "sac_gauss": "GaussPolicy"}
PPO = {"ppo_flow": "FlowPolicy", "ppo_lowrank": "LowRankPolicy"}
POLICIES = {**SAC, **PPO, "tqc_flow": "FlowPolicy", "crossq_flow": "FlowPolicy"}
SHARED_FROM = "# ---- From here on the"
SMALL = ("TunnelDiagonal-v0", "TunnelHorizontal-v0")
BULLET = ("Walker2DBulletEnv-v0", "AntBulletEnv-v0")


def blocks(algorithm):
    content = yaml.safe_load(hyperparameter_file(algorithm).read_text())
    # Blocks share objects where the file uses anchors.
    return {name: deepcopy(block) for name, block in content.items() if name[0] != "."}


@pytest.mark.parametrize("algorithms", [SAC, PPO])
def test_the_files_are_the_same_below_the_line(algorithms):
    parts = [hyperparameter_file(name).read_text().partition(SHARED_FROM) for name in algorithms]
    assert all(line and below for _, line, below in parts)
    assert len({below for _, _, below in parts}) == 1


def test_blocks_differ_in_the_policy_and_the_small_networks_alone():
    files = {name: blocks(name) for name in SAC}
    for block in (block for file in files.values() for block in file.values()):
        del block["policy"]
    small_networks = ("net_arch", "distribution_kwargs")
    for env_id, flow in files["sac_flow"].items():
        assert files["sac_lowrank"][env_id] == files["sac_gauss"][env_id]
        gauss = files["sac_gauss"][env_id]
        if env_id in SMALL:
            for kwargs in (flow["policy_kwargs"], gauss["policy_kwargs"]):
                for key in small_networks:
                    kwargs.pop(key, None)
        assert flow == gauss


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_block_is_ready_to_run(algorithm):
    for env_id, block in blocks(algorithm).items():
        assert block["policy"] == POLICIES[algorithm], env_id
        assert isinstance(block["n_timesteps"], int), env_id
        # PyYAML reads 3e-4, without a point, as text; rl_zoo3 reads text as a schedule.
        text = {key for key, value in block.items() if isinstance(value, str)}
        schedules = {key for key in text if block[key].startswith("lin_")}
        assert text - schedules <= {"policy", "policy_kwargs", "ent_coef", "callback"}, env_id


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_environment_of_ours_has_a_block(algorithm):
    assert {*TUNNEL_IDS, *SQUARE_IDS, *BULLET} <= set(blocks(algorithm))


def test_small_networks_of_section_3_2_4():
    for env_id in SMALL:
        flow = blocks("sac_flow")[env_id]
        assert flow["ent_coef"] == 2.5e-3
        assert flow["policy_kwargs"] == {
            "net_arch": {"pi": [4, 4], "qf": [16, 16]},
            "distribution_kwargs": {"hidden": [4, 4]},
            "optimizer_kwargs": {"weight_decay": 2.5e-5},
        }
        assert blocks("sac_gauss")[env_id]["policy_kwargs"] == {
            "net_arch": [16, 16],
            "optimizer_kwargs": {"weight_decay": 2.5e-5},
        }


@pytest.mark.parametrize("algorithm", SAC)
@pytest.mark.parametrize("env_id", BULLET)
def test_table_3_1(algorithm, env_id):
    block = blocks(algorithm)[env_id]
    block.pop("callback", None)
    assert block == {
        "policy": POLICIES[algorithm],
        "n_timesteps": 1_000_000,
        "policy_kwargs": {"net_arch": [256, 256], "optimizer_kwargs": {"weight_decay": 2.5e-4}},
        "gamma": 0.98,
        "tau": 0.01,
        "learning_rate": 3e-4,
        "ent_coef": "auto",
        "batch_size": 256,
        "train_freq": 256,
        "gradient_steps": 256,
        "buffer_size": 10**6,
        "learning_starts": 2000,
        "random_steps": 10**4,
        "critic_loss_coef": 1.0,
    }
