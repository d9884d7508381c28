"""Where torch cannot compile, training runs eagerly, with one warning and the same numbers."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_flowpolicy import SACFlow
from sb3_flowpolicy.engine.compiling import Compiled, Compiler

SMALL: dict[str, Any] = {
    "learning_starts": 20,
    "batch_size": 16,
    "buffer_size": 100,
    "seed": 0,
    "device": "cpu",
    "policy_kwargs": {"net_arch": [8]},
}
# Prints how many warnings spoke of running eagerly.
TRAIN = f"""
import sys, warnings, numpy as np, torch as th
th.set_num_threads(1)
from sb3_flowpolicy import SACFlow
warnings.simplefilter("always")
with warnings.catch_warnings(record=True) as caught:
    model = SACFlow("FlowPolicy", "Pendulum-v1", compile=True, **{SMALL}).learn(40)
print(sum("runs eagerly" in str(w.message) for w in caught))
np.save(sys.argv[1], model.policy.parameters_to_vector())
"""


def test_no_compiler(tmp_path: Path) -> None:
    hidden = {
        "PATH": str(tmp_path),  # no g++, no cc
        "CXX": "no-such-compiler",
        "CC": "no-such-compiler",
        "TORCHINDUCTOR_CACHE_DIR": str(tmp_path / "cache"),
    }
    output = subprocess.run(
        [sys.executable, "-c", TRAIN, str(tmp_path / "hidden.npy")],
        env={**os.environ, **hidden},
        capture_output=True,
        text=True,
        check=True,
    )
    assert output.stdout.split()[-1] == "1"
    eager = SACFlow("FlowPolicy", "Pendulum-v1", compile=False, **SMALL).learn(40)
    got = np.load(tmp_path / "hidden.npy")
    assert np.array_equal(got, eager.policy.parameters_to_vector())


@pytest.mark.parametrize(
    "missing", ["compiler.skip_all_guards_unsafe", "_dynamo.config.trace_autograd_ops", "option"]
)
def test_torch_lacks_a_feature(missing: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if missing == "option":
        options = {"cpp.of_another_version": True}
        monkeypatch.setattr("sb3_flowpolicy.engine.compiling._options", lambda device: options)
    elif missing.startswith("_dynamo"):
        monkeypatch.delitem(th._dynamo.config._config, "trace_autograd_ops")
    else:
        monkeypatch.delattr(f"torch.{missing}")
    x = th.linspace(-1, 1, 5)
    compiler = Compiler(th.device("cpu"))
    one, two = (
        Compiled(lambda x: (x.exp() * 3, x.sum()), f"test {k}", compiler) for k in ("one", "two")
    )
    with pytest.warns(RuntimeWarning, match="test one could not be compiled") as caught:
        results = [one("key", x), one("key", x), one("other", x[:2]), two("key", x)]
    assert len(caught) == 1
    for result, values in zip(results, (x, x, x[:2], x), strict=True):
        assert all(map(th.equal, result, (values.exp() * 3, values.sum())))
