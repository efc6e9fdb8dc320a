"""Talks to one Modbus unit through its register map. Pure: generators of exchanges.

Signals that lie side by side are read in one message. Commands turn SI quantities into registers, and
refuse, before anything is sent, what a register cannot hold.

Concurrency: none; a :class:`MappedUnit` belongs to one driver thread.
"""

from __future__ import annotations

import errno
from collections.abc import Generator, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import msgspec

from sioms.sdk.codec import modbus_pdu as pdus
from sioms.sdk.codec.modbus import UNIT_IN_HEADER, RtuUnit, SerialLine, TcpUnit, Unit
from sioms.sdk.codec.modbus_pdu import MAX_READ_BITS, MAX_READ_REGISTERS, Pdu
from sioms.sdk.exchange import DeviceError, Exchange, Pause, Steps
from sioms.sdk.golden import Golden, Incomplete
from sioms.sdk.settings import LineSettings

from .registers import RANGES, UNITS, Gearing, rounded, to_raw, to_words, width
from .regmap import Command, GoldenFrame, Identify, Item, RegisterMap, Signal, Write

Values = dict[str, Any]
"""Signal name to value: float in SI, text, a list of floats for an array, an integer for bits."""

SIZES = ("speed", "acceleration", "deceleration")

BUSY_TRIES = 4
"""Times a write is sent that the device answers with "busy": it has not been carried out then, so it may be sent again.
"""
BUSY_S = 0.01
"""Pause before it is sent again [s]."""

_READ = {
    "coil": pdus.READ_COILS,
    "discrete": pdus.READ_DISCRETE,
    "holding": pdus.READ_HOLDING,
    "input": pdus.READ_INPUT,
}


class Misfit(ValueError):
    """A quantity of a command does not fit its register.

    Attributes:
        source: the quantity.
    """

    def __init__(self, source: str, text: str) -> None:
        super().__init__(text)
        self.source = source


@dataclass(frozen=True, slots=True)
class Read:
    """One message and the signals in its reply, each with its place behind the first."""

    pdu: Pdu
    parts: tuple[tuple[str, Signal, int], ...]


