"""Register maps: a Modbus device family described in one TOML file, without code.

A map tells how a device is identified, which registers are read in every poll, what their numbers
mean in SI units, what the bits of the status say, which writes make up a command and whether it may
be repeated, how it is stopped, what dead-man it has, and its alarm codes. ``docs/register-maps.md``
explains every key by example; the structs below are the schema. ``regmap_files`` reads and checks files.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from .registers import Rounding, TypeName, WordOrder, width

Table = Literal["holding", "input", "coil", "discrete"]


class Schema(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of the schema: unknown keys are errors."""


class Signal(Schema, frozen=True):
    """A value, or an array of values, in registers or bits.

    Args:
        address: of the first register or bit.
        type: of one value; coils and discrete inputs have none.
        table: where it is.
        count: number of values, one after the other.
        words: length of a text [registers].
        unit, scale, offset: SI = (raw + offset) * scale * unit.
        word_order: of 32-bit values, when it differs from the map's.
        verified: False for what was not tried on a device or found in the vendor's documents.
        note: free text.
    """

    address: int
    type: TypeName = "u16"
    table: Table = "holding"
    count: int = 1
    words: int = 0
    unit: str = ""
    scale: float = 1.0
    offset: float = 0.0
    word_order: WordOrder | None = None
    verified: bool = True
    note: str = ""

    @property
    def is_bits(self) -> bool:
        """Whether it lies among coils or discrete inputs."""
        return self.table in ("coil", "discrete")

    @property
    def span(self) -> int:
        """Number of registers, or bits, that it covers."""
        return self.count if self.is_bits else self.count * width(self.type, self.words)


class Identify(Schema, frozen=True):
    """One test of identity: the signal must lie in a range, or contain a text."""

    signal: str
    minimum: float | None = None
    maximum: float | None = None
    contains: str | None = None
    equals_setting: str | None = None
    """Name of a setting of the device that it must equal, e.g. ``pulses_per_turn``."""


class Bit(Schema, frozen=True):
    """A bit of a signal of the status."""

    signal: str
    bit: int
    inverted: bool = False


class Item(Schema, frozen=True):
    """One value of a write: a constant, a quantity of the command converted to the unit, or one that changes the
    register.

    Args:
        type: of the registers.
        value: the constant.
        values: constants of which the first is written that ``differs_from`` does not read just before the command.
        differs_from: signal of the register that only acts when it is modified.
        source: name of the quantity: position, velocity, acceleration, deceleration, speed (|velocity|) ...
        unit, scale: as for a signal.
        minimum, maximum: raw numbers that the device accepts.
        round: "down" never passes the asked value in size, "up" never stays below it.
    """

    type: TypeName = "u16"
    value: int | None = None
    values: tuple[int, ...] = ()
    differs_from: str | None = None
    source: str | None = None
    unit: str = ""
    scale: float = 1.0
    minimum: int | None = None
    maximum: int | None = None
    round: Rounding = "nearest"


class Write(Schema, frozen=True):
    """One message to the device: items into consecutive registers, or one coil."""

    address: int
    items: tuple[Item, ...]
    table: Literal["holding", "coil"] = "holding"
    function: Literal["single", "multiple"] = "multiple"
    pause_s: float = 0.0
    """Time that the device needs after it [s]."""


class Command(Schema, frozen=True):
    """Writes that belong together.

    Args:
        writes: in order.
        repeat: whether the whole may be sent again after a failed exchange; never for relative moves,
            jog starts, "position := x" and EEPROM writes.
        verified: as for a signal.
    """

    writes: tuple[Write, ...]
    repeat: bool = False
    verified: bool = True
    note: str = ""


class Proof(Schema, frozen=True):
    """What a signal reads while something holds: a number, a range, or a quantity of the command that set it.

    Args:
        signal: that is read.
        equals: number that it must read, in SI.
        minimum, maximum: or the range.
        source: or the quantity: ``timeout``.
    """

    signal: str
    equals: float | None = None
    minimum: float | None = None
    maximum: float | None = None
    source: str | None = None


