"""ROS 2 messages as CDR, and what rmw_zenoh calls their keys. Pure.

CDR is the little-endian encoding of OMG's DDS-XTYPES 1.3, 7.4.1, that ROS 2 uses: four bytes of encapsulation, then
each number aligned to its size, counted from there. Key expressions, liveliness tokens and attachments are those of
ros2/rmw_zenoh, rmw_zenoh_cpp/src/detail: liveliness_utils.cpp (commit 3411fdec), attachment_helpers.cpp (534747dc) and
rmw_publisher_data.cpp (3e19ec73). Type hashes are REP 2016's of the released definitions, the same in Humble, Jazzy and
Kilted.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256

_UNFIT = re.compile(r"[^A-Za-z0-9_]")
DEPTH = 10
"""Messages that a subscriber keeps by default (rclcpp's and rclpy's usual depth)."""


@dataclass(frozen=True, slots=True)
class Type:
    """A type of messages: its name in the keys of rmw_zenoh, and its hash."""

    name: str
    hash: str


JOINT_STATE = Type(
    "sensor_msgs::msg::dds_::JointState_", "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"
)
WRENCH = Type(
    "geometry_msgs::msg::dds_::WrenchStamped_",
    "RIHS01_8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77",
)
DIAGNOSTICS = Type(
    "diagnostic_msgs::msg::dds_::DiagnosticArray_",
    "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
)


class Cdr:
    """Bytes of a message in the making."""

    def __init__(self) -> None:
        self._body = bytearray()

    def number(self, code: str, value: float) -> Cdr:
        """Append a number of a format of ``struct``, aligned to its size."""
        size = struct.calcsize(code)
        self._body += bytes(-len(self._body) % size) + struct.pack(f"<{code}", value)
        return self

    def text(self, value: str) -> Cdr:
        """Append a string: its length with the zero at its end, and both."""
        data = value.encode("utf-8", "replace").replace(b"\0", b"?") + b"\0"
        self.number("I", len(data))
        self._body += data
        return self

    def texts(self, values: Sequence[str]) -> Cdr:
        """Append a sequence of strings."""
        self.number("I", len(values))
        for value in values:
            self.text(value)
        return self

    def floats(self, values: Sequence[float]) -> Cdr:
        """Append a sequence of float64."""
        self.number("I", len(values))
        for value in values:
            self.number("d", value)
        return self

    def header(self, stamp_ns: int, frame: str) -> Cdr:
        """Append a std_msgs/Header."""
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        return self.number("i", seconds).number("I", nanoseconds).text(frame)

    def done(self) -> bytes:
        """Return the message."""
        return b"\0\1\0\0" + bytes(self._body)


def joint_state(
    stamp_ns: int, frame: str, names: Sequence[str], position: Sequence[float], velocity: Sequence[float],
    effort: Sequence[float],
) -> bytes:  # fmt: skip
    """Return a sensor_msgs/JointState.

    Args:
        stamp_ns: since 1970 by UTC [ns].
        frame: of coordinates, '' = none.
        names: of the joints; position, velocity, effort: of each [m and N, or rad and N*m].
    """
    return Cdr().header(stamp_ns, frame).texts(names).floats(position).floats(velocity).floats(effort).done()


def wrench(stamp_ns: int, frame: str, values: Sequence[float]) -> bytes:
    """Return a geometry_msgs/WrenchStamped of three forces [N] and three torques [N*m].

    Raises:
        ValueError: not six values.
    """
    if len(values) != 6:
        raise ValueError(f"a wrench of {len(values)} values; want 6")
    cdr = Cdr().header(stamp_ns, frame)
    for value in values:
        cdr.number("d", value)
    return cdr.done()


@dataclass(frozen=True, slots=True)
class Status:
    """A diagnostic_msgs/DiagnosticStatus: level 0 good, 1 warning, 2 error, 3 stale."""

    level: int
    name: str
    message: str
    hardware: str
    values: tuple[tuple[str, str], ...] = ()


def diagnostics(stamp_ns: int, statuses: Sequence[Status]) -> bytes:
    """Return a diagnostic_msgs/DiagnosticArray."""
    cdr = Cdr().header(stamp_ns, "").number("I", len(statuses))
    for status in statuses:
        cdr.number("B", status.level).text(status.name).text(status.message).text(status.hardware)
        cdr.number("I", len(status.values))
        for key, value in status.values:
            cdr.text(key).text(value)
    return cdr.done()


# --- keys ------------------------------------------------------------------------------------------


def part(name: str) -> str:
    """Return a name as a part of the name of a topic: letters, digits and ``_``, no digit first."""
    fit = _UNFIT.sub("_", name)
    return f"_{fit}" if not fit or fit[0].isdigit() else fit


def topic_key(domain: int, topic: str, of: Type) -> str:
    """Return the key expression of a topic, ``/cell/mod0/joint_states``."""
    return f"{domain}/{topic.strip('/')}/{of.name}/{of.hash}"


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def node_token(domain: int, zid: str, node: str) -> str:
    """Return the liveliness token of a node in the root name space."""
    return f"@ros2_lv/{domain}/{zid}/0/0/NN/%/%/{node}"


def publisher_token(domain: int, zid: str, number: int, node: str, topic: str, of: Type) -> str:
    """Return the liveliness token of a publisher, reliable and volatile, that keeps DEPTH messages."""
    head = f"@ros2_lv/{domain}/{zid}/0/{number}/MP/%/%/{node}"
    return f"{head}/{_mangled(topic)}/{of.name}/{of.hash}/::,{DEPTH}:,:,:,,"


def identity(token: str) -> bytes:
    """Return 16 bytes that tell a publisher from any other."""
    return sha256(token.encode()).digest()[:16]


def attachment(number: int, stamp_ns: int, publisher: bytes) -> bytes:
    """Return what goes along with a message: its number from 1, when it was sent, and the identity of the publisher."""
    return struct.pack("<qqB", number, stamp_ns, len(publisher)) + publisher
