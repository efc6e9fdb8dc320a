"""A SCHUNK FTS sensor with its Ethernet box: ``python -m sioms.tools.counterparts.schunk_ifb --port 0 --data-port 0``.

Commands on TCP, a record of 35 bytes a thousand times a second on UDP to the host that the commands came from. The stream goes on when
the commands' connection ends. Commands on standard input: ``load FX FY FZ TX TY TZ [SECONDS]``, ``status BITS`` (or-ed to its own), ``stall``,
``resume``, ``reboot``, ``hang_up``, ``product NAME``, ``unit NUMBER``, ``garbage SIZE``, ``state``, and the faults of the records' way: ``mute COUNT``
(drop), ``double``, ``late SECONDS COUNT``, ``cut``; ``deaf COUNT`` loses commands.
"""

from __future__ import annotations

import argparse
import asyncio
import struct
import time
from collections.abc import Callable

from .control import serve
from .faults import Faults
from .load import Load
from .udp import Address, UdpPort, missed, stream

DATA_PORT = 54843
READY, MECHANICAL_RANGE = 0x01, 0x10
OK, UNKNOWN, LENGTH, VALUE, LOCKED, NO_INDEX, NO_SUBINDEX = 0x00, 0x01, 0x02, 0x03, 0x10, 0x13, 0x14
LENGTHS = {0x12: 1, 0x13: 1, 0x30: 2, 0x31: 2, 0x40: 1, 0x41: 1, 0xF0: 4}
MOST = {0x30: 3, 0x31: 4}


class Sensor:
    """The sensor without its ports; times in seconds of the given clock."""

    def __init__(self, options: argparse.Namespace, clock: Callable[[], float] = time.monotonic) -> None:
        self.options, self.clock = options, clock
        self.load = Load(options.range_n, options.range_nm)
        self.parameters: dict[tuple[int, int], bytes] = {
            (0x0001, 0): options.product.encode(), (0x0001, 3): b"\x2a\x00", (0x0050, 0): b"\x00", (0x1002, 1): b"1.0.4",
        }  # fmt: skip
        self.extra_status = 0
        self.stalled = False
        self.reboot()

    def reboot(self) -> None:
        """Begin anew, as after a power cycle."""
        self.streaming = False
        self.next_s = 0.0
        self.counter = 0
        self.selected = {0x30: 0, 0x31: 0}
        self.received = b""
        self.load.zero(None)

    def take(self, data: bytes) -> list[bytes]:
        """Return the replies to what came on TCP, cut anywhere."""
        self.received += data
        replies = []
        while len(self.received) >= 6:
            sync, counter, length = struct.unpack("<2sHH", self.received[:6])
            if sync != b"\xff\xff":
                self.received = b""
                break
            if len(self.received) < 6 + length:
                break
            payload, self.received = self.received[6 : 6 + length], self.received[6 + length :]
            answer = self._answer(payload)
            replies.append(struct.pack("<2sHH", b"\xff\xff", counter, len(answer)) + answer)
        return replies

    def _answer(self, payload: bytes) -> bytes:
        command = payload[0] if payload else 0
        if command == 0xF1:
            return bytes((command, LOCKED))
        if command not in LENGTHS:
            return bytes((command, UNKNOWN))
        if len(payload) != LENGTHS[command]:
            return bytes((command, LENGTH))
        match command:
            case 0x12:
                self.load.zero(self.clock())
            case 0x13:
                self.load.zero(None)
            case 0x30 | 0x31:
                if payload[1] > MOST[command]:
                    return bytes((command, VALUE))
                self.selected[command] = payload[1]
            case 0x40:
                self.streaming, self.next_s = True, self.clock()
            case 0x41:
                self.streaming, self.next_s = False, 0.0
            case 0xF0:
                return self._parameter(payload)
        return bytes((command, OK))

    def _parameter(self, payload: bytes) -> bytes:
        index, sub = struct.unpack("<HB", payload[1:])
        if (index, sub) in self.parameters:
            return bytes((0xF0, OK)) + payload[1:] + self.parameters[index, sub]
        known = any(index == each for each, _ in self.parameters)
        return bytes((0xF0, NO_SUBINDEX if known else NO_INDEX))

    def due(self, send: Callable[[bytes], None]) -> None:
        """Send the records sampled until now."""
        now_s, rate_hz = self.clock(), self.options.rate * (1 + self.options.clock_ppm * 1e-6)
        if self.streaming:
            count = missed(self.next_s, now_s, rate_hz)
            self.next_s += count / rate_hz
            self.counter = (self.counter + count) % 0x10000
        while self.streaming and self.next_s <= now_s:
            values, clipped = self.load.measured(self.next_s)
            status = READY | self.extra_status | (MECHANICAL_RANGE if clipped else 0)
            self.counter = (self.counter + 1) % 0x10000
            self.next_s += 1 / rate_hz
            if not self.stalled:
                send(struct.pack("<2sHHBI6f", b"\xff\xff", self.counter, 29, 0x40, status, *values))

    def handlers(self) -> dict[str, Callable[..., object]]:
        """Return the commands on standard input."""

        def status(bits: str) -> None:
            self.extra_status = int(bits, 0)

        def product(*words: str) -> None:
            self.parameters[0x0001, 0] = " ".join(words).encode()

        def unit(number: str) -> None:
            self.parameters[0x0050, 0] = bytes((int(number),))

        def set_stall(value: bool) -> Callable[[], None]:
            return lambda: setattr(self, "stalled", value)

        def state() -> dict[str, object]:
            return {
                "streaming": self.streaming, "counter": self.counter, "tool": self.selected[0x30],
                "noise_filter": self.selected[0x31], "load": self.load.true(self.clock()),
            }  # fmt: skip

        return {
            **self.load.handlers(self.clock), "status": status, "product": product, "unit": unit, "reboot": self.reboot,
            "stall": set_stall(True), "resume": set_stall(False), "state": state,
        }  # fmt: skip


