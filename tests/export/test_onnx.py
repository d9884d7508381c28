"""The file does what the model does, from raw observations to actions in the env's units."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import onnx
import onnxruntime
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.envs import SimpleMultiObsEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import flowpolicy_envs  # noqa: F401, registers the environments
from sb3_flowpolicy import CrossQFlow, FlowPolicy, SACFlow, TQCFlow, export_onnx
from sb3_flowpolicy.distributions import registered_distributions
from sb3_flowpolicy.export import onnx_export
from tests.bundle.conftest import FAST, NET

N = 1000


class Robot(gym.Env):
    """Large numbers in different units, actions of shape (2, 3) with bounds of their own."""

    action_space = spaces.Box(np.float32(0), np.arange(1, 7, dtype=np.float32).reshape(2, 3))

    def __init__(self, space: spaces.Space | None = None) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (4,)) if space is None else space

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
        super().reset(seed=seed)
        return self._obs(), {}

    def step(self, action: np.ndarray) -> tuple:
        return self._obs(), float(-action.sum()), False, self.np_random.random() < 0.1, {}

    def _obs(self) -> Any:
        if isinstance(self.observation_space, spaces.Dict):
            return {k: draw(self.np_random, 1)[0] for k in self.observation_space.spaces}
        return draw(self.np_random, 1)[0]


def draw(rng: np.random.Generator, n: int) -> np.ndarray:
    """Some of it far outside of what a clip at 1.5 lets pass."""
    return (rng.standard_normal((n, 4)) * [1, 100, 1e-3, 3] + [0, 5000, 0, -2]).astype(np.float32)


DICT = spaces.Dict({name: spaces.Box(-np.inf, np.inf, (4,)) for name in ("arm", "eye")})


def trained(policy: str, **kwargs: Any) -> SACFlow:
    env = DummyVecEnv([lambda: Robot(DICT if policy.startswith("Multi") else None)])
    model = SACFlow(
        policy, VecNormalize(env, clip_obs=1.5), **FAST, **{"policy_kwargs": NET, **kwargs}
    )
    model.learn(60)
    # A flow starts as the identity, whose deterministic action hardly depends on anything.
    with th.no_grad():
        for parameter in model.actor.density.parameters():  # type: ignore[operator]
            parameter.add_(0.3 * th.randn(parameter.shape))
    return model


def run(path: Path, outputs: list[str], feed: dict[str, np.ndarray]) -> list[np.ndarray]:
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    return session.run(outputs, feed)


@pytest.mark.filterwarnings("ignore:training runs the stock loop")
@pytest.mark.parametrize(
    ("kind", "form"),
    [
        ("Gauss", ""),
        ("LowRank", ""),
        ("Flow", "MultiInput"),
        # Densities that have no policy class of their own.
        ("lattice", ""),
        ("spline", ""),
    ],
)
def test_actions_are_those_of_predict(kind: str, form: str, tmp_path: Path) -> None:
    """Deterministic actions, and samples given the noise that torch draws, of 1000 observations."""
    if kind in registered_distributions():
        policy_kwargs = {**NET, "distribution": kind}
        if kind == "spline":
            policy_kwargs["distribution_kwargs"] = {"layers": 2}  # exporting a layer takes long
        model = trained("FlowPolicy", policy_kwargs=policy_kwargs)
    else:
        model = trained(f"{form}{kind}Policy")
    path = export_onnx(model, tmp_path / "policy", stochastic=True)
    rng = np.random.default_rng(0)
    obs: Any = {key: draw(rng, N) for key in DICT} if form else draw(rng, N)
    env = model.get_vec_normalize_env()
    assert env is not None
    normalized = env.normalize_obs(obs)
    th.manual_seed(3)
    noise = th.randn(N, model.actor.density.noise_dim).numpy()  # type: ignore[operator]
    feed = {**(obs if form else {"obs": obs}), "noise": noise}
    action, sampled = run(path, ["action", "sampled_action"], feed)
    assert action.shape == (N, 2, 3)
    assert action.dtype == np.float32
    # Where a spline is steep, it makes more of float32's rounding: here, relative to the range.
    atol = 6 * onnx_export.TOLERANCE if kind == "spline" else 1e-5
    expected = model.predict(normalized, deterministic=True)[0]
    np.testing.assert_allclose(action, expected, rtol=0, atol=atol)
    th.manual_seed(3)
    np.testing.assert_allclose(sampled, model.predict(normalized)[0], rtol=0, atol=atol)
    # Every part has a say, or the comparison would prove little.
    assert np.abs(expected.std(0)).min() > 1e-3
    assert np.abs(sampled - action).max() > 1e-2


def test_without_noise_unless_asked_for(tmp_path: Path) -> None:
    """Plain SAC, no statistics, a density without a policy class of its own; one of a batch."""
    kwargs = {**NET, "distribution": "full_covariance"}
    model = SAC(FlowPolicy, Robot(), policy_kwargs=kwargs, **FAST)
    path = export_onnx(model, tmp_path / "folder" / "policy.onnx")
    session = onnxruntime.InferenceSession(path)
    assert [one.name for one in session.get_inputs()] == ["obs"]
    for n in (1, 5):
        obs = draw(np.random.default_rng(1), n) / 5000
        (action,) = session.run(None, {"obs": obs})
        np.testing.assert_allclose(action, model.predict(obs, deterministic=True)[0], atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(5),
        spaces.MultiDiscrete([3, 4]),
        spaces.MultiBinary(5),
        spaces.Box(-1, 1, (2, 2), np.float64),
        SimpleMultiObsEnv().observation_space,
    ],
    ids=["Discrete", "MultiDiscrete", "MultiBinary", "float64", "image and vector"],
)
def test_other_observations(space: spaces.Space, tmp_path: Path) -> None:
    """The export compares 64 observations with ``predict``, and would raise."""
    policy = "MultiInputFlowPolicy" if isinstance(space, spaces.Dict) else "FlowPolicy"
    model = SACFlow(policy, Robot(space), policy_kwargs=NET, **FAST)
    assert export_onnx(model, tmp_path / "policy", stochastic=True).is_file()


def test_the_file_says_what_it_is(tmp_path: Path) -> None:
    model = SACFlow("GaussPolicy", Robot(), policy_kwargs=NET, **FAST)
    path = export_onnx(model, tmp_path / "policy", stochastic=True)
    proto = onnx.load(path)
    onnx.checker.check_model(proto, full_check=True)
    facts = {entry.key: entry.value for entry in proto.metadata_props}
    assert facts["format"] == "sb3_flowpolicy.onnx.1"
    assert (facts["policy"], facts["distribution"]) == ("GaussPolicy", "gaussian")
    assert json.loads(facts["observation_space"])["low"] == "-inf"
    assert json.loads(facts["action_space"])["high"] == [[1, 2, 3], [4, 5, 6]]
    assert json.loads(facts["noise"])["shape"] == ["batch", 6]
    assert json.loads(facts["made_with"])["torch"] == th.__version__
    # Where the exporter found each operation does not matter.
    assert b"site-packages" not in path.read_bytes()
    assert b".py" not in path.read_bytes()


def test_the_model_is_left_as_it_was(tmp_path: Path) -> None:
    model = SACFlow("GaussPolicy", "Pendulum-v1", policy_kwargs=NET, **FAST).learn(20)
    before = [parameter.data_ptr() for parameter in model.policy.parameters()]
    state = th.get_rng_state()
    export_onnx(model, tmp_path / "policy")
    assert [parameter.data_ptr() for parameter in model.policy.parameters()] == before
    assert th.equal(th.get_rng_state(), state)


def test_refusals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    choosy = SACFlow("FlowPolicy", "Pendulum-v1", policy_kwargs={"deterministic_mode": "q"})
    with pytest.raises(ValueError, match="got FlowPolicy with deterministic_mode='q'"):
        export_onnx(choosy, tmp_path / "choosy")
    with pytest.raises(ValueError, match="use_sde=False, got SACPolicy"):
        export_onnx(SAC("MlpPolicy", "Pendulum-v1", **FAST), tmp_path / "x")
    sde = SACFlow("GaussPolicy", "Pendulum-v1", use_sde=True, **FAST)
    with pytest.raises(ValueError, match=r"use_sde=False, got GaussPolicy .* an actor of type Act"):
        export_onnx(sde, tmp_path / "x")
    named = spaces.Dict({"noise": spaces.Box(-1, 1, (4,))})
    model = SACFlow("MultiInputGaussPolicy", Robot(named), policy_kwargs=NET, **FAST)
    with pytest.raises(ValueError, match="Input names cannot be duplicated"):
        export_onnx(model, tmp_path / "x", stochastic=True)
    # A file that acts otherwise gets no name.
    model = SACFlow("GaussPolicy", "Pendulum-v1", policy_kwargs=NET, **FAST)
    actual = onnx_export.expected_actions
    monkeypatch.setattr(
        onnx_export, "expected_actions", lambda *args: [a + 1e-3 for a in actual(*args)]
    )
    with pytest.raises(
        RuntimeError, match="action of the ONNX file must equal the model's to 1e-05"
    ):
        export_onnx(model, tmp_path / "x")
    assert not list(tmp_path.iterdir())


WITHOUT_TORCH = """
import runpy, sys
for name in ("torch", "stable_baselines3", "sb3_flowpolicy"):
    sys.modules[name] = None  # importing it raises
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def test_the_example_runs_without_torch(tmp_path: Path) -> None:
    example = Path(__file__).parents[2] / "docs" / "examples" / "run_onnx.py"
    model = SACFlow("GaussPolicy", "TunnelDiagonal-v0", policy_kwargs=NET, **FAST)
    path = export_onnx(model, tmp_path / "tunnel", stochastic=True)
    command = [sys.executable, "-c", WITHOUT_TORCH, str(example), str(path), "--episodes", "2"]
    for options in ([], ["--sample"]):
        result = subprocess.run([*command, *options], capture_output=True, text=True, check=True)
        assert "TunnelDiagonal-v0: success" in result.stdout


@pytest.mark.parametrize("algorithm", [TQCFlow, CrossQFlow])
def test_other_off_policy_algorithms(algorithm: Any, tmp_path: Path) -> None:
    model = algorithm("FlowPolicy", "Pendulum-v1", policy_kwargs=NET, **FAST)
    assert export_onnx(model, tmp_path / "policy").is_file()
