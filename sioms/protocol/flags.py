"""Enumerations of the protocol. The numbers are wire facts: never renumber, only append."""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from enum import IntEnum, IntFlag
else:
    from .enumeration import IntEnum, IntFlag

PROTOCOL_VERSION = 6
READONLY = ".readonly"
"""What the name of a node's read-only companion ends with."""


class NodeClass(IntEnum):
    """Class of a device node (dissertation, table F.1)."""

    BINARY = 1
    ANALOG = 2
    AXIS = 3


class ControlMode(IntFlag):
    """The ``control_mode`` field of an axis write record (dissertation, table F.4).

    Exactly one of the first six says what is commanded, with two extensions: POSITION together with
    VELOCITY (and ACCELERATION) commands a position that is passed with that velocity (and
    acceleration) instead of reached at rest; VELOCITY together with ACCELERATION goes over to that
    velocity with that acceleration at most. The other flags say which further fields hold.
    """

    JERK = 0x0001
    ACCELERATION = 0x0002
    VELOCITY = 0x0004
    POSITION = 0x0008
    FORCE = 0x0010
    FORCE_VELOCITY = 0x0020
    SPECIFIED_TIME = 0x0040
    WAIT_FOR_EXTERNAL_SYNCH = 0x0080
    SPECIFIED_GAINS = 0x0100
    SPECIFIED_FORCE_OFFSET = 0x0200
    SPECIFIED_MAX_VEL_ACC = 0x0400
    SPECIFIED_MAX_FORCE = 0x0800
    SPECIFIED_WAIT_MARKER = 0x1000
    SPECIFIED_SIGNAL_MARKER = 0x2000
    RELATIVE = 0x4000
    """Beyond the table: ``position`` counts from where the preceding command ends."""


QUANTITIES = 0x003F
"""Mask of the flags that say what is commanded."""


class AxisStatus(IntFlag):
    """The ``status`` word of an axis reading."""

    MOVING = 0x0001
    FORCE_MODE = 0x0002
    LIMIT_MINUS = 0x0004
    LIMIT_PLUS = 0x0008
    HOMED = 0x0010
    FOLLOWING_ERROR = 0x0020
    FAULT = 0x0040
    EMERGENCY_STOP = 0x0080
    WAITING_MARKER = 0x0100
    WAITING_SYNCH = 0x0200
    SATURATED = 0x0400
    HOMING = 0x0800
    STOPPING = 0x1000
    SWITCH_MINUS = 0x2000
    SWITCH_PLUS = 0x4000
    STALLED = 0x8000
    MISSED_TARGET = 0x10000
    """The last point move ended farther from its target than the tolerance, after all its retries."""
    POSITION_LOST = 0x20000
    """The device may have lost its place: no positions are taken until HOME or CALIBRATE_DEVICE; RESET keeps it."""

    FORCE_ENDED = 0x40000
    """The last force command met a limit of velocity or position before its end: what holds now is the position."""

    @property
    def severity(self) -> int:
        """How bad it is: 0 good, 1 minor (a limit, a miss, a force that met none, saturation), 2 major (fault, stall,
        emergency stop, lost place).
        """
        return 2 if int(self) & 0x280E0 else 1 if int(self) & 0x5640C else 0


class AnalogStatus(IntFlag):
    """The ``flags`` word of an analog reading; 0 is a good value."""

    SATURATED = 0x1
    INVALID = 0x2
    OVERRUN = 0x4
    """Samples were lost before this one."""
    LOW = 0x8
    HIGH = 0x10
    LOLO = 0x20
    HIHI = 0x40
    """At or beyond a limit of its ``[[alarm]]``."""

    @property
    def severity(self) -> int:
        """How bad it is: 0 good, 1 minor, 2 major."""
        return 2 if int(self) & 0x62 else 1 if int(self) & 0x1D else 0


class Severity(IntEnum):
    """How bad an alarm is; the words are those of EPICS."""

    NONE = 0
    MINOR = 1
    MAJOR = 2
    INVALID = 3
    """What is to be watched cannot be read."""


class Reaction(IntEnum):
    """What an alarm stops, until that is reset."""

    NONE = 0
    STOP_NODE = 1
    STOP_DEVICE = 2
    STOP_WORKCELL = 3


