"""A SCHUNK FTS sensor with its Ethernet box: ``python -m sioms.drivers.schunk_ft.simulator --port 0 --data-port 0``.

Commands on TCP, a record of 35 bytes a thousand times a second on UDP to the host that the commands came from, each
with a counter of 16 bits and one of 8. As in the vendor's own simulator replies are numbered on each connection from 1
on whatever the command's number, what one segment brings is one command, and a piece of less than 7 bytes ends the
connection. The stream goes on when the commands' connection ends. With ``--vendor`` it is that simulator in the rest
too: it streams from its start and always, answers every parameter with its name, takes all and does nothing of it.

Commands on standard input: ``load FX FY FZ TX TY TZ [SECONDS]``, ``status BITS`` (or-ed to its own), ``stall``,
``resume``, ``hang_up``, ``product NAME``, ``unit NUMBER``, ``garbage SIZE``, ``state``, ``power_cycle [SECONDS]``
(connections die without a word), ``refuse COUNT`` (busy), ``freeze [COUNT]``, ``foreign zero|tool|filter|stop|unit
VALUE``, ``shift COUNT`` (the counter jumps), and the faults of the records' way: ``mute COUNT`` (drop), ``double``,
``late SECONDS COUNT``, ``cut``; ``deaf COUNT`` loses commands.
"""

from __future__ import annotations

import argparse
import asyncio
import struct
import time
from collections.abc import Callable

from sioms.simulation.control import serve
from sioms.simulation.faults import Faults
from sioms.simulation.load import Load
from sioms.simulation.supply import Refusals, Standstill, Supply
from sioms.simulation.udp import Address, UdpPort, missed, stream

DATA_PORT = 54843
READY, MECHANICAL_RANGE = 0x01, 0x10
OK, UNKNOWN, LENGTH, VALUE, BUSY, LOCKED, NO_INDEX, NO_SUBINDEX = (
    0x00,
    0x01,
    0x02,
    0x03,
    0x04,
    0x10,
    0x13,
    0x14,
)
LENGTHS = {0x12: 1, 0x13: 1, 0x20: 1, 0x30: 2, 0x31: 2, 0x40: 1, 0x41: 1, 0xF0: 4}
MOST = {0x30: 3, 0x31: 4}
RESET_S = 5.0
"""Time that the vendor's tests give a sensor after command 0x20."""


