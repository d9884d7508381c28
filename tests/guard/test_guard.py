"""Experience with NaN is rejected; a run stops where training produces NaN, and says where."""

from __future__ import annotations

import re
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_flowpolicy import CrossQFlow, NonFiniteError, SACFlow, SeedBatch
from sb3_flowpolicy.guard.finite import all_finite
from sb3_flowpolicy.guard.training_guard import TrainingGuard
from tests.engine.test_equality import everything

FAST: dict[str, Any] = {
    "learning_starts": 10,
    "buffer_size": 200,
    "batch_size": 16,
    "device": "cpu",
    "policy_kwargs": {"net_arch": [16, 16]},
}
SEEDED = {**FAST, "seed": 0}


class Faulty(gym.Env):
    """Hands out something wrong at one step, counted from 1; step 0 is the reset."""

    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, what: str, value: float, at: int = 20, dictionary: bool = False) -> None:
        self.what, self.value, self.at, self.dictionary = what, value, at, dictionary
        box = spaces.Box(-np.inf, np.inf, (3,), np.float32)
        self.observation_space: spaces.Space = spaces.Dict(camera=box) if dictionary else box
        self.count = 0

    def _observe(self, spoilt: bool) -> Any:
        obs = self.np_random.normal(size=3).astype(np.float32)
        obs[1] = self.value if spoilt else obs[1]
        return {"camera": obs} if self.dictionary else obs

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        super().reset(seed=seed)
        return self._observe(self.what == "reset"), {}

    def step(self, action: np.ndarray) -> tuple:
        self.count += 1
        now = self.count == self.at
        reward = self.value if now and self.what == "rewards" else 1.0
        ends = now and self.what == "final"
        return (
            self._observe(now and self.what in ("observations", "final")),
            reward,
            ends,
            False,
            {},
        )


def size(model: SACFlow) -> int:
    assert model.replay_buffer is not None
    return model.replay_buffer.size()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("rewards", "rewards must be finite in float32, got {} from environment 0 at step 20"),
        ("observations", r"observations .* got {} from environment 0 at step 20, index \(0, 1\)"),
        ("final", r"final observations .* got {} from environment 0 at step 20, index \(1,\);"),
    ],
)
def test_experience_is_checked(what: str, message: str, value: float) -> None:
    model = SACFlow("FlowPolicy", Faulty(what, value), compile=False, **SEEDED)
    with pytest.raises(NonFiniteError, match=message.format(value)):
        model.learn(50)
    assert size(model) == 19
    assert all_finite(model.policy.parameters_to_vector())


def test_the_first_observation_counts() -> None:
    with pytest.raises(NonFiniteError, match=r"observations must be finite .* at step 0"):
        SACFlow("FlowPolicy", Faulty("reset", np.nan), **SEEDED).learn(5)
    # Each agent has two environments, of which the batch steps the second.
    values = iter([0.0, np.nan])
    batch = SeedBatch("FlowPolicy", lambda: Faulty("reset", next(values)), [4], **FAST)
    with pytest.raises(
        NonFiniteError, match=r"observations .* from seed 4 at step 0, index \(0, 1\)"
    ):
        batch.learn(5)


@pytest.mark.filterwarnings("ignore:overflow encountered in cast")
def test_a_reward_too_large_for_float32_is_infinite() -> None:
    with pytest.raises(NonFiniteError, match="rewards must be finite in float32, got inf"):
        SACFlow("GaussPolicy", Faulty("rewards", 1e300), compile=False, **SEEDED).learn(30)


def test_the_environment_of_several_is_named() -> None:
    env = DummyVecEnv([lambda: Faulty("rewards", np.nan, 99), lambda: Faulty("rewards", np.nan)])
    model = SACFlow("GaussPolicy", env, compile=False, **SEEDED)
    with pytest.raises(NonFiniteError, match="got nan from environment 1 at step 40"):
        model.learn(60)


def test_dictionaries_are_looked_through() -> None:
    env = Faulty("observations", np.inf, dictionary=True)
    model = SACFlow("MultiInputGaussPolicy", env, **SEEDED)
    message = r"observations\['camera'\] must be .* got inf from environment 0 at step 20"
    with pytest.raises(NonFiniteError, match=message):
        model.learn(50)


@pytest.mark.parametrize("what", ["rewards", "observations"])
def test_vec_normalize_does_not_hide_infinity(what: str) -> None:
    env = VecNormalize(DummyVecEnv([lambda: Faulty(what, np.inf)]))
    with (
        pytest.raises(NonFiniteError, match=f"{what} must be finite in float32, got inf"),
        np.errstate(invalid="ignore"),
    ):
        SACFlow("GaussPolicy", env, compile=False, **SEEDED).learn(50)


