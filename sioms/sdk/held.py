"""Axes of other devices that this device holds: it commands them as a client does, and never waits for them.

The other end is a handle as any other: it halts its axes when this process ends, is silent for longer than the lease,
or closes. Commands are velocities that hold until the next one.

Concurrency: the one thread of the driver process.
"""

from __future__ import annotations

import errno
import socket
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from sioms.protocol.driver_verbs import HeldSilent
from sioms.protocol.flags import ControlMode, NodeClass, Request, WriteFlag
from sioms.protocol.messages import MAX_PACKET, MalformedMessage, decode_reply
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.protocol.records import WRITE, WRITE_STRUCT
from sioms.protocol.verbs import Ioctl, Keepalive, Message, Write

from .driver import AtLimitError

_RECORD = WRITE_STRUCT[NodeClass.AXIS]
_NAMES = list(WRITE[NodeClass.AXIS])
_VELOCITY = _NAMES.index("velocity")
_JOG = int(ControlMode.VELOCITY)
"""A velocity without a time lasts until the next command; one with a time the bank would judge the long way."""
NEVER_NS = 2**62
_MOST_ANSWERS = 64
"""Answers that are looked at in a tick; there is one to each command."""


class Held:
    """An axis node that this device holds; empty until the daemon hands it over, and again after every loss.

    Args:
        name: of the node.
        most_ns: longest time that an answer may take [ns].
        now_ns: the time [ns, CLOCK_MONOTONIC].
        told: sends the daemon a message.
        watch, unwatch: have its answers heard as soon as they come, and not any more; by descriptor.

    Attributes:
        channels: its axes; empty while it is not there.
        shows_reset_ns: see ``HeldNode``.
    """

    def __init__(
        self, name: str, most_ns: int, now_ns: Callable[[], int], told: Callable[[Message], None],
        watch: Callable[[int], None] = lambda fd: None, unwatch: Callable[[int], None] = lambda fd: None,
    ) -> None:  # fmt: skip
        self.name = name
        self._most_ns, self._now_ns, self._told = most_ns, now_ns, told
        self._watch_fd, self._unwatch_fd = watch, unwatch
        self._heard: OSError | None = None
        """Trouble that has been heard between two ticks."""
        self._asked: deque[tuple[int, int]] = deque()
        """Numbers of what is not answered yet, and when it was asked [ns]; not of the watch, which lasts."""
        self.channels: tuple[ChannelInfo, ...] = ()
        self._sock: socket.socket | None = None
        self.shows_reset_ns = 0
        self._number = 0
        self._watch = self._reset = self._driven = 0
        """Numbers of the wait for a stop by somebody, of the last reset, and of the command that is not answered."""
        self._past_watches: set[int] = set()
        """Numbers of waits that a stop of our own has ended, or is about to: how they end tells nothing any more."""
        self._wanted: Sequence[float] | None = None
        self._record: list[Any] = [0] * len(_NAMES)
        self._record[1] = _JOG

    def attach(self, fd: int, channels: Sequence[Sequence[Any]]) -> None:
        """Take the node: the socket of its handle, and its packed channels.

        Where it was held until now its device has been lost and is there again, sooner than a tick has come: that is
        trouble all the same, as what it does now is not what was asked of it.
        """
        if self._sock is not None:
            self._heard = self._heard or OSError(errno.EIO, f"{self.name}: its device was lost, and is another now")
        self.detach()
        self._sock = socket.socket(fileno=fd)
        self._sock.setblocking(False)
        self.channels = tuple(ChannelInfo(*channel) for channel in channels)
        self._watch_fd(self._sock.fileno())

    def detach(self) -> None:
        """Let the node go: its axes halt."""
        if self._sock is not None:
            self._unwatch_fd(self._sock.fileno())
            self._sock.close()
        self._sock, self.channels, self._watch, self._reset, self.shows_reset_ns = None, (), 0, 0, 0
        self._driven, self._wanted = 0, None
        self._asked.clear()
        self._past_watches.clear()

    @property
    def is_there(self) -> bool:
        """Whether it is held now."""
        return self._sock is not None

    def drive(self, velocities: Sequence[float]) -> None:
        """Have the axes go at velocities [unit/s] from now until the next command.

        While the command before is not answered, this one waits here, where a later one or a stop replaces it: a
        device that is slow to serve us finds no queue of old commands.
        """
        self._wanted = velocities
        if not self._driven:
            self._send_wanted()

    def _send_wanted(self) -> None:
        if self._wanted is None:
            return
        velocities, self._wanted = self._wanted, None
        record, packed = self._record, []
        for axis, velocity in enumerate(velocities):
            record[0], record[_VELOCITY] = axis, velocity
            packed.append(_RECORD.pack(*record))
        self._driven = self._ask()
        self._send(Write(int(WriteFlag.REPLACE), 0.0, b"".join(packed)).packed(self._driven))
        if not self._watch:  # whoever stops these axes ends it with a reason
            self._watch = self._next()
            self._send(Ioctl(int(Request.WAIT_UNTIL_IDLE), None, None).packed(self._watch))

    def stop(self) -> None:
        """Stop the axes at their greatest deceleration."""
        if self._watch:
            self._past_watches.add(self._watch)
        self._watch, self._wanted = 0, None
        self._send(Ioctl(int(Request.STOP), None, 0.0).packed(self._ask()))

    def reset(self, until_ns: int) -> None:
        """Reset the axes after what a reading has shown; a stop that came later stays, and the reset is refused.

        Args:
            until_ns: ``as_of_ns`` of that reading.
        """
        self._reset, self.shows_reset_ns = self._ask(), NEVER_NS
        self._send(Ioctl(int(Request.RESET), until_ns, None).packed(self._reset))

    def keep(self) -> None:
        """Renew the lease."""
        self._send(Keepalive().packed())

    def hear(self) -> OSError | None:
        """Take the answers before the next tick does; return trouble, once; the tick is told of it, too."""
        known = self._heard is not None
        self._heard = self.trouble()
        return None if known else self._heard

    def trouble(self) -> OSError | None:
        """Take the answers; return why it does not do as it was told, None when it does.

        A node whose handle has ended is not held any more.
        """
        found, self._heard = self._heard, None
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
            try:
                error = self._answered(*decode_reply(packet))
            except MalformedMessage as malformed:
                return self._give_up(f"its device answers its holder with what is none: {malformed}", errno.EPROTO)
            found = error if found is None or isinstance(found, AtLimitError) else found
        if not self._driven:
            self._send_wanted()
        return found or self._silence()

    def _silence(self) -> OSError | None:
        """Let the node go when it does not answer, and have the daemon stop it, however alive its page looks."""
        silent_ns = self._now_ns() - self._asked[0][1] if self._asked else 0
        if silent_ns <= self._most_ns:
            return None
        return self._give_up(f"its device has left an order of its holder unanswered for {silent_ns * 1e-9:.2g} s")

    def _give_up(self, why: str, errno_: int = errno.ETIMEDOUT) -> OSError:
        self.detach()
        self._told(HeldSilent(self.name, why))
        return OSError(errno_, f"{self.name}: {why}; the daemon is to stop it")

    def _answered(self, _: int, number: int, errno_: int, value: Any, __: bool, as_of_ns: int) -> OSError | None:
        """Take an answer; return what is wrong.

        What was asked for before the last reset tells nothing any more, and what a stop of our own ends is no trouble.
        """
        if number in self._past_watches:
            self._past_watches.discard(number)
            return None
        watched = number == self._watch and number != 0
        if watched:
            self._watch = 0
        while not watched and self._asked and self._asked[0][0] <= number:
            self._asked.popleft()
        if number >= self._driven and number and not watched:
            self._driven = 0
        if number == self._reset:
            self.shows_reset_ns = as_of_ns
        if watched and errno_ == errno.ERANGE:
            return AtLimitError(errno_, str(value))
        if not errno_ or 0 < number < self._reset or (errno_ == errno.ECANCELED and number and not watched):
            return None
        return OSError(errno_, str(value))

    def _next(self) -> int:
        self._number += 1
        return self._number

    def _ask(self) -> int:
        """Return the number of a request that is answered at once."""
        number = self._next()
        if self._sock is not None:
            self._asked.append((number, self._now_ns()))
        return number

    def _send(self, packet: bytes) -> None:
        if self._sock is None:
            return
        try:
            self._sock.send(packet)
        except BlockingIOError:  # it has not taken what we sent for so long that there is no more room
            self._give_up("its device does not take the orders of its holder any more")
        except OSError:  # it has ended our handle, and halts
            self.detach()
