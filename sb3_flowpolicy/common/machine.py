"""Facts about the machine, to record with measurements."""

from __future__ import annotations

import os
import platform
import subprocess
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch as th

import sb3_flowpolicy

PACKAGES = ("torch", "stable_baselines3", "gymnasium", "numpy", "numba", "zuko", "sbx-rl")


def machine() -> dict[str, Any]:
    """Return the hardware, the load, the versions and the commit, and the date."""
    return {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "platform": platform.platform(),
        "processor": _processor(),
        "cpu_count": os.cpu_count(),
        # Processes that wanted to run, averaged over a minute. Near 0 on an idle machine.
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "threads": th.get_num_threads(),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in PACKAGES},
        "commit": _commit(),
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def _commit() -> str | None:
    """Return the commit of the source tree; None where the package was installed from a wheel."""
    source = Path(sb3_flowpolicy.__file__)

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(source.parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", source.name)  # it may lie in another source tree
        return git("describe", "--always", "--dirty", "--abbrev=12")
    except (OSError, subprocess.CalledProcessError):
        return None
