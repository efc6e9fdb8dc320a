"""The pages of drivers: every configuration in them is read by the driver that it names, and every
driver has a page.
"""

from __future__ import annotations

import re
import textwrap
import tomllib
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from sioms.sdk import finding

PAGES = Path(__file__).parents[3] / "drivers"


def examples(path: Path) -> list[str]:
    """Return the indented blocks of a page that configure a device."""
    blocks = re.findall(r"(?:^(?: {4}.*)?\n)+", path.read_text(), re.MULTILINE)
    return [textwrap.dedent(block) for block in blocks if "[device." in block]


TEXTS = [(str(path.relative_to(PAGES)), text) for path in sorted(PAGES.glob("*/*.md")) for text in examples(path)]


@pytest.mark.parametrize(("page", "text"), TEXTS, ids=[page for page, _ in TEXTS])
def test_the_example_of_a_page_is_a_configuration(page: str, text: str) -> None:
    for name, table in tomllib.loads(text)["device"].items():
        driver = finding.find_driver(table.pop("driver"), str(PAGES))
        settings, errors = finding.read_settings(driver, table, str(PAGES))
        assert not errors
        description, errors = finding.describe(driver, name, settings)
        assert not errors and description


def test_every_driver_and_every_register_map_has_a_page_with_an_example() -> None:
    devices = [table for _, text in TEXTS for table in tomllib.loads(text)["device"].values()]
    registered = {point.name for point in entry_points(group="sioms.drivers")}
    simulated = {name for name in registered if name.startswith("sim-")}
    assert {table["driver"] for table in devices} >= registered - simulated
    maps = {path.stem for path in (PAGES / "modbus" / "maps").glob("*.toml")}
    assert {table["map"] for table in devices if "map" in table} == maps


def test_the_table_of_families_leads_to_a_page_of_every_driver_and_map() -> None:
    linked = set(re.findall(r"\]\(([\w/-]+\.md)[)#]", (PAGES / "README.md").read_text()))
    assert all((PAGES / name).exists() for name in linked)
    pages: dict[str, set[str]] = {}
    for page, text in TEXTS:
        for table in tomllib.loads(text)["device"].values():
            pages.setdefault(table.get("map", table["driver"]), set()).add(page)
    assert all(found & linked for found in pages.values()), pages
