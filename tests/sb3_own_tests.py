"""Run stable-baselines3's own SAC tests with SACFlow in SAC's place.

    python tests/sb3_own_tests.py CHECKOUT [--gauss] [pytest's arguments]

CHECKOUT is a folder with stable-baselines3's repository, of the version that is installed; only
its tests are used. Tests of other algorithms are left out. SB3's ``"MlpPolicy"`` is a flow here,
or with ``--gauss`` the diagonal normal distribution. Two kinds of tests pass only with ``--gauss``:
those that use gSDE, which flows do not support, and one that expects the first update to change a
shared features extractor, which gets no gradient while a flow is still the identity.
"""

import sys
from pathlib import Path

import pytest


class InPlaceOfSAC:
    """Pytest plug-in that hides SAC behind SACFlow and selects the tests that use it."""

    def __init__(self, gauss: bool) -> None:
        self.gauss = gauss

    def pytest_configure(self) -> None:
        """Replace SAC before the tests import it."""
        import stable_baselines3
        from stable_baselines3 import sac

        from sb3_flowpolicy import SACFlow

        stable_baselines3.SAC = sac.SAC = SACFlow  # type: ignore[misc]
        if self.gauss:
            for form in ("", "Cnn", "MultiInput"):
                gauss = SACFlow.policy_aliases[f"{form}GaussPolicy"]
                SACFlow.policy_aliases[f"{form or 'Mlp'}Policy"] = gauss

    def pytest_collection_modifyitems(
        self, config: pytest.Config, items: list[pytest.Item]
    ) -> None:
        """Leave out the tests of other algorithms."""
        chosen = [item for item in items if "sac" in item.name.lower()]
        config.hook.pytest_deselected(items=[item for item in items if item not in chosen])
        items[:] = chosen


def main(checkout: str, *arguments: str) -> int:
    """Return pytest's exit code."""
    folder = Path(checkout).resolve()
    files = [str(p) for p in sorted(folder.glob("tests/test_*.py")) if "SAC" in p.read_text()]
    gauss = "--gauss" in arguments
    arguments = tuple(one for one in arguments if one != "--gauss")
    settings = (f"--rootdir={folder}", "--override-ini=addopts=", "-p", "no:cacheprovider")
    return pytest.main([*files, *settings, *arguments], plugins=[InPlaceOfSAC(gauss)])


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
