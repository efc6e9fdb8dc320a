"""Finds everything that is wrong with a register map, with the place and what would be right. Pure."""

from __future__ import annotations

import types
import typing
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

import msgspec

from sioms.sdk.codec.modbus_pdu import MAX_READ_BITS, MAX_READ_REGISTERS, MAX_WRITE_REGISTERS
from sioms.wording import did_you_mean, plain_words

from .registers import RANGES, UNITS, Per, to_words, width
from .regmap import Command, Item, Proof, RegisterMap, Signal, Write

MODES = ("POSITION", "VELOCITY", "FORCE")
POLL_GROUPS = ("always", "seldom", "open")
STATUS_NAMES = (
    "fault", "enabled", "moving", "done", "homed", "ready", "busy", "limit_minus", "limit_plus", "switch_minus",
    "switch_plus", "in_position",
)  # fmt: skip
# command -> whether a failed exchange of it may be repeated at all
COMMANDS = {
    "position": False, "relative": False, "velocity": False, "force": False, "jog_speed": True, "jog_plus": False,
    "jog_minus": False, "stop": True, "fastest": True, "brake": True, "home": False, "reset": True, "zero": False,
    "enable": True, "disable": True, "watchdog": True, "watchdog_restart": True, "token": True,
}  # fmt: skip
# quantity of a command -> SI unit
SOURCES = {
    "position": "{u}", "velocity": "{u}/s", "speed": "{u}/s", "acceleration": "{u}/s^2", "deceleration": "{u}/s^2",
    "force": "N", "timeout": "s", "token": "",
}  # fmt: skip


def schema_problems(value: Any, expected: Any, place: str = "") -> list[str]:
    """Return one sentence for each part of ``value`` that is not of the expected type."""
    origin = typing.get_origin(expected)
    if origin in (typing.Union, types.UnionType):
        parts = [part for part in typing.get_args(expected) if part is not type(None)]
        if len(parts) == 1:
            return schema_problems(value, parts[0], place)
    if isinstance(expected, type) and issubclass(expected, msgspec.Struct) and isinstance(value, Mapping):
        return _struct_problems(value, expected, place)
    if origin is dict and isinstance(value, Mapping):
        inner = typing.get_args(expected)[1]
        return [p for key, part in value.items() for p in schema_problems(part, inner, f"{place}{key}.")]
    if origin is typing.Literal:
        words = typing.get_args(expected)
        near = did_you_mean(str(value), map(str, words))
        return [] if value in words else [f"{place[:-1]} = {value!r}: unknown{near}"]
    if origin is tuple and isinstance(value, list):
        inner = typing.get_args(expected)[0]
        numbered = enumerate(value)
        return [p for i, part in numbered for p in schema_problems(part, inner, f"{place[:-1]}[{i}].")]
    try:
        msgspec.convert(value, expected)
    except msgspec.ValidationError as error:
        return [f"{place[:-1]} = {value!r}: {plain_words(str(error).split(' - at')[0])}"]
    return []


def _struct_problems(value: Mapping[str, Any], expected: type[msgspec.Struct], place: str) -> list[str]:
    hints = typing.get_type_hints(expected)
    fields = {field.name: field for field in msgspec.structs.fields(expected)}
    problems = [f"{place}{key}: unknown key{did_you_mean(key, fields)}" for key in value if key not in fields]
    problems += [f"{place}{name}: missing" for name, field in fields.items() if field.required and name not in value]
    for key, part in value.items():
        if key in fields:
            problems += schema_problems(part, hints[key], f"{place}{key}.")
    return problems


def meaning_problems(m: RegisterMap) -> list[str]:
    """Return one sentence for each contradiction in a map that follows the schema."""
    parts = (
        _signals, _overlaps, _references, _commands, _axis, _dead_man, _proofs, _restart, _ports, _alarms, _golden,
    )  # fmt: skip
    return [problem for part in parts for problem in part(m)]


def _signals(m: RegisterMap) -> Iterator[str]:
    for name, signal in m.signals.items():
        place = f"signals.{name}"
        if signal.count < 1:
            yield f"{place}: count is {signal.count}; want at least 1"
        if signal.type == "text" and signal.words < 1:
            yield f"{place}: a text needs words, the number of registers it takes"
        if signal.scale == 0:
            yield f"{place}: scale is 0; want another number"
        if not 0 <= signal.address <= 0x10000 - max(1, signal.span):
            yield f"{place}: address {signal.address:#x} with {signal.span} places leaves 0 to 0xffff"
        most = MAX_READ_BITS if signal.is_bits else MAX_READ_REGISTERS
        if signal.span > most:
            yield f"{place}: {signal.span} places; one message reads at most {most}"
        yield from _unit(f"{place}.unit", signal.unit)


