"""The numbers of devout: which numbers a device takes of the input, and the records they make. Pure."""

from __future__ import annotations

from sioms.protocol.flags import ControlMode, NodeClass
from sioms.protocol.records import ANALOG_WRITE, AXIS_WRITE, BINARY_WRITE, WRITE

from .options import Target, UsageError

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence

    from sioms.protocol.nodeinfo import NodeInfo

# The numbers of an axis, always in this order whatever the order of the letters (section F.4.2).
ORDER = (
    ("p", "position"),
    ("v", "velocity"),
    ("a", "acceleration"),
    ("j", "jerk"),
    ("f", "force"),
    ("F", "force_velocity"),
    ("o", "force_offset"),
    ("t", "time"),
    ("m", "wait_marker_number"),
    ("s", "signal_marker_number"),
)
QUANTITIES = "pvajfF"
MOST_WHOLE = 1 << 53
"""The greatest whole number that may be given, either sign: all up to it are numbers of floating point, too."""
_COLUMNS = WRITE[NodeClass.AXIS]


class Columns:
    """The columns of one device.

    Attributes:
        is_axis: whether it has axes.
        count: numbers that one iteration takes for this device.
        replace: each iteration takes over at once from the one before, as a command without a time does;
            else they queue up in the command buffer.
        has_end: motion commanded here comes to an end of its own, so that it can be waited for.

    Args:
        target: the device with its flags.
        info: what the node is.

    Raises:
        UsageError: a structure that the node has not, or a mode for something that is not an axis.
    """

    __slots__ = ("_channels", "_info", "_mode", "_names", "count", "has_end", "is_axis", "replace")

    def __init__(self, target: Target, info: NodeInfo) -> None:
        flags = target.flags
        self._info = info
        self._channels = target.channels(len(info.channels))
        self._mode = ControlMode(0)
        self._names = ["data"]
        self.replace = self.has_end = False
        self.is_axis = info.node_class is NodeClass.AXIS
        letters = [letter for letter, _ in ORDER if letter in flags]
        if self.is_axis:
            if not any(letter in QUANTITIES for letter in letters):
                letters.insert(0, "p")
            self._names = [name for letter, name in ORDER if letter in letters]
            for name in self._names:
                self._mode |= _COLUMNS[name].flag
            queued = any(letter in "tms" for letter in letters)
            self.replace = not queued
            self.has_end = "t" in letters or "p" in letters
        elif letters:
            raise UsageError(
                f"{target.name}: -{letters[0]} applies to axes; this is a node of class {info.node_class.name.lower()}"
            )
        self.count = len(self._channels) * len(self._names)

    def records(self, numbers: Sequence[float]) -> bytes:
        """Make the records of one iteration.

        Args:
            numbers: ``count`` of them, those of one structure after those of the one before.

        Raises:
            ValueError: a number that must be whole is not.
        """
        if self._info.node_class is NodeClass.ANALOG:
            return b"".join([ANALOG_WRITE.pack(c, 0, x) for c, x in zip(self._channels, numbers, strict=True)])
        if self._info.node_class is NodeClass.BINARY:
            return b"".join(
                [BINARY_WRITE.pack(c, 0, _whole(x, "data"), 0) for c, x in zip(self._channels, numbers, strict=True)]
            )
        width = len(self._names)
        return b"".join([self._axis(c, numbers[i * width : (i + 1) * width]) for i, c in enumerate(self._channels)])

    def open_ended(self, numbers: Sequence[float]) -> bool:
        """Tell whether an iteration with these numbers leaves an axis in motion without an end."""
        if not self.has_end:
            return True
        if "time" not in self._names:
            return False
        width, at = len(self._names), self._names.index("time")
        return any(numbers[i * width + at] < 0 for i in range(len(self._channels)))

    def _axis(self, channel: int, numbers: Sequence[float]) -> bytes:
        fields: dict[str, float] = dict.fromkeys(_COLUMNS, 0)
        fields["axis"], fields["control_mode"] = channel, int(self._mode)
        for name, value in zip(self._names, numbers, strict=True):
            fields[name] = value if _COLUMNS[name].code == "d" else _whole(value, name.replace("_", " "))
        return AXIS_WRITE.pack(*fields.values())


def _whole(value: float, what: str) -> int:
    if value != int(value) or not -MOST_WHOLE <= value <= MOST_WHOLE:
        raise ValueError(f"{what} {value:g}; want an integer")
    return int(value)