class MappedUnit:
    """A unit and its map.

    Args:
        rmap: the register map.
        unit: the Modbus unit that frames the requests.
        gearing: from the motor's turns to the axis' unit.
        name: for messages.
        counts: signal name to the number of values that this device has, where it is less than the map's.
    """

    def __init__(
        self,
        rmap: RegisterMap,
        unit: Unit,
        gearing: Gearing | None = None,
        name: str = "",
        counts: Mapping[str, int] | None = None,
    ) -> None:
        self.rmap, self.unit = rmap, unit
        self.gearing = gearing or Gearing()
        self.name = name or f"{rmap.family} unit {unit.unit}"
        self._counts = counts or {}

    def plan(self, names: Iterable[str]) -> tuple[Read, ...]:
        """Return the fewest messages that read these signals."""
        wanted = sorted(((self._signal(name), name) for name in dict.fromkeys(names)), key=_order)
        groups: list[list[tuple[Signal, str]]] = []
        for signal, name in wanted:
            if groups and self._joins(groups[-1], signal):
                groups[-1].append((signal, name))
            else:
                groups.append([(signal, name)])
        return tuple(_read(group) for group in groups)

    def read(self, plan: Iterable[Read]) -> Generator[Exchange, Any, Values]:
        """Read all signals of a plan; returns their values."""
        values: Values = {}
        for read in plan:
            reply = yield self.unit.exchange(read.pdu)
            for name, signal, at in read.parts:
                values[name] = self._value(signal, at, reply)
        return values

    def command(self, name: str, **quantities: float) -> Steps:
        """Send a command of the map.

        Args:
            name: of the command.
            quantities: what its items name, in SI.

        Raises:
            DeviceError: EINVAL, and nothing is sent, when a quantity does not fit its register.
        """
        command = self.rmap.commands[name]
        changed = {item.differs_from for write in command.writes for item in write.items} - {None}
        present = (yield from self.read(self.plan(map(str, changed)))) if changed else {}
        try:
            encoded = [(self.encode(write, quantities, present), write.pause_s) for write in command.writes]
        except ValueError as error:
            raise DeviceError(errno.EINVAL, f"{name} of {self.name}: {error}") from None
        for pdu, pause_s in encoded:
            yield from self.write(replace(pdu, repeatable=command.repeat))
            if pause_s:
                yield Pause(pause_s)

    def write(self, pdu: Pdu) -> Steps:
        """Send a write. What the device is too busy for (exception 6) is sent again; what it still works at (5) is
        taken.
        """
        for tries in range(BUSY_TRIES):
            try:
                yield self.unit.exchange(pdu)
                return
            except DeviceError as error:
                if error.errno == errno.EINPROGRESS:
                    return
                if error.errno != errno.EBUSY or tries == BUSY_TRIES - 1:
                    raise
            yield Pause(BUSY_S)

    def check(self, command: Command, quantities: Mapping[str, float]) -> None:
        """Raise Misfit when a quantity does not fit its register."""
        for write in command.writes:
            self.encode(write, quantities)

    def encode(self, write: Write, quantities: Mapping[str, float], present: Mapping[str, Any] | None = None) -> Pdu:
        """Return the request of one write; raises ValueError when a quantity does not fit."""
        if write.table == "coil":
            return pdus.write_coil(write.address, bool(write.items[0].value))
        words = [word for item in write.items for word in self._item(item, quantities, present or {})]
        if write.function == "single":
            return pdus.write_register(write.address, words[0])
        return pdus.write_registers(write.address, words)

    def in_register(self, name: str, source: str, si: float, more: int = 0) -> float:
        """Return the size that a quantity has in the register of a command, ``more`` steps further [SI]."""
        items = [item for write in self.rmap.commands[name].writes for item in write.items if item.source == source]
        if not items:
            return si
        item = items[0]
        raw = rounded(self._raw(item, si), item.round) + more
        return abs(self.gearing.to_si(raw, UNITS[item.unit], item.scale))

    def step(self, name: str) -> float:
        """Return how much one count of a signal's register is [SI]."""
        signal = self.rmap.signals[name]
        return abs(self.gearing.to_si(1.0, UNITS[signal.unit], signal.scale))

    def identify(self, settings: Mapping[str, Any]) -> Steps:
        """Read what tells the device from others and compare.

        Raises:
            DeviceError: ENODEV, another device than configured.
        """
        tests = self.rmap.identify
        try:
            values = yield from self.read(self.plan(test.signal for test in tests))
        except DeviceError as error:
            text = f"identify {self.name}: {error}; the configuration says {self.rmap.title!r}"
            raise DeviceError(errno.ENODEV, f"{text}; check address, wiring and configuration") from None
        for test in tests:
            if wrong := _differs(test, values[test.signal], settings):
                text = f"identify {self.name}: {test.signal} is {values[test.signal]!r}; {wrong}"
                raise DeviceError(errno.ENODEV, f"{text}; check address, wiring and configuration")

    def alarm_text(self, code: int) -> str:
        """Return an alarm code in words, '' for none."""
        alarms = self.rmap.alarms
        if alarms is None or code == 0:
            return ""
        texts = {int(key, 0): text for key, text in alarms.codes.items()}
        lasting = "; only a power cycle clears it" if code in alarms.lasting else ""
        if lasting and code in alarms.place_lost:
            lasting = "; homing or a preset with the vendor's tool, or a power cycle clears it"
        return f"alarm {code:#x}, {texts.get(code, 'not in the map')}{lasting}"

    def _signal(self, name: str) -> Signal:
        signal = self.rmap.signals[name]
        count = self._counts.get(name, signal.count)
        return signal if count == signal.count else _with_count(signal, count)

    def _joins(self, group: list[tuple[Signal, str]], signal: Signal) -> bool:
        first, last = group[0][0], group[-1][0]
        gap = signal.address - (last.address + last.span)
        span = signal.address + signal.span - first.address
        most = MAX_READ_BITS if signal.is_bits else MAX_READ_REGISTERS
        return signal.table == first.table and 0 <= gap <= self.rmap.merge_gap and span <= most

    def _value(self, signal: Signal, at: int, reply: Any) -> Any:
        if signal.is_bits:
            return reply >> at & ((1 << signal.count) - 1)
        size = width(signal.type, signal.words)
        values = [self._number(signal, reply[at + i * size : at + (i + 1) * size]) for i in range(signal.count)]
        return values[0] if signal.count == 1 else values

    def _number(self, signal: Signal, words: tuple[int, ...]) -> float | str:
        raw = to_raw(words, signal.type, signal.word_order or self.rmap.word_order)
        if isinstance(raw, str) or (not signal.unit and signal.scale == 1.0 and not signal.offset):
            return raw
        return self.gearing.to_si(raw, UNITS[signal.unit], signal.scale, signal.offset)

    def _raw(self, item: Item, si: float) -> float:
        """Return a quantity as the register counts it; speeds and accelerations have no direction."""
        raw = self.gearing.from_si(si, UNITS[item.unit], item.scale)
        return abs(raw) if item.source in SIZES else raw

    def _item(self, item: Item, quantities: Mapping[str, float], present: Mapping[str, Any]) -> tuple[int, ...]:
        if item.value is not None:
            return to_words(item.value, item.type, self.rmap.word_order)
        if item.values:
            other = next(value for value in item.values if value != present.get(str(item.differs_from)))
            return to_words(other, item.type, self.rmap.word_order)
        source = str(item.source)
        si = quantities[source]
        raw = self._raw(item, si)
        if item.type in RANGES:
            raw = rounded(raw, item.round)
            low, high = RANGES[item.type]
            low = low if item.minimum is None else item.minimum
            high = high if item.maximum is None else item.maximum
            if not low <= raw <= high:
                raise Misfit(source, self._misfit(item, source, si, raw, low, high))
        return to_words(raw, item.type, self.rmap.word_order)

    def _misfit(self, item: Item, source: str, si: float, raw: float, low: int, high: int) -> str:
        unit = UNITS[item.unit]
        bounds = sorted(abs(self.gearing.to_si(bound, unit, item.scale)) for bound in (low, high))
        if low < 0:
            bounds = sorted(self.gearing.to_si(bound, unit, item.scale) for bound in (low, high))
        return (
            f"{source} {si:g} is {raw:g} {item.unit} in the register, which takes {low} to {high}; "
            f"want {bounds[0]:.6g} to {bounds[1]:.6g}"
        )


