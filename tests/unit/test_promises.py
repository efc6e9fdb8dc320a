"""Each promise of docs/promises.md names tests that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

TREE = Path(__file__).resolve().parents[2]
PAGE = (TREE / "docs" / "promises.md").read_text(encoding="utf-8")
NAMED = sorted(set(re.findall(r"`(tests/[\w/]+\.py(?:::\w+)?)`", PAGE)))


@pytest.mark.parametrize("name", NAMED)
def test_a_named_test_exists(name: str) -> None:
    path, _, test = name.partition("::")
    text = (TREE / path).read_text(encoding="utf-8")
    assert f"def {test}(" in text if test else "def test_" in text or "TestCase" in text


def test_each_promise_names_a_test() -> None:
    rows = [
        line
        for line in PAGE.splitlines()
        if line.startswith("| ") and not line.startswith(("| ---", "| promise", "| way in"))
    ]
    assert len(rows) > 20
    assert all("`tests/" in row.split("|")[-2] for row in rows)


def test_each_bridge_says_with_whose_rights_it_acts() -> None:
    front = (TREE / "tools" / "front.py").read_text(encoding="utf-8")
    bridges = re.findall(r'"(\w+)": Command\("sioms\.bridges\.', front)
    assert len(bridges) >= 4
    for name in [*bridges, "serve"]:
        assert f"| `sioms {name}` |" in PAGE, name
    for path in (TREE / "sioms" / "bridges").iterdir():
        if path.is_dir() and path.name not in ("__pycache__", *bridges):
            assert f"| {path.name} |" in PAGE, path.name


def test_benches_that_are_named_exist() -> None:
    commands = (TREE / "sioms" / "bench" / "command.py").read_text(encoding="utf-8")
    for name in re.findall(r"`sioms bench (\w+)`", PAGE):
        assert f'"{name}": (' in commands, name


def test_what_is_not_promised_is_said() -> None:
    assert "## What is not promised" in PAGE and "(docs/promises.md)" in (TREE / "README.md").read_text(
        encoding="utf-8"
    )


def test_the_number_of_mutants_is_told() -> None:
    count = (TREE / "tests" / "mutants" / "mutants.toml").read_text(encoding="utf-8").count("[[mutant]]")
    assert f"with {count} small faults" in PAGE
