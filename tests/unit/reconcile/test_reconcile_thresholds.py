"""What decides a verdict stands in one table, each with what it separates."""

from __future__ import annotations

import ast
from pathlib import Path

import sioms.reconcile
from sioms.reconcile import thresholds

ENGINE = Path(sioms.reconcile.__file__).parent


def _names(node: ast.stmt) -> list[str]:
    if not isinstance(node, ast.Assign):
        return []
    return [n.id for n in ast.walk(node.targets[0]) if isinstance(n, ast.Name)]


def test_every_threshold_says_what_it_separates() -> None:
    body = ast.parse(Path(thresholds.__file__).read_text()).body
    for node, after in zip(body, [*body[1:], None], strict=True):
        if _names(node) and not {"AXIS", "SENSOR"} & set(_names(node)):
            said = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            assert said, _names(node)


def test_no_module_has_a_threshold_of_its_own_by_a_name_of_the_table() -> None:
    table = {n for n in vars(thresholds) if n.isupper()} - {"AXIS", "SENSOR"}
    elsewhere = {
        f"{path.relative_to(ENGINE)}: {name}"
        for path in ENGINE.rglob("*.py")
        if path.name != "thresholds.py" and not {"report", "live", "command", "files"} & set(path.parts)
        for node in ast.parse(path.read_text()).body
        for name in _names(node)
        if name in table and not (isinstance(node, ast.Assign) and isinstance(node.value, ast.Call | ast.Attribute))
    }
    assert not elsewhere


def test_no_name_stands_twice_in_the_table() -> None:
    """The second would be that of the first, too."""
    body = ast.parse(Path(thresholds.__file__).read_text()).body
    names = [
        n.id
        for a in body
        if isinstance(a, ast.Assign)
        for t in a.targets
        for n in ast.walk(t)
        if isinstance(n, ast.Name)
    ]
    assert sorted(names) == sorted(set(names))
