"""The fork server: imports drivers once, validates their settings, and forks a process for each device, or for those
that the configuration gives one process.

Started by the daemon, which calls ``main`` in an interpreter of its own. Forking shares the memory of the
libraries among all drivers, and makes a restart a matter of milliseconds. The fork server has one thread
and no state but imported modules; drivers live on when it dies, and it ends when the daemon does.
"""

from __future__ import annotations

import gc
import os
import select
import signal
import socket
import sys
import traceback
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from msgspec import Struct, field

from sioms.descriptors import is_readable, receive
from sioms.protocol.driver_verbs import TO_FORK_SERVER, Describe, Spawn
from sioms.protocol.messages import MAX_UNPACKED, encode, pack_compressed, refusal, reply
from sioms.protocol.verbs import take

from .finding import DriverNotFound, contents, describe, find_driver, missing_files, read_settings


def main(fd: int) -> None:
    """Serve the daemon until it closes the socket."""
    gc.disable()  # until the first fork: what is imported stays, and is not looked through again and again
    sock = socket.socket(fileno=fd)
    os.set_inheritable(fd, False)
    for ignored in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(ignored, signal.SIG_IGN)  # what these mean is for the daemon to decide
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel reaps; the daemon watches by pidfd
    asked = select.poll()
    asked.register(sock, select.POLLIN)
    hosts = Hosts(asked)
    while True:
        if not asked.poll(0):
            from . import process  # noqa: F401  # what forking needs, while the daemon is not ready to ask
        hosts.send_until_asked(sock.fileno())
        packet, fds = receive(sock, 1 << 20, 8)
        if not packet:
            return
        number, message = take(packet, TO_FORK_SERVER, values=MAX_UNPACKED)
        try:
            match message:
                case Describe():
                    # Thousands of alike channels would not fit into a packet.
                    described = pack_compressed(_describe(*message), 1)
                    _tell(sock, encode(0, number, 0, described))
                case Spawn() if name := message.options["process"]:
                    host = hosts.of(name, sock, fds)
                    _answer_spawn(sock, number, host.pid, host.pidfd)  # before the device can be up
                    hosts.send(host, packet, fds)
                case Spawn():
                    _spawn(sock, hosts, number, fds, *message)
        except Exception as error:  # a driver's describe may raise anything; the daemon must hear of it
            traceback.print_exc()
            _tell(sock, refusal(number, 5, f"{type(error).__name__}: {error}"))
        finally:
            for each in fds:
                os.close(each)


def _tell(sock: socket.socket, packet: bytes, fds: Sequence[int] = ()) -> None:
    """Answer the daemon; when it has ended meanwhile, so does the fork server, and every driver sees it by itself."""
    try:
        socket.send_fds(sock, [packet], fds)
    except ConnectionError:
        raise SystemExit from None


def _describe(device: str, driver: str, table: dict[str, Any], folder: str) -> list[Any]:
    try:
        found = find_driver(driver, folder)
    except DriverNotFound as error:
        return [[f": {error}"], None]
    settings, errors = read_settings(found, table, folder)
    if settings is None:
        return [errors, None]
    packed, more = describe(found, device, settings, contents(found, table, folder))
    return [errors + (more or missing_files(table, folder)), packed]


def _spawn(
    sock: socket.socket, hosts: Hosts, number: int, fds: list[int], device: str, driver: str, table: dict[str, Any],
    generation: int, options: dict[str, Any],
) -> None:  # fmt: skip
    from .process import run  # not needed to check a configuration

    found = find_driver(driver, options["folder"])
    settings, errors = read_settings(found, table, options["folder"])
    if errors:
        raise ValueError("; ".join(errors))
    pid, pidfd = _fork(sock, hosts)
    if pid == 0:
        status = 1
        try:
            if wanted := os.environ.get("SIOMS_TRACE"):
                from . import trace

                trace.begin(wanted, device, driver, table)
            status = run(found, device, settings, generation, options, fds)
        except BaseException:  # the process ends here whatever happened, and must not run the fork server's code
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(status)
    try:
        _answer_spawn(sock, number, pid, pidfd)
    finally:
        os.close(pidfd)


