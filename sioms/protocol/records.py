"""Records: little-endian structs of fixed size, one per channel; each is one table of named columns.

Writing follows table F.3 of the dissertation column by column. Reading is kept as one array per
column ("struct of arrays") in the shared page, because a driver fills and a client takes whole
columns; the record of one channel is one value of each.

The classes ``AxisWrite``, ``AxisRead``, ... are the tables. Everything else is made from them and asks for columns by
name: structs and dtypes, the rows of blocks and banks, snapshots and readings, which words of a command set which flag,
what devout takes, and ``docs/records.md``. The order in a table is the order on the wire.

Units are SI and declared per channel in the node's information: {u} is m or rad, {f} is N or N*m.
Time is in seconds in records and integer nanoseconds of CLOCK_MONOTONIC in stamps.
"""

from __future__ import annotations

from struct import Struct

from .flags import ControlMode, NodeClass

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import Any


class Column:
    """One column of a record.

    Attributes:
        name: as it is in the table.
        code: of struct.
        unit: with {u} for the unit of the channel and {f} for that of its force; empty for none.
        text: what it is.
        flag: the ControlMode flag without which the column of a command is ignored; 0: it always holds.
    """

    __slots__ = ("code", "flag", "name", "text", "unit")

    def __init__(self, code: str, unit: str, text: str, flag: int) -> None:
        self.name = ""
        self.code = code
        self.unit = unit
        self.text = text
        self.flag = flag

    def __set_name__(self, _owner: type, name: str) -> None:
        self.name = name


def _real(unit: str, text: str, flag: int = 0) -> Any:
    return Column("d", unit, text, int(flag))


def _whole(text: str, flag: int = 0, *, code: str = "q", unit: str = "") -> Any:
    return Column(code, unit, text, int(flag))


class AxisWrite:
    """A command for an axis."""

    axis: int = _whole("index of the axis in the node", code="i")
    control_mode: int = _whole("ControlMode flags: what is commanded, and which columns hold", code="I")
    signal_marker_number: int = _whole(
        "marker signalled at the end: its token, or its number", ControlMode.SPECIFIED_SIGNAL_MARKER
    )
    wait_marker_number: int = _whole(
        "marker waited for at the beginning: its token, or its number", ControlMode.SPECIFIED_WAIT_MARKER
    )
    position: float = _real("{u}", "position to go to", ControlMode.POSITION)
    velocity: float = _real(
        "{u}/s", "velocity to go over to, or with which the position is passed", ControlMode.VELOCITY
    )
    acceleration: float = _real(
        "{u}/s^2", "acceleration, or with a velocity the greatest one", ControlMode.ACCELERATION
    )
    jerk: float = _real("{u}/s^3", "jerk", ControlMode.JERK)
    max_velocity: float = _real(
        "{u}/s",
        "greatest velocity from now on; a force that is commanded with it ends at this speed",
        ControlMode.SPECIFIED_MAX_VEL_ACC,
    )
    max_acceleration: float = _real("{u}/s^2", "greatest acceleration from now on", ControlMode.SPECIFIED_MAX_VEL_ACC)
    time: float = _real("s", "duration; below 0 it lasts until the next command", ControlMode.SPECIFIED_TIME)
    k: float = _real("", "gain k of the control law", ControlMode.SPECIFIED_GAINS)
    kz: float = _real("", "gain kz of the control law", ControlMode.SPECIFIED_GAINS)
    kp: float = _real("", "gain kp of the control law", ControlMode.SPECIFIED_GAINS)
    kb: float = _real("", "gain kb of the control law", ControlMode.SPECIFIED_GAINS)
    force_offset: float = _real("{f}", "force added to that of the control law", ControlMode.SPECIFIED_FORCE_OFFSET)
    force: float = _real("{f}", "force to press with", ControlMode.FORCE)
    force_velocity: float = _real("{f}/s", "rate at which the force grows", ControlMode.FORCE_VELOCITY)
    max_force: float = _real("{f}", "greatest force from now on", ControlMode.SPECIFIED_MAX_FORCE)


class AnalogWrite:
    """A value for an analog output."""

    channel: int = _whole("index of the channel in the node", code="i")
    reserved: int = _whole("0", code="I")
    data: float = _real("{u}", "the value")