def _unit(place: str, unit: str) -> Iterator[str]:
    if unit not in UNITS:
        near = did_you_mean(unit, UNITS) or f"; there are: {', '.join(filter(None, UNITS))}, and none"
        yield f"{place}: unknown unit {unit!r}{near}"


def _overlaps(m: RegisterMap) -> Iterator[str]:
    def order(item: tuple[str, Signal]) -> tuple[str, int]:
        return item[1].table, item[1].address

    signals = sorted(m.signals.items(), key=order)
    for (name, signal), (next_name, following) in pairwise(signals):
        if signal.table == following.table and signal.address + signal.span > following.address:
            last = signal.address + signal.span - 1
            yield (
                f"signals.{next_name}: begins at {following.address:#06x} inside signals.{name} "
                f"({signal.address:#06x} to {last:#06x} of the {signal.table} table)"
            )


def _references(m: RegisterMap) -> Iterator[str]:
    for group, names in m.poll.items():
        if group not in POLL_GROUPS:
            yield f"poll.{group}: unknown group{did_you_mean(group, POLL_GROUPS)}"
        for name in names:
            yield from _signal(m, f"poll.{group}", name)
    for i, test in enumerate(m.identify):
        yield from _signal(m, f"identify[{i}]", test.signal)
        if test.minimum is None and test.maximum is None and not test.contains and not test.equals_setting:
            yield f"identify[{i}]: tests nothing; want minimum, maximum, contains or equals_setting"


def _signal(m: RegisterMap, place: str, name: str) -> Iterator[str]:
    if name not in m.signals:
        yield f"{place}: unknown signal {name}{did_you_mean(name, m.signals)}"


def _commands(m: RegisterMap) -> Iterator[str]:
    for name, command in m.commands.items():
        place = f"commands.{name}"
        if name not in COMMANDS:
            yield f"{place}: unknown command{did_you_mean(name, COMMANDS)}"
        elif command.repeat and not COMMANDS[name]:
            yield f"{place}: repeat is true, but {name} has an effect each time it is sent; want false"
        if not command.writes:
            yield f"{place}: writes nothing"
        yield from _writes(m, place, command)


def _writes(m: RegisterMap, place: str, command: Command) -> Iterator[str]:
    for i, write in enumerate(command.writes):
        here = f"{place}.writes[{i}]"
        size = sum(width(item.type) for item in write.items)
        if not 1 <= size <= MAX_WRITE_REGISTERS:
            yield f"{here}: {size} registers; want 1 to {MAX_WRITE_REGISTERS}"
        if not 0 <= write.address <= 0x10000 - size:
            yield f"{here}: address {write.address:#x} with {size} registers leaves 0 to 0xffff"
        if write.function == "single" and size != 1:
            yield f"{here}: function single writes one register, not {size}"
        yield from _coil(here, write)
        for j, item in enumerate(write.items):
            yield from _item(m, f"{here}.items[{j}]", item)


def _coil(place: str, write: Write) -> Iterator[str]:
    if write.table == "coil" and (len(write.items) != 1 or write.items[0].value not in (0, 1)):
        yield f"{place}: a coil takes one item with value 0 or 1"


def _item(m: RegisterMap, place: str, item: Item) -> Iterator[str]:
    if item.type == "text":
        yield f"{place}: a text cannot be written"
        return
    ways = [name for name in ("value", "source", "values") if getattr(item, name) not in (None, ())]
    if len(ways) != 1:
        count = {0: "neither value nor source", 2: f"both {' and '.join(ways)}"}.get(len(ways), "all of them")
        yield f"{place}: has {count}; want exactly one"
        return
    yield from _alternates(m, place, item)
    for value in item.values if item.value is None else (item.value,):
        try:
            to_words(value, item.type, m.word_order)
        except ValueError as error:
            yield f"{place}: {error}"
    if item.source is None:
        return
    if item.scale == 0:
        yield f"{place}: scale is 0; want another number"
    yield from _unit(f"{place}.unit", item.unit)
    yield from _item_source(place, item)