def _answer_spawn(sock: socket.socket, number: int, pid: int, pidfd: int) -> None:
    _tell(sock, reply(number, pid), [pidfd])


def _fork(sock: socket.socket, hosts: Hosts) -> tuple[int, int]:
    """Fork; return pid and pidfd, or (0, -1) in the new process, in which what is the fork server's is closed."""
    if not gc.isenabled():
        gc.freeze()
        gc.enable()
    pid = os.fork()
    if pid:
        return pid, os.pidfd_open(pid)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    sock.close()
    hosts.close()
    return 0, -1


class Host(Struct):
    """A process of several devices.

    Attributes:
        sock: to it.
        pid, pidfd: of it.
        unsent: what its socket had no room for: packets and their descriptors.
    """

    sock: socket.socket
    pid: int
    pidfd: int
    unsent: deque[tuple[bytes, list[int]]] = field(default_factory=deque)


class Hosts:
    """The processes that carry several devices, by name.

    Args:
        poll: of the fork server.
    """

    def __init__(self, poll: select.poll) -> None:
        self._poll = poll
        self._hosts: dict[str, Host] = {}

    def of(self, name: str, sock: socket.socket, fds: Sequence[int]) -> Host:
        """Return a process, which is started when it is not there.

        Args:
            name: of the process.
            sock: to the daemon, and
            fds: for its first device: what a new process closes, as they are not its own.
        """
        host = self._hosts.get(name)
        if host is not None and is_readable(host.pidfd):
            self._drop(name)
            host = None
        if host is None:
            host = self._hosts[name] = self._start(name, sock, fds)
        return host

    def send(self, host: Host, packet: bytes, fds: Sequence[int]) -> None:
        """Send a device to a process, now or when it takes it."""
        host.unsent.append((packet, [os.dup(fd) for fd in fds]))
        self._send(host)

    def send_until_asked(self, fd: int) -> None:
        """Send what is left to send until the daemon asks for something, by a descriptor."""
        while any(host.unsent for host in self._hosts.values()):
            ready = [ready for ready, _ in self._poll.poll()]
            for host in list(self._hosts.values()):
                if host.sock.fileno() in ready:
                    self._send(host)
            if fd in ready:
                return

    def _send(self, host: Host) -> None:
        while host.unsent:
            packet, fds = host.unsent[0]
            try:
                socket.send_fds(host.sock, [packet], fds)
            except BlockingIOError:
                self._poll.register(host.sock, select.POLLOUT)
                return
            except OSError:  # it has gone, which the daemon sees by itself
                pass
            host.unsent.popleft()
            for fd in fds:
                os.close(fd)
        with suppress(KeyError):
            self._poll.unregister(host.sock)

    def _start(self, name: str, sock: socket.socket, fds: Sequence[int]) -> Host:
        from .group import main as run_group

        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        pid, pidfd = _fork(sock, self)
        if pid == 0:
            status = 1
            try:
                ours.close()
                for fd in fds:  # of its first device: they come over the socket, too
                    os.close(fd)
                run_group(name, theirs)
                status = 0
            except BaseException:  # as above
                traceback.print_exc()
            finally:
                sys.stderr.flush()
                os._exit(status)
        theirs.close()
        return Host(ours, pid, pidfd)

    def close(self) -> None:
        """Close all that belongs to these processes, which live on."""
        for name in list(self._hosts):
            self._drop(name)

    def _drop(self, name: str) -> None:
        host = self._hosts.pop(name)
        with suppress(KeyError):
            self._poll.unregister(host.sock)
        host.sock.close()
        os.close(host.pidfd)
        for _, fds in host.unsent:
            for fd in fds:
                os.close(fd)
