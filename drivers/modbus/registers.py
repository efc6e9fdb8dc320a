"""What stands in a register: types, units and the scaling to SI. Pure.

A number goes through three forms: *words* (unsigned 16-bit registers as on the wire), *raw* (the integer
or float that the words spell), and *SI* (m or rad and their derivatives, A, V, s ...). Axis quantities are
related to one turn of the motor, because drives count in pulses, rpm and pulses per second.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from struct import pack, unpack
from typing import Literal

WordOrder = Literal["big", "little"]
TypeName = Literal["u16", "i16", "u32", "i32", "f32", "text"]
Rounding = Literal["nearest", "down", "up"]

RANGES: dict[str, tuple[int, int]] = {
    "u16": (0, 0xFFFF),
    "i16": (-0x8000, 0x7FFF),
    "u32": (0, 0xFFFF_FFFF),
    "i32": (-0x8000_0000, 0x7FFF_FFFF),
}
_PACKING = {"u32": ">I", "i32": ">i", "f32": ">f"}


def width(type_name: TypeName, text_words: int = 0) -> int:
    """Return the number of registers a value of the type takes."""
    if type_name == "text":
        return text_words
    return 1 if type_name in ("u16", "i16") else 2


def to_raw(words: Sequence[int], type_name: TypeName, order: WordOrder) -> float | str:
    """Return the number or text that registers spell.

    Example:
        >>> to_raw((0xFFFF, 0xD8F0), "i32", "big")
        -10000
    """
    if type_name == "u16":
        return words[0]
    if type_name == "i16":
        return words[0] - 0x10000 if words[0] & 0x8000 else words[0]
    data = pack(f">{len(words)}H", *words)
    if type_name == "text":
        return data.split(b"\0")[0].decode("ascii", "replace").strip()
    if order == "little":
        data = data[2:] + data[:2]
    number: float = unpack(_PACKING[type_name], data)[0]
    return number


def to_words(raw: float, type_name: TypeName, order: WordOrder) -> tuple[int, ...]:
    """Return the registers that spell a number; raises ValueError when it does not fit.

    Example:
        >>> to_words(-10000, "i32", "big")
        (65535, 55536)
    """
    if type_name in RANGES:
        low, high = RANGES[type_name]
        if not low <= raw <= high:
            raise ValueError(f"{raw:g} does not fit a register of type {type_name}; want {low} to {high}")
        raw = int(raw)
    if type_name in ("u16", "i16"):
        return (int(raw) & 0xFFFF,)
    if type_name == "text":
        raise ValueError("a text cannot be written")
    high_word, low_word = unpack(">HH", pack(_PACKING[type_name], raw))
    return (high_word, low_word) if order == "big" else (low_word, high_word)


class Per(Enum):
    """What a raw number of a unit counts."""

    ITSELF = "itself"
    TURN = "turn of the motor"
    PULSE = "pulse"
    TIME_TO_SPEED = "time to reach a speed"


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit of a register.

    Args:
        si: SI unit of the result; ``{u}`` is the axis' unit, m or rad.
        factor: SI per unit, or turns (of the motor) per unit.
        per: what it counts.
    """

    si: str
    factor: float = 1.0
    per: Per = Per.ITSELF


UNITS = {
    "": Unit(""),
    "A": Unit("A"),
    "mA": Unit("A", 1e-3),
    "V": Unit("V"),
    "mV": Unit("V", 1e-3),
    "s": Unit("s"),
    "ms": Unit("s", 1e-3),
    "Hz": Unit("Hz"),
    "%": Unit("", 1e-2),
    "degC": Unit("degC"),
    "N": Unit("N"),
    "N*m": Unit("N*m"),
    "turn": Unit("{u}", 1.0, Per.TURN),
    "rpm": Unit("{u}/s", 1 / 60, Per.TURN),
    "pulse": Unit("{u}", 1.0, Per.PULSE),
    "pulse/s": Unit("{u}/s", 1.0, Per.PULSE),
    "pulse/s2": Unit("{u}/s^2", 1.0, Per.PULSE),
    # acceleration given as the time from rest to 1000 rpm [ms]: a = (1000/60 turns/s) / (t/1000 s)
    "ms/krpm": Unit("{u}/s^2", 1000 / 60 * 1000, Per.TIME_TO_SPEED),
}


@dataclass(frozen=True, slots=True)
class Gearing:
    """From the motor's turns to the axis' unit.

    Args:
        travel_per_turn: travel of the axis in one turn of the motor [m or rad]; negative when the
            axis counts against the motor.
        pulses_per_turn: counts of the drive's position in one turn.
    """

    travel_per_turn: float = 2 * math.pi
    pulses_per_turn: float = 1.0

    def __post_init__(self) -> None:
        for name, value in (
            ("travel_per_turn", self.travel_per_turn),
            ("pulses_per_turn", self.pulses_per_turn),
        ):
            if not math.isfinite(value) or value == 0:
                raise ValueError(f"{name} is {value}; want a finite number other than 0")

    def factor(self, unit: Unit) -> float:
        """Return SI per raw number (the reciprocal relation of a time to speed: SI times raw)."""
        match unit.per:
            case Per.ITSELF:
                return unit.factor
            case Per.TURN:
                return unit.factor * self.travel_per_turn
            case Per.PULSE:
                return unit.factor * self.travel_per_turn / self.pulses_per_turn
            case Per.TIME_TO_SPEED:
                return unit.factor * abs(self.travel_per_turn)

    def to_si(self, raw: float, unit: Unit, scale: float = 1.0, offset: float = 0.0) -> float:
        """Return the SI value of a raw number: (raw + offset) * scale units."""
        value = (raw + offset) * scale
        if unit.per is Per.TIME_TO_SPEED:
            return self.factor(unit) / value if value else math.inf
        return value * self.factor(unit)

    def from_si(self, si: float, unit: Unit, scale: float = 1.0, offset: float = 0.0) -> float:
        """Return the raw number, not yet rounded, of an SI value."""
        factor = self.factor(unit)
        value = (factor / si if si else math.inf) if unit.per is Per.TIME_TO_SPEED else si / factor
        return value / scale - offset


def rounded(raw: float, how: Rounding) -> float:
    """Round to an integer; "down" is towards zero and "up" away from it."""
    if not math.isfinite(raw):
        return raw
    if how == "nearest":
        return float(round(raw))
    # a hair of tolerance, so that 200.00000000000003 is 200 in either direction
    near = round(raw)
    if abs(raw - near) < 1e-6 * max(1.0, abs(raw)):
        return float(near)
    size = math.floor(abs(raw)) if how == "down" else math.ceil(abs(raw))
    return math.copysign(size, raw)
