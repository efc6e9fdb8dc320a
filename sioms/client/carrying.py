"""Frames of a link that are moved by the thread of the program that waits for one: changes of threads take a good part
of the time of a request.

One thread of the program at a time takes the place of the session's own, for as long as it waits for an answer. What it
does with the link it does whole: signals, whose handlers may raise, are held back for the moment. Should one come by
another thread of the program all the same, the session ends.

Concurrency: any threads of the process that has made the session; none of a forked child.
"""

from __future__ import annotations

import ctypes
import errno
import os
import threading
from _signal import (  # type: ignore[import-not-found]  # that of ``signal`` makes an enumeration of each number
    SIG_BLOCK,
    SIG_SETMASK,
    SIGABRT,
    SIGBUS,
    SIGFPE,
    SIGILL,
    SIGSEGV,
    valid_signals,
)
from collections.abc import Callable, Sequence
from functools import partial
from select import POLLIN, poll
from time import monotonic, sleep
from typing import TYPE_CHECKING, Protocol, Self

if TYPE_CHECKING:
    from _socket import socket

ALL = valid_signals() - {SIGABRT, SIGBUS, SIGFPE, SIGILL, SIGSEGV}
"""Signals that are held back: all but those of a crash, which somebody may want to be told of."""
WHY_MS = 1000
"""How long the session's own thread may take to say why a channel has ended [ms]."""
END_S = 5.0
"""How long a thread of the program may take to notice the end of the session that it moves frames of [s]."""
LOOK_S = 1e-3
"""How often to look whether it has [s]."""
NOBODY = -1
"""A channel that is none."""
MAIN = threading.main_thread().ident
_Mask = ctypes.c_uint64 * 16
_sigmask = ctypes.PyDLL(None).pthread_sigmask
"""That of the module ``signal`` takes 7 us, as it makes sets of numbers."""
_sigmask.argtypes = ctypes.c_int, ctypes.POINTER(_Mask), ctypes.POINTER(_Mask)
_ALL = _Mask(sum(1 << (number - 1) for number in ALL))


class Bridge(Protocol):
    """What moves the frames of a session, as far as threads of the program do it.

    Attributes:
        link_fd: readable when the link has something to do.
    """

    link_fd: int

    def say(self, channel: int, packet: bytes) -> None:
        """Send a packet of the program, 0 = to the daemon; raises OSError: EPIPE, that channel has ended."""

    def serve(self, channel: int) -> bytes:
        """Move what has come; return an answer for who waits on a channel, b"": what is for it lies in its socket."""

    def watch(self, whether: bool) -> None:
        """Have the session's own thread watch the link, or not."""

    def spoil(self, why: str) -> None:
        """Have the session end."""


class Lead:
    """The right to wait for frames, which a signal leaves behind with nobody: it is taken in one step, by a token, and
    given back by who cannot know whether he had it.
    """

    def __init__(self) -> None:
        self._holder: dict[int, object] = {}

    def take(self, token: object) -> bool:
        """Take it; return whether it is this token's now."""
        return self._holder.setdefault(0, token) is token

    @property
    def is_taken(self) -> bool:
        """Whether it is anybody's."""
        return 0 in self._holder

    def has(self, token: object) -> bool:
        """Return whether it is this token's."""
        return self._holder.get(0) is token

    def leave(self, token: object) -> None:
        """Give it back, if it is this token's."""
        if self.has(token):
            del self._holder[0]


class Carrying:
    """The right to move the frames of a session, which its own thread and those of the program share.

    Args:
        bridge: what moves them.

    Attributes:
        lock: held by who does something with the link.
    """

    def __init__(self, bridge: Bridge) -> None:
        self.lock = threading.Lock()
        self.bridge = bridge
        self.leading = Lead()
        self._pid = os.getpid()

    @property
    def is_a_childs(self) -> bool:
        """Whether this is a forked child, in which the session's own thread is not."""
        return os.getpid() != self._pid

    def alone(self, act: Callable[[], object]) -> None:
        """Do something with the link, whole, in a thread of the program.

        Raises:
            OSError: EPROTO, in a forked child; and what it raises.
        """
        if self.is_a_childs:
            raise OSError(errno.EPROTO, "a forked child cannot use the session of its parent; open another one")
        if threading.get_ident() != MAIN:
            self._whole(act)
            return
        before = _Mask()
        try:
            _sigmask(SIG_BLOCK, _ALL, before)
            self._whole(act)
        finally:
            _sigmask(SIG_SETMASK, before, None)

    def _whole(self, act: Callable[[], object]) -> None:
        with self.lock:
            try:
                act()
            except OSError:
                raise
            except BaseException as error:  # of a signal's handler: another thread has got that
                self.bridge.spoil(f"{type(error).__name__} while a frame was moved")
                raise

    def end(self, release: Callable[[], None]) -> None:
        """Let go of the link when no thread of the program moves its frames; none will any more."""
        deadline = monotonic() + END_S
        while not self.leading.take(self):
            if monotonic() > deadline:
                return  # a signal has come where it should not: let it leak
            sleep(LOOK_S)
        with self.lock:
            release()


