import pytest


@pytest.fixture(autouse=True)
def headless(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give the "human" mode a dummy display."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
