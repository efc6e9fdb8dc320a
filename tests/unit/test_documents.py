"""Documents that anybody may have written: tables or one sentence, whatever the bytes are."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sioms.daemon.config import parse
from sioms.documents import DEEPEST, MOST_BYTES, json_of, read_bytes, read_text, toml_of, toml_text
from sioms.drivers.modbus.regmap_files import RegisterMapError, load_map
from sioms.plant.effects import EffectsError, parse_effects
from sioms.tactile.finger import from_toml

BAD: list[tuple[Callable[[Any], Any], bytes, str]] = [
    (toml_of, b"x = " + b"[" * 2000 + b"]" * 2000, "nested too deep"),
    (toml_of, b"a. " * 200_000 + b"b = 1", "nested too deep"),
    (toml_of, b"x = " + b"[" * 50 + b"]" * 50, f"nested deeper than {DEEPEST}"),
    (toml_of, b"x = " + b"9" * 5000, "digits"),
    (toml_of, b"x = 99999999999999999999", "x: an integer of more than 64 bits"),
    (toml_of, b"[a]\nx = [{ y = 1979-05-27 }]", r"a\.x\[0\]\.y = 1979-05-27: a date; want"),
    (toml_of, b"x = 1\nx = 2", "overwrite"),
    (toml_of, b"x = \xff", "not text in UTF-8 .byte 4 is 0xff"),
    (json_of, b"[" * 100_000, "nested too deep"),
    (json_of, b"[" * 50 + b"]" * 50, "nested deeper"),
    (json_of, b'{"a": ' + b"9" * 5000 + b"}", "digits"),
    (json_of, b'{"a": 99999999999999999999}', "a: an integer of more than 64 bits"),
    (json_of, b"", "Expecting value"),
    (json_of, b"\xff\xfe", "not text in UTF-8"),
]


@pytest.mark.parametrize(("parser", "data", "words"), BAD, ids=[words for _, _, words in BAD])
def test_what_is_no_document_costs_a_sentence(parser: Callable[[Any], Any], data: bytes, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        parser(data)


def test_documents_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text("[a]\nx = [1, 2.5, true, 'µ']\n")
    assert toml_of(read_text(path)) == toml_of(read_bytes(path)) == {"a": {"x": [1, 2.5, True, "µ"]}}
    assert json_of('{"a": [null, NaN]}')["a"][0] is None


def test_a_huge_file_is_read_up_to_a_bound(tmp_path: Path) -> None:
    path = tmp_path / "huge.toml"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(ValueError, match="larger than 4 MiB"):
        read_bytes(path)
    assert MOST_BYTES == 1 << 22


@given(st.binary(max_size=60) | st.text(alphabet='[]{}"=,.-:01\n x', max_size=60).map(str.encode))
def test_any_bytes(data: bytes) -> None:
    for parser in (toml_of, json_of):
        try:
            parser(data)
        except ValueError as error:
            assert str(error)


DEVICE = '[device.io0]\ndriver = "sim-io"\noutputs = 8\n'


@pytest.mark.parametrize(
    "line",
    ["x = 1979-05-27", "x = 99999999999999999999", "x = " + "9" * 5000, "x = " + "[" * 2000 + "]" * 2000],
    ids=["date", "65 bits", "5000 digits", "2000 deep"],
)
def test_no_value_of_a_configuration_is_anything_but_an_error(line: str) -> None:
    for text in (DEVICE + line, "[workcell]\n" + line, "[[grant]]\n" + line, line):
        _, errors = parse(text, "/")
        assert errors and all(len(error) < 500 for error in errors)


def test_readers_of_documents_say_what_is_wrong(tmp_path: Path) -> None:
    for data in (
        b"x = " + b"[" * 3000,
        b"x = " + b"9" * 5000,
        b"\xff",
        b"x = 1979-05-27",
        b"\x00",
        b"[finger]\nx=1",
    ):
        path = tmp_path / "x.toml"
        path.write_bytes(data)
        with pytest.raises(RegisterMapError):
            load_map(path)
        text = data.decode("latin-1")
        with pytest.raises(ValueError):
            from_toml(text)
        with pytest.raises(EffectsError):
            parse_effects(text, ["x"])


_TEXTS = st.text(st.characters(codec="utf-8"), max_size=8)
_VALUES = st.recursive(
    st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | _TEXTS,
    lambda below: st.lists(below, max_size=3) | st.dictionaries(_TEXTS, below, max_size=3),
    max_leaves=12,
)


@given(st.dictionaries(_TEXTS, _VALUES, max_size=4))
def test_what_is_written_is_read_back_exactly(tables: dict[str, Any]) -> None:
    assert tomllib.loads(toml_text(tables)) == tables


def test_a_device_of_a_configuration_has_a_head_and_so_has_each_of_its_axes() -> None:
    text = toml_text({"device": {"left": {"axis": [{"name": "x", "watch": {"tolerance": 0.1}}], "driver": "sim-axes"}}})
    assert text == (
        '[device.left]\ndriver = "sim-axes"\n\n[[device.left.axis]]\nname = "x"\nwatch = { tolerance = 0.1 }\n'
    )


def test_what_no_document_holds_is_not_written() -> None:
    with pytest.raises(TypeError, match="a NoneType; want a number, a text"):
        toml_text({"a": None})
