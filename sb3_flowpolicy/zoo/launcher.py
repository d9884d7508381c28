"""Runs rl_zoo3's scripts with our algorithms, without the start-up hook."""

import runpy
import sys
from importlib.util import find_spec

from sb3_flowpolicy.zoo.registration import register

INSTALL_HINT = 'rl_zoo3 is not installed. Install it with: pip install "sb3_flowpolicy[zoo]"'


def run(script: str) -> None:
    """Run `python -m rl_zoo3.<script>` in this process, with this process's arguments."""
    if find_spec("rl_zoo3") is None:
        sys.exit(INSTALL_HINT)
    register()
    runpy.run_module(f"rl_zoo3.{script}", run_name="__main__", alter_sys=True)