def _alternates(m: RegisterMap, place: str, item: Item) -> Iterator[str]:
    """Check an item that only acts when the register changes."""
    if item.differs_from is not None:
        yield from _signal(m, f"{place}.differs_from", item.differs_from)
        if len(set(item.values)) < 2:
            yield (f"{place}: values are {list(item.values)}; want two that differ, one of which changes the register")
    elif item.values:
        yield f"{place}: values without differs_from, the signal of the register they change"


def _item_source(place: str, item: Item) -> Iterator[str]:
    source = item.source or ""
    if source not in SOURCES:
        yield f"{place}: unknown quantity {source}{did_you_mean(source, SOURCES)}"
    elif item.unit in UNITS and UNITS[item.unit].si != SOURCES[source]:
        right = [name for name, unit in UNITS.items() if unit.si == SOURCES[source]]
        yield f"{place}: {source} cannot be in {item.unit!r}; want one of {', '.join(right)}"
    if item.type in RANGES:
        low, high = RANGES[item.type]
        for key, bound in (("minimum", item.minimum), ("maximum", item.maximum)):
            if bound is not None and not low <= bound <= high:
                yield f"{place}: {key} {bound} does not fit type {item.type}; want {low} to {high}"


def _axis(m: RegisterMap) -> Iterator[str]:
    axis = m.axis
    if axis is None:
        if not m.ports:
            yield "axis: missing, and ports too; a device has one or the other"
        return
    for mode in axis.modes:
        if mode not in MODES:
            yield f"axis.modes: unknown mode {mode}{did_you_mean(mode, MODES)}"
        elif mode.lower() not in m.commands:
            yield f"axis.modes: {mode} needs commands.{mode.lower()}"
    for name in ("stop", "fastest"):
        if name not in m.commands:
            yield f"commands.{name}: missing; an axis must have a stop that needs no prior state"
        elif not m.commands[name].repeat:
            yield f"commands.{name}: repeat is false; a stop must be repeatable"
    for name in filter(None, (axis.position, axis.velocity)):
        yield from _signal(m, "axis", name)
        if name in m.signals and name not in m.poll.get("always", ()):
            yield f"poll.always: {name} is missing, the axis reads it in every poll"
    yield from _status(m)


def _status(m: RegisterMap) -> Iterator[str]:
    axis = m.axis
    if axis is None:
        return
    for name, bit in axis.status.items():
        place = f"axis.status.{name}"
        if name not in STATUS_NAMES:
            yield f"{place}: unknown status{did_you_mean(name, STATUS_NAMES)}"
        yield from _signal(m, place, bit.signal)
        if bit.signal in m.signals:
            bits = 16 * m.signals[bit.signal].span
            if not 0 <= bit.bit < bits:
                yield f"{place}: bit {bit.bit} of {bit.signal}; want 0 to {bits - 1}"
            if bit.signal not in m.poll.get("always", ()):
                yield f"poll.always: {bit.signal} is missing, the status reads it in every poll"
    if not {"moving", "done"} & set(axis.status):
        yield "axis.status: neither moving nor done; the end of a move could not be seen"


def _dead_man(m: RegisterMap) -> Iterator[str]:
    dead = m.dead_man
    if dead.by != "none" and dead.timeout_s <= 0:
        yield f"dead_man.timeout_s: is {dead.timeout_s} s; want more than 0"
    if dead.by == "refresh" and not dead.refresh:
        yield "dead_man.refresh: names no command that must be sent again"
    if dead.alarm and (m.alarms is None or "reset" not in m.commands):
        yield "dead_man.alarm: needs alarms and commands.reset, by which it is told and cleared"
    for name in dead.refresh:
        if name not in m.commands:
            yield f"dead_man.refresh: unknown command {name}{did_you_mean(name, m.commands)}"


def _proofs(m: RegisterMap) -> Iterator[str]:
    dead = m.dead_man
    named = [(f"dead_man.proof[{i}]", proof) for i, proof in enumerate(dead.proof)]
    if dead.tripped is not None:
        named.append(("dead_man.tripped", dead.tripped))
        if "watchdog_restart" not in m.commands:
            yield "dead_man.tripped: needs commands.watchdog_restart, which ends it"
    for place, proof in named:
        yield from _signal(m, place, proof.signal)
        yield from _proof(m, place, proof)
    if "watchdog" in m.commands and not dead.proof:
        yield (
            "dead_man.proof: missing; what commands.watchdog sets must be read back, or nobody knows whether it runs"
        )


