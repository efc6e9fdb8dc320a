"""What a driver says to its line: exchanges, as values. Pure; the kit does the I/O.

A driver's hooks are generators: they yield an :class:`Exchange` (or a :class:`Send`, a :class:`Pause`, an
:class:`SideExchange`) and are resumed with the decoded reply. The kit owns time-outs, silence, draining,
repetition, reconnection and the serving of clients in between, so a driver has no sleeps, no
retries and no threads, and its tests need no line: they resume the generator themselves.

    def poll(self):
        status = yield self.bus.read_holding(0x1003, 1)
        self.moving[0] = bool(status[0] & 4)
"""

from __future__ import annotations

import errno
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any


class LinkError(Exception):
    """The line failed: no reply, a cut or garbled reply, a reply to another request.

    The kit repeats a repeatable exchange, counts the failure, and declares the link lost after
    ``misses`` failures in a row. Not for what a device answers properly: that is DeviceError.

    Attributes:
        heard: bytes came, but no right reply; set by the kit.
    """

    heard = False


class DeviceError(Exception):
    """The device answered, and refused (Modbus exception, error status). Never repeated.

    Args:
        errno_: POSIX errno that a client sees, e.g. EINVAL for an illegal value, EIO otherwise.
        text: sentence without full stop that names the request and the refusal.
    """

    def __init__(self, errno_: int, text: str) -> None:
        super().__init__(text)
        self.errno = errno_


class StateLost(DeviceError):
    """A poll found that what the opening had set is gone: the device restarted, or somebody else has set it.

    The kit counts the unit as lost at once, without waiting for ``misses``, and opens it again at once: nothing moves
    and no output is believed until the opening has set and proved everything anew.

    Args:
        text: what was read, and what it should be.
    """

    def __init__(self, text: str) -> None:
        super().__init__(errno.EIO, text)


class HookError(Exception):
    """A driver's hook raised what it should not have; the cause is the driver author's exception. Ends the device.

    Args:
        what: which hook.
    """

    def __init__(self, what: str) -> None:
        super().__init__(what)


@dataclass(frozen=True, slots=True)
class Exchange:
    """One request and its reply.

    Args:
        data: bytes to send.
        want: given the bytes received so far, the total length of the reply, or None while that
            cannot be told yet; raises LinkError as soon as the bytes cannot be the reply.
        decode: turns the complete reply into the value the generator is resumed with; raises
            LinkError (damaged) or DeviceError (refused).
        timeout_s: longest time from the last byte sent to the last byte received [s].
        repeatable: True only for requests without side effects.
        what: the request in words, for messages: ``read 2 registers at 0x1014 of unit 1``.
        has_checksum: the reply has one that ``decode`` checks, so that stray bytes in front of it may be skipped.
    """

    data: bytes
    want: Callable[[bytes], int | None]
    decode: Callable[[bytes], Any]
    timeout_s: float
    repeatable: bool
    what: str
    has_checksum: bool = False


@dataclass(frozen=True, slots=True)
class Send:
    """Bytes that draw no reply (ODrive set-points, stream control, heartbeats)."""

    data: bytes
    what: str


@dataclass(frozen=True, slots=True)
class Pause:
    """Let the line rest, and the kit serve others, for a time [s] that the device needs."""

    duration_s: float


@dataclass(frozen=True, slots=True)
class SideExchange:
    """An exchange on the driver's connection beside its line (``StreamDriver.side_line``): a web page, a command port.

    The reply may end with the connection: ``decode`` then gets what has come.

    Args:
        exchange: what is asked.
        anew: on a new connection: behind a loss the one there was may be dead, without a word from the other side.
    """

    exchange: Exchange
    anew: bool = False


Step = Exchange | Send | Pause | SideExchange
Steps = Generator[Step, Any, None]
"""What a hook returns: a generator of steps."""


def until(end: bytes = b"\n", longest: int = 80) -> Callable[[bytes], int | None]:
    """Return the ``want`` of an exchange that is answered with a line of text, however long.

    Args:
        end: how a line ends.
        longest: more bytes than this without an end are no line.

    Example:
        >>> until()(b"12.0,1.5\\nrest")
        9
        >>> until()(b"12.0,")
    """

    def want(reply: bytes) -> int | None:
        at = reply.find(end)
        if at < 0 and len(reply) > longest:
            raise LinkError(f"{len(reply)} bytes without an end of line; is the baud rate right")
        return None if at < 0 else at + len(end)

    return want


def while_wanted(
    steps: Steps, is_wanted: Callable[[], bool], each: Callable[[Step], Step] = lambda step: step
) -> Generator[Step, Any, bool]:
    """Carry out steps one by one, and no further once they are not wanted any more.

    Args:
        is_wanted: asked before every step.
        each: what is carried out instead of a step.

    Returns:
        Whether they came to their end.
    """
    value: Any = None
    failure: Exception | None = None
    while is_wanted():
        try:
            step = steps.throw(failure) if failure else steps.send(value)
        except StopIteration:
            return True
        value, failure = None, None
        try:
            value = yield each(step)
        except (LinkError, DeviceError) as error:
            failure = error
    return False


def noting(steps: Steps, note: Callable[[], None]) -> Steps:
    """Carry out steps, and note each good reply when it comes: others may have their turn before the steps go on."""

    def noted(step: Step) -> Step:
        if isinstance(step, Exchange):
            return replace(step, decode=partial(_decode_and_note, step.decode, note))
        return step

    yield from while_wanted(steps, lambda: True, noted)


def _decode_and_note(decode: Callable[[bytes], Any], note: Callable[[], None], reply: bytes) -> Any:
    value = decode(reply)
    note()
    return value