class Request(IntEnum):
    """ioctl requests (dissertation, table F.5, and beyond it from STOP on); see ``REQUESTS``."""

    GET_IO_STRUCT_INFO = 1
    CALIBRATE_DEVICE = 2
    ZERO_DEVICE = 3
    WAIT_UNTIL_IDLE = 4
    SEND_EXTERNAL_SYNCH = 5
    EMERGENCY_STOP = 6
    SIGNAL_MARKER = 7
    WAIT_MARKER = 8
    RESERVE_MARKER = 9
    FREE_MARKER = 10
    WAIT_UNTIL_EVENT = 11
    SET_GAINS = 12
    GET_GAINS = 13
    STOP = 20
    RESET = 21
    HOME = 22
    SET_LIMITS = 23
    GET_LIMITS = 24
    FLUSH = 25
    CANCEL_WAITS = 26
    GET_STATISTICS = 27
    GET_DIAGNOSTICS = 28


class Access(IntFlag):
    """Mode of an open: what the handle may do."""

    READ = 1
    WRITE = 2


class Right(IntFlag):
    """What the configuration grants a user on a node."""

    READ = 1
    WRITE = 2
    STOP = 4
    ADMINISTER = 8
    ALL = 15


REQUESTS: dict[int, tuple[Right, bool, bool, str]] = {
    Request.GET_IO_STRUCT_INFO: (Right.WRITE, False, False, "describe the node; answered by the client library"),
    Request.CALIBRATE_DEVICE: (
        Right.WRITE,
        True,
        False,
        "define the present positions, one an axis; nil: an axis keeps the one that it has",
    ),
    Request.ZERO_DEVICE: (Right.WRITE, True, False, "define the present position or reading as 0"),
    Request.WAIT_UNTIL_IDLE: (Right.READ, False, True, "wait until axes are at rest and their buffers are empty"),
    Request.SEND_EXTERNAL_SYNCH: (Right.WRITE, False, False, "start all commands that wait for the external synch"),
    Request.EMERGENCY_STOP: (Right.STOP, False, False, "stop the node until it is reset"),
    Request.SIGNAL_MARKER: (Right.WRITE, False, False, "signal a marker; passed on to the daemon"),
    Request.WAIT_MARKER: (Right.WRITE, False, False, "wait for a marker; passed on to the daemon"),
    Request.RESERVE_MARKER: (Right.WRITE, False, False, "reserve a marker; passed on to the daemon"),
    Request.FREE_MARKER: (Right.WRITE, False, False, "free a marker; passed on to the daemon"),
    Request.WAIT_UNTIL_EVENT: (
        Right.READ,
        False,
        False,
        "wait for an edge; answered by the client library, from the page",
    ),
    Request.SET_GAINS: (Right.WRITE, True, False, "set the gain matrix"),
    Request.GET_GAINS: (Right.READ, False, True, "return the gain matrix"),
    Request.STOP: (Right.STOP | Right.WRITE, False, False, "stop at maximum deceleration and empty the buffers"),
    Request.RESET: (Right.WRITE | Right.ADMINISTER, False, False, "clear stops and faults of the node"),
    Request.HOME: (Right.WRITE, True, False, "start homing"),
    Request.SET_LIMITS: (Right.WRITE, True, False, "set limits, within the configured ones"),
    Request.GET_LIMITS: (Right.READ, False, True, "return the limits in force"),
    Request.FLUSH: (Right.WRITE, True, False, "empty the buffers; the running command continues"),
    Request.CANCEL_WAITS: (Right.WRITE | Right.ADMINISTER, False, False, "end the waits of all sessions on the node"),
    Request.GET_STATISTICS: (Right.READ, False, True, "return tick times and link counters"),
    Request.GET_DIAGNOSTICS: (Right.READ, False, True, "return raw position, offset, retries and misses of axes"),
}
"""The table of requests: any of which rights it takes; whether it needs the output node itself, not its read-only
companion; whether it only looks (else a reading after the answer shows its effect); what it does.
"""
OF_SOME_AXES = (Request.ZERO_DEVICE, Request.WAIT_UNTIL_IDLE, Request.STOP, Request.HOME)
"""Requests whose argument may be the index of an axis in the node, or a list of indices; without one they concern all
axes.
"""


class PageState(IntEnum):
    """State words of a page. A reader accepts only GOOD from both the driver and the daemon."""

    STARTING = 0
    GOOD = 1
    LINK_LOST = 2
    FAULT = 3
    STALE = 4
    CLOSED = 5


class WriteFlag(IntFlag):
    """Flags of a WRITE message."""

    APPEND = 0
    REPLACE = 1
    """Empty the buffer first and re-plan from the present state, without a jump."""
    LATEST = 2
    """Do not wait for an acknowledgement line by line: reply only when the write is refused."""
