"""Optuna: sampled values, kept values, and the way from a trial back to arguments."""

import pytest

from sb3_flowpolicy.zoo.samplers import CONVERTERS, FLOW_HIDDEN, SAMPLERS

pytest.importorskip("rl_zoo3")
optuna = pytest.importorskip("optuna")

CONFIGURED = {
    "net_arch": [7],
    "optimizer_kwargs": {"weight_decay": 2.5e-5},
    "distribution_kwargs": {"init": "identity", "hidden": [4, 4]},
}
ADDITIONAL = {"using_her_replay_buffer": False, "her_kwargs": {}}


@pytest.fixture
def study():
    """A study as rl_zoo3 creates it, with the configured values as text."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    study.set_user_attr("policy_kwargs", str(CONFIGURED))
    return study


def sample(algorithm, study, n_actions=2):
    trial = study.ask()
    return trial, SAMPLERS[algorithm](trial, n_actions, 1, dict(ADDITIONAL))


@pytest.mark.parametrize("algorithm", SAMPLERS)
def test_a_trial_turns_back_into_what_was_sampled(algorithm, study):
    for _ in range(5):
        trial, sampled = sample(algorithm, study)
        assert CONVERTERS[algorithm](study.trials[trial.number].params) == sampled


@pytest.mark.parametrize("algorithm", SAMPLERS)
def test_configured_values_that_are_not_tuned_are_kept(algorithm, study):
    _, sampled = sample(algorithm, study)
    policy_kwargs = sampled["policy_kwargs"]
    assert policy_kwargs["optimizer_kwargs"] == {"weight_decay": 2.5e-5}
    assert policy_kwargs["distribution_kwargs"]["init"] == "identity"
    assert policy_kwargs["net_arch"] != [7]


def test_flow_shapes(study):
    sampled = [sample("sac_flow", study)[1]["policy_kwargs"] for _ in range(40)]
    shapes = [policy_kwargs["distribution_kwargs"] for policy_kwargs in sampled]
    assert {shape["layers"] for shape in shapes} == {2, 4, 6}
    assert all(shape["hidden"] in FLOW_HIDDEN.values() for shape in shapes)


@pytest.mark.parametrize(("n_actions", "ranks"), [(1, {1}), (2, {1, 2}), (8, {1, 2, 3, 4})])
def test_ranks(study, n_actions, ranks):
    seen = [sample("sac_lowrank", study, n_actions)[1] for _ in range(40)]
    assert {s["policy_kwargs"]["distribution_kwargs"]["rank"] for s in seen} == ranks


def test_nothing_beyond_rl_zoo3s_space_for_the_gaussian():
    study = optuna.create_study()
    _, sampled = sample("sac_gauss", study)
    assert set(sampled["policy_kwargs"]) == {"net_arch"}


def test_values_that_are_not_plain_cannot_be_kept(study):
    study.set_user_attr("policy_kwargs", "{'activation_fn': <class 'torch.nn.ReLU'>}")
    with pytest.warns(UserWarning, match="policy_kwargs must be plain"):
        _, sampled = sample("sac_gauss", study)
    assert set(sampled["policy_kwargs"]) == {"net_arch"}