class Sensor:
    """The sensor without its ports; times in seconds of the given clock."""

    def __init__(self, options: argparse.Namespace, clock: Callable[[], float] = time.monotonic) -> None:
        self.options, self.clock = options, clock
        self.load = Load(options.range_n, options.range_nm)
        self.parameters: dict[tuple[int, int], bytes] = {
            (0x0001, 0): options.product.encode(),
            (0x0001, 3): b"\x2a\x00",
            (0x0050, 0): b"\x00",
            (0x1002, 1): b"1.0.4",
        }
        self.extra_status = 0
        self.stalled = False
        self.supply = Supply(clock, self.boot, options.boot_s)
        self.standstill, self.refusals = Standstill(), Refusals()
        self.boot(clock())

    def boot(self, at_s: float) -> None:
        """Begin anew, as after its power came back."""
        self.streaming = self.options.vendor
        self.next_s = at_s if self.streaming else 0.0
        self.counter = self.packet = 0
        self.selected = {0x30: 0, 0x31: 0}
        self.is_tared = False
        self.load.zero(None)

    def take(self, data: bytes, number: int) -> bytes | None:
        """Return the reply to what one segment brought, None when the connection is given up.

        Args:
            data: the segment; the vendor's receiver takes one for one command, and looks at no sync and no length.
            number: of the reply on its connection.
        """
        if len(data) < 7:
            return None
        answer = self._answer(data[6:])
        return struct.pack("<2sHH", b"\xff\xff", number % 0x10000, len(answer)) + answer

    def _answer(self, payload: bytes) -> bytes:
        command = payload[0]
        if self.options.vendor:
            if command in (0xF0, 0xF1):
                return bytes((command, OK)) + payload[1:4] + (self.options.product.encode() if command == 0xF0 else b"")
            return bytes((command, OK if command in LENGTHS or command in (0x10, 0x11, 0x20) else UNKNOWN))
        if command == 0xF1:
            return bytes((command, LOCKED))
        if command not in LENGTHS:
            return bytes((command, UNKNOWN))
        if len(payload) != LENGTHS[command]:
            return bytes((command, LENGTH))
        if command != 0xF0 and self.refusals.take():
            return bytes((command, BUSY))
        match command:
            case 0x12 | 0x13:
                self.is_tared = command == 0x12
                self.load.zero(self.clock() if self.is_tared else None)
            case 0x20:
                self.supply.cycle(str(RESET_S))
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
        if not self.supply.is_on:
            return
        if self.streaming:
            count = missed(self.next_s, now_s, rate_hz)
            self.next_s += count / rate_hz
            self.counter = (self.counter + count) % 0x10000
            self.packet = (self.packet + count) % 0x100
        while self.streaming and self.next_s <= now_s:
            values, clipped = self.load.measured(self.next_s)
            status = READY | self.extra_status | (MECHANICAL_RANGE if clipped else 0)
            self.counter, self.packet = (self.counter + 1) % 0x10000, (self.packet + 1) % 0x100
            self.next_s += 1 / rate_hz
            if not self.stalled:
                record = struct.pack("<2sHHBI6f", b"\xff\xff", self.counter, 29, self.packet, status, *values)
                send(self.standstill.bend(record))

    def handlers(self) -> dict[str, Callable[..., object]]:
        """Return the commands on standard input."""

        def status(bits: str) -> None:
            self.extra_status = int(bits, 0)

        def product(*words: str) -> None:
            self.parameters[0x0001, 0] = " ".join(words).encode()

        def unit(number: str) -> None:
            self.parameters[0x0050, 0] = bytes((int(number),))

        def foreign(kind: str, value: str = "0") -> None:
            if kind == "zero":
                self.load.zero(self.clock())
            elif kind in ("tool", "filter"):
                self.selected[0x30 if kind == "tool" else 0x31] = int(value)
            elif kind == "stop":
                self.streaming, self.next_s = False, 0.0
            elif kind == "unit":
                unit(value)
            else:
                raise ValueError(f"{kind}; want one of zero, tool, filter, stop, unit")

        def shift(count: str) -> None:
            self.counter = (self.counter + int(count)) % 0x10000

        def set_stall(value: bool) -> Callable[[], None]:
            return lambda: setattr(self, "stalled", value)

        def state() -> dict[str, object]:
            return {
                "streaming": self.streaming, "counter": self.counter, "tool": self.selected[0x30],
                "noise_filter": self.selected[0x31], "load": self.load.true(self.clock()), "tared": self.is_tared,
                "on": self.supply.is_on,
            }  # fmt: skip

        return {
            **self.load.handlers(self.clock),
            "status": status,
            "product": product,
            "unit": unit,
            "foreign": foreign,
            "shift": shift,
            "power_cycle": self.supply.cycle,
            "freeze": self.standstill.set,
            "refuse": self.refusals.set,
            "stall": set_stall(True),
            "resume": set_stall(False),
            "state": state,
        }


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
        cycles, number = self._sensor.supply.cycles, 0
        try:
            while data := await reader.read(1024):
                if cycles != self._sensor.supply.cycles:
                    if self._sensor.supply.is_on:
                        writer.transport.abort()  # a box that has restarted knows nothing of this connection
                        break
                    continue
                if self._faults.hears():
                    number += 1
                    reply = self._sensor.take(data, number)
                    if reply is None:
                        break
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
    parser.add_argument("--boot-s", type=float, default=0.0, help="from power to readiness")
    parser.add_argument("--vendor", action="store_true", help="as the vendor's own simulator")
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
        stream(lambda: sensor.due(lambda record: data.send(record, to())), lambda: sensor.next_s, sensor.clock)
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
