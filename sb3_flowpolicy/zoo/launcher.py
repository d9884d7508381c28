"""Runs rl_zoo3's scripts with our algorithms, without the start-up hook."""

import runpy

from sb3_flowpolicy.zoo.registration import register


def run(script: str) -> None:
    """Run `python -m rl_zoo3.<script>` in this process, with this process's arguments."""
    register()
    runpy.run_module(f"rl_zoo3.{script}", run_name="__main__", alter_sys=True)
