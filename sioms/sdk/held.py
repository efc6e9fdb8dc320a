"""Axes of other devices that this device holds: it commands them as a client does, and never waits for them.

The other end is a handle as any other: it halts its axes when this process ends, is silent for longer than the lease,
or closes. Commands are velocities that hold until the next one.

Concurrency: the one thread of the driver process.
"""

from __future__ import annotations

import errno
import socket
from collections.abc import Sequence
from typing import Any

from sioms.protocol.flags import ControlMode, NodeClass, Request, WriteFlag
from sioms.protocol.messages import MAX_PACKET, decode_reply
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.protocol.records import WRITE, WRITE_STRUCT
from sioms.protocol.verbs import Ioctl, Keepalive, Write

_RECORD = WRITE_STRUCT[NodeClass.AXIS]
_NAMES = list(WRITE[NodeClass.AXIS])
_VELOCITY, _TIME = _NAMES.index("velocity"), _NAMES.index("time")
_JOG = int(ControlMode.VELOCITY | ControlMode.SPECIFIED_TIME)
_MOST_ANSWERS = 64
"""Answers that are looked at in a tick; there is one to each command."""


class Held:
    """An axis node that this device holds; empty until the daemon hands it over, and again after every loss.

    Args:
        name: of the node.

    Attributes:
        channels: its axes; empty while it is not there.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.channels: tuple[ChannelInfo, ...] = ()
        self._sock: socket.socket | None = None
        self._number = 0
        self._watch = 0
        self._record: list[Any] = [0] * len(_NAMES)
        self._record[1], self._record[_TIME] = _JOG, -1.0

    def attach(self, fd: int, channels: Sequence[Sequence[Any]]) -> None:
        """Take the node: the socket of its handle, and its packed channels."""
        self.detach()
        self._sock = socket.socket(fileno=fd)
        self._sock.setblocking(False)
        self.channels = tuple(ChannelInfo(*channel) for channel in channels)

    def detach(self) -> None:
        """Let the node go: its axes halt."""
        if self._sock is not None:
            self._sock.close()
        self._sock, self.channels, self._watch = None, (), 0

    @property
    def is_there(self) -> bool:
        """Whether it is held now."""
        return self._sock is not None

    def drive(self, velocities: Sequence[float]) -> None:
        """Have the axes go at velocities [unit/s] from now until the next command."""
        record, packed = self._record, []
        for axis, velocity in enumerate(velocities):
            record[0], record[_VELOCITY] = axis, velocity
            packed.append(_RECORD.pack(*record))
        self._send(Write(int(WriteFlag.REPLACE), 0.0, b"".join(packed)).packed(self._next()))
        if not self._watch:  # whoever stops these axes ends it with a reason
            self._watch = self._next()
            self._send(Ioctl(int(Request.WAIT_UNTIL_IDLE), None, None).packed(self._watch))

    def stop(self) -> None:
        """Stop the axes at their greatest deceleration."""
        self._watch = 0
        self._send(Ioctl(int(Request.STOP), None, 0.0).packed(self._next()))

    def reset(self) -> None:
        """Reset the axes after a stop or a fault."""
        self._send(Ioctl(int(Request.RESET), None, None).packed(self._next()))

    def keep(self) -> None:
        """Renew the lease."""
        self._send(Keepalive().packed())

    def trouble(self) -> OSError | None:
        """Take the answers; return why it does not do as it was told, None when it does.

        A node whose handle has ended is not held any more.
        """
        found: OSError | None = None
        for _ in range(_MOST_ANSWERS):
            if self._sock is None:
                break
            try:
                packet = self._sock.recv(MAX_PACKET)
            except BlockingIOError:
                break
            except OSError:
                packet = b""
            if not packet:
                self.detach()
                found = found or OSError(errno.EIO, f"{self.name}: its device does not serve it any more")
                break
            _, number, errno_, value, *_ = decode_reply(packet)
            watched = number == self._watch and number != 0
            if watched:
                self._watch = 0
            if errno_ and (watched or number == 0 or errno_ != errno.ECANCELED) and found is None:
                found = OSError(errno_, str(value))
        return found

    def _next(self) -> int:
        self._number += 1
        return self._number

    def _send(self, packet: bytes) -> None:
        if self._sock is None:
            return
        try:
            self._sock.send(packet)
        except OSError:  # gone, or it has not served us for so long that it is as good as gone
            self.detach()
