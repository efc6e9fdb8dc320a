"""What the simulators without Modbus share: a device behind a pty or TCP port whose line can be disturbed.

A device takes bytes and answers with messages; it may also speak unasked when time passes (``due``).
"""

from __future__ import annotations

import argparse
import asyncio
import socket
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Protocol

from .control import serve
from .faults import Faults
from .ports import PtyPort

PERIOD_S = 0.002
QUIET_S = 0.02
"""How often ``due`` is called of a device that never speaks unasked: what it does meanwhile, it does at its time."""


class Device(Protocol):
    """A device on a line."""

    def take(self, data: bytes) -> list[bytes]:
        """Take bytes as they come, cut anywhere, and return the messages that answer them."""

    def due(self) -> list[bytes]:
        """Return what it has to say now; called once a period."""

    def connected(self) -> list[bytes]:
        """A master has come (TCP alone); return what is said to it."""


class TcpPort:
    """A TCP port with one master at a time, as a device of this kind has it."""

    def __init__(self, port: int, received: Callable[[bytes], None], greet: Callable[[], None]) -> None:
        self._received, self._greet = received, greet
        self._server: asyncio.Server | None = None
        self._writer: asyncio.StreamWriter | None = None
        self._port = port
        self._sock: socket.socket | None = None
        self.name = ""

    def plug(self) -> None:
        """Listen."""
        sock = socket.create_server(("127.0.0.1", self._port))
        self._port = sock.getsockname()[1]
        self.name = f"127.0.0.1:{self._port}"
        self._sock = sock
        self._task = asyncio.ensure_future(asyncio.start_server(self._serve, sock=sock))
        self._task.add_done_callback(lambda task: setattr(self, "_server", task.result()))

    def unplug(self) -> None:
        """Stop listening and drop the master."""
        if self._server is not None:
            self._server.close()
            self._server = None
        if self._writer is not None:
            self._writer.transport.abort()

    def write(self, data: bytes) -> bool:
        """Send to the master, if there is one."""
        if self._writer is not None and data:
            self._writer.write(data)
        return True

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._writer is not None:
            writer.close()
            return
        self._writer = writer
        self._greet()
        try:
            while data := await reader.read(4096):
                self._received(data)
        except ConnectionError:
            pass
        finally:
            self._writer = None
            writer.close()


def parser(description: str, *, tcp: bool = False) -> argparse.ArgumentParser:
    """Return the options that all have."""
    options = argparse.ArgumentParser(description=description)
    options.add_argument("--link", type=Path, help="fixed path of the port")
    options.add_argument("--baud", type=int, default=0, help="let replies take the time of a line of this speed")
    if tcp:
        options.add_argument("--tcp", type=int, default=-1, help="TCP port instead of a pty, 0 = a free one")
    return options


async def run(
    device: Device,
    options: argparse.Namespace,
    handlers: Mapping[str, Callable[..., object]],
    period_s: float = PERIOD_S,
) -> None:
    """Serve a device until told to end.

    Args:
        device: it, on its line.
        options: of ``parser``.
        handlers: of commands on standard input.
        period_s: how often ``due`` is called [s].
    """
    loop, faults = asyncio.get_running_loop(), Faults()
    character_s = 10 / options.baud if options.baud else 0.0
    free_s = 0.0
    requests = 0

    def send(message: bytes) -> None:
        nonlocal free_s
        delay_s, bent = faults.outgoing(message)
        free_s = max(free_s, loop.time()) + len(bent) * character_s
        at_s = free_s + delay_s
        if at_s > loop.time():
            loop.call_at(at_s, port.write, bent)
        else:
            port.write(bent)

    def received(data: bytes) -> None:
        nonlocal free_s, requests
        free_s = max(free_s, loop.time() + len(data) * character_s)
        requests += 1
        if faults.hears():
            for message in device.take(data):
                send(message)

    def greet() -> None:
        for message in device.connected():
            send(message)

    def unplug(duration_s: str = "") -> None:
        port.unplug()
        if duration_s:
            loop.call_later(float(duration_s), port.plug)

    async def speak() -> None:
        while True:
            for message in device.due():
                send(message)
            await asyncio.sleep(period_s)

    tcp = getattr(options, "tcp", -1)
    port: TcpPort | PtyPort = TcpPort(tcp, received, greet) if tcp >= 0 else PtyPort(options.link, received)
    port.plug()
    speaking = asyncio.create_task(speak())

    async def close() -> None:
        speaking.cancel()
        port.unplug()

    def garbage(count: str) -> None:
        port.write(faults.chance.randbytes(int(count)))

    def stray(count: str = "1") -> None:
        """Let the device hear noise."""
        device.take(b"\xa5" * int(count))

    everything = {
        **faults.handlers(), **handlers,
        "unplug": unplug, "plug": port.plug, "garbage": garbage, "stray": stray, "requests": lambda: requests,
    }  # fmt: skip
    await serve(port.name if tcp >= 0 else str(options.link or port.name), everything, close)
