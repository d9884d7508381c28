import pytest


@pytest.fixture(autouse=True)
def headless(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows of the "human" mode open nowhere."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
