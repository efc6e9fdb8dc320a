"""ATI's raw data transfer (RDT) over UDP and the sensor's own page, without I/O: Net F/T box and Ethernet Axia.

A request of 8 bytes starts and stops the stream, sets the zero ("bias") and clears latches. A datagram holds one record
of 36 bytes, or several in buffered mode; all numbers are big-endian. ``rdt_seq`` counts records from 1 on for each
request, ``ft_seq`` the sensor's internal samples. Forces are counts, whose number per unit stands in the sensor's page.
Sources: ATI Net F/T manual, section "UDP interface using RDT" and status code; ATI Ethernet Axia manual
(9620-05-C-Ethernet Axia-02), status code, table 11.2 (page), section 12 (RDT).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import Enum, IntEnum
from struct import Struct, pack
from typing import NamedTuple

from sioms.sdk.exchange import Exchange, LinkError

PAGE = "/netftapi2.xml"
RECORD_BYTES = 36
MAX_RECORDS = 40
"""Records of a buffered datagram that fit an Ethernet frame."""
SEQUENCE_MODULUS = 1 << 32
SAMPLE_HZ = 7000.0
"""Internal samples a second of a Net F/T, where its page does not tell."""
SLOWEST_SAMPLE_HZ = 100.0
"""A smaller number where the page tells the internal rate is the number of a setting, not a rate."""
_RECORD = Struct(">III6i")


class Command(IntEnum):
    """Commands of a request."""

    STOP = 0x0000
    REALTIME = 0x0002
    BUFFERED = 0x0003
    RESET_LATCH = 0x0041
    BIAS = 0x0042


class Record(NamedTuple):
    """One record; the forces and torques are counts."""

    rdt_seq: int
    ft_seq: int
    status: int
    fx: int
    fy: int
    fz: int
    tx: int
    ty: int
    tz: int


def request(command: Command, count: int = 0) -> bytes:
    """Return a request; ``count`` records are sent, 0 = until stopped.

    Example:
        >>> request(Command.REALTIME).hex(" ")
        '12 34 00 02 00 00 00 00'
    """
    return pack(">HHI", 0x1234, command, count)


def parse(datagram: bytes) -> list[Record] | None:
    """Return the records of a datagram, None when it is none."""
    if not datagram or len(datagram) % RECORD_BYTES or len(datagram) > MAX_RECORDS * RECORD_BYTES:
        return None
    return [Record._make(fields) for fields in _RECORD.iter_unpack(datagram)]


def build(record: Record) -> bytes:
    """Return the bytes of a record."""
    return _RECORD.pack(*record)


def start(command: Command, timeout_s: float) -> Exchange:
    """Return the exchange that starts the stream; its value is the first record.

    A request may be lost on its way, and the sensor answers nothing but records: so the request is sent again until one
        comes.
    """
    what = f"start the {command.name.lower()} stream"

    def want(reply: bytes) -> int | None:
        return RECORD_BYTES if reply and decode(reply) else None

    def decode(reply: bytes) -> Record:
        if not reply or len(reply) % RECORD_BYTES:
            raise LinkError(f"{what}: {len(reply)} bytes received; want records of {RECORD_BYTES}")
        return Record._make(_RECORD.unpack_from(reply))

    return Exchange(request(command), want, decode, timeout_s, True, what)


# --- status ---------------------------------------------------------------------------------------


class Model(Enum):
    """Families whose status words differ."""

    NET = "net"
    AXIA = "axia"


ERROR = 1 << 31
_LATCHED_ALONE = 0x80010000
"""Net F/T: a monitored condition is latched and nothing else is wrong."""
_BITS = {
    Model.NET: {
        30: "CPU or RAM",
        29: "digital board",
        28: "analog board",
        27: "serial link",
        26: "program memory",
        25: "halted or wrong configuration",
        24: "settings",
        23: "calibration does not match",
        22: "network",
        21: "CAN bus",
        20: "RDT",
        19: "EtherNet/IP",
        18: "DeviceNet",
        17: "saturation or A/D converter",
        16: "a monitored condition is latched",
        7: "analog ground",
        6: "supply too high",
        5: "supply too low",
        4: "no serial data",
        3: "reference",
        2: "temperature",
        1: "HTTP",
    },
    Model.AXIA: {
        30: "force or torque out of range",
        29: "calibration checksum",
        28: "simulated error",
        27: "gage out of range",
        16: "a monitored condition is latched",
        7: "calibration not accessible",
        5: "other error",
        3: "busy",
        2: "broken gage",
        1: "supply voltage",
        0: "temperature",
    },
}
_NET_BITS_8_TO_14 = "watchdog, stack, EEPROM, flash, analog watchdog or excitation"
_SATURATED = {Model.NET: 1 << 17, Model.AXIA: 1 << 30 | 1 << 27}


def is_invalid(status: int, model: Model) -> bool:
    """Tell whether the status word says that a record must not be used."""
    return bool(status & ERROR) and not (model is Model.NET and status == _LATCHED_ALONE)


def is_saturated(status: int, model: Model) -> bool:
    """Tell whether the sensor is loaded beyond its range."""
    return bool(status & _SATURATED[model])


def status_text(status: int, model: Model) -> str:
    """Return a status word in words.

    Example:
        >>> status_text(0x80020000, Model.NET)
        'saturation or A/D converter'
    """
    if not status:
        return "ok"
    words = [text for bit, text in _BITS[model].items() if status >> bit & 1]
    if model is Model.NET and status & 0x7F00:
        words.append(_NET_BITS_8_TO_14)
    unknown = [str(bit) for bit in range(31) if status >> bit & 1 and not _is_named(bit, model)]
    if unknown:
        words.append(f"bit {', '.join(unknown)}, which has no meaning here")
    return "; ".join(words) or "an error without a name"


def _is_named(bit: int, model: Model) -> bool:
    return bit in _BITS[model] or (model is Model.NET and 8 <= bit <= 14)


# --- the sensor's page ----------------------------------------------------------------------------

_FORCE_UNITS = {"n": 1.0, "kn": 1e3, "lbf": 4.4482216152605, "lb": 4.4482216152605, "klbf": 4448.2216152605,
                "kgf": 9.80665, "kg": 9.80665, "gf": 9.80665e-3, "g": 9.80665e-3}  # fmt: skip
_LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "ft": 0.3048}


def force_unit(name: str) -> float | None:
    """Return the newtons of a unit of force as the sensor names it, None for an unknown one.

    Example:
        >>> force_unit("lbf")
        4.4482216152605
    """
    return _FORCE_UNITS.get(name.strip().lower())


def torque_unit(name: str) -> float | None:
    """Return the newton metres of a unit of torque such as Nm, N-mm or lbf-in, in either order; None for an unknown
    one.

    Example:
        >>> torque_unit("N-m"), torque_unit("Nmm"), torque_unit("kN-m"), torque_unit("parsec")
        (1.0, 0.001, 1000.0, None)
    """
    plain = re.sub(r"[\s*.·-]", "", name).lower()
    for force, newton in _FORCE_UNITS.items():
        for length, metre in _LENGTH_UNITS.items():
            if plain in (force + length, length + force):
                return newton * metre
    return None


@dataclass(frozen=True, slots=True)
class SensorPage:
    """What a sensor says of itself.

    Args:
        product: name of the product.
        serial: serial number of the calibrated transducer.
        counts_per_force: counts in a unit of force.
        counts_per_torque: counts in a unit of torque.
        force_unit, torque_unit: names of these units.
        rate_hz: rate of its records [Hz].
        sample_hz: internal samples a second, which ``ft_seq`` counts; 0 where the page does not tell.
        bias: the vector that its zero subtracts; empty where the page does not tell.
    """

    product: str
    serial: str
    counts_per_force: float
    counts_per_torque: float
    force_unit: str
    torque_unit: str
    rate_hz: float
    sample_hz: float = 0.0
    bias: tuple[float, ...] = ()


def parse_page(text: str) -> SensorPage:
    """Return what stands in ``/netftapi2.xml``.

    Raises:
        LinkError: it is another page, or an element is missing or no number.
    """
    return SensorPage(
        _element(text, "prodname"), _element(text, "setserial"), _number(text, "cfgcpf"), _number(text, "cfgcpt"),
        _element(text, "scfgfu"), _element(text, "scfgtu"), _number(text, "comrdtrate"), _sample_hz(text), _bias(text),
    )  # fmt: skip


def _sample_hz(text: str) -> float:
    """Return the internal rate: ``runrate`` of a Net F/T, ``setrate`` of an Axia (488 to 7812)."""
    for name in ("runrate", "setrate"):
        word = _optional(text, name)
        if word and re.fullmatch(r"\d+(\.\d*)?", word) and float(word) >= SLOWEST_SAMPLE_HZ:
            return float(word)
    return 0.0


def _bias(text: str) -> tuple[float, ...]:
    """Return ``setbias``: six numbers apart by semicolon, comma or blank."""
    try:
        return tuple(float(word) for word in re.split(r"[;,\s]+", _optional(text, "setbias").strip(" ;,")) if word)
    except ValueError:
        return ()


def _optional(text: str, name: str) -> str:
    found = re.search(rf"<{name}>([^<]{{0,200}})</{name}>", text)
    return "" if found is None else found[1].strip()


def _element(text: str, name: str) -> str:
    found = re.search(rf"<{name}>([^<]{{0,200}})</{name}>", text)
    if found is None:
        raise LinkError(f"read {PAGE}: it has no element {name}; is this a Net F/T or an Ethernet Axia")
    return found[1].strip()


def _number(text: str, name: str) -> float:
    word = _element(text, name)
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise LinkError(f"read {PAGE}: {name} is {word!r}; want a positive number")
    return value
