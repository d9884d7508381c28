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
import safetensors.numpy

from sb3_flowpolicy import BundleError, SACFlow
from sb3_flowpolicy.bundle.container import MAX_HEADER_BYTES
from tests.bundle.conftest import make_model, parts_of, sealed
from tests.bundle.mutations import Evil

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
    "later version": (setting("format", 2), r"format must be 1, got 2: is it a newer file"),
    "unknown key": (setting("extra", 1), "extra.* must be as save_safe writes"),
    "unknown setting": (setting("settings.x", 1), "settings.* must be as save_safe writes"),
    "missing key": (lambda c, a: c["settings"].pop("tau"), "KeyError: 'tau'"),
    "no object": (setting("progress", 3), "TypeError: 'int' object is not subscriptable"),
    "class by path": (setting("policy.policy_class", "os.system"), r"one of .* got 'os\.system'"),
    "activation": (setting("policy.activation_fn", "exec"), "activation_fn must be one of"),
    "unknown argument": (setting("policy.x", 1), "unexpected keyword argument 'x'"),
    "gSDE": (setting("policy.use_sde", True), "use_sde must be False"),
    "density": (setting("policy.distribution", "x"), "distribution must be one of"),
    "absurd size": (setting("policy.net_arch", [10**9]), r"must be .* of shape \(1000000000"),
    "absurd depth": (
        setting("policy.distribution_kwargs", {"layers": 10**9}),
        "no more parameters than the .* arrays",
    ),
    "absurd number": (setting("policy.n_critics", 10**9), "no more parameters than"),
    "no space": (
        setting("action_space", {"type": "Tuple"}),
        "action_space must be a Box or a Dict",
    ),
    "bounds": (
        array("action_space.low", lambda low: low + 9),
        "less than or equal to high",
    ),
    "infinite actions": (
        array("action_space.high", lambda high: high * np.inf),
        "action_space must be a Box with finite bounds",
    ),
    "shape": (array(WEIGHT, lambda weight: weight.T), rf"{WEIGHT} must be torch.float32 of shape"),
    "type": (array(WEIGHT, lambda weight: weight.astype("f8")), rf"{WEIGHT} must be torch.float32"),
    "NaN": (array(WEIGHT, lambda weight: weight * np.nan), rf"NaN or infinity in {WEIGHT}"),
    "missing array": (lambda c, a: a.pop(WEIGHT), rf"KeyError: '{WEIGHT}'"),
    "unknown array": (lambda c, a: a.update(x=np.ones(3)), r"\['x'\] must be as save_safe writes"),
    "schedule": (setting("settings.learning_rate", {"schedule": "code"}), "KeyError: 'start'"),
    "rate": (setting("settings.learning_rate", -1.0), "learning_rate must be at least 0, got -1"),
    "setting": (setting("settings.gamma", "high"), "gamma must be a number, got 'high'"),
    "seed": (setting("settings.seed", 2**40), "seed must be None or an integer"),
    "undecided": (setting("settings.target_entropy", "auto"), "target_entropy must be a number"),
    "progress": (setting("progress.num_timesteps", -1), "num_timesteps must be an integer"),
    "buffer": (setting("replay_buffer.class", "dict"), "replay_buffer_class must be one of"),
    "betas": (setting("optimizers.actor.betas", [0.9, 1.5]), "Invalid beta parameter at index 1"),
    "number of betas": (setting("optimizers.actor.betas", [0.9] * 3), "too many values to unpack"),
    "type of betas": (setting("optimizers.actor.betas", ["0.9", 0.9]), "TypeError: .*'str'"),
    "optimizer": (lambda c, a: c["optimizers"].pop("actor"), "KeyError: 'actor'"),
    "optimizer's setting": (setting("optimizers.actor.x", 1), "unexpected keyword argument 'x'"),
    "half the moments": (
        lambda c, a: a.pop("optimizer.actor.0.exp_avg"),
        "KeyError: 'optimizer.actor.0.exp_avg'",
    ),
    "shape of moments": (
        array("optimizer.actor.0.exp_avg", lambda moment: moment[:1]),
        "exp_avg must be torch.float32 of shape",
    ),
    "entropy coefficient": (
        array("log_ent_coef", lambda log: log * np.inf),
        "NaN or infinity in log_ent_coef",
    ),
    "shape of the entropy coefficient": (
        array("log_ent_coef", lambda log: log.reshape(())),
        r"log_ent_coef must be torch.float32 of shape \(1,\), got torch.float32 \(\)",
    ),
    "statistics": (setting("normalization.epsilon", 0), "epsilon must be above 0"),
    "variance": (array("normalization.0.var", lambda var: -var), "var must be at least 0"),
    "keys": (setting("normalization.keys", ["x"]), "is applicable only with `gym.spaces.Dict`"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refusals_name_file_expectation_and_value(case: str, tampered: Any) -> None:
    change, message = REFUSED[case]
    path = tampered(change)
    with pytest.raises(BundleError, match=rf"(?s){re.escape(str(path))} must be.*{message}"):
        SACFlow.load_safe(path, device="cpu")


def test_a_buffer_that_fits_no_memory_is_refused_where_one_is_needed(tampered: Any) -> None:
    path = tampered(setting("settings.buffer_size", 2**50))
    assert SACFlow.load_safe(path).predict(np.zeros(3))[0].shape == (1,)
    with pytest.raises(BundleError, match=r"must be a bundle .*MemoryError"):
        SACFlow.load_safe(path, env="Pendulum-v1")


def test_messages_about_damaged_files(bundle: Path, tmp_path: Path) -> None:
    content = bundle.read_bytes()
    path = tmp_path / "spoiled.safetensors"
    path.write_bytes(content[:-1])
    with pytest.raises(BundleError, match=r"save_safe: .*not fully covered"):
        SACFlow.load_safe(path)
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(BundleError, match="save_safe: content was altered, its checksum is"):
        SACFlow.load_safe(path)
    header, config, data = parts_of(content)
    header["x" * MAX_HEADER_BYTES] = {}
    path.write_bytes(sealed(header, config, data))
    with pytest.raises(BundleError, match=rf"a header of .* bytes, more than {MAX_HEADER_BYTES}"):
        SACFlow.load_safe(path)
    safetensors.numpy.save_file({"x": np.ones(3)}, path, {"format": "np"})
    with pytest.raises(BundleError, match="KeyError: 'sb3_flowpolicy'"):
        SACFlow.load_safe(path)


def test_pickles_are_not_opened_as_such(bundle: Path, tmp_path: Path) -> None:
    trace = tmp_path / "executed"
    poison = pickle.dumps(Evil(trace))
    path = tmp_path / "model.safetensors"
    for content in (poison, bundle.read_bytes() + poison, poison + bundle.read_bytes()):
        path.write_bytes(content)
        with pytest.raises(BundleError, match=re.escape(str(path))):
            SACFlow.load_safe(path)
    # The same inside a bundle with a valid checksum.
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
    with pytest.raises(BundleError, match="must be a bundle written by save_safe: a header of"):
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
    with pytest.raises(BundleError, match="not a regular file that exists"):
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

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match="no space left"):
        model.save_safe(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
