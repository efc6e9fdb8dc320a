"""A request channel: a SOCK_SEQPACKET socket on which requests are answered by number.

Concurrency: any number of threads may call at once. One of those that wait reads for all; when its
own answer has come it passes the reading on.

``_socket`` instead of ``socket``: importing the latter costs a shell tool half of its start time.
"""

from __future__ import annotations

import errno
import os
from _socket import CMSG_SPACE, SHUT_RDWR, SO_PEERCRED, SO_RCVTIMEO, SOL_SOCKET, socket
from _thread import allocate_lock, get_ident
from itertools import chain, repeat
from struct import pack, unpack
from time import monotonic

from sioms.protocol.messages import MAX_PACKET, MalformedMessage, decode_reply, encode, short_reply, value_of
from sioms.protocol.verbs import Cancel, CancelOnHandle, Heard, Keepalive, Part, Passed

from .abandoned import undoing
from .arguments import checked, seconds
from .shown import acknowledged_by_daemon

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from typing import Any

    from sioms.protocol.clock import Clock
    from sioms.protocol.verbs import Message

    from .carrying import Carrier
    from .overdue import Overdue

_CMSG_CLOEXEC = 0x40000000
_DONTWAIT = 0x40
_ANCILLARY = CMSG_SPACE(8 * 4)
KEEPALIVE = Keepalive().packed()
INTERRUPTIBLE_S = 1.0
"""A signal that comes just before the interpreter goes to sleep is seen when that wakes: it sleeps this long [s]."""
FIRST_LOOK_S = 1.0
"""How long after its own time-out an answer is overdue: then the process that owes it is looked at (``overdue``) [s].
"""
_STEP_S = 1 / 64
"""Steps in which the time-out of the socket is set [s]."""
ENOUGH_LOOK_S = 0.25
"""The same for an answer that may be needless when it is overdue [s]."""


class Call:
    """A request to be sent: a message, and how long its answer may take.

    Attributes:
        what: the request in words, for messages.
        message: its arguments as its verb takes them.
        ahead: records that are sent ahead of it, in parts.
        limit_s: the time-out that the other side has been given [s], None = it may take for ever.
        enough: tells of an overdue answer whether it is not needed any more.
        through: the process that has to act before it can be answered, beside the one that answers; 0: none.
        number: with which it is sent, known before it is; 0: it has not come to that.
        found: the packet that answers it, and its descriptors; None: there is none yet.

    Raises:
        TypeError, ValueError: an argument is none that the verb takes; the other side would take it for a broken
            client.
    """

    __slots__ = ("ahead", "enough", "found", "limit_s", "message", "number", "through", "what")

    def __init__(
        self,
        what: str,
        message: Message,
        *,
        ahead: tuple[bytes, ...] = (),
        limit_s: float | None = 0.0,
        enough: Callable[[], bool] | None = None,
        through: int = 0,
    ) -> None:
        self.what = what
        self.through = through
        self.message = checked(what, message)
        self.ahead = ahead
        self.limit_s = seconds(what, limit_s)
        self.enough = enough
        self.number = 0
        self.found: tuple[list[Any], Descriptors] | None = None

    @property
    def first_look_s(self) -> float:
        """How long after its time-out its answer is overdue [s]."""
        return FIRST_LOOK_S if self.enough is None else ENOUGH_LOOK_S


class Descriptors(list[int]):
    """Descriptors that came with an answer, if any did."""

    __slots__ = ()

    def take(self) -> list[int]:
        """Return them; they are the caller's."""
        taken = list(self)
        self.clear()
        return taken

    def close(self) -> None:
        """Close them."""
        while self:
            os.close(self.pop())


class Untaken(Descriptors):
    """Some that did. Those that nobody takes out are closed, however it comes that nobody does: of a node that has been
    opened for who is interrupted, its driver sees the end of file.

    With the last of them it is one no longer: an interrupt that came in a ``__del__`` would be shown and forgotten.
    """

    __slots__ = ()

    def take(self) -> list[int]:
        """Return them; they are the caller's."""
        taken = super().take()
        self.__class__ = Descriptors  # type: ignore[assignment]
        return taken

    def close(self) -> None:
        """Close them."""
        super().close()
        self.__class__ = Descriptors  # type: ignore[assignment]

    __del__ = close


class Answer:
    """A successful reply: its value, and the descriptors that came along."""

    __slots__ = ("fds", "value")

    def __init__(self, value: Any, fds: Descriptors) -> None:
        self.value = value
        self.fds = fds


