"""Register types and the scaling to SI, against numbers worked by hand."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sioms.drivers.modbus.registers import UNITS, Gearing, rounded, to_raw, to_words


@pytest.mark.parametrize(
    ("raw", "kind", "order", "words"),
    [
        (65535, "u16", "big", (0xFFFF,)),
        (-1, "i16", "big", (0xFFFF,)),
        (-32768, "i16", "big", (0x8000,)),
        (0x12345678, "u32", "big", (0x1234, 0x5678)),
        (0x12345678, "u32", "little", (0x5678, 0x1234)),
        (-10000, "i32", "big", (0xFFFF, 0xD8F0)),
        (1.0, "f32", "big", (0x3F80, 0)),
        (1.0, "f32", "little", (0, 0x3F80)),
    ],
)
def test_words(raw: float, kind: str, order: str, words: tuple[int, ...]) -> None:
    assert to_words(raw, kind, order) == words  # type: ignore[arg-type]
    assert to_raw(words, kind, order) == raw  # type: ignore[arg-type]


def test_text_ends_at_zero() -> None:
    assert to_raw((0x4531, 0x3231, 0x3200, 0x5858), "text", "big") == "E1212"


@pytest.mark.parametrize(("raw", "kind"), [(65536, "u16"), (-1, "u16"), (32768, "i16"), (2**31, "i32"), (-1, "u32")])
def test_what_does_not_fit_is_refused(raw: float, kind: str) -> None:
    with pytest.raises(ValueError, match=f"does not fit a register of type {kind}"):
        to_words(raw, kind, "big")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("unit", "raw", "si"),
    [
        # 5 mm of travel a turn, 10000 pulses a turn
        ("pulse", 10000, 0.005),
        ("rpm", 600, 0.05),
        ("pulse/s", 20000, 0.01),
        ("pulse/s2", 20000, 0.01),
        # 100 ms to 1000 rpm = 16.667 turns/s in 0.1 s = 166.67 turns/s^2 = 0.8333 m/s^2
        ("ms/krpm", 100, 0.005 * 1000 / 60 / 0.1),
        ("A", 32, 32.0),
        ("ms", 5, 0.005),
    ],
)
def test_units(unit: str, raw: float, si: float) -> None:
    gearing = Gearing(0.005, 10000)
    assert gearing.to_si(raw, UNITS[unit]) == pytest.approx(si)
    assert gearing.from_si(si, UNITS[unit]) == pytest.approx(raw)


def test_a_reversed_axis_counts_backwards_but_keeps_its_acceleration() -> None:
    gearing = Gearing(-0.005, 10000)
    assert gearing.to_si(10000, UNITS["pulse"]) == pytest.approx(-0.005)
    assert gearing.from_si(0.05, UNITS["rpm"]) == pytest.approx(-600)
    assert gearing.from_si(1.0, UNITS["ms/krpm"]) > 0


def test_no_acceleration_takes_for_ever() -> None:
    assert Gearing(1.0, 1.0).from_si(0.0, UNITS["ms/krpm"]) == math.inf


@given(st.floats(-1e6, 1e6))
def test_rounding(raw: float) -> None:
    assert abs(rounded(raw, "down")) <= abs(raw) * (1 + 1e-6) + 1e-6
    assert abs(rounded(raw, "up")) >= abs(raw) * (1 - 1e-6) - 1e-6
    assert abs(rounded(raw, "nearest") - raw) <= 0.5


def test_gearing_must_be_a_number() -> None:
    with pytest.raises(ValueError, match="pulses_per_turn is 0"):
        Gearing(1.0, 0.0)
