"""The pages of the libraries are those of the effects, each with its picture."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from sioms.reconcile.finger.effects import library as of_fingers
from sioms.reconcile.report import effects, effects_sensors
from sioms.reconcile.report.signatures import ELEMENTS, panels_of_finger

DOCS = Path(__file__).parents[3] / "docs"


@pytest.mark.parametrize(("file", "page"), [
    ("reconcile-effects.md", effects.page),
    ("reconcile-effects-sensors.md", effects_sensors.page),
])  # fmt: skip
def test_the_page_is_made_of_the_library_and_its_pictures_are_there(file: str, page: object) -> None:
    text = page()  # type: ignore[operator]
    assert (DOCS / file).read_text() == text
    pictures = re.findall(r"\]\((pictures/[^)]+)\)", text)
    assert len(pictures) == text.count("\n### ")
    assert all((DOCS / p).is_file() for p in pictures)


@pytest.mark.parametrize("name", ["hertz", "creep", "temperature_drift"])
def test_a_picture_shows_something(name: str) -> None:
    panels = panels_of_finger(of_fingers()[name])
    assert {curves.shape[1] for _, _, curves, _ in panels} == {ELEMENTS}
    assert max(abs(curves).max() for _, _, curves, _ in panels) > 1e-3