class CommandPort:
    """The box's TCP port; the host of the last connection gets the records.

    Attributes:
        host: that host.
        name: ``host:port``.
    """

    def __init__(self, sensor: Sensor, faults: Faults) -> None:
        self._sensor, self._faults = sensor, faults
        self._writers: set[asyncio.StreamWriter] = set()
        self.host = "127.0.0.1"
        self.name = ""

    async def open(self, port: int) -> None:
        """Listen; 0 = a free port."""
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", port)
        self.name = "{}:{}".format(*self._server.sockets[0].getsockname())

    def hang_up(self) -> None:
        """End the connections."""
        for writer in list(self._writers):
            writer.transport.abort()

    def close(self) -> None:
        """Stop listening, and end the connections."""
        self._server.close()
        self.hang_up()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.host = writer.get_extra_info("peername")[0]
        self._writers.add(writer)
        try:
            while data := await reader.read(4096):
                if self._faults.hears():
                    for reply in self._sensor.take(data):
                        writer.write(reply)
        except ConnectionError:
            pass
        finally:
            self._writers.discard(writer)
            writer.close()


def options_parser() -> argparse.ArgumentParser:
    """Return the options."""
    parser = argparse.ArgumentParser(description="simulated SCHUNK FTS with its Ethernet box")
    parser.add_argument("--port", type=int, default=82, help="TCP port of the commands, 0 = a free one")
    parser.add_argument("--data-port", type=int, default=DATA_PORT, help="0: the number of the TCP port")
    parser.add_argument("--product", default="KMS")
    parser.add_argument("--rate", type=float, default=1000.0)
    parser.add_argument("--clock-ppm", type=float, default=40.0)
    parser.add_argument("--range-n", type=float, default=400.0)
    parser.add_argument("--range-nm", type=float, default=15.0)
    return parser


async def run() -> None:
    """Serve until told to end."""
    options = options_parser().parse_args()
    sensor, faults = Sensor(options), Faults()
    commands, data = CommandPort(sensor, faults), UdpPort(faults)
    await commands.open(options.port)
    await data.open(0)
    data_port = options.data_port or int(commands.name.rpartition(":")[2])

    def to() -> Address:
        return commands.host, data_port

    streaming = asyncio.create_task(
        stream(
            lambda: sensor.due(lambda record: data.send(record, to())), lambda: sensor.next_s, sensor.clock
        )
    )

    async def close() -> None:
        streaming.cancel()
        commands.close()
        data.close()

    handlers = {
        **faults.handlers(), **sensor.handlers(), "hang_up": commands.hang_up, "sent": lambda: data.sent,
        "garbage": lambda size: data.garbage(int(size), to()),
    }  # fmt: skip
    await serve(commands.name, handlers, close)


if __name__ == "__main__":
    asyncio.run(run())
