"""The kit's modules import each other in one direction, for type checkers too: a part knows no whole that knows it."""

from __future__ import annotations

import ast
from graphlib import TopologicalSorter
from pathlib import Path

TREE = Path(__file__).parents[3] / "sioms"


def imports(package: Path) -> dict[str, set[str]]:
    """Return which modules of a package each of them imports, also only for type checkers."""
    modules = {path.stem for path in package.glob("*.py")}
    found: dict[str, set[str]] = {module: set() for module in modules}
    for module in modules:
        for node in ast.walk(ast.parse((package / f"{module}.py").read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.level == 1 or node.module == f"sioms.{package.name}"):
                names = [node.module.split(".")[0]] if node.level and node.module else []
                found[module] |= {*names, *(alias.name for alias in node.names)} & modules
            elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith(f"sioms.{package.name}."):
                found[module].add(str(node.module).split(".")[2])
    return found


def test_no_ring_in_the_kit() -> None:
    TopologicalSorter(imports(TREE / "sdk")).prepare()  # raises CycleError with the ring


def test_no_ring_in_the_motion_core() -> None:
    TopologicalSorter(imports(TREE / "motion")).prepare()
