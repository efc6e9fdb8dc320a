"""The text of ``devin --record``: a table for programs, with names and units, and the readings' own time stamps. Pure.

One line a reading, columns parted by tabs, under one line of names with their units. The first column is the stamp that
the driver gave the reading, in seconds on the monotonic clock. The columns of a node of one axis have the names that
``sioms reconcile axis`` reads without a description.
"""

from __future__ import annotations

from sioms.protocol.flags import NodeClass

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    from sioms.protocol.nodeinfo import NodeInfo

# Name of a column, attribute of the snapshot, what its unit is made of.
_AXIS = (
    ("position", "position", "{unit}"), ("velocity", "velocity", "{unit}/s"), ("force", "force", "{push}"),
    ("command", "commanded_position", "{unit}"),
)  # fmt: skip
_VALUE = (("", "data", "{unit}"),)


class Table:
    """How the readings of one node become lines.

    Args:
        info: what the node is.
        channels: the structures that are recorded.
        digits: digits after the point; None: as many as tell two readings apart.
    """

    def __init__(self, info: NodeInfo, channels: Sequence[int], digits: int | None) -> None:
        fields = _AXIS if info.node_class is NodeClass.AXIS else _VALUE
        self._places = [(name, index) for index in channels for _, name, _ in fields]
        number = "%.12g" if digits is None else f"%.{digits}e"
        self._format = "%d.%09d" + f"\t{number}" * len(self._places) + "\n"
        heads = ["time [s]"]
        for index in channels:
            channel = info.channels[index]
            push = "N m" if channel.unit == "rad" else "N"
            for title, _, unit in fields:
                name = " ".join(
                    [word for word in (channel.name if len(channels) > 1 or not title else "", title) if word]
                )
                shown = unit.format(unit=channel.unit, push=push) if channel.unit else ""
                heads.append(f"{name} [{shown}]" if shown else name)
        self.head = "\t".join(heads) + "\n"

    def row(self, snapshot: Any) -> str:
        """Return the line of one reading."""
        values = [getattr(snapshot, name)[index] for name, index in self._places]
        return self._format % (*divmod(snapshot.stamp_ns, 1_000_000_000), *values)
