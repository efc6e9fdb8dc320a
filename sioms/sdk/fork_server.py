"""The fork server: imports drivers once, validates their settings, and forks a process for each device.

Started by the daemon as ``python -m sioms.sdk.fork_server FD``. Forking shares the memory of the
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
from collections.abc import Sequence
from typing import Any

from sioms.descriptors import receive
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
    while True:
        if not asked.poll(0):
            from . import runtime  # noqa: F401  # what forking needs, while the daemon is not ready to ask
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
                case Spawn():
                    _spawn(sock, number, fds, *message)
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
    sock: socket.socket, number: int, fds: list[int], device: str, driver: str, table: dict[str, Any],
    generation: int, options: dict[str, Any],
) -> None:  # fmt: skip
    from .runtime import run  # not needed to check a configuration

    found = find_driver(driver, options["folder"])
    settings, errors = read_settings(found, table, options["folder"])
    if errors:
        raise ValueError("; ".join(errors))
    if not gc.isenabled():
        gc.freeze()
        gc.enable()
    pid = os.fork()
    if pid == 0:
        status = 1
        try:
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            sock.close()
            if wanted := os.environ.get("SIOMS_TRACE"):
                from . import trace

                trace.begin(wanted, device, driver, table)
            status = run(found, device, settings, generation, options, fds)
        except BaseException:  # the process ends here whatever happened, and must not run the fork server's code
            traceback.print_exc()
        finally:
            sys.stderr.flush()
            os._exit(status)
    pidfd = os.pidfd_open(pid)
    try:
        _tell(sock, reply(number, pid), [pidfd])
    finally:
        os.close(pidfd)


if __name__ == "__main__":
    main(int(sys.argv[1]))
