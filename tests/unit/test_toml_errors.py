"""Mistakes in TOML: the line, what stands there, and what would be right; whatever the text is, one bounded line."""

from __future__ import annotations

import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sioms.toml_errors import explained


def error_of(text: str) -> str:
    with pytest.raises(tomllib.TOMLDecodeError) as error:
        tomllib.loads(text)
    return explained(text, error.value)


@pytest.mark.parametrize(
    ("line", "right"),
    [
        ("low = .035", "want 0.035"),
        ("low = -.5  # mm", "want -0.5"),
        ("low = 1.", "want 1.0"),
        ("low = 007", "want 7"),
        ("low = 1,5", "want 1.5"),
        ("low = 5 mm", "want the number alone"),
        ("low = 0.2m/s", "want the number alone"),
        ("box = [0.1, .2]", "want 0.2"),
        ("motor = { mass = 2.0, viscous = .4 }", "want 0.4"),
        ("enable = True", "want true or false"),
        ("enable = yes", "want true or false"),
        ("driver = sim-axes", 'want "sim-axes"'),
        ("line = { serial = /dev/ttyUSB0, baud = 9600 }", 'want "/dev/ttyUSB0"'),
        ("unit = \u201cm\u201d", "want straight quotes"),
        ("path = \"C:\\x\"", "a backslash is written twice"),
        ("unit = \"m", "want the quotes closed"),
        ("position max = 1", "without blanks"),
        ("low =", "want one behind each ="),
        ("low = 1 high = 2", "want one KEY = VALUE a line"),
        ("a = 1\na = 2", "the key stands twice"),
        ("[device.a]\n[device.a]", "the table stands twice"),
        ("[device.a", "ends with ]"),
    ],
)  # fmt: skip
def test_the_usual_mistakes_are_told_with_what_would_be_right(line: str, right: str) -> None:
    text = f"[workcell]\nname = 'x'\n{line}"
    told = error_of(text)
    number = text.count("\n") + 1
    assert told.startswith(f"line {number}: {line.splitlines()[-1].strip()}: "), told
    assert right in told


@given(st.text(alphabet="ab=.,0123456789[]{}\"'#\n\r \\-+e_\u201c\x1b", max_size=60))
def test_any_text_gives_one_printable_bounded_line(text: str) -> None:
    try:
        tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        told = explained(text, error)
        assert told.isprintable() and len(told) < 400
