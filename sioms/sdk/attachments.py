"""Attachments: the handles of a driver process, from the daemon's ATTACH to their end, however it comes.

Concurrency: the one thread of the driver process.
"""

from __future__ import annotations

import errno
import os
import socket
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sioms.descriptors import has_ended, process_of
from sioms.protocol import verbs
from sioms.protocol.compiled import add_decoders
from sioms.protocol.driver_verbs import Attach, Detached
from sioms.protocol.flags import REQUESTS, Access, Request, Right
from sioms.protocol.journal import JournalWriter, Note
from sioms.protocol.messages import MAX_INLINE, MAX_PACKET, MAX_WRITE, MalformedMessage
from sioms.protocol.text import shown
from sioms.protocol.verbs import Message
from sioms.timestamps import Timestamps, pending_bytes, receive
from sioms.turns import Turns

from .blocks import AnyBlock, AxisBlock
from .exchange import HookError
from .handles import LATER, UNKNOWN, Came, Handle, Quota
from .parts import Service
from .requests import ioctl
from .stops import Reason, Stop
from .writing import concerned, take_plain, write

OWNERS, READERS = 0, 1
NEVER_NS = 2**62
SHARES = (0.85, 0.125)
"""Of its time, what a driver spends at most on the requests of who owns outputs, and on those of all others."""
add_decoders(verbs.ON_HANDLE)