class DeadMan(Schema, frozen=True):
    """What the device itself does when its host falls silent.

    Args:
        by: "refresh": a command must be sent again within ``timeout_s``; "link": any message counts;
            "none": the device goes on.
        timeout_s: of the device [s].
        refresh: commands that must be sent again (by = "refresh").
        proof: what is read while it is set and runs: after ``commands.watchdog``, where the map has that, and in the
            polls. A device that reads otherwise is not opened, or opened again.
        tripped: what is read when it has acted and holds the outputs until ``commands.watchdog_restart``.
        alarm: by which a drive tells that it has acted; reset at opening, for every end of a host raises it.
    """

    by: Literal["refresh", "link", "none"] = "none"
    timeout_s: float = 0.0
    refresh: tuple[str, ...] = ()
    proof: tuple[Proof, ...] = ()
    tripped: Proof | None = None
    alarm: int = 0
    note: str = ""


class Restart(Schema, frozen=True):
    """What tells that a device was off meanwhile, even if it answers again before its link counts as lost.

    Args:
        counter: signal that only grows while the device is on: its uptime.
        token: signal of a register that a power cycle sets back and that nothing else uses; ``commands.token`` writes
            it at opening, the polls look whether it still reads so.
        minimum, maximum: of the token; its value after switching on is not among them.
        keeps_place: the drive knows its position after a power cycle: an absolute encoder.
    """

    counter: str = ""
    token: str = ""
    minimum: int = 1
    maximum: int = 999
    keeps_place: bool = False
    note: str = ""


class Alarms(Schema, frozen=True):
    """Alarm codes as text; keys are numbers, decimal or 0x…"""

    signal: str
    codes: dict[str, str] = {}
    lasting: tuple[int, ...] = ()
    """Codes that only a power cycle clears."""
    place_lost: tuple[int, ...] = ()
    """Codes after which the position means nothing until the axis is homed or calibrated."""


class Axis(Schema, frozen=True):
    """What makes the device an axis.

    Args:
        modes: control modes that exist: POSITION, VELOCITY, FORCE; each has a command of its name in lower case.
        position, velocity: signals of the readings; without velocity the position is differentiated.
        status: names of :data:`STATUS_NAMES` to bits.
    """

    modes: tuple[str, ...]
    position: str
    velocity: str | None = None
    status: dict[str, Bit] = {}


class Port(Schema, frozen=True):
    """A block of binary or analog channels.

    Args:
        signal: its values; the number of channels is the model's, or the setting's.
        node_class: binary (bits make one port) or analog.
        name: of the node, when it differs from the port's.
        writable: whether clients may write it.
        minimum, maximum: accepted analog values [SI].
    """

    signal: str
    node_class: Literal["binary", "analog"]
    name: str = ""
    writable: bool = False
    minimum: float | None = None
    maximum: float | None = None


class GoldenFrame(Schema, frozen=True):
    """Messages out of the vendor's manual, which the map must make or read.

    Args:
        requests: what is sent, in hex, one a message.
        transport: what frames them: "rtu", with address and CRC; "tcp", with a header whose transactions count from 1.
        command: that sends them, with its ``quantities``; lengths in turns of the motor, else in SI.
        quantities: by name.
        signals: or what is read by them.
        reply: to the first request, in hex.
        values: that the reply gives, by signal.
        pulses_per_turn: of the motor.
    """

    requests: tuple[str, ...]
    transport: Literal["rtu", "tcp"] = "rtu"
    command: str = ""
    quantities: dict[str, float] = {}
    signals: tuple[str, ...] = ()
    reply: str = ""
    values: dict[str, float | str | list[float]] = {}
    pulses_per_turn: float = 10000.0


class RegisterMap(Schema, frozen=True, kw_only=True):
    """A device family."""

    family: str
    title: str
    source: str
    word_order: WordOrder = "big"
    turnaround_s: float = 0.1
    gap_s: float = 0.0
    """Silence that the device needs between frames, beyond the line's own [s]."""
    merge_gap: int = 0
    """Unused registers that a read may cross to join two signals; 0 where they may be illegal."""
    identify: tuple[Identify, ...] = ()
    poll: dict[str, tuple[str, ...]] = {}
    """Group name to signals: "always" in each poll, "seldom" about once a second, "open" once."""
    signals: dict[str, Signal]
    commands: dict[str, Command] = {}
    axis: Axis | None = None
    ports: dict[str, Port] = {}
    models: dict[str, dict[str, int]] = {}
    """Model name to the number of channels of each port."""
    dead_man: DeadMan = DeadMan()
    restart: Restart = Restart()
    alarms: Alarms | None = None
    golden: tuple[GoldenFrame, ...] = ()
