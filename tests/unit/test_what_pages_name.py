"""What README and the pages of docs name is there: options of commands, files, names of Python, tests."""

from __future__ import annotations

import argparse
import importlib
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

from tool_rig import parsers

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
PAGES += sorted((ROOT / "drivers").rglob("*.md"))
FOLDERS = "docs|drivers|daemon|etc|examples|sioms|tests|tools"
MADE = {"etc/sioms", "sioms/siomsd.sock"}
"""Begins of paths on other machines, or of what is made."""
NO_NAME = "(?:toml|service|conf|socket|sock)"
GROUPS = {"effects", "drivers", "twins"}
"""Groups of entry points."""


def code(page: Path) -> Iterator[str]:
    """Yield the pieces of code of a page: spans, and lines of blocks."""
    text = page.read_text(encoding="utf-8")
    for block in re.findall(r"^```\w*\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
        yield from (line.removeprefix("$ ").strip() for line in block.replace("\\\n", " ").splitlines())
    yield from re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL))


def everything() -> Iterator[tuple[str, str]]:
    """Yield name of the page and piece of code."""
    for page in PAGES:
        for piece in code(page):
            yield str(page.relative_to(ROOT)), piece


def spoken(line: str) -> list[str]:
    """Return the words of the first ``sioms`` command in a line."""
    found = re.search(r"(?:^|[|;&(] ?|\$ )sioms ([a-z].*)", line)
    if not found:
        return []
    try:
        words = shlex.split(re.split(r" [|;&>]|\)|  #", found[1])[0], comments=True)
    except ValueError:  # an apostrophe in a sentence
        words = found[1].split()
    return words


def test_options_of_commands() -> None:
    known, wrong, seen = parsers(), [], 0
    for page, line in everything():
        words = spoken(line)
        verb = next((name for name in (" ".join(words[:2]), *words[:1]) if name in known), "")
        if not verb:
            continue
        parser = known[verb]
        shorts = {o for a in parser._actions for o in a.option_strings}
        nested = any(isinstance(a, argparse._SubParsersAction) for a in parser._actions)
        for word in words[len(verb.split()) :]:
            option = re.match(r"--[a-z][a-z-]*|-[a-zA-Z]", word)
            if option and not nested:
                seen += 1
                if option[0] not in shorts:
                    wrong.append(f"{page}: {line}: {option[0]}")
    assert not wrong and seen > 60, "\n".join(wrong)


def test_files() -> None:
    wrong = []
    for page, piece in everything():
        if page.startswith("drivers/"):
            continue  # they cite files of the vendors
        for name in re.findall(rf"(?<![\w./~-])((?:{FOLDERS})/[\w./-]*[\w/])", piece):
            here = ROOT / name
            if not here.exists() and not any(name.startswith(made) for made in MADE):
                wrong.append(f"{page}: {name}")
    assert not wrong, "\n".join(wrong)


def test_names_of_python() -> None:
    """``sioms.NAME``, and what is said of the classes that a script begins with."""
    wrong, seen = [], 0
    face = importlib.import_module("sioms")
    for page, piece in everything():
        for name in re.findall(rf"(?<![\w./-])sioms\.([A-Za-z]\w*)(?!\w*[-.]?{NO_NAME}\b)", piece):
            seen += 1
            if name not in GROUPS and not hasattr(face, name) and importlib.util.find_spec(f"sioms.{name}") is None:
                wrong.append(f"{page}: sioms.{name}")
        for kind, name in re.findall(r"\b(Workcell|Fleet|AxisNode|AnalogNode|BinaryNode)\.([a-z_]+)\b", piece):
            if not hasattr(getattr(importlib.import_module("sioms"), kind), name):
                wrong.append(f"{page}: {kind}.{name}")
    assert not wrong and seen > 40, "\n".join([*wrong, str(seen)])


def test_modules_that_are_run() -> None:
    wrong = []
    for page, piece in everything():
        for name in re.findall(r"(?:-m |import |from )(sioms(?:\.[a-z_0-9]+)+)", piece):
            try:
                found = importlib.util.find_spec(name)
            except ModuleNotFoundError:
                found = None
            if found is None:
                wrong.append(f"{page}: {name}")
    assert not wrong, "\n".join(wrong)