@pytest.mark.parametrize("what", ["rewards", "observations", "final"])
def test_seed_batch_names_the_seed(what: str) -> None:
    made: list[Faulty] = []

    def make() -> gym.Env:
        # The agents take the first two, their own; those that are stepped come after.
        made.append(Faulty(what, np.nan, at=20 if len(made) == 3 else 10**9))
        return made[-1]

    batch = SeedBatch("FlowPolicy", make, [5, 8], compile=False, **FAST)
    with pytest.raises(NonFiniteError, match=r"got nan from seed 8.* at step 20"):
        batch.learn(50)
    for model in batch.models:
        assert size(model) == 19
        assert np.isfinite(model.predict(np.zeros(3, np.float32))[0]).all()


@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nothing_is_predicted_for_what_is_not_finite(value: float, deterministic: bool) -> None:
    model = SACFlow("FlowPolicy", "Pendulum-v1", **SEEDED)
    # A unit that infinity switches off: no action would tell.
    with th.no_grad():
        model.actor.latent_pi[0].weight[:] = -1.0
    obs = np.array([[0, 0, 0], [0, 0, value]], dtype=np.float32)
    message = rf"observation must be finite in float32, got {value} at index \(1, 2\)"
    with pytest.raises(ValueError, match=message):
        model.predict(obs, deterministic=deterministic)


def trained(policy: str = "FlowPolicy", **settings: Any) -> SACFlow:
    model = SACFlow(policy, "Pendulum-v1", compile=False, **{**SEEDED, **settings})
    return model.learn(60)


def spoil(model: SACFlow, column: str, row: int, value: float) -> None:
    assert model.replay_buffer is not None
    getattr(model.replay_buffer, column)[row] = value


@pytest.mark.parametrize("optimizer", [th.optim.Adam, th.optim.SGD], ids=["engine", "SB3's loop"])
@pytest.mark.parametrize(
    ("column", "value", "loss"),
    [
        ("rewards", np.nan, "critic_loss"),
        ("rewards", 1e30, "critic_loss"),
        ("observations", np.nan, "ent_coef_loss"),
        ("actions", -np.inf, "critic_loss"),
    ],
)
@pytest.mark.filterwarnings("ignore:training runs the stock loop")
def test_training_stops_and_goes_back(
    column: str, value: float, loss: str, optimizer: type[th.optim.Optimizer]
) -> None:
    kwargs = {"net_arch": [16, 16], "optimizer_class": optimizer}
    model = trained(policy_kwargs=kwargs)
    before, updates = everything(model), model._n_updates
    model._guard.restart()  # as learn() does
    spoil(model, column, slice(None), value)  # type: ignore[arg-type]
    if optimizer is th.optim.SGD:  # SB3 tells means over all updates, of which each may be first
        loss = "critic_loss"
    with pytest.raises(NonFiniteError, match=rf"{loss} must be finite, got .*step 60") as caught:
        model.train(3, batch_size=16)
    error = str(caught.value)
    assert model._n_updates == updates
    assert f"back at update {updates}" in error
    th.testing.assert_close(everything(model), before, rtol=0, atol=0)
    look_at = "values not finite, the first in row" if not np.isfinite(value) else "extreme in row"
    assert re.search(f"{column} [^;]*{look_at}", error)
    # The model is of use again once the data are.
    spoil(model, column, slice(None), 0.5)  # type: ignore[arg-type]
    model.train(3, batch_size=16)
    assert model._n_updates == updates + 3
    model.predict(np.zeros(3, np.float32))


@pytest.mark.filterwarnings("ignore:training runs the stock loop")
def test_a_buffer_without_next_observations_is_described() -> None:
    kwargs = {"net_arch": [16, 16], "optimizer_class": th.optim.SGD}
    options = {"handle_timeout_termination": False}
    model = trained(policy_kwargs=kwargs, optimize_memory_usage=True, replay_buffer_kwargs=options)
    spoil(model, "rewards", slice(None), np.nan)  # type: ignore[arg-type]
    with pytest.raises(NonFiniteError, match=r"critic_loss must be finite.*rewards"):
        model.train(3, batch_size=16)


def test_crossq_goes_back_with_its_running_statistics() -> None:
    """Their counts of steps are integers."""
    model = CrossQFlow("GaussPolicy", "Pendulum-v1", compile=False, **SEEDED).learn(60)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    assert before["critic.qf0.0.steps"] > 0
    model._guard.restart()
    model.train(3, batch_size=16)
    assert model.replay_buffer is not None
    model.replay_buffer.rewards[:] = np.nan
    with pytest.raises(NonFiniteError, match=r"critic_loss must be finite"):
        model.train(3, batch_size=16)
    th.testing.assert_close(dict(model.policy.state_dict()), before, rtol=0, atol=0)