def _proof(m: RegisterMap, place: str, proof: Proof) -> Iterator[str]:
    if proof.minimum is None and proof.maximum is None and proof.equals is None and proof.source is None:
        yield f"{place}: tests nothing; want equals, minimum, maximum or source"
    if proof.source is not None and proof.source != "timeout":
        yield f"{place}: unknown quantity {proof.source}; want timeout"
    signal = m.signals.get(proof.signal)
    if signal is not None and (signal.count > 1 or signal.type == "text"):
        yield f"{place}: {proof.signal} is not a single number"


def _restart(m: RegisterMap) -> Iterator[str]:
    restart = m.restart
    for key, name in (("counter", restart.counter), ("token", restart.token)):
        if name:
            yield from _signal(m, f"restart.{key}", name)
    if bool(restart.token) != ("token" in m.commands):
        yield "restart.token: needs commands.token, which writes it; want both or neither"
    if restart.token and restart.maximum - restart.minimum < 1:
        yield f"restart: the token is {restart.minimum} to {restart.maximum}; want a wider range"


def _ports(m: RegisterMap) -> Iterator[str]:
    for name, port in m.ports.items():
        place = f"ports.{name}"
        yield from _signal(m, place, port.signal)
        signal = m.signals.get(port.signal)
        if signal is None:
            continue
        if port.node_class == "binary" and not signal.is_bits:
            yield f"{place}: binary, but {port.signal} is in the {signal.table} table; want coil or discrete"
        if port.node_class == "binary" and signal.count > 62:
            yield f"{place}: {signal.count} bits; a port has at most 62"
        if port.node_class == "analog" and (signal.is_bits or signal.type == "text"):
            yield f"{place}: analog, but {port.signal} does not hold numbers"
        if port.writable and port.node_class == "analog":
            yield from _fits(f"{place}.minimum", signal, port.minimum)
            yield from _fits(f"{place}.maximum", signal, port.maximum)
        if port.writable and signal.table in ("input", "discrete"):
            yield f"{place}: writable, but the {signal.table} table is read-only; want holding or coil"
    for model, counts in m.models.items():
        for name, count in counts.items():
            if name not in m.ports:
                yield f"models.{model}: unknown port {name}{did_you_mean(name, m.ports)}"
            elif (signal := m.signals.get(m.ports[name].signal)) and not 0 <= count <= signal.count:
                yield f"models.{model}.{name}: {count} channels; want 0 to {signal.count}"


def _fits(place: str, signal: Signal, value: float | None) -> Iterator[str]:
    """Check that a value in SI can be written to a register, of one that does not count turns or pulses."""
    unit = UNITS.get(signal.unit)
    if value is None or unit is None or unit.per is not Per.ITSELF or signal.scale == 0 or signal.type not in RANGES:
        return
    low, high = sorted((raw + signal.offset) * signal.scale * unit.factor for raw in RANGES[signal.type])
    if not low <= value <= high:
        yield (
            f"{place}: {value:g} {unit.si} does not fit {signal.type} at {signal.address:#06x}, which takes "
            f"{low:g} to {high:g}"
        )


def _alarms(m: RegisterMap) -> Iterator[str]:
    if m.alarms is None:
        return
    yield from _signal(m, "alarms", m.alarms.signal)
    for code in m.alarms.codes:
        try:
            int(code, 0)
        except ValueError:
            yield f"alarms.codes: {code!r} is not a number; write it in decimal or as 0x…"


def _golden(m: RegisterMap) -> Iterator[str]:
    for i, frame in enumerate(m.golden):
        place = f"golden[{i}]"
        if bool(frame.command) == bool(frame.signals):
            yield f"{place}: names {'both' if frame.command else 'neither'} a command and signals; want one"
        if frame.command and frame.command not in m.commands:
            yield f"{place}: unknown command {frame.command}{did_you_mean(frame.command, m.commands)}"
        for name in {*frame.signals, *frame.values} - set(m.signals):
            yield f"{place}: unknown signal {name}{did_you_mean(name, m.signals)}"
        for text in (*frame.requests, frame.reply):
            try:
                bytes.fromhex(text)
            except ValueError:
                yield f"{place}: {text!r} is not hexadecimal; want e.g. '01 06 60 02 00 40 37 fa'"
