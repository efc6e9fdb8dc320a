"""A driver process of several light devices: one wait for all, and a runtime each.

What one device raises ends that device, as in a process of its own. What a driver does to the process (a crash, a loop
without end, SIGKILL) it does to all in it; so devices share a process only where the configuration says so.
"""

from __future__ import annotations

import gc
import math
import os
import select
import socket
import time
import traceback
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from sioms.descriptors import MOST_FILES, is_readable, permit_files, receive
from sioms.native.language import library
from sioms.native.system import MOST_EVENTS
from sioms.protocol.driver_verbs import TO_FORK_SERVER, Spawn
from sioms.protocol.messages import MAX_UNPACKED
from sioms.protocol.verbs import take

from .finding import find_driver, read_settings
from .quiet import QuietRun
from .quiet_step import Many, begin_asked_stop, begin_halt, heed_one, run_many, wait_turn
from .rt import ChangeWatch, name_process, settle
from .runtime import Runtime

REQUEST = 2
"""Which of a device's descriptors is the stop-request file, see ``process.run``."""
PAUSE_S = 50e-6
"""After each device that has come, and after each few that have been served in a row: a process in a real-time class
must not work for long without a pause."""
CLOSING_S = 1e-3
"""Pause for a process that ends to close more of its sockets, which it may do on this processor, in an ordinary class.
"""
IN_A_ROW = 8
FAIR = 4
"""One turn in so many goes to who can wait best, however many cannot."""
STOPS, STANDS, CALLED, CAN_WAIT = range(4)
"""Who is served first: who has yet to begin a stop; whose tick is the loop's; whom the daemon calls; the others."""


@dataclass(slots=True)
class Member:
    """A device of the process.

    Attributes:
        runtime: its own.
        fds: what its runtime has been given and does not close itself.
        priority, user: of the process, by what its configuration says.
        quiet: by whom it ticks while it waits; None: by its loop.
        owes: whether it has to look for a stop that somebody has asked for.
        losses: what it has to do first: its owner or the daemon has gone, see ``Runtime.losses``.
    """

    runtime: Runtime
    fds: list[int]
    priority: int
    user: str
    quiet: QuietRun | None = None
    owes: bool = False
    losses: list[Callable[[], None]] = field(default_factory=list)