def _fds_of(ancillary: list[tuple[int, int, bytes]]) -> Descriptors:
    # In one step, as ``Channel._received``. Without the module array, which drags a third of the start time of a shell
    # tool behind it.
    if not ancillary:
        return Descriptors()
    fds = Untaken()
    rows = map(list.pop, repeat(ancillary, len(ancillary)))
    parts: Iterator[Any] = map(memoryview, map(tuple.__getitem__, rows, repeat(2)))  # type: ignore[arg-type]
    fds.extend(chain.from_iterable(map(memoryview.cast, parts, repeat("i"))))  # type: ignore[arg-type]
    return fds


class Channel:
    """Requests and answers on a connected socket.

    Args:
        sock: the socket, owned by the channel from now on.
        name: whose it is, for messages: the daemon, or a node.
        passed: whether answers may bring descriptors along; those of drivers never do, and looking for
            them takes time.
        acknowledged: told of the instant of the effect of what has been answered [ns], before the answer is.
        behind: the process that made the socket and the one that answers on it, as the former numbers them;
            empty: it is the one that made it.
        clock: of the cell, where that is another machine's; None: it is ours.
        carrier: what packets to another machine are sent by, and waited through; None: the socket.

    Attributes:
        keepalive_s: while a thread waits for an answer, it tells the other side this often [s] that it
            lives; 0 = never. The waiting thread itself does, so that a program that hangs is silent.
        fellows: channels that are told together with this one, itself among them; none: this one alone.
        said_ns: of a bridge, which passes on what others say: tells when what is sent now was said at the earliest [ns,
            CLOCK_MONOTONIC].
    """

    def __init__(
        self,
        sock: socket,
        name: str,
        passed: bool = True,
        acknowledged: Callable[[int], None] = acknowledged_by_daemon,
        behind: Sequence[int] = (),
        clock: Clock | None = None,
        carrier: Carrier | None = None,
    ) -> None:
        self.name = name
        self.acknowledged = acknowledged
        self.clock = clock
        self.carrier = carrier
        self._sock = sock
        self._flags = 0 if carrier is None else _DONTWAIT
        self._passed = passed
        self._behind = behind
        self._number = 0
        self._mutex = allocate_lock()
        self._reading = 0
        self._abandoned: dict[int, Message | None] = {}
        self._answers: dict[int, tuple[list, Descriptors]] = {}  # type: ignore[type-arg]
        self._came: list[tuple[bytes, list[tuple[int, int, bytes]], int, Any]] = []
        self._waiting: dict[int, object] = {}
        self._timeout = 0.0
        self.keepalive_s = 0.0
        self.fellows: Sequence[Channel] = ()
        self.said_ns: Callable[[], int] | None = None
        self._others_due_s = 0.0
        self._ended: tuple[int, str] | None = None
        self._pid = os.getpid()

    @property
    def closed(self) -> bool:
        """Whether the channel has been closed on this side."""
        return self._sock.fileno() < 0

    @property
    def ended(self) -> bool:
        """Whether no more requests can be sent: either side has ended the channel."""
        return self._ended is not None

    def fileno(self) -> int:
        """Return the socket's descriptor."""
        return self._sock.fileno()

    def call(self, call: Call) -> Answer:
        """Send a request and wait for its answer.

        Raises:
            OSError: the refusal, with its errno and sentence; EIO when the other side is gone,
                ETIMEDOUT when it does not answer within the time-out and what ``overdue`` adds to it.
        """
        try:
            self.send(call)
            return self.wait(call.number, call)
        except KeyboardInterrupt:  # also of one that comes when the request has been sent, and before ``send`` returns
            self.abandon(call)
            raise

    def abandon(self, call: Call) -> None:
        """Nobody waits for the answer to a request any more, if it has been sent: cancel it, and undo what it did."""
        if call.number:
            self._abandon(call.number, call.message, call.found)

    def short_call(self, arguments: tuple[Any, ...], call: Callable[[], Call]) -> Any:
        """Send a request and return the value of its answer, in few steps where no thread shares the channel.

        A program that calls seldom pays for each function on the way, whose code is in no cache any more.

        Args:
            arguments: verb and arguments of the request, known to be right.
            call: makes the same request for ``call``, if it comes to that.

        Raises:
            OSError: as ``call``.
        """
        number = 0
        try:
            number = self._lead()
            if not number:
                return self.call(call()).value
            message = self._exchange(number, arguments, call)
            if message is None:
                return self.wait(number, call(), 0.0 if number in self._answers else self._timeout).value
        except KeyboardInterrupt:
            self._read_no_more()
            if number:
                self._abandon(number)
            raise
        self.acknowledged(message[5])
        return message[3]

    def _lead(self) -> int:
        """Begin to read for all threads; return the number of a request, 0 when somebody else reads, nothing has yet
        been asked, or the socket would wait for longer than leases may.
        """
        with self._mutex:
            is_late = 0 < self.keepalive_s < self._timeout - _STEP_S
            if self._reading or self._ended is not None or not self._timeout or is_late:
                return 0
            self._reading = get_ident()
            self._number += 1
            return self._number

    def _exchange(self, number: int, arguments: tuple[Any, ...], call: Callable[[], Call]) -> list[Any] | None:
        """Send a request and read one packet; return it if it is the usual answer, else keep it for ``wait``."""
        packet = b""
        try:
            self._put(encode(arguments[0], number, *arguments[1:]))
            if self.fellows:
                self._keep_others()
            if self.carrier is not None:
                packet = self.carrier.wait(self._timeout)
            packet = packet or self._sock.recv(MAX_PACKET, self._flags)
            message = short_reply(packet, number)
            if message is None:
                self._sort(*self._decoded(packet, Descriptors()))
            return message
        except BlockingIOError:
            if self.keepalive_s:
                self.keepalive()
            return None
        except OSError as error:
            raise self._gone(error, "receive" if packet else call().what) from None
        finally:
            with self._mutex:
                self._reading = 0
                self._pass_on()

    def _abandon(
        self, number: int, message: Message | None = None, found: tuple[list[Any], Descriptors] | None = None
    ) -> None:
        """Cancel a request, and let go of what its answer may bring, or has brought."""
        cancel = Cancel(number) if self._passed else CancelOnHandle(number)
        cancelled = Call("cancel", cancel)
        try:
            self.send(cancelled)
        except OSError:
            return  # the other side has gone, and the request with it
        with self._mutex:
            self._abandoned |= {number: message, cancelled.number: None}
            found = found or self._answers.pop(number, None)
        if found:
            self._drop(*found)

    def _drop(self, message: list[Any], fds: Descriptors) -> None:
        """Let go of an answer that nobody waits for, and undo what it tells of."""
        fds.close()
        for each in undoing(self._abandoned.pop(message[1]), message[2], message[3]):
            undo = Call("undo", each)
            try:
                self.send(undo)
            except OSError:
                return
            self._abandoned[undo.number] = None

    def send(self, call: Call) -> int:
        """Send a request; return its number."""
        with self._mutex:
            if self._ended is not None:
                raise OSError(*self._ended)
            self._number += 1
            number = call.number = self._number
            packet = call.message.packed(number)
            if len(packet) > MAX_PACKET:
                raise OSError(errno.EMSGSIZE, f"{call.what}: {len(packet)} bytes in one message; at most {MAX_PACKET}")
            try:
                for part in call.ahead:
                    self._put(Part(number, part).packed())
                self._put(packet)
            except OSError as error:
                raise self._gone(error, call.what) from None
        if self.fellows:
            self._keep_others()
        return number

    def _put(self, packet: bytes) -> None:
        if self.said_ns is not None:
            at_ns = self.said_ns()
            packet = Heard(at_ns).packed() if packet is KEEPALIVE else Passed(at_ns, packet).packed()
        if self.carrier is None:
            self._sock.send(packet)
        else:
            self.carrier.send(packet)

    def _keep_others(self) -> None:
        """Renew the leases of the other channels, now and then: a request tells that this client is alive, and its
        answer may come before anybody waits.
        """
        now_s = monotonic()
        if now_s < self._others_due_s:
            return
        self._others_due_s = now_s + self.keepalive_s
        for channel in self.fellows:
            if channel is not self:
                try:
                    channel.notice(KEEPALIVE)
                except OSError:
                    continue  # who uses it hears of it there

    def notice(self, packet: bytes) -> None:
        """Send a packet that draws no answer."""
        try:
            self._put(packet)
        except OSError as error:
            raise self._gone(error, "send") from None

    def keepalive(self) -> None:
        """Tell the other side, and those of the channels that are kept alive with this one, that this client is
        alive.
        """
        for channel in self.fellows or (self,):
            try:
                channel.notice(KEEPALIVE)
            except OSError:
                if channel is self:
                    raise  # who uses another one hears of it there

    def wait(self, number: int, call: Call, waited_s: float = 0.0) -> Answer:
        """Wait for the answer to a request that was sent some time ago [s]."""
        try:
            return self._wait(number, call, waited_s)
        except BaseException:
            self._read_no_more()
            raise

    def _read_no_more(self) -> None:
        """Let others read where a signal has ended this thread's reading between two steps."""
        if self._reading == get_ident():
            with self._mutex:
                self._reading = 0
                self._pass_on()

    def _wait(self, number: int, call: Call, waited_s: float) -> Answer:
        due_s = monotonic() - waited_s + (call.limit_s or 0.0)
        deadline = None if call.limit_s is None else due_s + call.first_look_s
        overdue: Overdue | None = None
        while True:
            with self._mutex:
                # A signal may come behind each call, so that nothing is taken before it lies in its place.
                found = call.found = self._answers.get(number)
                if found is not None:
                    del self._answers[number]
                else:
                    if self._ended is not None:
                        raise OSError(*self._ended)
                    lead = not self._reading
                    if lead:
                        self._reading = get_ident()
                    else:
                        turn = allocate_lock()
                        turn.acquire()
                        self._waiting[number] = turn
            if found is not None:
                return self.result(found)
            if not lead:
                left = INTERRUPTIBLE_S if deadline is None else deadline - monotonic()
                turn.acquire(True, max(0.0, min(left, INTERRUPTIBLE_S)))
                with self._mutex:
                    self._waiting.pop(number, None)
                    late = False
                    if number not in self._answers and deadline is not None and monotonic() >= deadline:
                        overdue = overdue or self.overdue(call, due_s)
                        deadline = overdue.until(monotonic())
                        late = not deadline
                    if late and not self._reading:  # the reading may just have been passed to us
                        self._pass_on()
                if late:
                    self._abandon(number, call.message)
                    raise self.late(call)
                continue
            try:
                is_there = self._read(number, deadline)
            finally:
                with self._mutex:
                    self._reading = 0
                    self._pass_on()
            if not is_there and deadline is not None:
                overdue = overdue or self.overdue(call, due_s)
                deadline = overdue.until(monotonic())
                if not deadline:
                    self._abandon(number, call.message)
                    raise self.late(call)

    def _pass_on(self) -> None:
        """Let another thread read; when there is nothing to read any more, tell all."""
        for waiting in list(self._waiting)[: None if self._ended else 1]:
            self._waiting.pop(waiting).release()  # type: ignore[attr-defined]

    def take(self) -> tuple[list, Descriptors] | None:  # type: ignore[type-arg]
        """Read one packet without waiting, for event loops; None when there is none.

        Raises:
            OSError: the other side is gone, or has ended this channel with a reason.
        """
        try:
            found = self._packet(_DONTWAIT)
        except BlockingIOError:
            return None
        del self._came[:]
        return found

    def close(self) -> None:
        """Close the socket; waiting threads get EBADF. In a forked child that of its parent stays open."""
        with self._mutex:
            if self._ended is None:
                self._ended = (errno.EBADF, f"{self.name} is closed")
            if self._sock.fileno() >= 0:
                try:
                    if os.getpid() == self._pid:
                        self._sock.shutdown(SHUT_RDWR)
                except OSError:
                    pass  # the other side was gone already
                if not self._reading:
                    self._sock.close()

    def _read(self, number: int, deadline: float | None) -> bool:
        """Read packets until the answer with this number has come; return False when it is late."""
        while True:
            timeout = self.keepalive_s or INTERRUPTIBLE_S
            if deadline is not None:
                timeout = min(timeout, deadline - monotonic())
                if timeout <= 0:
                    return False
            self._set_timeout(timeout)
            packet = b"" if self.carrier is None else self.carrier.wait(timeout)
            try:
                message, fds = self._decoded(packet, Descriptors()) if packet else self._packet(self._flags)
                self._sort(message, fds)
            except BlockingIOError:
                if self.keepalive_s:
                    self.keepalive()
                continue
            except KeyboardInterrupt:
                if self._came:  # it may be for another thread, or bring what its request has been granted
                    self._sort(*self._packet(self._flags))
                raise
            if message[1] == number:
                return True

    def _sort(self, message: list[Any], fds: Descriptors) -> None:
        """Keep an answer for whom it is for."""
        if message[1] in self._abandoned:
            del self._came[:]
            self._drop(message, fds)
            return
        with self._mutex:
            self._answers[message[1]] = (message, fds)
            del self._came[:]  # no signal is heeded between these two
            turn = self._waiting.pop(message[1], None)
        if turn is not None:
            turn.release()  # type: ignore[attr-defined]

    def _packet(self, flags: int) -> tuple[list, Descriptors]:  # type: ignore[type-arg]
        if not self._passed:
            return self._decoded(self._received(flags), Descriptors())
        if not self._came:  # else a signal has ended the reading of what came last
            self._received(flags)
        packet, ancillary, _, _ = self._came[0]
        return self._decoded(packet, _fds_of(ancillary))

    def _received(self, flags: int) -> bytes:
        """Receive a packet; where descriptors may come along, put it and these into ``_came``, in one step: a signal
        behind it would leave descriptors that nobody knows, and with them a node open.
        """
        try:
            if not self._passed:
                return self._sock.recv(MAX_PACKET, flags)
            self._came.extend(map(self._sock.recvmsg, (MAX_PACKET,), (_ANCILLARY,), (flags | _CMSG_CLOEXEC,)))
        except BlockingIOError:
            raise
        except OSError as error:
            raise self._gone(error, "receive") from None
        return b""

    def _decoded(self, packet: bytes, fds: Descriptors) -> tuple[list, Descriptors]:  # type: ignore[type-arg]
        if not packet:
            raise self._gone(None, "receive")
        try:
            message = decode_reply(packet)
        except MalformedMessage as error:
            raise self._gone(OSError(errno.EPROTO, str(error)), "receive") from None
        if message[1] == 0:
            # The last word before the other side closes: errno and why.
            self._ended = (message[2], str(message[3]))
            raise OSError(*self._ended)
        return message, fds

    def _set_timeout(self, timeout: float) -> None:
        # In steps, because setting it is a system call: an answer is seldom late, and what is left of a second is a
        # little less at each call.
        coarse = max(0.001, timeout if timeout < _STEP_S else -(-timeout // _STEP_S) * _STEP_S)
        if coarse != self._timeout:
            self._timeout = coarse
            seconds = int(coarse)
            self._sock.setsockopt(SOL_SOCKET, SO_RCVTIMEO, pack("ll", seconds, int((coarse - seconds) * 1e6)))

    def result(self, found: tuple[list, Descriptors]) -> Answer:  # type: ignore[type-arg]
        """Turn a packet into an answer, or raise its refusal."""
        message, fds = found
        if message[5]:
            self.acknowledged(message[5])
        if message[2]:
            raise OSError(message[2], message[3])
        try:
            return Answer(value_of(message), fds)
        except MalformedMessage as error:
            raise OSError(errno.EPROTO, f"receive on {self.name}: {error}") from None

    def _gone(self, error: OSError | None, what: str) -> OSError:
        if self._ended is None:
            if error is not None and error.errno == errno.EPROTO:
                self._ended = (errno.EPROTO, f"{what} on {self.name}: {error.strerror}")
            elif self._sock.fileno() < 0:
                self._ended = (errno.EBADF, f"{self.name} is closed")
            else:
                gone = (errno.EIO, f"{self.name}: the process behind it has gone; connect or open again")
                self._ended = self._last_word() or gone
        return OSError(*self._ended)

    def _last_word(self) -> tuple[int, str] | None:
        """Return why the other side has ended this channel, if it said so; keep the answers before that."""
        for _ in range(2):  # a reset is reported once, ahead of what is still there to read
            try:
                while packet := self._sock.recv(MAX_PACKET, _DONTWAIT):
                    message = decode_reply(packet)
                    if message[1] == 0:
                        return message[2], str(message[3])
                    self._answers[message[1]] = (message, Descriptors())
            except (OSError, MalformedMessage):
                continue
        return None

    def overdue(self, call: Call, due_s: float) -> Overdue:
        """Return who tells how long an overdue answer is still waited for.

        Args:
            call: the request.
            due_s: the moment of its time-out [s, time.monotonic].
        """
        from .overdue import Overdue

        return Overdue(self.server, due_s, call.enough, through=call.through)

    @property
    def server(self) -> int:
        """The process that answers, as far as its number is one of this machine; 0: not known."""
        try:
            maker = unpack("3i", self._sock.getsockopt(SOL_SOCKET, SO_PEERCRED, 12))[0]
        except OSError:  # closed meanwhile
            maker = 0
        known, pid = self._behind or (maker, maker)
        # Elsewhere processes have other numbers than here.
        return int(pid) if known == maker and pid != os.getpid() else 0

    def late(self, call: Call) -> OSError:
        """Return the error of a request that nobody has answered in time."""
        return OSError(errno.ETIMEDOUT, f"{call.what}: {self.name} does not answer; is its process hung?")
