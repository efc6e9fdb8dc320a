"""Driver processes: start, supervise, restart, end. One ``DriverProcess`` a configured device."""

from __future__ import annotations

import errno
import fcntl
import mmap
import os
import signal
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from enum import Enum
from functools import partial
from typing import Any, Protocol

from sioms.descriptors import is_readable, receive
from sioms.protocol.driver_verbs import FROM_DRIVER, InUse, LinkChanged, Ready, Shutdown
from sioms.protocol.flags import PageState
from sioms.protocol.messages import MAX_PACKET, MalformedMessage
from sioms.protocol.page import NotReadable, PageReader, set_daemon_state
from sioms.protocol.verbs import Message, take

from .config import Device
from .fork_server import ForkServer
from .journals import journal_file
from .loop import Loop, Timer
from .names import DeviceInfo, part_name
from .patience import Patience
from .restarts import TOO_OFTEN, Restarts

_SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | 0x0010 | fcntl.F_SEAL_SEAL  # 0x10: F_SEAL_FUTURE_WRITE
_SHUTDOWN_S = 3.0
_ALONE_S = 0.02
"""A process closes the sockets of its devices so long before it has ended, at most [s]."""
_MOST_HEARD = 1024
"""More messages than the socket of a driver holds."""
LOOK_NS = 1_000_000_000
"""How often a driver that is starting is looked at."""


class State(Enum):
    """Life of a device."""

    DOWN = "down"
    STARTING = "starting"
    UP = "up"
    RESTARTING = "restarting"
    FAULT = "fault"
    ENDING = "ending"


class Owner(Protocol):
    """What the server does when something happens to a device."""

    def device_up(self, device: DriverProcess) -> None:
        """The driver is ready."""

    def device_gone(self, device: DriverProcess, reason: str) -> None:
        """The driver process is no more; its handles are void."""

    def device_hung(self, device: DriverProcess, reason: str) -> None:
        """The driver has missed its lease."""

    def device_ticks(self, device: DriverProcess) -> None:
        """The driver ticks again."""

    def stopped_of(self, device: str) -> dict[str, Any]:
        """Return options of a driver: what is ``stopped`` from its start, as of how many ``resets`` of the workcell."""

    def device_message(self, device: DriverProcess, message: Message) -> None:
        """The driver tells something."""