def test_the_update_and_the_row_are_named() -> None:
    """One bad transition among 60: which of 40 updates drew it first, and where in it?"""
    model = trained()
    spoil(model, "rewards", 33, np.nan)
    np.random.seed(5)  # noqa: NPY002 (SB3's buffers draw from the global state)
    drawn = np.random.randint(0, 60, size=(40, 16))  # noqa: NPY002
    update, row = np.argwhere(drawn == 33)[0]
    assert update > 0
    np.random.seed(5)  # noqa: NPY002
    first = model._n_updates
    count = (drawn[update] == 33).sum()
    message = (
        f"in update {first + update + 1}; minibatch: observations [^;]*; actions [^;]*; rewards "
        f"[^;]* and {count} values not finite, the first in row {row}; next_observations"
    )
    with pytest.raises(NonFiniteError, match=message) as caught:
        model.train(40, batch_size=16)
    assert str(caught.value).count("not finite") == 1


@pytest.mark.parametrize("where", ["parameter", "moment", "temperature"])
def test_learn_does_not_end_with_a_hidden_infinity(where: str) -> None:
    """Neither a relu's dead unit nor a dead optimizer shows in any loss."""
    model = trained(learning_starts=1000)  # no updates: nothing but the guard would notice
    if where == "parameter":
        model.critic.qf0[0].bias.data[3] = -np.inf
        name = "critic.qf0.0.bias"
    elif where == "moment":
        bias = model.actor.optimizer.param_groups[0]["params"][1]
        model.actor.optimizer.state[bias]["exp_avg_sq"] = th.full_like(bias, np.inf)
        name = "actor.optimizer.1.exp_avg_sq"
    else:
        assert model.log_ent_coef is not None
        model.log_ent_coef.data.fill_(-np.inf)
        name = "log_ent_coef"
    with pytest.raises(NonFiniteError, match=rf"{name} must be finite, got -?inf .*0 updates"):
        model.learn(5, reset_num_timesteps=False)


def test_checkpoints_are_mentioned_where_there_are_some() -> None:
    model = trained()
    spoil(model, "rewards", slice(None), np.nan)  # type: ignore[arg-type]
    with pytest.raises(NonFiniteError) as caught:
        model.train(1, batch_size=16)
    assert "resume" not in str(caught.value)
    model._guard.restart("runs/tunnel")
    with pytest.raises(NonFiniteError, match=r"resume\('runs/tunnel', env\) continues from"):
        model.train(1, batch_size=16)


def test_parameters_are_looked_at_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    looks = []
    look = TrainingGuard.look
    monkeypatch.setattr(
        TrainingGuard, "look", lambda guard: looks.append(guard.models[0]._n_updates) or look(guard)
    )
    monkeypatch.setattr("sb3_flowpolicy.guard.training_guard.UPDATES_BETWEEN_LOOKS", 20)
    trained()
    assert looks == [0, 20, 40, 50]  # and at the end


def test_seed_batch_names_the_agent_and_takes_all_back() -> None:
    batch = SeedBatch("FlowPolicy", "Pendulum-v1", [3, 9, 7], compile=False, **FAST).learn(40)
    before = [everything(model) for model in batch.models]
    spoil(batch.models[1], "rewards", slice(0, 40), np.nan)  # type: ignore[arg-type]
    message = r"critic_loss .* \(seed 9, step 4\d\) in update 3[12]; .* back at update 30\."
    with pytest.raises(NonFiniteError, match=message):
        batch.learn(30, reset_num_timesteps=False)
    for model, expected in zip(batch.models, before, strict=True):
        th.testing.assert_close(everything(model), expected, rtol=0, atol=0)
        assert model._n_updates == 30
    spoil(batch.models[1], "rewards", slice(None), 0.0)  # type: ignore[arg-type]
    batch.learn(5, reset_num_timesteps=False)


@pytest.mark.parametrize(
    ("values", "finite"),
    [
        (np.array([1.0, 3e38]), True),
        (np.array([1.0, 4e38]), False),
        (np.full(3, 1e30, np.float32), True),
        (np.full(3, 300, np.float16), True),
        (np.array(0.5), True),
        (np.zeros((0, 3)), True),
        (np.array([1, 2**60]), True),
        (np.array([-np.inf], np.float16), False),
        (np.full((2, 2), np.nan, np.float32).T, False),
    ],
)
def test_finite_means_as_float32(values: np.ndarray, finite: bool) -> None:
    assert all_finite(values) is finite


def test_demonstrations_must_fit_into_float32() -> None:
    from tests.algorithms.test_sac_flow import demos

    rows = {**demos(), "rewards": np.full(40, 1e300)}
    with pytest.raises(ValueError, match=r"demonstrations must be finite, .* in rewards"):
        SACFlow("FlowPolicy", "Pendulum-v1", demonstrations=rows, **SEEDED)


def test_logger_of_a_run_without_updates_is_not_looked_at() -> None:
    """SB3's loop records nothing of a fixed entropy coefficient."""
    kwargs = {"net_arch": [8], "optimizer_class": th.optim.SGD}
    env = make_vec_env("Pendulum-v1")
    model = SACFlow("GaussPolicy", env, ent_coef=0.1, **{**SEEDED, "policy_kwargs": kwargs})
    model.set_logger(configure(None, []))
    with pytest.warns(UserWarning, match="the stock loop"):
        model.learn(15)
    assert model._n_updates == 5