class Attachments:
    """The handles of a driver process.

    Args:
        handles: where they are kept, by the daemon's number.
        service: what their requests work with.
        turns: in which they take turns.
        tell: sends the daemon a message.
        journal: where commands are noted.
    """

    def __init__(
        self, handles: dict[int, Handle], service: Service, turns: Turns, tell: Callable[[Message], None],
        journal: JournalWriter,
    ) -> None:  # fmt: skip
        self.handles = handles
        self._service, self._turns, self._tell, self._journal = service, turns, tell, journal
        self.timestamps = Timestamps()
        self._leased: list[Handle] = []
        self._owners: dict[int, Handle] = {}
        """Who owns outputs, by the descriptors that tell of his end."""
        self.writers: list[Handle] = []
        """Handles that may write."""

    def close(self) -> None:
        """Release the descriptor that is not a handle's."""
        self.timestamps.close()

    def check_leases(self, now_ns: int) -> None:
        """End the handles whose clients have been silent for longer than their leases."""
        late = [handle for handle in self._leased if now_ns - handle.heard_ns > handle.lease_ns]
        if late:
            self._halt_all(late)
        for handle in late:
            lease_s = handle.lease_ns / 1e9
            text = f"{handle.node}: its client was silent for longer than its lease of {lease_s:g} s"
            self.end(handle, errno.ETIMEDOUT, text)

    def until_ns(self) -> int:
        """Return until when no lease can run out [ns]."""
        return min((handle.heard_ns + handle.lease_ns for handle in self._leased), default=2**62)

    def end_all(self, errno_: int, text: str, exclusive_only: bool = False) -> None:
        """End all handles, or those that own outputs."""
        ending = [h for h in self.handles.values() if h.exclusive or not exclusive_only]
        self._halt_all(ending)
        for handle in ending:
            self.end(handle, errno_, f"{handle.node}: {text}")

    def _halt_all(self, handles: Sequence[Handle]) -> None:
        """Stop what these handles own, before any of them takes time to be ended."""
        owners = [handle for handle in handles if handle.exclusive and not handle.halted]
        parts: dict[tuple[int, int], tuple[AnyBlock, list[int], int]] = {}
        for handle in owners:
            handle.halted = True
            key = id(handle.block), handle.bit
            parts.setdefault(key, (handle.block, [], handle.bit))[1].extend(handle.axes)
        if parts:
            self._service.stops.safe_stop(Reason(Stop.CONTROLLED, "its owner has gone"), [*parts.values()])

    def gone(self, fd: int) -> Handle | None:
        """Return the owner of whom a descriptor that is ready says that he has gone, if all axes of the device are his
        and have not been halted; else None.
        """
        handle = self._owners.get(fd)
        if handle is None or not self._owns_all(handle):
            return None
        return handle if fd == handle.pidfd or has_ended(handle.sock) else None

    def of_process(self, pid: int) -> list[Handle]:
        """Return the owners of all axes of the device that are of a process, and have sent nothing that is left to be
        taken.
        """
        owners = {handle.number: handle for handle in self._owners.values() if handle.pid == pid}.values()
        return [handle for handle in owners if self._owns_all(handle) and not pending_bytes(handle.sock)]

    def _owns_all(self, handle: Handle) -> bool:
        """Tell whether all axes of the device are his and have not been halted."""
        if handle.halted or len(handle.axes) != handle.block.n:
            return False
        return [block for block in self._service.blocks if isinstance(block, AxisBlock)] == [handle.block]

    def detach(self, number: int, errno_: int = 0, reason: str = "") -> None:
        """End a handle because the daemon says so, and tell its client why; one that has ended already is confirmed
        again.
        """
        handle = self.handles.get(number)
        if handle is None:
            self._tell(Detached(number))
        elif reason:
            self.end(handle, errno_, reason)
        else:
            self.drop(handle)

    def attach(self, fds: list[int], message: Attach) -> None:
        """Take a handle from the daemon: descriptors of socket, wake pipe and, if known, the client's process."""
        number, block, channels, bit, access, exclusive, rights, lease_ns, who, uid, quota, node = message
        if len(fds) < 2:  # the kernel drops what goes beyond the limit of open descriptors
            for fd in fds:
                os.close(fd)
            self._service.log("error", f"{node}: {who} could not be served: too many open descriptors")
            self._tell(Detached(number))
            return
        sock = socket.socket(fileno=fds[0])
        sock.setblocking(False)
        handle = Handle(
            number, node, who, uid, sock, fds[1], fds[2] if len(fds) > 2 else -1, self._service.blocks[block],
            np.array(channels, dtype=np.intp), bit, Access(access), exclusive, Right(rights), lease_ns,
            time.monotonic_ns(), self._service.effects, Quota(*quota),
        )  # fmt: skip
        self.handles[number] = handle
        if self._service.stops.resets.count:  # its client may have used it for long already
            handle.note_reset(self._service.stops.resets.latest_ns(id(handle.block), dict.fromkeys(channels, -1), 0))
        if exclusive:
            handle.pid = process_of(handle.pidfd)
            self._owners |= dict.fromkeys((sock.fileno(), *([handle.pidfd] if handle.pidfd >= 0 else [])), handle)
        if lease_ns:
            self._leased.append(handle)
        if handle.writes:
            self.writers.append(handle)
        kind = OWNERS if exclusive else READERS
        self._turns.add(sock.fileno(), uid, kind, lambda: self._readable(handle))
        if exclusive and handle.pidfd >= 0:
            # A child of the client may hold the socket open after the client's death.
            self._service.loop.watch(handle.pidfd, lambda: self.drop(handle))

    def _readable(self, handle: Handle) -> None:
        """Serve one packet; the tick and the other clients have their turn before the next."""
        self._service.loop.heed()  # what lies there may be older than a reset
        if handle.number not in self.handles:
            return
        resets = self._service.stops.resets.count
        try:
            packet, timestamp_ns = receive(handle.sock, MAX_PACKET + 1)
        except BlockingIOError:
            handle.took(0)
            return
        except OSError:
            packet, timestamp_ns = b"", 0
        handle.hear(time.monotonic_ns())

        def serve() -> None:
            if not packet:
                self.drop(handle)
                return
            number, message, whole, latest_ns = self._taken(handle, packet)
            is_in_doubt = handle.is_in_doubt or latest_ns < handle.reset_ns
            came = Came(UNKNOWN if is_in_doubt else resets, timestamp_ns, latest_ns)
            handle.took(len(packet))
            self._serve(handle, number, message, whole, came)

        self._guarded(handle, serve)

    def _taken(self, handle: Handle, packet: bytes) -> tuple[int, Message, bytes, int]:
        """Take a packet, and what a gateway says of it; return its number, message, the packet of the client, and the
        instant than which it is taken for no younger [ns, CLOCK_MONOTONIC].
        """
        number, message = verbs.take(packet, verbs.ON_HANDLE, pending=handle.waits)
        if not isinstance(message, verbs.Passed):
            return number, message, packet, handle.heard_ns if handle.passed_on else NEVER_NS
        at_ns, packet = message
        self.heard(handle, min(at_ns, handle.came_ns))
        number, message = verbs.take(packet, verbs.ON_HANDLE, pending=handle.waits)
        if isinstance(message, verbs.Passed):
            raise MalformedMessage("a packet that is passed on twice")
        return number, message, packet, at_ns

    def _guarded(self, handle: Handle, serve: Callable[[], None]) -> None:
        """Serve a client; what goes wrong ends its handle."""
        try:
            serve()
        except MalformedMessage as error:
            self._service.log("warning", f"{handle.node}: connection of {handle.who} ended: malformed message: {error}")
            self.end(handle, errno.EPROTO, f"{handle.node}: malformed message: {error}")
        except HookError:
            raise  # the driver may have done half of it: it stops its device
        except Exception as error:  # a mistake of ours costs this handle, which halts what it moved
            trace = "".join(traceback.format_exception(error)[-3:])
            self._service.log("error", f"{handle.node}: the driver failed to serve {handle.who}: {trace}")
            self.end(handle, errno.EIO, f"{handle.node}: the driver failed: {shown(error)}")

    def served(
        self, handle: Handle, packet: bytes, came_ns: int, effect_ns: int, took_ns: int, unsent: int | None
    ) -> None:
        """Work in a plain write that steps have taken and acknowledged (serve_step.py).

        Args:
            handle, packet: whose, and as it came.
            came_ns, effect_ns: when it came, and took effect [ns, CLOCK_MONOTONIC].
            took_ns: how long serving it took [ns].
            unsent: what its answer would have told, if it could not be sent; else None.
        """
        handle.hear(came_ns)
        self._service.effects.last_ns = effect_ns

        def work_in() -> None:
            number, message = verbs.take(packet, verbs.ON_HANDLE, pending=handle.waits)
            _, flags, _, records = (number, *message)
            take_plain(self._service, handle, flags, records, effect_ns)
            if unsent is not None:
                handle.answer(number, unsent)
            self._note(handle, packet, 0, "")

        self._guarded(handle, work_in)
        self._turns.charge(handle.sock.fileno(), took_ns)

    def heard(self, handle: Handle, at_ns: int) -> None:
        """Let a lease run from when a client said something, which has been; never from earlier than before."""
        handle.heard_ns = max(handle.heard_ns, at_ns) if handle.passed_on else at_ns
        handle.passed_on = True

    def _serve(self, handle: Handle, number: int, message: verbs.Message, packet: bytes, came: Came) -> None:
        if isinstance(message, verbs.Keepalive):
            return
        if isinstance(message, verbs.Heard):
            self.heard(handle, min(message.at_ns, handle.came_ns))
            return
        if isinstance(message, verbs.Part):
            _keep_part(handle, message, came)
            self._note(handle, packet, 0, "")
            return
        # Nothing is taken after a stop, or refused after its reset, because no tick has come in between; and no order
        # that was acknowledged before undoes what is acknowledged now.
        self._service.loop.heed()
        self._service.stops.before_telling()  # before an answer may tell of one
        if handle.number not in self.handles:
            return  # that was the order
        try:
            if _acts(message) and self._is_stale(handle, number, message, came):
                handle.ahead = (0, [])
                raise OSError(
                    errno.ECANCELED, f"{_what(message)} {handle.node}: sent before the last reset; send it again"
                )
            value = self._value(handle, number, message, came)
        except OSError as error:
            why = error.errno or errno.EIO, error.strerror or str(error)
            handle.refuse(number, *why)
            self._note(handle, packet, *why)
        else:
            if value is not LATER:
                handle.answer(number, value)
            if not message.query and not (isinstance(message, verbs.Ioctl) and REQUESTS[message.request][2]):
                self._note(handle, packet, 0, "")

    def _is_stale(self, handle: Handle, number: int, message: verbs.Message, came: Came) -> bool:
        """Return whether what a message is for was stopped, and reset, after its first part had been sent."""
        resets, ahead = self._service.stops.resets, b""
        if handle.ahead[1] and handle.ahead[0] == number:
            came, ahead = handle.ahead_came, b"".join(handle.ahead[1])
        if came.resets == resets.count:
            return False
        reset_ns = resets.latest_ns(id(handle.block), concerned(handle, message, ahead), handle.number)
        return self._sent_ns(came) < reset_ns

    def _sent_ns(self, came: Came) -> int:
        """Return when a packet was sent [ns, CLOCK_MONOTONIC], or before."""
        return min(self.timestamps.monotonic_ns(came.timestamp_ns), came.latest_ns)

    def _note(self, handle: Handle, packet: bytes, errno_: int, why: str) -> None:
        """Note a command, after its answer has been sent: a client does not wait for that."""
        self._journal.note(Note.COMMAND, handle.came_ns, handle.node, handle.who, packet, errno_, why)

    def _value(self, handle: Handle, number: int, message: verbs.Message, came: Came) -> Any:
        match message:
            case verbs.Write(flags, timeout_s, records):
                self._service.effects.note()
                if handle.ahead[1]:
                    records = _whole(handle, number, records)
                return write(self._service, handle, number, flags, timeout_s, records)
            case verbs.Ioctl(request, argument, timeout_s):
                if request not in REQUESTS or not REQUESTS[request][2]:
                    self._service.effects.note()
                sent_ns = self._sent_ns(came) if request == Request.RESET else 0
                return ioctl(self._service, handle, number, request, argument, timeout_s, sent_ns)
            case verbs.Subscribe(every):
                self._subscribe(handle, every)
                return None
            case verbs.CancelOnHandle(waiting):
                wait = handle.waits.get(waiting)
                if wait is not None:
                    self._service.waits.end(wait, errno.ECANCELED, f"{wait.what}: cancelled")
                return wait is not None
            case _:
                raise NotImplementedError(f"{type(message).__name__} is not served")

    def _subscribe(self, handle: Handle, every: int) -> None:
        if not -1 <= every <= 1_000_000:
            raise OSError(errno.EINVAL, f"subscribe to {handle.node}: every {every}; want -1 to 1000000")
        subscribers = self._service.pages.subscribers(handle.block)
        if handle in subscribers:
            subscribers.remove(handle)
        elif (
            every
            and (most := sum(h.every != 0 for h in self.handles.values() if h.uid == handle.uid))
            >= handle.quota.subscriptions
        ):
            raise OSError(
                errno.EAGAIN,
                f"subscribe to {handle.node}: user {handle.uid} has {most} subscriptions to this device, as many as "
                "subscriptions of [quota] allows",
            )
        handle.every, handle.countdown = every, 0
        if every:
            subscribers.append(handle)

    def end(self, handle: Handle, errno_: int, text: str) -> None:
        """End a handle and tell its client why."""
        handle.tell_end(errno_, text)
        self.drop(handle)

    def drop(self, handle: Handle) -> None:
        """End a handle: halt what it owns, then tell the daemon that the channels are free."""
        if self.handles.pop(handle.number, None) is None:
            return
        self._turns.remove(handle.sock.fileno())
        if handle.pidfd >= 0:
            self._service.loop.unwatch(handle.pidfd)
        for fd in (handle.sock.fileno(), handle.pidfd):
            self._owners.pop(fd, None)
        if handle in self._leased:
            self._leased.remove(handle)
        if handle.writes:
            self.writers.remove(handle)
        if handle.every:
            self._service.pages.subscribers(handle.block).remove(handle)
        self._service.waits.forget(handle)
        self._halt_all([handle])
        if handle.exclusive and isinstance(handle.block, AxisBlock):
            handle.block.bank.forget_settings(sorted(handle.axes))
        handle.close()
        self._tell(Detached(handle.number))