class DriverProcess:
    """A device's driver process, through all its restarts.

    Args:
        loop: the daemon's loop.
        fork_server: returns the fork server of the day.
        device: its configuration.
        info: its description.
        shared: descriptors of latch, request page and marker table, passed to each process.
        owner: who is told.
        log: the daemon's log.
        options: what the driver is told beside its settings.
    """

    def __init__(
        self, loop: Loop, fork_server: Callable[[], ForkServer], device: Device, info: DeviceInfo,
        shared: Sequence[int], owner: Owner, log: Callable[..., None], options: dict[str, Any],
    ) -> None:  # fmt: skip
        self.device = device
        self.info = info
        self.state = State.DOWN
        self.reason = ""
        self.trouble, self._trouble_ns, self._fault_ns = "", 0, 0
        self._faults: dict[tuple[int, int], tuple[int, str]] = {}
        self.link: tuple[PageState, str] = (PageState.STARTING, "")
        self.generation = 0
        self.pid = 0
        self.started_ns = 0
        self.restarts = Restarts()
        self.page_fds: list[int] = []
        self.journal_fd = journal_file(f"sioms:{device.name}.journal")
        self.hung = False
        self.used = False
        self.options = options
        self._maps: list[mmap.mmap] = []
        self._readers: list[PageReader] = []
        self._loop = loop
        self._fork_server = fork_server
        self._ended: Callable[[], None] | None = None
        self._shared = shared
        self._owner = owner
        self._log = log
        self._sock: socket.socket | None = None
        self._is_heard = False
        self._pidfd = -1
        self._dying: set[int] = set()
        self._then: Callable[[], None] | None = None
        self._timer: Timer | None = None
        self._patience: Patience | None = None
        self._look_ns = 0
        self._lease_s = device.common.lease_s or info.lease_s

    @property
    def name(self) -> str:
        """Device name."""
        return self.device.name

    @property
    def process(self) -> str:
        """Name of the process that it shares with other devices; empty: it has one of its own."""
        return self.device.common.process

    @property
    def lives_in(self) -> tuple[str, str]:
        """The same for all devices of a process, and for no other."""
        return self.process, "" if self.process else self.name

    @property
    def is_there(self) -> bool:
        """Whether there is a process to send messages to."""
        return self._sock is not None

    @property
    def contact(self) -> tuple[socket.socket, int] | None:
        """The socket to the process and its pidfd, while it is up and ticks and both are known."""
        there = self.state is State.UP and not self.hung and self._pidfd >= 0
        return (self._sock, self._pidfd) if there and self._sock is not None else None

    @property
    def lease_s(self) -> float:
        """How long the process may be silent before it counts as hung [s]."""
        return self._lease_s

    @property
    def settled(self) -> bool:
        """Whether the first start has succeeded or failed for good."""
        return self.state not in (State.DOWN, State.STARTING)

    def start(self) -> None:
        """Fork the driver process, as soon as the one before it is gone: it may hold the device still."""
        self._when_gone(self._fork)

    def _fork(self) -> None:
        self.generation += 1
        self.state = State.STARTING
        self.started_ns = time.monotonic_ns()
        self.hung = self.used = False
        try:
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        except OSError as error:
            self._lost(f"its process could not be started: {error.strerror}")
            return
        ours.setblocking(False)
        self._sock = ours
        options = dict(
            self.options,
            user=self.device.common.user,
            process=self.process,
            lease_s=self._lease_s,
            **self._owner.stopped_of(self.name),
        )
        self._is_heard = True
        self._loop.watch(ours.fileno(), self._receive)  # first, because a spawn may be refused at once
        with theirs:
            try:
                self._fork_server().spawn(
                    self.name, self.device.common.driver, self.device.settings, self.generation, options,
                    [theirs.fileno(), *self._shared, self.journal_fd], partial(self._spawned, self.generation),
                )  # fmt: skip
            except OSError as error:
                self._end(f"its process could not be started: {error.strerror}")

    def _spawned(self, generation: int, pid: Any, errno_: int, text: str, fds: list[int]) -> None:
        if self._sock is None or generation != self.generation:  # ended while the fork server was forking
            for fd in fds:
                self._part(fd)
        elif errno_:
            self._end(f"its process could not be started: {text}")
        elif not fds:  # the kernel drops what goes beyond the limit; the process ends with its control socket
            self._end("its process could not be started: too many open files in the daemon; raise LimitNOFILE")
        else:
            self.pid, self._pidfd = pid, fds[0]
            self._patience = Patience(pid)
            self._patience.renew(time.monotonic())
            self._loop.watch(self._pidfd, self._exited)

    def _part(self, pidfd: int) -> None:
        """Have done with a process that has ended, or has closed its socket: kill it, unless it has other devices."""
        if self.process:
            os.close(pidfd)
        else:
            self._bury(pidfd)

    def _bury(self, pidfd: int) -> None:
        """Kill a process and see it gone: until then it may hold the device."""
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(pidfd, signal.SIGKILL)

        def gone() -> None:
            self._loop.unwatch(pidfd)
            os.close(pidfd)
            self._dying.discard(pidfd)
            self._when_gone(self._then)

        self._dying.add(pidfd)
        self._loop.watch(pidfd, gone)

    def _when_gone(self, then: Callable[[], None] | None) -> None:
        """Do one thing when no process of the past is left, instead of what was to be done."""
        self._then = then
        if not self._dying and then is not None:
            self._then = None
            then()

    def send(self, message: Message, fds: Sequence[int] = ()) -> None:
        """Send a notice to the driver.

        Raises:
            OSError: EIO, the driver is gone or does not take messages any more.
        """
        if self._sock is None:
            raise OSError(errno.EIO, f"device {self.name} is {self.state.value}: {self.reason}")
        try:
            socket.send_fds(self._sock, [message.packed()], list(fds))
        except OSError as error:
            raise OSError(errno.EIO, f"driver of {self.name} does not take messages: {error.strerror}") from None

    def tell(self, message: Message) -> None:
        """Send a notice; a driver that cannot take it will be found dead or hung anyway."""
        try:
            self.send(message)
        except OSError as error:
            self._log("warning", "notice lost", device=self.name, verb=type(message).__name__, why=error.strerror)

    def tell_use(self, used: bool) -> None:
        """Tell the driver whether somebody reads it through another device, when that is news; it may be asked again
        and again.
        """
        if self.state is State.UP and used != self.used:
            with suppress(OSError):
                self.send(InUse(used))
                self.used = used

    def why_unreadable(self, block: int) -> str:
        """Return why readers of a block are refused, empty when they are not."""
        if self.state is not State.UP:
            return self.reason or f"device {self.name} is {self.state.value}"
        try:
            self._readers[block].check(time.monotonic_ns())
        except NotReadable as error:
            late = error.state is PageState.STALE and not self.hung  # not for longer than check() allows
            return "" if late else error.reason or error.state.name.lower()
        return ""

    def check(self, now_ns: int) -> None:
        """Look at the lease: mark a hung driver stale, end one that stays hung."""
        if self.state is not State.UP:
            if self.state is State.STARTING and now_ns >= self._look_ns:
                self._look_ns = now_ns + LOOK_NS
                if self._patience is not None and (why := self._patience.stuck(now_ns / 1e9)):
                    self.kill(f"it was not ready: {why}")
            return
        reader = self._readers[0]
        age_ns = max(0, now_ns - reader.alive_ns)  # it may have ticked since the daemon looked at the clock
        if age_ns > self._lease_s * 1e9 and not self.hung:
            self.hung = True
            self._patience = Patience(self.pid, self.device.common.hang_s)
            self._patience.renew(now_ns / 1e9)
            self._owner.device_hung(self, f"its driver has not ticked for {age_ns / 1e9:.3f} s")
        elif age_ns < self._lease_s * 1e9:
            if self.hung:
                self._owner.device_ticks(self)
            self.hung = False
        if self.hung and self._patience is not None and (why := self._patience.stuck(now_ns / 1e9)):
            self.kill(f"its driver hung for {age_ns / 1e9:.2f} s and was killed: {why}")

    def kill(self, reason: str) -> None:
        """End the process at once (SIGKILL) and let the restart policy go on."""
        self._end(reason)

    def shutdown(self, done: Callable[[], None] | None = None) -> None:
        """Let the driver stop, make its outputs safe and exit; kill it when it takes too long."""
        if self._timer is not None:
            self._timer.cancel()
        self._ended = done
        if self._sock is None:
            self.state = State.DOWN
            self._when_gone(done)
            return
        self.state = State.ENDING
        self.tell(Shutdown())
        self._timer = self._loop.after(_SHUTDOWN_S, lambda: self.kill("it did not end when asked to"))

    def _receive(self) -> None:
        if self._sock is None or self._take() is not False:
            return
        if self.process and self._pidfd >= 0:  # whether it has ended alone, the end of the process will tell, or not
            self._unwatch(self._sock)
            self._loop.after(_ALONE_S, partial(self._ended_alone, self.generation))
            return
        self._exited()

    def _unwatch(self, sock: socket.socket) -> None:
        if self._is_heard:
            self._is_heard = False
            self._loop.unwatch(sock.fileno())

    def _ended_alone(self, generation: int) -> None:
        if generation == self.generation:
            self._exited()

    def _take(self) -> bool | None:
        """Take one packet; False at the end of file, None when there is none."""
        if self._sock is None:
            return None
        try:
            packet, fds = receive(self._sock, MAX_PACKET + 1, 250)
        except BlockingIOError:
            return None
        except ConnectionResetError:
            return self._take()  # a reset is reported once, ahead of what is still there to read
        except OSError:
            return False
        if not packet:
            return False
        try:
            _, message = take(packet, FROM_DRIVER, state=self.state.value)
        except MalformedMessage as error:
            for fd in fds:
                os.close(fd)
            self.kill(f"its driver sent a malformed message: {error}")
            return None
        if isinstance(message, Ready):
            self._ready(fds)
            return True
        for fd in fds:
            os.close(fd)
        if isinstance(message, LinkChanged):
            self.link = (PageState(message.state), message.reason)
        self._owner.device_message(self, message)
        return True

    def _ready(self, fds: list[int]) -> None:
        if len(fds) < len(self.info.blocks):  # as above
            for fd in fds:
                os.close(fd)
            self.kill("its pages could not be taken: too many open files in the daemon; raise LimitNOFILE")
            return
        self._maps = [mmap.mmap(fd, 4096) for fd in fds]
        for fd in fds:
            fcntl.fcntl(fd, fcntl.F_ADD_SEALS, _SEALS)
        self._readers = [PageReader(m) for m in self._maps]
        self.page_fds = fds
        if self.state is State.ENDING:
            return  # it was told to end before it was ready, and will
        self.state = State.UP
        self.reason = ""
        self._log("info", "device up", device=self.name, pid=self.pid, generation=self.generation)
        self._owner.device_up(self)

    def _exited(self) -> None:
        while self._take():
            pass  # its last words: why it failed, which handles it has ended
        if self._sock is None:
            return
        # A driver that closed its control socket has no business living on.
        self._end(self.reason or self._why_ended(), self._part)

    def _why_ended(self) -> str:
        if not self.process:
            return "its driver process ended"
        if self._pidfd >= 0 and is_readable(self._pidfd):
            return f"process {self.process} ended, and with it every device in it"
        return f"its driver ended, in process {self.process}"

    def _end(self, reason: str, part: Callable[[int], None] | None = None) -> None:
        """Clear everything of the present process, tell the owner, and plan the restart.

        Args:
            reason: why, for who asks.
            part: what becomes of the process, by its pidfd; None: it is killed.
        """
        if self._sock is None:
            return
        for mapping in self._maps:
            set_daemon_state(memoryview(mapping), PageState.STALE, reason)
        for reader in self._readers:
            reader.release()
        self._maps, self._readers = [], []
        for fd in self.page_fds:
            os.close(fd)
        self.page_fds = []
        self._unwatch(self._sock)
        self._sock.close()
        self._sock = None
        if self._pidfd >= 0:
            self._loop.unwatch(self._pidfd)
            (part or self._bury)(self._pidfd)
            self._pidfd = -1
        self._patience = None  # the next process is not to blame for what this one did
        self._lost(reason)

    def _lost(self, reason: str) -> None:
        if self._timer is not None:
            self._timer.cancel()
        was, self.pid = self.state, 0
        self._faults.clear()
        self.reason = reason
        self.link = (PageState.STALE, reason)
        if was is State.ENDING:
            self.state = State.DOWN
            self._owner.device_gone(self, reason)
            self._when_gone(self._ended)
            return
        again_ns = self.restarts.died(time.monotonic_ns())
        self.state, self._fault_ns = State.FAULT if again_ns is None else State.RESTARTING, time.monotonic_ns()
        self._log("error", "device lost", device=self.name, reason=reason, then=self.state.value)
        if again_ns is None:
            self.reason = f"{reason}; {TOO_OFTEN}, so it waits for a reset"
        self._owner.device_gone(self, reason)
        if again_ns is not None:
            self._timer = self._loop.at(again_ns, self.start)

    def note_trouble(self, text: str) -> None:
        """Keep for the status what its driver reports as an error."""
        self.trouble, self._trouble_ns = text, time.monotonic_ns()

    def note_fault(self, block: int, channel: int, at_ns: int, text: str) -> None:
        """Note since when a channel is in fault [ns, CLOCK_MONOTONIC], and why; 0: it is so no longer."""
        self._faults[block, channel] = (at_ns, text)
        if not any(since_ns for since_ns, _ in self._faults.values()):
            self.trouble = ""

    def hear(self) -> None:
        """Take what its driver has told until now, ahead of its turn."""
        for _ in range(_MOST_HEARD):
            if not self._take():
                break

    def failed_since(self, instant_ns: int, block: int = -1, channels: Sequence[int] = ()) -> str:
        """Return what has come into fault since an instant, and why, as far as it has told; else ''.

        Args:
            instant_ns: [ns, CLOCK_MONOTONIC].
            block, channels: what counts beside the device as a whole; no block: all.
        """
        if self.state is State.FAULT and self._fault_ns > instant_ns:
            return f"{self.name} has failed ({self.reason})"
        for (number, channel), (at_ns, text) in self._faults.items():
            if at_ns > instant_ns and (block < 0 or (number == block and channel in channels)):
                return f"{part_name(self.info, number, channel, -1)} has come into fault ({text})"
        return ""

    def reset(self, sent_ns: int) -> None:
        """Forget its trouble, and start it again, with a clean record, if it is in fault; but for what came later.

        Args:
            sent_ns: when the reset was sent, at the earliest [ns, CLOCK_MONOTONIC].
        """
        if self._trouble_ns <= sent_ns:
            self.trouble = ""
        if self.state is State.FAULT and self._fault_ns <= sent_ns:
            self.restarts.forget()
            self.start()
