"""Decisions are found by their number: in one page or one section of a page, all listed by subject."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "decisions"
PAGES = {page.name: page.read_text(encoding="utf-8") for page in sorted(FOLDER.glob("[0-9]*.md"))}
SECTION = re.compile(r"^##? (\d{4}): \S", re.MULTILINE)
NUMBERS = {name: set(SECTION.findall(text)) for name, text in PAGES.items()}
ROW = re.compile(r"^\* \[(\d{4})\]\((\S+)\)(?: \(([\d, ]+)\))?: (\S.*)$", re.MULTILINE)
CITED = re.compile(r"[Dd]ecisions?[ /\n]+\(?(\d{3,4})\b(?!\.\d)((?:(?:,| and|, and|,\n) ?\d{4}\b)*)")
LINK = re.compile(r"\[[^\]]*?(\d{3,4})\]\((?:\S*/)?(\d{4}-[\w-]+\.md)\)")
BARE = re.compile(r"(?<![\w.,/#-])0\d{3}(?![\w%-]|[.,]\d)")
"""A number of a decision in a page of decisions, where no other number begins with 0."""


def texts() -> dict[str, str]:
    """Return the files that may cite decisions, by their path."""
    folders = [ROOT / name for name in ("daemon", "docs", "drivers", "etc", "examples", "sioms", "tests", "tools")]
    files = [path for folder in folders for path in sorted(folder.rglob("*")) if "__pycache__" not in path.parts]
    files += [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "pyproject.toml", "dev")]
    kept = [path for path in files if path.suffix in {".md", ".py", ".toml", ".c", ".h", ""} and path.is_file()]
    return {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8", errors="ignore") for path in kept}


def test_a_number_stands_in_one_page() -> None:
    times = Counter(number for numbers in NUMBERS.values() for number in numbers)
    assert len(times) > 280
    assert not [number for number, count in times.items() if count > 1]


def test_headings_begin_with_the_number_of_the_file() -> None:
    assert not [name for name, text in PAGES.items() if not re.match(rf"# {name[:4]}: \S", text)]


def test_the_index_lists_every_page_once_with_its_numbers() -> None:
    rows = ROW.findall((FOLDER / "README.md").read_text(encoding="utf-8"))
    assert sorted(name for _, name, _, _ in rows) == sorted(PAGES)
    listed = {name: {number, *others.replace(",", " ").split()} for number, name, others, _ in rows}
    assert listed == NUMBERS


def test_cited_numbers_are_there() -> None:
    known = set().union(*NUMBERS.values())
    wrong, seen = [], 0
    for name, text in texts().items():
        cited = [
            number.zfill(4) for first, rest in CITED.findall(text) for number in (first, *re.findall(r"\d{4}", rest))
        ]
        if name.startswith("docs/decisions/"):
            cited += BARE.findall(text)
        seen += len(cited)
        wrong += [f"{name}: {number}" for number in cited if number not in known]
    assert not wrong and seen > 500, "\n".join([*wrong, str(seen)])


def test_links_lead_to_the_page_of_their_number() -> None:
    wrong, seen = [], 0
    for name, text in texts().items():
        for number, page in LINK.findall(text):
            seen += 1
            if number.zfill(4) not in NUMBERS.get(page, set()):
                wrong.append(f"{name}: {number} in {page}")
    assert not wrong and seen > 150, "\n".join([*wrong, str(seen)])