class Group:
    """The devices of this process, and the socket on which more of them come.

    Args:
        sock: to the fork server; its end is the end of the process when there is no device left.

    Concurrency: the one thread of the process.
    """

    def __init__(self, sock: socket.socket) -> None:
        self._sock: socket.socket | None = sock
        self._epoll = select.epoll()
        self._epoll.register(sock.fileno(), select.EPOLLIN)
        self._members: dict[int, Member] = {}
        self._built: deque[Member] = deque()
        self._due: dict[int, int] = {}
        """Who has more to do than to tick, by descriptor, and his rank: one after another, the others tick in between.
        Those who have come before stand before."""
        self._pauses: dict[int, float] = {}
        """After how long members have to be served without an event."""
        self._busy = np.zeros(1, dtype=np.int64)
        """Of how many devices writes are kept, see ``serve_step.Desk``."""
        self._turns = 0
        self._loses = False
        """Whether somebody has just gone, who may have had more than has been seen."""
        self._stopped_ns = 0
        """Since when the workcell is stopped, as has been seen [ns]."""
        self._is_braking = False
        """Whether devices have just begun a stop, which has yet to show in a tick."""
        self._requests: ChangeWatch | None = None
        self._is_settled = self._has_litter = False
        self._of = np.zeros(MOST_FILES, dtype=np.int64)
        self._ready = np.zeros(MOST_EVENTS, dtype=np.int64)
        self._many = Many(
            poll=self._epoll.fileno(), ready=self._ready, timeout_ms=-1, of=self._of, size=MOST_FILES, heed=heed_one
        )

    def run(self) -> None:
        """Serve devices until there is none and none can come."""
        while self._members or self._built or self._sock is not None:
            if self._built:
                self._start(self._built.popleft())
            for fd in self._wait():
                if fd in self._members:
                    self._put(fd)
                elif self._requests is not None and fd == self._requests.fd:
                    self._heed_requests()
                elif self._sock is not None and fd == self._sock.fileno():
                    self._take(self._sock)
            if self._loses:  # a process that ends closes one socket after another, if it gets to
                self._loses = False
                time.sleep(CLOSING_S)
            elif not self._look_for_stops():
                self._serve_next()

    def _wait(self) -> list[int]:
        """Return the descriptors that are ready; those of members who have more to do are."""
        pauses = self._pauses
        timeout_s = 0.0 if self._built or self._due else min(pauses.values(), default=None)
        if library is None:
            found = [fd for fd, _ in self._epoll.poll(timeout_s)]
        else:
            self._many.timeout_ms = -1 if timeout_s is None else math.ceil(timeout_s * 1e3)
            found = self._ready[: run_many(self._many)].tolist()
        return found + [fd for fd in pauses if fd not in found]

    def _put(self, fd: int) -> None:
        """Have a member served soon; until then it ticks on, unless the tick itself is what there is to be served."""
        quiet = self._members[fd].quiet
        if quiet is not None and not self._may_go_on(self._members[fd], quiet):
            self._rank(fd, STOPS)
        if quiet is None or wait_turn(quiet.record):
            self._of[fd] = 0
            self._rank(fd, STANDS)
        else:
            self._of[fd] = quiet.record.address
            if self._due.get(fd) == STANDS:  # it can tick now
                self._due[fd] = CAN_WAIT
            self._rank(fd, CALLED if quiet.record.called else CAN_WAIT)

    def _may_go_on(self, member: Member, quiet: QuietRun) -> bool:
        """Have a member halt by steps whose owner, or the daemon, has gone; return False where its loop has to."""
        if not member.losses:
            member.losses = member.runtime.losses(quiet.ready)
            if member.losses and not self._lose_process(member.runtime.exiting(quiet.ready)):
                self._loses = True
        return not member.losses or not begin_halt(quiet.record, time.monotonic_ns())

    def _lose_process(self, pid: int) -> bool:
        """Have all halt whose owner is a process that is about to end; return whether it is known which."""
        for fd, member in self._members.items() if pid else ():
            if not member.losses and (losses := member.runtime.losses_of(pid)):
                member.losses = losses
                halts = member.quiet is not None and not begin_halt(member.quiet.record, time.monotonic_ns())
                self._rank(fd, CAN_WAIT if halts else STOPS)
        return pid != 0

    def _rank(self, fd: int, rank: int) -> None:
        """Let a member wait with others of its rank, behind those that have come before, if not with better ones."""
        self._due[fd] = min(rank, self._due.get(fd, rank))

    def _serve_next(self) -> None:
        """Serve the member whose turn it is."""
        if not self._due:
            return
        self._turns += 1
        first = min if self._turns % FAIR else max
        fd = first(self._due, key=self._due.__getitem__)
        del self._due[fd]
        self._serve(fd, self._members[fd])
        if self._turns % IN_A_ROW == 0:
            time.sleep(PAUSE_S)

    # --- devices ---------------------------------------------------------------------------------

    def _take(self, sock: socket.socket) -> None:
        """Take a device that the fork server sends; all that come first, for none ticks then."""
        first = True
        while first or (not self._members and is_readable(sock)):
            first = False
            try:
                packet, fds = receive(sock, 1 << 20, 8)
            except OSError:
                packet, fds = b"", []
            if not packet:
                self._epoll.unregister(sock.fileno())
                sock.close()
                self._sock = None
                break
            try:
                message = take(packet, TO_FORK_SERVER, values=MAX_UNPACKED)[1]
                if isinstance(message, Spawn):
                    self._built.append(self._build(message, fds))
            except Exception:  # the daemon hears of it by the end of the control socket
                traceback.print_exc()
                _close(fds)
                break

    def _build(self, message: Spawn, fds: list[int]) -> Member:
        device, name, table, generation, options = message
        driver = find_driver(name, options["folder"])
        settings, errors = read_settings(driver, table, options["folder"])
        if errors:
            raise ValueError("; ".join(errors))
        runtime = Runtime(driver, device, settings, generation, options, fds)
        return Member(runtime, fds[1:], int(options["realtime_priority"]), str(options["user"]))

    def _start(self, member: Member) -> None:
        runtime = member.runtime
        self._settle(member)
        self._clear_away()
        runtime.sees_requests, runtime.busy = self._requests is not None, self._busy
        self._members[runtime.poll_fd] = member
        self._epoll.register(runtime.poll_fd, select.EPOLLIN)
        self._guarded(member, runtime.start)
        self._go_on(runtime.poll_fd, member)
        time.sleep(PAUSE_S)

    def _clear_away(self) -> None:
        """Free what is left of devices that have ended: their parts know each other, and the collector is off.

        That takes some ms, as the construction of the device does that comes now; nothing else has to wait for it.
        """
        if self._has_litter:
            self._has_litter = False
            gc.collect()

    def _settle(self, member: Member) -> None:
        """Become who the process shall be, with the first of its devices."""
        if self._is_settled:
            return
        self._is_settled = True
        log = member.runtime.log
        try:
            self._requests = ChangeWatch(member.fds[REQUEST - 1])
            self._epoll.register(self._requests.fd, select.EPOLLIN)
        except OSError as error:
            log("debug", f"stops through the stop-request file are seen in ticks: {error.strerror}")
        settle(member.priority, member.user, log)

    def _serve(self, fd: int, member: Member) -> None:
        runtime, ticked = member.runtime, member.quiet is not None
        ready = self._take_back(fd, member)
        owes, member.owes = member.owes, False
        if owes:
            self._guarded(member, runtime.heed_requests)
        losses, member.losses = member.losses, []
        for lose in losses:
            self._guarded(member, lose)
        if losses:  # whose descriptors are ready no more
            ready = [each for each in ready if each in runtime.timers]
        known = [*ready, *runtime.timers] if ticked else ready  # steps go on with the timers
        self._guarded(member, lambda: runtime.serve(ready + runtime.ready_but(known)))
        self._go_on(fd, member)

    def _take_back(self, fd: int, member: Member) -> list[int]:
        """Have the loop of a device go on; return the descriptors that are ready."""
        quiet, member.quiet = member.quiet, None
        self._of[fd] = 0
        ready: list[int] = []
        if quiet is not None:
            self._guarded(member, lambda: ready.extend(member.runtime.take_back(quiet)))
        return ready

    def _go_on(self, fd: int, member: Member) -> None:
        """Let a device tick by steps, or leave."""
        self._guarded(member, lambda: self._lend(fd, member))
        if not member.runtime.running:
            del self._members[fd]
            self._pauses.pop(fd, None)
            self._due.pop(fd, None)
            self._epoll.unregister(fd)
            member.runtime.release()
            _close(member.fds)
            self._has_litter = True

    def _lend(self, fd: int, member: Member) -> None:
        self._pauses.pop(fd, None)
        if (pause_s := member.runtime.pause_s) is not None:
            self._pauses[fd] = pause_s
        member.quiet = member.runtime.lend()
        if member.quiet is not None:
            self._of[fd] = member.quiet.record.address

    def _guarded(self, member: Member, work: Callable[[], object]) -> None:
        """Do the work of one device that has not ended; what it raises ends this one."""
        if not member.runtime.running:
            return
        try:
            work()
        except Exception as error:  # stop first, report second; the others go on
            member.runtime.fail(error)
            member.runtime.running = False

    def _heed_requests(self) -> None:
        """Somebody has written to the stop-request file."""
        if self._requests is not None:
            self._requests.drain()
        self._begin_stops()

    def _begin_stops(self) -> None:
        """Have all brake at once, by steps where these can; they tell of it one by one, behind a tick that shows it."""
        now_ns, self._is_braking = time.monotonic_ns(), True
        for fd, member in self._members.items():
            if member.quiet is not None and member.quiet.record.is_stopped:
                continue  # by the same request, whose stop the daemon has latched now
            member.owes = True
            self._rank(fd, CAN_WAIT if self._brakes(member, now_ns) else STOPS)

    def _look_for_stops(self) -> bool:
        """Begin a stop that has been latched since the last look, of which the daemon tells one device of a process;
        return whether one has just been begun.
        """
        seen_ns = self._stopped_ns
        for member in list(self._members.values())[:1]:
            self._stopped_ns = member.runtime.stopped_ns
        if self._stopped_ns not in (0, seen_ns) and not self._is_braking:
            self._begin_stops()
        begun, self._is_braking = self._is_braking, False
        return begun

    def _brakes(self, member: Member, now_ns: int) -> bool:
        """Have a member begin its stop by steps; return whether it has."""
        return member.quiet is not None and begin_asked_stop(member.quiet.record, now_ns) != 0


def _close(fds: list[int]) -> None:
    for fd in fds:
        with suppress(OSError):
            os.close(fd)


def main(name: str, sock: socket.socket) -> None:
    """Be the driver process of several devices until there is none left.

    Args:
        name: of the process.
        sock: to the fork server, on which devices come.
    """
    name_process(f"sioms:{name}")
    permit_files()
    Group(sock).run()
