"""The text of devin: a snapshot and a choice of fields in, characters out. Pure.

The formats are those of the examples in section F.4.1. Values are separated by one blank. With N each
structure is a line, ``0 0 0.0000e+00 0.0000e+00 2.56e+02``, without a blank at its end. Without N every
value is followed by a blank and there is no newline at all: ``-3.60e+00 ``. An analog value that is INVALID is ``nan``,
so that nothing acts on it in a pipe.
"""

from __future__ import annotations

from sioms.protocol.flags import AnalogStatus, AxisStatus, NodeClass

from .options import Target

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from sioms.protocol.nodeinfo import NodeInfo

# Letter, attribute of the snapshot, digits after the point (None: an integer), in the order of printing.
_AXIS = (("m", "in_motion", None), ("p", "position", 4), ("v", "velocity", 4), ("f", "force", 2))
_ANALOG = (("p", "data", 2),)
_BINARY = (("p", "data", None),)
FIELDS: dict[NodeClass, tuple[tuple[str, str, int | None], ...]] = {
    NodeClass.AXIS: _AXIS, NodeClass.ANALOG: _ANALOG, NodeClass.BINARY: _BINARY,
}  # fmt: skip
_CHOICE = "pvfmN"
_INVALID, _NAN = int(AnalogStatus.INVALID), float("nan")


class Rows:
    """How one device is printed.

    Args:
        target: the device with its flags.
        info: what the node is.
        timed: print a bare stream of numbers, as timed output does.
        digits: digits after the point; None for those of the examples.

    Raises:
        UsageError: a structure that the node has not, or fields that its class has not.
    """

    def __init__(self, target: Target, info: NodeInfo, timed: bool = False, digits: int | None = None) -> None:
        flags = target.flags
        self._channels = target.channels(len(info.channels))
        self._info = info
        # In timed output N speaks of the whole line and chooses nothing.
        choice = _CHOICE.replace("N", "") if timed else _CHOICE
        chosen = [letter for letter in choice if letter in flags] or list(choice)
        self.verbose = "V" in flags and not timed
        self.lines = "N" in chosen
        fields = [field for field in FIELDS[info.node_class] if field[0] in chosen]
        self._names = [name for _, name, _ in fields]
        formats = [_format(places, digits) for _, _, places in fields]
        if self.lines:
            self._format = " ".join(["%d", *formats]) + "\n"
        else:
            self._format = "".join([text + " " for text in formats])
        # One format for all channels of a stream: one operation a sample.
        self._all = self._format * len(self._channels)
        self._is_analog = info.node_class is NodeClass.ANALOG and "data" in self._names
        self._straight = self._channels == range(len(info.channels))

    def text(self, snapshot: Any) -> str:
        """Return the text of one snapshot of the node."""
        if self.verbose:
            return "".join([self._described(snapshot, i) for i in self._channels])
        columns = [getattr(snapshot, name) for name in self._names]
        if self._is_analog:
            columns = [[_NAN if f & _INVALID else v for v, f in zip(columns[0], snapshot.flags, strict=True)]]
        if not self._straight:
            columns = [[column[i] for i in self._channels] for column in columns]
        if self.lines:
            columns.insert(0, self._channels)
        return self._all % tuple([value for row in zip(*columns, strict=True) for value in row])

    def _described(self, snapshot: Any, index: int) -> str:
        """Return one structure in words: ``mod0 0 xaxis: position 1.0000e-01 m, ...``."""
        info, channel = self._info, self._info.channels[index]
        head = f"{info.name.removesuffix('.readonly')} {index} {channel.name}: "
        unit = f" {channel.unit}" if channel.unit else ""
        reading = snapshot[index]
        if info.node_class is NodeClass.BINARY:
            stamp = f", last edge at {reading.changed_ns / 1e9:.6f} s" if reading.edges else ""
            return f"{head}data {reading.data:d}, {reading.edges} edges{stamp}\n"
        if info.node_class is NodeClass.ANALOG:
            words = _words(AnalogStatus(reading.flags))
            return f"{head}data {reading.data:.6e}{unit}{words}\n"
        rate = f" {channel.unit}/s" if channel.unit else ""
        push = " N*m" if channel.unit == "rad" else " N"
        return (
            f"{head}position {reading.position:.6e}{unit}, velocity {reading.velocity:.6e}{rate}, "
            f"force {reading.force:.4e}{push}, following error {reading.following_error:.2e}{unit}, "
            f"{reading.buffered} commands{_words(AxisStatus(reading.status))}\n"
        )


def _format(places: int | None, digits: int | None) -> str:
    return "%d" if places is None else f"%.{places if digits is None else digits}e"


def _words(flags: AxisStatus | AnalogStatus) -> str:
    """Return the flags that are set, in words."""
    names = [flag.name.lower().replace("_", " ") for flag in type(flags) if flag in flags and flag.name]
    return "".join([", " + name for name in names])
