"""A Robotiq FT 300 on a pty: ``python -m sioms.drivers.ft300.simulator --link PATH``.

Modbus RTU slave 9, functions 03 and 16, until 0x0200 is written to register 410; then a record of 16 bytes a hundred
times a second, and no answer to anything, until fifty times 0xFF have come in a row. Commands on standard input, beside
those of
the line: ``load FX FY FZ TX TY TZ [SECONDS]``, ``lose COUNT`` (records that are not sent), ``power_cycle [SECONDS]``
(then no stream, or with ``--streams`` one at once), ``freeze [COUNT]`` (the last record again, and the same registers),
``refuse COUNT`` (busy to writes), ``foreign stream|stop 0`` (another master starts or ends the stream), ``register
ADDRESS VALUE``, ``state``.
"""

from __future__ import annotations

import asyncio
import struct
import time
from collections.abc import Callable

from sioms.simulation import wire
from sioms.simulation.load import Load
from sioms.simulation.supply import FOREVER, Refusals, Supply
from sioms.simulation.udp import missed

PERIOD_S = 0.01
STOP_BYTES = 50
STREAM_SELECT = 410
GRAVITY = 1000
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, BUSY = 1, 2, 3, 6


def crc(data: bytes) -> int:
    """Return the CRC of Modbus, bit by bit as its specification draws it."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ 0xA001 if value & 1 else value >> 1
    return value


def framed(body: bytes) -> bytes:
    """Return a body with its CRC, low byte first."""
    return body + struct.pack("<H", crc(body))


class Sensor:
    """The sensor without its port; times in seconds of the given clock."""

    def __init__(
        self, slave: int, firmware: str, serial: int, clock: Callable[[], float] = time.monotonic, streams: bool = False
    ) -> None:  # fmt: skip
        self.slave, self.clock = slave, clock
        self.load = Load()
        self.words = {500 + i: int.from_bytes(firmware[2 * i : 2 * i + 2].encode(), "big") for i in range(3)}
        self.words |= {510: 0, 511: 0, 512: serial & 0xFFFF, 513: serial >> 16, 514: 2019, STREAM_SELECT: 0}
        self.received = b""
        self.heard_s = 0.0
        self.lose = self.frozen = 0
        self.last = [0] * 6
        self.streams = streams
        self.supply, self.refusals = Supply(clock, self.boot), Refusals()
        self.boot(clock())

    def boot(self, at_s: float) -> None:
        """Begin anew, as after its power came back."""
        self.stream(self.streams, at_s)

    def stream(self, on: bool, at_s: float) -> None:
        """Begin or end the stream."""
        self.streaming, self.stops = on, 0
        self.next_s = at_s + PERIOD_S if on else 0.0
        self.received = b""

    def connected(self) -> list[bytes]:
        """Nothing is said to a new master."""
        return []

    def take(self, data: bytes) -> list[bytes]:
        """Return the replies to what came."""
        if not self.supply.is_on:
            return []
        if self.streaming:
            for byte in data:
                self.stops = self.stops + 1 if byte == 0xFF else 0
            if self.stops >= STOP_BYTES:
                self.stream(False, 0.0)
            return []
        # a frame that was cut off by silence is none
        now_s = self.clock()
        if now_s - self.heard_s > 0.02:
            self.received = b""
        self.heard_s = now_s
        self.received = (self.received + data)[-256:]
        size = self._frame_size(self.received)
        if size is None or len(self.received) < size:
            return []
        frame, self.received = self.received[:size], b""
        if frame[0] != self.slave or struct.pack("<H", crc(frame[:-2])) != frame[-2:]:
            return []
        return [framed(bytes((self.slave,)) + self._answer(frame[1], frame[2:-2]))]

    @staticmethod
    def _frame_size(data: bytes) -> int | None:
        if len(data) < 7:
            return None
        return 9 + data[6] if data[1] == 16 else 8

    def _answer(self, function: int, body: bytes) -> bytes:
        if function not in (3, 16):
            return bytes((function | 0x80, ILLEGAL_FUNCTION))
        address, count = struct.unpack(">HH", body[:4])
        if function == 3:
            try:
                words = [self._word(at) for at in range(address, address + count)]
            except KeyError:
                return bytes((0x83, ILLEGAL_ADDRESS))
            if not 1 <= count <= 125:
                return bytes((0x83, ILLEGAL_VALUE))
            return struct.pack(f">BB{count}H", 3, 2 * count, *words)
        if (address, count) != (STREAM_SELECT, 1):
            return bytes((0x90, ILLEGAL_ADDRESS))
        if self.refusals.take():
            return bytes((0x90, BUSY))
        value = struct.unpack(">H", body[5:7])[0]
        if value == 0x0200:
            self.stream(True, self.clock())
        return struct.pack(">BHH", 16, address, count)

    def _word(self, address: int) -> int:
        if 180 <= address <= 185:
            return self.counts(self.clock())[address - 180] & 0xFFFF
        if 190 <= address <= 192:
            return GRAVITY if address == 192 else 0
        if 186 <= address <= 189:
            return 0
        return self.words[address]

    def counts(self, now_s: float) -> list[int]:
        """Return 0.01 N and 0.001 N m."""
        if self.frozen:
            self.frozen -= 1
            return self.last
        values, _ = self.load.measured(now_s)
        self.last = [round(value * (100 if i < 3 else 1000)) for i, value in enumerate(values)]
        return self.last

    def due(self) -> list[bytes]:
        """Return the records sampled until now."""
        now_s, records = self.clock(), []
        if not self.supply.is_on:
            return []
        if self.streaming:  # a sensor does not make up for what its process missed while it was held up
            self.next_s += missed(self.next_s, now_s, 1 / PERIOD_S) * PERIOD_S
        while self.streaming and self.next_s <= now_s:
            body = b"\x20\x4e" + struct.pack("<6h", *self.counts(self.next_s))
            self.next_s += PERIOD_S
            if self.lose:
                self.lose -= 1
            else:
                records.append(framed(body))
        return records

    def handlers(self) -> dict[str, Callable[..., object]]:
        """Return the commands on standard input."""

        def lose(count: str) -> None:
            self.lose = int(count)

        def register(address: str, value: str) -> None:
            self.words[int(address)] = int(value, 0)

        def freeze(count: str = "") -> None:
            self.frozen = int(count) if count else FOREVER

        def foreign(kind: str, value: str = "0") -> None:
            if kind not in ("stream", "stop"):
                raise ValueError(f"{kind}; want one of stream, stop")
            self.stream(kind == "stream", self.clock())

        def state() -> dict[str, object]:
            return {
                "streaming": self.streaming,
                "load": self.load.true(self.clock()),
                "on": self.supply.is_on,
            }

        return {
            **self.load.handlers(self.clock), "lose": lose, "register": register, "state": state,
            "power_cycle": self.supply.cycle, "freeze": freeze, "refuse": self.refusals.set, "foreign": foreign,
        }  # fmt: skip


async def main() -> None:
    """Serve until told to end."""
    parser = wire.parser("simulated Robotiq FT 300", tcp=True)
    parser.add_argument("--slave", type=int, default=9)
    parser.add_argument("--firmware", default="FT3-21", help="six characters")
    parser.add_argument("--serial", type=int, default=123456)
    parser.add_argument("--streams", action="store_true", help="stream from power on")
    options = parser.parse_args()
    sensor = Sensor(options.slave, options.firmware, options.serial, streams=options.streams)
    await wire.run(sensor, options, sensor.handlers())


if __name__ == "__main__":
    asyncio.run(main())