class Carrier:
    """A channel of a session: see ``channel.Channel``.

    Args:
        carrying: of the session.
        channel: number of the handle, 0 = the daemon.
        sock: the program's end of its socket, in which answers arrive.
    """

    __slots__ = ("_both", "_carrying", "_channel", "_fd", "_found", "_own")

    def __init__(self, carrying: Carrying, channel: int, sock: socket) -> None:
        self._carrying, self._channel, self._fd = carrying, channel, sock.fileno()
        self._found = b""
        self._own, self._both = poll(), poll()
        for each in (self._own, self._both):
            each.register(self._fd, POLLIN)
        self._both.register(carrying.bridge.link_fd, POLLIN)

    def of(self, channel: int, sock: socket) -> Carrier:
        """Return that of another channel of the session."""
        return Carrier(self._carrying, channel, sock)

    def send(self, packet: bytes) -> None:
        """Send a packet.

        Raises:
            OSError: EPIPE, the channel has ended, and says why when it is read; EPROTO, in a forked child.
        """
        try:
            self._carrying.alone(lambda: self._carrying.bridge.say(self._channel, packet))
        except BrokenPipeError:
            self._own.poll(WHY_MS)
            raise

    def wait(self, timeout_s: float) -> bytes:
        """Wait until an answer has arrived, and move frames meanwhile unless another thread of the program does.

        Returns:
            The answer, b"": what there is lies in the socket. One thread at a time waits on a channel.
        """
        if not self._found:
            token, leading = object(), self._carrying.leading
            try:
                if leading.take(token):
                    self._lead(monotonic() + timeout_s)
                else:
                    self._own.poll(1e3 * timeout_s)
            finally:
                try:
                    self._let_go(token)
                finally:  # where a signal has come behind a call of that
                    self._let_go(token)
        found, self._found = self._found, b""  # kept until here: who is interrupted finds it with the next call
        return found

    def _lead(self, deadline: float) -> None:
        carrying = self._carrying
        carrying.bridge.watch(False)
        while not self._found and (left_s := deadline - monotonic()) > 0:
            ready = self._both.poll(1e3 * left_s)
            if self._fd in dict(ready):
                return
            if ready:
                carrying.alone(self._serve)

    def _let_go(self, token: object) -> None:
        if self._carrying.leading.has(token):
            self._carrying.bridge.watch(True)
            self._carrying.leading.leave(token)

    def _serve(self) -> None:
        self._found = self._carrying.bridge.serve(self._channel)


class Led:
    """Sessions whose frames this thread moves within a ``with`` block: their own threads would be in each other's way.

    Args:
        carriers: channels of different sessions.
    """

    def __init__(self, carriers: Sequence[Carrier]) -> None:
        self._fds = {each._fd for each in carriers}
        self._sessions = {each._carrying.bridge.link_fd: each._carrying for each in carriers}

    def __enter__(self) -> Self:
        for fd, carrying in list(self._sessions.items()):
            if carrying.leading.take(self):
                carrying.bridge.watch(False)
            else:
                del self._sessions[fd]  # another thread of the program does
        return self

    def __exit__(self, *_: object) -> None:
        for carrying in self._sessions.values():
            carrying.bridge.watch(True)
            carrying.leading.leave(self)

    def wait(self, timeout_s: float) -> None:
        """Wait until an answer has arrived on each channel."""
        deadline, left, poller = monotonic() + timeout_s, set(self._fds), poll()
        for fd in (*self._sessions, *left):
            poller.register(fd, POLLIN)
        while left and (left_s := deadline - monotonic()) > 0:
            for fd, _ in poller.poll(1e3 * left_s):
                if fd in left:
                    left.remove(fd)
                    poller.unregister(fd)
                elif fd in self._sessions:
                    self._sessions[fd].alone(partial(self._sessions[fd].bridge.serve, NOBODY))
