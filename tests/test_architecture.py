"""The layers of the package: each imports only from those below it."""

from __future__ import annotations

import ast
import graphlib
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
# From bottom to top. A package may import only from those before it.
LIBRARY = [
    "common",
    "guard",
    "distributions",
    "policies",
    "engine",
    "bundle",
    "checkpoint",
    "algorithms",
    "export",
    "seeds",
    "diagnostics",
    "zoo",
]
RESEARCH = ["density", "benchmarks", "experiments"]
FLOORS = LIBRARY + RESEARCH
THIRD_PARTY = {
    "distributions": {"torch"},
    "density": {"torch", "numpy", "pandas", "scipy", "sklearn", "matplotlib", "PIL", "tqdm"},
    "policies": {"torch", "numpy", "gymnasium", "stable_baselines3", "sb3_contrib"},
}


def imports(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def files(floor: str) -> list[Path]:
    return sorted((ROOT / "sb3_flowpolicy" / floor).rglob("*.py"))


@pytest.mark.parametrize("floor", FLOORS)
def test_imports_point_down(floor: str) -> None:
    allowed = {f"sb3_flowpolicy.{below}" for below in FLOORS[: FLOORS.index(floor) + 1]}
    for path in files(floor):
        for name in imports(path):
            if name.startswith("sb3_flowpolicy."):
                assert ".".join(name.split(".")[:2]) in allowed, f"{path} imports {name}"


def test_modules_do_not_import_in_a_circle() -> None:
    """Imports for type checkers count, too; the package's own lazy table does not."""
    modules = {}
    for source in (ROOT / "sb3_flowpolicy", ROOT / "envs" / "flowpolicy_envs"):
        for path in source.rglob("*.py"):
            parts = path.relative_to(source.parent).with_suffix("").parts
            modules[".".join(parts).removesuffix(".__init__")] = path
    del modules["sb3_flowpolicy"]
    graph = {}
    for module, path in modules.items():
        # "package.module.name" is a module, or a name in one.
        found = {name if name in modules else name.rpartition(".")[0] for name in imports(path)}
        graph[module] = (found & modules.keys()) - {module}
    assert list(graphlib.TopologicalSorter(graph).static_order())  # raises CycleError


@pytest.mark.parametrize("floor", THIRD_PARTY)
def test_lower_floors_need_few_libraries(floor: str) -> None:
    allowed = THIRD_PARTY[floor] | set(sys.stdlib_module_names) | {"sb3_flowpolicy"}
    for path in files(floor):
        assert {name.split(".")[0] for name in imports(path)} <= allowed, path


def test_every_package_has_its_floor() -> None:
    package = ROOT / "sb3_flowpolicy"
    entries = {path.stem for path in package.iterdir() if path.suffix in ("", ".py")}
    assert entries - {"__init__", "__pycache__"} == set(FLOORS)


@pytest.mark.parametrize(
    ("statement", "unwanted"),
    [
        ("import sb3_flowpolicy", ["torch", "stable_baselines3", "numpy"]),
        ("import sb3_flowpolicy.distributions", ["stable_baselines3", "gymnasium"]),
    ],
)
def test_imports_stay_light(statement: str, unwanted: list[str]) -> None:
    code = f"{statement}; import sys; print([m for m in {unwanted} if m in sys.modules])"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"


def test_public_names_resolve() -> None:
    import sb3_flowpolicy

    for name in sb3_flowpolicy.__all__:
        assert getattr(sb3_flowpolicy, name).__name__ == name
    assert set(sb3_flowpolicy.__all__) <= set(dir(sb3_flowpolicy))
    # Type checkers see the same names.
    modules = sb3_flowpolicy._MODULES.items()
    expected = {f"sb3_flowpolicy.{module}.{name}" for name, module in modules}
    found = imports(ROOT / "sb3_flowpolicy" / "__init__.py")
    assert {name for name in found if name.startswith("sb3_flowpolicy.")} == expected
    with pytest.raises(AttributeError, match="has no attribute 'NoPolicy'"):
        sb3_flowpolicy.NoPolicy  # noqa: B018