def unit_on(line: LineSettings, address: int, turnaround_s: float) -> Unit:
    """Return the unit with this address behind a serial line or a TCP connection.

    Raises:
        ValueError: the line carries no Modbus, or the address is impossible on it.
    """
    if line.serial is not None:
        return RtuUnit(address, SerialLine(line.baud, line.bits_per_character), turnaround_s)
    if line.tcp is not None:
        return TcpUnit(address, turnaround_s)
    raise ValueError("line = udp: Modbus runs on serial and tcp")


def golden_of(rmap: RegisterMap) -> list[Golden]:
    """Return the golden frames of a map, on a serial line of 115200 baud or on TCP."""
    return [golden for frame in rmap.golden for golden in _golden(rmap, frame)]


def _golden(rmap: RegisterMap, frame: GoldenFrame) -> list[Golden]:
    first = bytes.fromhex(frame.requests[0])
    unit: Unit = (
        TcpUnit(first[UNIT_IN_HEADER], rmap.turnaround_s)
        if frame.transport == "tcp"
        else RtuUnit(first[0], SerialLine(115200), rmap.turnaround_s)
    )
    mapped = MappedUnit(rmap, unit, Gearing(1.0, frame.pulses_per_turn))
    if frame.signals:
        plan = mapped.plan(frame.signals)
        exchanges = [unit.exchange(read.pdu) for read in plan]
        what = "read " + ", ".join(frame.signals)
        wanted = {name: frame.values[name] for name in frame.values}

        def read(data: bytes) -> Values:
            length = exchanges[0].want(data)
            if length is None or len(data) < length:
                raise Incomplete("the reply is not complete")
            reply = exchanges[0].decode(data[:length])
            return {name: mapped._value(signal, at, reply) for name, signal, at in plan[0].parts if name in wanted}

        return [
            Golden(what, exchanges[0], frame.requests[0], frame.reply, wanted, read),
            *(Golden(what, e, text) for e, text in zip(exchanges[1:], frame.requests[1:], strict=True)),
        ]
    steps = [step for step in mapped.command(frame.command, **frame.quantities) if isinstance(step, Exchange)]
    texts = [*frame.requests, *[""] * (len(steps) - len(frame.requests))]
    return [
        Golden(frame.command, step, text, frame.reply if i == 0 else "", None)
        for i, (step, text) in enumerate(zip(steps, texts, strict=True))
    ]


def _order(item: tuple[Signal, str]) -> tuple[str, int]:
    return item[0].table, item[0].address


def _with_count(signal: Signal, count: int) -> Signal:
    return msgspec.structs.replace(signal, count=count)


def _read(group: list[tuple[Signal, str]]) -> Read:
    first, last = group[0][0], group[-1][0]
    count = last.address + last.span - first.address
    build = pdus.read_bits if first.is_bits else pdus.read_registers
    pdu = build(_READ[first.table], first.address, count)
    return Read(pdu, tuple((name, signal, signal.address - first.address) for signal, name in group))


def _differs(test: Identify, value: Any, settings: Mapping[str, Any]) -> str:
    if test.contains is not None:
        text = test.contains.format_map(settings)
        return "" if text in str(value) else f"the configuration says {text}"
    if test.equals_setting is not None:
        right = settings[test.equals_setting]
        return "" if value == right else f"the configuration says {test.equals_setting} = {right:g}"
    low = -float("inf") if test.minimum is None else test.minimum
    high = float("inf") if test.maximum is None else test.maximum
    return "" if low <= value <= high else f"want {low:g} to {high:g}"
