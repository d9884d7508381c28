"""Where torch cannot compile, training goes on eagerly: one warning, the same numbers."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch as th

from sb3_flowpolicy.engine.compiling import Compiled

TRAIN = """
import sys, warnings, numpy as np, torch as th
th.set_num_threads(1)
from sb3_flowpolicy import SACFlow
warnings.simplefilter("always")
with warnings.catch_warnings(record=True) as caught:
    model = SACFlow(
        "FlowPolicy", "Pendulum-v1", learning_starts=20, batch_size=16, buffer_size=100, seed=0,
        device="cpu", policy_kwargs=dict(net_arch=[8]), compile=sys.argv[1] == "True",
    ).learn(40)
print(sum("runs eagerly" in str(w.message) for w in caught))
np.save(sys.argv[2], model.policy.parameters_to_vector())
"""


def train(compile: bool, result: Path, **environment: str) -> int:
    """Train in a new process; return how many warnings spoke of running eagerly."""
    command = [sys.executable, "-c", TRAIN, str(compile), str(result)]
    output = subprocess.run(
        command, env={**os.environ, **environment}, capture_output=True, text=True, check=True
    )
    return int(output.stdout.split()[-1])


def test_no_compiler(tmp_path: Path) -> None:
    import numpy as np

    hidden = {
        "PATH": str(tmp_path),  # no g++, no cc
        "CXX": "no-such-compiler",
        "CC": "no-such-compiler",
        "TORCHINDUCTOR_CACHE_DIR": str(tmp_path / "cache"),
    }
    assert train(True, tmp_path / "hidden.npy", **hidden) == 1
    assert train(False, tmp_path / "eager.npy") == 0
    got, expected = (np.load(tmp_path / f"{name}.npy") for name in ("hidden", "eager"))
    assert np.array_equal(got, expected)


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
    compiled = Compiled(lambda x: (x.exp() * 3, x.sum()), "the test", th.device("cpu"))
    with pytest.warns(RuntimeWarning, match="the test could not be compiled") as caught:
        results = [compiled("key", x), compiled("key", x), compiled("other", x[:2])]
    assert len(caught) == 1
    for result, values in zip(results, (x, x, x[:2]), strict=True):
        assert all(map(th.equal, result, (values.exp() * 3, values.sum())))
