"""What a node is, as ``GET_IO_STRUCT_INFO`` tells it.

Plain slotted classes instead of dataclasses: the shell tools load this module, and dataclasses
would double their start time.
"""

from .flags import NodeClass
from .records import READ_SIZE, WRITE_STRUCT


class ChannelInfo:
    """One channel of a node.

    Attributes:
        name: e.g. ``xaxis``, ``fx``, ``bit3``.
        unit: SI unit of its value, e.g. ``m``, ``rad``, ``N``; '' for bits.
        minimum, maximum: accepted range of position or value, None when there is no limit.
        width: bits of a binary port, 0 for the other classes.
        modes: ControlMode flags an axis accepts, 0 for the other classes.
        limits: further limits of an axis by name (velocity, acceleration, jerk, force).
        description: free text of the configuration.
    """

    __slots__ = ("description", "limits", "maximum", "minimum", "modes", "name", "unit", "width")

    def __init__(
        self,
        name: str,
        unit: str = "",
        minimum: float | None = None,
        maximum: float | None = None,
        width: int = 0,
        modes: int = 0,
        limits: dict[str, float] | None = None,
        description: str = "",
    ) -> None:
        self.name = name
        self.unit = unit
        self.minimum = minimum
        self.maximum = maximum
        self.width = width
        self.modes = modes
        self.limits = limits or {}
        self.description = description

    def pack(self) -> list[object]:
        """Return the wire form."""
        return [
            self.name,
            self.unit,
            self.minimum,
            self.maximum,
            self.width,
            self.modes,
            self.limits,
            self.description,
        ]


class NodeInfo:
    """A node: the answer to ``GET_IO_STRUCT_INFO`` and to ``sioms info``.

    Attributes:
        name: node name, e.g. ``mod0.xaxis.readonly``.
        node_class: binary, analog or axis.
        read_only: the node accepts no write.
        channels: its channels, in order.
        bit: for a node of one bit the bit of its port, else -1.
        tick_hz: rate of the driver's loop.
        buffer_capacity: commands an axis buffers, 0 for the other classes.
        device, driver: who is behind it.
        protocol_version: of the daemon.
    """

    __slots__ = (
        "bit", "buffer_capacity", "channels", "device", "driver", "name", "node_class", "protocol_version",
        "read_only", "tick_hz",
    )  # fmt: skip

    name: str
    read_only: bool
    bit: int
    tick_hz: float
    buffer_capacity: int
    device: str
    driver: str
    protocol_version: int

    def __init__(self, packed: list) -> None:  # type: ignore[type-arg]
        (self.name, cls, self.read_only, channels, self.bit, self.tick_hz, self.buffer_capacity, self.device,
         self.driver, self.protocol_version) = packed  # fmt: skip
        self.node_class = NodeClass(cls)
        self.channels = [ChannelInfo(*channel) for channel in channels]

    @property
    def number_structs(self) -> int:
        """Number of channels (``number_structs`` of the appendix)."""
        return len(self.channels)

    @property
    def read_struct_size(self) -> int:
        """Bytes of one channel's reading."""
        return READ_SIZE[self.node_class]

    @property
    def write_struct_size(self) -> int:
        """Bytes of one channel's write record; 0 for a read-only node."""
        return 0 if self.read_only else WRITE_STRUCT[self.node_class].size
