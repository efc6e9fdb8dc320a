"""Decisions are found by their number: one page each, whose heading begins with the number of its file."""

from __future__ import annotations

import re
from pathlib import Path

PAGES = sorted((Path(__file__).parents[2] / "docs" / "decisions").glob("[0-9]*.md"))


def test_every_page_has_a_number_of_its_own() -> None:
    numbers = [page.name[:4] for page in PAGES]
    assert len(numbers) > 100
    assert sorted(set(numbers)) == numbers


def test_headings_begin_with_the_number_of_the_file() -> None:
    heads = {page.name: page.read_text().partition("\n")[0] for page in PAGES}
    assert not [name for name, head in heads.items() if not re.match(rf"# {name[:4]}: \S", head)]
