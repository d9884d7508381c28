"""`python -m sb3_flowpolicy.zoo.train` and its siblings."""

import runpy
import sys

import pytest


@pytest.fixture
def launch(monkeypatch):
    """Run `python -m sb3_flowpolicy.zoo.<script> <arguments>` in this process."""

    def run(script, *arguments):
        module = f"sb3_flowpolicy.zoo.{script}"
        # Collecting doctests imports it; runpy warns about modules that were imported before.
        monkeypatch.delitem(sys.modules, module, raising=False)
        monkeypatch.setattr(sys, "argv", [module, *arguments])
        runpy.run_module(module, run_name="__main__")

    return run


@pytest.mark.parametrize("script", ["train", "enjoy", "record_video"])
def test_it_runs_the_script_of_rl_zoo3_with_our_algorithms(script, launch, capsys):
    pytest.importorskip("rl_zoo3")
    with pytest.raises(SystemExit) as exit_:
        launch(script, "--help")
    assert exit_.value.code == 0
    assert "sac_flow" in capsys.readouterr().out
