"""The Python examples of the documentation run, with short training."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from typing import Any

import pytest

from sb3_flowpolicy.distributions import registry

ROOT = Path(__file__).parent.parent.parent
BLOCK = re.compile(r"^(<!-- not run: .+ -->\n+)?```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
# SB3's SAC starts to update after 100 steps.
SHORTER = {
    r"learn\([\d_]+": "learn(110",
    r"checkpoint_every=[\d_]+": "checkpoint_every=50",
    r"seeds=\d+": "seeds=4",
}
PATH = re.compile(r"`((?:sb3_flowpolicy|envs|tests|docs|zoo_\w+)/(?!_build)[\w./*-]+)`")
MODULE = re.compile(r"python -m (sb3_flowpolicy[\w.]*\w)")
LINK = re.compile(r"\]\((?!https?:|#)([^)#]+)")


def pages() -> list[Path]:
    docs = [p for p in (ROOT / "docs").rglob("*.md") if not {"_build", "results"} & {*p.parts}]
    return sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *docs])


def with_examples() -> list[Path]:
    return [page for page in pages() if BLOCK.search(page.read_text())]


@pytest.mark.parametrize(
    "page", with_examples(), ids=lambda page: page.relative_to(ROOT).as_posix()
)
def test_examples_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "_REGISTRY", registry.registered_distributions())
    text, namespace = page.read_text(), dict[str, Any](__name__="__main__")
    for block in BLOCK.finditer(text):
        not_run, code = block.groups()
        if not_run:
            continue
        for long, short in SHORTER.items():
            code = re.sub(long, short, code)
        first_line = text.count("\n", 0, block.start(2))
        exec(compile("\n" * first_line + code, page, "exec"), namespace)


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.relative_to(ROOT).as_posix())
def test_what_it_names_exists(page: Path) -> None:
    text = page.read_text()
    for path in PATH.findall(text):
        assert any(ROOT.glob(path)), f"{path} does not exist"
    for module in MODULE.findall(text):
        assert importlib.util.find_spec(module), f"{module} does not exist"
    for link in LINK.findall(text):
        assert (page.parent / link).exists(), f"{link} does not exist"
