"""Records: little-endian structs of fixed size, one per channel.

Writing follows table F.3 of the dissertation field by field. Reading is kept as one array per
field ("struct of arrays") in the shared page, because a driver fills and a client takes whole
fields; the record of one channel is the column.

Units are SI and declared per channel in the node's information: m or rad, m/s or rad/s, N or N*m.
Time is in seconds in records and integer nanoseconds of CLOCK_MONOTONIC in stamps.
"""

from struct import Struct

from .flags import NodeClass

# axis: index in the node; markers: token (key and number) or bare number, see markers.py.
AXIS_WRITE_FIELDS = (
    ("axis", "i"),
    ("control_mode", "I"),
    ("signal_marker_number", "q"),
    ("wait_marker_number", "q"),
    ("position", "d"),
    ("velocity", "d"),
    ("acceleration", "d"),
    ("jerk", "d"),
    ("max_velocity", "d"),
    ("max_acceleration", "d"),
    ("time", "d"),
    ("k", "d"),
    ("kz", "d"),
    ("kp", "d"),
    ("kb", "d"),
    ("force_offset", "d"),
    ("force", "d"),
    ("force_velocity", "d"),
    ("max_force", "d"),
)
BINARY_WRITE_FIELDS = (("channel", "i"), ("reserved", "I"), ("data", "q"), ("mask", "q"))
ANALOG_WRITE_FIELDS = (("channel", "i"), ("reserved", "I"), ("data", "d"))

AXIS_READ_FIELDS = (
    ("position", "d"),
    ("velocity", "d"),
    ("force", "d"),
    ("k", "d"),
    ("kz", "d"),
    ("kp", "d"),
    ("kb", "d"),
    ("commanded_position", "d"),
    ("commanded_velocity", "d"),
    ("following_error", "d"),
    ("in_motion", "q"),
    ("status", "q"),
    ("buffered", "q"),
)
# data: the port as an integer; changed_ns: stamp of its last edge; edges: count of changes since start.
BINARY_READ_FIELDS = (("data", "q"), ("changed_ns", "q"), ("edges", "q"))
ANALOG_READ_FIELDS = (("data", "d"), ("flags", "q"))

READ_FIELDS = {
    NodeClass.AXIS: AXIS_READ_FIELDS,
    NodeClass.ANALOG: ANALOG_READ_FIELDS,
    NodeClass.BINARY: BINARY_READ_FIELDS,
}
WRITE_FIELDS = {
    NodeClass.AXIS: AXIS_WRITE_FIELDS,
    NodeClass.ANALOG: ANALOG_WRITE_FIELDS,
    NodeClass.BINARY: BINARY_WRITE_FIELDS,
}


def _struct(fields: tuple[tuple[str, str], ...]) -> Struct:
    return Struct("<" + "".join(code for _, code in fields))


WRITE_STRUCT = {cls: _struct(fields) for cls, fields in WRITE_FIELDS.items()}
READ_SIZE = {cls: 8 * len(fields) for cls, fields in READ_FIELDS.items()}
"""Bytes of one channel's reading."""

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
    return [(name, code[c]) for name, c in WRITE_FIELDS[node_class]]