def _acts(message: verbs.Message) -> bool:
    """Return whether a message does anything but look, wait, stop, or reset what has been stopped."""
    if isinstance(message, verbs.Ioctl):
        stops = message.request in (Request.STOP, Request.EMERGENCY_STOP, Request.FLUSH, Request.CANCEL_WAITS)
        judged_there = message.request == Request.RESET
        return not stops and not judged_there and not (message.request in REQUESTS and REQUESTS[message.request][2])
    return isinstance(message, verbs.Write)


def _what(message: verbs.Message) -> str:
    return f"{Request(message.request).name} on" if isinstance(message, verbs.Ioctl) else "write"


def _keep_part(handle: Handle, message: verbs.Part, came: Came) -> None:
    """Keep records that come ahead of their write; those of a write that never came are dropped."""
    number, records = message
    if len(records) > MAX_INLINE:
        raise MalformedMessage(f"part of a write with {len(records)} bytes; want up to {MAX_INLINE}")
    if not handle.writes:
        return  # its write will be refused
    if handle.ahead[0] != number:
        handle.ahead, handle.ahead_came = (number, []), came
    parts = handle.ahead[1]
    if len(parts) <= MAX_WRITE // MAX_INLINE:  # one more than allowed tells that it is too much
        parts.append(records)


def _whole(handle: Handle, number: int, rest: bytes) -> bytes:
    """Return all records of a write."""
    (ahead, parts), handle.ahead = handle.ahead, (0, [])
    whole = b"".join([*parts, rest]) if ahead == number else rest
    if len(whole) > MAX_WRITE:
        raise OSError(errno.EMSGSIZE, f"write {handle.node}: more than {MAX_WRITE} bytes of records")
    return whole
