"""Run stable-baselines3's own SAC tests with SACFlow in SAC's place.

    python tests/sb3_own_tests.py CHECKOUT [pytest's arguments]

CHECKOUT is a folder with stable-baselines3's repository, of the version that is installed; only
its tests are used. Tests of the other algorithms and tests that use gSDE, which flows do not
support, are left out.
"""

import re
import sys
from pathlib import Path

import pytest


class InPlaceOfSAC:
    """Pytest plug-in that hides SAC behind SACFlow and selects the tests that use it."""

    def pytest_configure(self) -> None:
        """Replace SAC before the tests import it."""
        import stable_baselines3
        from stable_baselines3 import sac

        from sb3_flowpolicy import SACFlow

        stable_baselines3.SAC = sac.SAC = SACFlow  # type: ignore[misc]

    def pytest_collection_modifyitems(
        self, config: pytest.Config, items: list[pytest.Item]
    ) -> None:
        """Leave out the tests of other algorithms, and gSDE."""
        others = re.compile("A2C|DDPG|DQN|PPO|TD3", re.IGNORECASE)
        chosen = [
            item
            for item in items
            if ("sac" in item.name.lower() or not others.search(item.name))
            and not re.search("sde", item.name)
        ]
        config.hook.pytest_deselected(items=[item for item in items if item not in chosen])
        items[:] = chosen


def main(checkout: str, *arguments: str) -> int:
    """Return pytest's exit code."""
    folder = Path(checkout).resolve()
    files = [str(p) for p in sorted(folder.glob("tests/test_*.py")) if "SAC" in p.read_text()]
    settings = (f"--rootdir={folder}", "--override-ini=addopts=", "-p", "no:cacheprovider")
    return pytest.main([*files, *settings, *arguments], plugins=[InPlaceOfSAC()])


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
