"""Each refusal on its own, with what it says."""

from __future__ import annotations

import os
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sb3_flowpolicy import BundleError, SACFlow
from sb3_flowpolicy.bundle.container import MAX_HEADER_BYTES
from tests.bundle.conftest import make_model, parts_of, sealed

Change = Callable[[Any, dict[str, np.ndarray]], None]


def setting(path: str, value: Any) -> Change:
    def change(config: Any, arrays: dict) -> None:
        *parents, last = path.split(".")
        for parent in parents:
            config = config[parent]
        config[last] = value

    return change


def array(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Change:
    def replace(config: Any, arrays: dict) -> None:
        arrays[name] = change(arrays[name])

    return replace


WEIGHT = "policy.actor.latent_pi.0.weight"
REFUSED: dict[str, tuple[Change, str]] = {
    "later version": (setting("format", 2), r"format must be 1, got 2: is it of a later version"),
    "unknown key": (setting("extra", 1), r"the settings: \[\] missing, \['extra'\] unknown"),
    "missing key": (lambda c, a: c["settings"].pop("tau"), r"settings: \['tau'\] missing"),
    "no object": (setting("progress", 3), "progress must be an object, got 3"),
    "class by path": (setting("policy", "os.system"), r"policy must be one of .* got 'os\.system'"),
    "activation": (setting("policy_kwargs.activation_fn", "exec"), "activation_fn must be one of"),
    "unknown argument": (setting("policy_kwargs.x", 1), "policy_kwargs must not have 'x'"),
    "gSDE": (setting("policy_kwargs.use_sde", True), "use_sde must be False"),
    "density": (setting("policy_kwargs.distribution", "x"), "distribution must be one of"),
    "absurd size": (
        setting("policy_kwargs.net_arch", [10**9]),
        r"must be .* of shape \(1000000000",
    ),
    "absurd depth": (
        setting("policy_kwargs.distribution_kwargs", {"layers": 10**9}),
        "more parameters than the .* arrays in the file",
    ),
    "absurd number": (setting("policy_kwargs.n_critics", 10**9), "more parameters than"),
    "absurd space": (
        setting("observation_space", {"type": "Discrete", "n": 2**31 - 1, "start": 0}),
        "normalization.0.mean must be",
    ),
    "no space": (setting("action_space", {"type": "Tuple"}), "action_space must describe a space"),
    "discrete actions": (
        setting("action_space", {"type": "Discrete", "n": 3, "start": 0}),
        "action_space must be a Box",
    ),
    "bounds": (
        array("action_space.low", lambda low: low + 9),
        "action_space must have low <= high",
    ),
    "infinite actions": (
        array("action_space.high", lambda high: high * np.inf),
        "action_space must be a Box with finite bounds",
    ),
    "shape": (array(WEIGHT, lambda weight: weight.T), rf"{WEIGHT} must be torch.float32 of shape"),
    "type": (array(WEIGHT, lambda weight: weight.astype("f8")), rf"{WEIGHT} must be torch.float32"),
    "NaN": (array(WEIGHT, lambda weight: weight * np.nan), rf"{WEIGHT} must be finite"),
    "missing array": (lambda c, a: a.pop(WEIGHT), rf"{WEIGHT} must be .*, got none"),
    "unknown array": (lambda c, a: a.update(x=np.ones(3)), r"must all belong .* \['x'\] besides"),
    "schedule": (setting("settings.learning_rate", {"schedule": "code"}), "learning_rate must be"),
    "rate": (setting("settings.learning_rate", -1.0), "learning_rate must be at least 0, got -1"),
    "setting": (setting("settings.gamma", "high"), "gamma must be a number, got 'high'"),
    "seed": (setting("settings.seed", 2**40), "seed must be an integer"),
    "undecided": (setting("settings.target_entropy", "auto"), "target_entropy must be a number"),
    "progress": (setting("progress.num_timesteps", -1), "num_timesteps must be an integer"),
    "buffer": (setting("replay_buffer.class", "dict"), "replay_buffer must be one of"),
    "unfit buffer": (setting("replay_buffer.class", "HerReplayBuffer"), "replay_buffer must fit"),
    "betas": (setting("optimizers.actor.betas", [0.9, 1.5]), "actor.betas must be below 1"),
    "optimiser": (lambda c, a: c["optimizers"].pop("actor"), r"optimizers: \['actor'\] missing"),
    "moments": (
        array("optimizer.actor.0.exp_avg_sq", lambda square: square - 1),
        "exp_avg_sq must be finite, at least 0",
    ),
    "half the moments": (
        lambda c, a: a.pop("optimizer.actor.0.exp_avg"),
        "optimizer.actor.0 must remember",
    ),
    "temperature": (array("temperature", lambda t: t * np.inf), "temperature must be finite"),
    "statistics": (setting("normalization.epsilon", 0), "epsilon must be above 0"),
    "variance": (array("normalization.0.var", lambda var: -var), "a variance and a count of"),
    "keys": (setting("normalization.keys", ["x"]), "normalization.keys must be among"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals_name_file_expectation_and_value(case: str, tampered: Any) -> None:
    change, message = REFUSED[case]
    path = tampered(change)
    with pytest.raises(BundleError, match=rf"(?s){re.escape(str(path))} must.*{message}"):
        SACFlow.load_safe(path, device="cpu")


def test_a_buffer_that_fits_no_memory_is_refused_where_one_is_needed(tampered: Any) -> None:
    path = tampered(setting("settings.buffer_size", 2**50))
    assert SACFlow.load_safe(path).predict(np.zeros(3))[0].shape == (1,)
    with pytest.raises(BundleError, match="must hold a model of SACFlow"):
        SACFlow.load_safe(path, env="Pendulum-v1")


def test_altered_and_cut_files_say_so(bundle: Path, tmp_path: Path) -> None:
    content = bundle.read_bytes()
    path = tmp_path / "spoiled.safetensors"
    path.write_bytes(content[:-1])
    with pytest.raises(BundleError, match=rf"must have {len(content)} bytes, .* was it cut off"):
        SACFlow.load_safe(path)
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(BundleError, match=r"must have the checksum .*: bytes were altered"):
        SACFlow.load_safe(path)
    header, config, data = parts_of(content)
    header["x" * MAX_HEADER_BYTES] = {}
    path.write_bytes(sealed(header, config, data))
    with pytest.raises(BundleError, match=rf"a header of at most .*{MAX_HEADER_BYTES} bytes, got"):
        SACFlow.load_safe(path)


class Evil:
    """Unpickling this writes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


def test_pickles_are_not_opened_as_such(bundle: Path, tmp_path: Path) -> None:
    trace = tmp_path / "executed"
    poison = pickle.dumps(Evil(trace))
    path = tmp_path / "model.safetensors"
    for content in (poison, bundle.read_bytes() + poison, poison + bundle.read_bytes()):
        path.write_bytes(content)
        with pytest.raises(BundleError, match=re.escape(str(path))):
            SACFlow.load_safe(path)
    # Inside a bundle whose checksum holds, too.
    header, config, data = parts_of(bundle.read_bytes())
    config["settings"]["learning_rate"] = poison.decode("latin-1")
    path.write_bytes(sealed(header, config, data))
    with pytest.raises(BundleError, match="learning_rate must be a number"):
        SACFlow.load_safe(path)
    assert not trace.exists()
    pickle.loads(poison)
    assert trace.exists()  # or the test would prove nothing


def test_zips_of_sb3_are_not_bundles(tmp_path: Path) -> None:
    make_model().save(tmp_path / "model.zip")
    with pytest.raises(
        BundleError, match=r"must be a bundle written by save_safe, but begins with"
    ):
        SACFlow.load_safe(tmp_path / "model.zip")


@pytest.mark.parametrize("kind", ["folder", "pipe", "null", "name with a zero"])
def test_only_regular_files_are_read(kind: str, tmp_path: Path) -> None:
    path = tmp_path / kind
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path = Path("/dev/null") if kind == "null" else Path("a\0b")
    with pytest.raises(BundleError, match=r"must be a (regular file|file that can be read)"):
        SACFlow.load_safe(path)


def test_an_interrupted_save_leaves_the_old_file(
    bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = make_model()
    path = model.save_safe(tmp_path / "model")
    before = path.read_bytes()
    model.num_timesteps = 77

    def full(*_: Any) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="no space left"):
        model.save_safe(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