class BinaryWrite:
    """Bits for a binary port."""

    channel: int = _whole("index of the channel in the node", code="i")
    reserved: int = _whole("0", code="I")
    data: int = _whole("the bits; of a node of one bit 0 or 1")
    mask: int = _whole("which bits are written; 0: all")


class AxisRead:
    """The readings of an axis."""

    position: float = _real("{u}", "measured position")
    velocity: float = _real("{u}/s", "filtered measured velocity")
    force: float = _real("{f}", "force or torque applied by the actuator")
    k: float = _real("", "gain k of the control law")
    kz: float = _real("", "gain kz of the control law")
    kp: float = _real("", "gain kp of the control law")
    kb: float = _real("", "gain kb of the control law")
    commanded_position: float = _real("{u}", "position that the profile asks for now")
    commanded_velocity: float = _real("{u}/s", "velocity that the profile asks for now")
    following_error: float = _real("{u}", "commanded minus measured position")
    in_motion: int = _whole("1 while a command is being carried out")
    status: int = _whole("AxisStatus flags")
    buffered: int = _whole("commands that wait in the buffer; the running one has left it")


class AnalogRead:
    """The reading of an analog channel."""

    data: float = _real("{u}", "the value")
    flags: int = _whole("AnalogStatus flags, 0 = good")


class BinaryRead:
    """The reading of a binary port."""

    data: int = _whole("the bits; of a node of one bit 0 or 1")
    changed_ns: int = _whole("time of the port's last edge, CLOCK_MONOTONIC", unit="ns")
    edges: int = _whole("edges of the port since the driver started")


def columns(table: type) -> dict[str, Column]:
    """Return the columns of a table by name, in order."""
    return {name: column for name, column in vars(table).items() if isinstance(column, Column)}


def struct(table: dict[str, Column]) -> Struct:
    """Return the struct of a record."""
    return Struct("<" + "".join([column.code for column in table.values()]))


READ = {
    NodeClass.AXIS: columns(AxisRead),
    NodeClass.ANALOG: columns(AnalogRead),
    NodeClass.BINARY: columns(BinaryRead),
}
WRITE = {
    NodeClass.AXIS: columns(AxisWrite),
    NodeClass.ANALOG: columns(AnalogWrite),
    NodeClass.BINARY: columns(BinaryWrite),
}
VALUE = {NodeClass.AXIS: "position", NodeClass.ANALOG: "data", NodeClass.BINARY: "data"}
"""The column that is the value of a channel."""

WRITE_STRUCT = {cls: struct(table) for cls, table in WRITE.items()}
READ_SIZE = {cls: 8 * len(table) for cls, table in READ.items()}
"""Bytes of one channel's reading: every column takes 8."""

AXIS_WRITE = WRITE_STRUCT[NodeClass.AXIS]
BINARY_WRITE = WRITE_STRUCT[NodeClass.BINARY]
ANALOG_WRITE = WRITE_STRUCT[NodeClass.ANALOG]


def numpy_dtype(node_class: NodeClass) -> list[tuple[str, str]]:
    """Return the numpy dtype description of a write record (no numpy needed to call this).

    Example:
        >>> numpy_dtype(NodeClass.ANALOG)
        [('channel', '<i4'), ('reserved', '<u4'), ('data', '<f8')]
    """
    code = {"i": "<i4", "I": "<u4", "q": "<i8", "d": "<f8"}
    return [(name, code[column.code]) for name, column in WRITE[node_class].items()]


def read_rows(node_class: NodeClass, fields: Any) -> dict[str, Any]:
    """Return the rows of an array of readings by name: views of its memory, in the type of their column.

    Args:
        node_class: whose readings.
        fields: shape (columns, channels) float64, as they are in a page.
    """
    words = fields.view("<i8")
    table = READ[node_class].values()
    return {column.name: fields[row] if column.code == "d" else words[row] for row, column in enumerate(table)}


def tuple_of(name: str, names: Iterable[str]) -> Any:
    """Return a named tuple class of columns, to be derived from beside their table, which tells type checkers about
    them.
    """
    from collections import namedtuple  # a tenth of the start time of a shell tool

    return namedtuple(name, names)
