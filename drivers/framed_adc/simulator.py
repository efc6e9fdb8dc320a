"""A front end that streams framed samples on a pty: ``python -m sioms.drivers.framed_adc.simulator --link PATH``.

A tactile array of ``--channels`` elements in rows of ``--columns``, pitch 1, first element at (0, 0), behind an ADC:
forces spread over the elements, noise, clipping with its flag, an own clock with an error, a dead-man of 5 s. Commands
on
standard input: ``touch NEWTON X Y [RADIUS]``, ``press FROM TO SECONDS X Y [RADIUS]``, ``release``, ``lose COUNT``
(blocks the device fails to send), ``restart`` (as after a power cycle), ``power_cycle [SECONDS]``, ``freeze [COUNT]``
(the last block again), ``hold on|off`` (numbers go on, clock and samples stand still), ``refuse COUNT`` (busy),
``foreign rate|stop|zero VALUE``, ``unplug [SECONDS]``, ``plug``, ``state``, and the faults of a line.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import math
import random
import struct
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from sioms.simulation.control import serve
from sioms.simulation.faults import Faults
from sioms.simulation.ports import PtyPort
from sioms.simulation.supply import Refusals, Standstill, Supply

DEAD_MAN_S = 5.0
SATURATED, OVERRUN = 1, 2
FORMATS = {"i16": (0x01, "h", 32767), "i32": (0x02, "i", 2**31 - 1), "f32": (0x03, "f", 0)}
"""Name to first byte, code of struct and largest number, 0 for none."""
OK, UNKNOWN, VALUE, BUSY = 0, 1, 2, 3


def _crc_step(byte: int) -> int:
    value = byte << 8
    for _ in range(8):
        value = (value << 1 ^ (0x1021 if value & 0x8000 else 0)) & 0xFFFF
    return value


_CRC_STEPS = [_crc_step(byte) for byte in range(256)]


def crc(data: bytes) -> int:
    """Return CRC-16/CCITT-FALSE."""
    value = 0xFFFF
    for byte in data:
        value = (value << 8 & 0xFF00) ^ _CRC_STEPS[value >> 8 ^ byte]
    return value


def frame(payload: bytes) -> bytes:
    """Return COBS(payload + CRC) and the closing zero, byte by byte as a small controller does it."""
    out, code_at, code = bytearray(b"\0"), 0, 1
    for byte in payload + struct.pack("<H", crc(payload)):
        if byte:
            out.append(byte)
            code += 1
        if byte == 0 or code == 0xFF:
            out[code_at] = code
            code_at, code = len(out), 1
            out.append(0)
    out[code_at] = code
    return bytes(out) + b"\0"


def unframe(wire: bytes) -> bytes | None:
    """Return the payload of a frame without its closing zero, None when it is damaged."""
    out, at = bytearray(), 0
    while at < len(wire):
        code = wire[at]
        if code == 0 or at + code > len(wire):
            return None
        out += wire[at + 1 : at + code]
        at += code
        if code < 0xFF and at < len(wire):
            out.append(0)
    payload = bytes(out[:-2])
    return payload if len(out) > 2 and struct.pack("<H", crc(payload)) == bytes(out[-2:]) else None


@dataclass
class Touch:
    """A contact that presses with a force that may ramp."""

    x: float = 0.0
    y: float = 0.0
    radius: float = 1.0
    start_s: float = 0.0
    low_n: float = 0.0
    high_n: float = 0.0
    duration_s: float = 0.0

    def force_n(self, now_s: float) -> float:
        """Return the present force [N]."""
        part = 1.0 if self.duration_s <= 0 else min(1.0, max(0.0, (now_s - self.start_s) / self.duration_s))
        return self.low_n + (self.high_n - self.low_n) * part


class FrontEnd:
    """The device without its port: messages in, frames out; times in seconds of the given clock."""

    def __init__(self, options: argparse.Namespace, clock: Callable[[], float] = time.monotonic) -> None:
        self.options, self.clock = options, clock
        self.press(Touch())
        chance = random.Random(options.seed)
        self.noise = itertools.cycle([chance.gauss(0, options.noise) for _ in range(9973)])
        self.received = b""
        self.clock_start_us = int(options.clock_start_us)
        self.lose = 0
        self.held_s = 0.0
        self.supply = Supply(clock, self.boot)
        self.standstill, self.refusals = Standstill(), Refusals()
        self.restart()

    def restart(self) -> None:
        """Begin anew at once."""
        self.boot(self.clock())

    def boot(self, at_s: float) -> None:
        """Begin anew, as after its power came back: no stream, clock and number at their start."""
        self.born_s = self.heard_s = at_s
        self.rate_hz = 0
        self.sequence = 0
        self.flags = 0
        self.zeros = [0.0] * self.options.channels
        self.next_s = 0.0

    def take(self, data: bytes) -> list[bytes]:
        """Return the replies to what the host sent."""
        if not self.supply.is_on:
            return []
        self.heard_s = self.clock()
        *pieces, self.received = (self.received + data).split(b"\0")
        self.received = self.received[-300:]
        payloads = [payload for piece in pieces if (payload := unframe(piece)) is not None]
        return [frame(reply) for payload in payloads if (reply := self._answer(payload))]

    def _answer(self, payload: bytes) -> bytes:
        kind, options = payload[0], self.options
        form = list(FORMATS).index(options.format)
        if kind == 0x10:
            name = str(options.name).encode()
            return struct.pack("<BBBBI", 0x11, 1, options.channels, form, options.max_rate) + name
        if kind in (0x12, 0x13, 0x14) and self.refusals.take():
            return bytes((0x1F, kind, BUSY))
        if kind == 0x12 and len(payload) == 6:
            return bytes((0x1F, kind, self._start(*struct.unpack("<BI", payload[1:]))))
        if kind in (0x13, 0x14) and len(payload) == 2:
            if payload[1] != 1:
                return bytes((0x1F, kind, VALUE))
            if kind == 0x13:
                self.rate_hz = 0
            else:
                self.zeros = self._forces(self.clock())
            return bytes((0x1F, kind, OK))
        return bytes((0x1F, kind, UNKNOWN))

    def _start(self, stream: int, rate_hz: int) -> int:
        if stream != 1 or not 1 <= rate_hz <= self.options.max_rate:
            return VALUE
        if self.rate_hz != rate_hz:
            self.rate_hz, self.next_s = rate_hz, self.clock()
        return OK

    def due(self) -> list[bytes]:
        """Return the frames of the blocks sampled until now, and stop when the host has been silent too long."""
        now_s = self.clock()
        if not self.supply.is_on:
            return []
        if self.rate_hz and now_s - self.heard_s > DEAD_MAN_S:
            self.rate_hz = 0
        frames = []
        while self.rate_hz and self.next_s <= now_s:
            frames.append(self.standstill.bend(frame(self._block(self.held_s or self.next_s))))
            self.next_s += 1 / self.rate_hz
            if self.lose:
                self.lose -= 1
                frames.pop()
        return frames

    def overrun(self) -> None:
        """Note that a block did not leave the device."""
        self.flags |= OVERRUN

    def press(self, touch: Touch) -> None:
        """Replace the contact; its force spreads over the elements as a bell of its radius, the sum kept."""
        columns = self.options.columns
        places = [(i % columns, i // columns) for i in range(self.options.channels)]
        bell = [math.exp(-((x - touch.x) ** 2 + (y - touch.y) ** 2) / (2 * touch.radius**2)) for x, y in places]
        total = sum(bell)
        self.touch = touch
        self.shares = [value / total if total > 1e-9 else 0.0 for value in bell]

    def _forces(self, now_s: float) -> list[float]:
        force = self.touch.force_n(now_s)
        return [force * share for share in self.shares]

    def _block(self, at_s: float) -> bytes:
        options = self.options
        kind, code, top = FORMATS[options.format]
        flags, self.flags = self.flags, 0
        gain = options.counts_per_newton
        pairs = zip(self._forces(at_s), self.zeros, self.noise, strict=False)
        values: list[float] = [(force - zero) * gain + noise for force, zero, noise in pairs]
        if top:
            values = [min(max(round(value), -top), top) for value in values]
            if max(values) == top or min(values) == -top:
                flags |= SATURATED
        t_us = self.clock_start_us + round((at_s - self.born_s) * (1e6 + options.clock_ppm))
        head = struct.pack("<BBHIBB", kind, 1, self.sequence, t_us % 2**32, options.channels, flags)
        self.sequence = self.sequence + 1 & 0xFFFF
        return head + struct.pack(f"<{len(values)}{code}", *values)

    def state(self) -> dict[str, float]:
        """Return what a bystander sees."""
        return {
            "rate_hz": self.rate_hz,
            "sequence": self.sequence,
            "force_n": self.touch.force_n(self.clock()),
            "since_heard_s": self.clock() - self.heard_s,
            "on": self.supply.is_on,
        }

    def handlers(self) -> dict[str, Callable[..., object]]:
        """Return the commands on standard input that need no port."""

        def hold(word: str) -> None:
            self.held_s = self.clock() if word == "on" else 0.0

        def foreign(kind: str, value: str = "0") -> None:
            if kind == "rate":
                self._start(1, int(value))
            elif kind == "stop":
                self.rate_hz = 0
            elif kind == "zero":
                self.zeros = self._forces(self.clock())
            else:
                raise ValueError(f"{kind}; want one of rate, stop, zero")

        return {
            "restart": self.restart,
            "state": self.state,
            "power_cycle": self.supply.cycle,
            "freeze": self.standstill.set,
            "refuse": self.refusals.set,
            "hold": hold,
            "foreign": foreign,
        }


async def _stream(device: FrontEnd, send: Callable[[bytes], None]) -> None:
    """Send what is due, about every millisecond while a stream runs."""
    while True:
        for data in device.due():
            send(data)
        await asyncio.sleep(max(0.001, device.next_s - device.clock()) if device.rate_hz else 0.005)


def options_parser() -> argparse.ArgumentParser:
    """Return the options."""
    parser = argparse.ArgumentParser(description="simulated tactile array behind a framed sample stream")
    parser.add_argument("--link", type=Path)
    parser.add_argument("--name", default="TAC16")
    parser.add_argument("--channels", type=int, default=16)
    parser.add_argument("--columns", type=int, default=4)
    parser.add_argument("--format", choices=FORMATS, default="i16")
    parser.add_argument("--max-rate", type=int, default=1000)
    parser.add_argument("--counts-per-newton", type=float, default=2000.0)
    parser.add_argument("--noise", type=float, default=3.0, help="standard deviation [counts]")
    parser.add_argument("--clock-ppm", type=float, default=40.0)
    parser.add_argument("--clock-start-us", type=int, default=0)
    parser.add_argument("--seed", type=int, default=1)
    return parser


async def run(device: FrontEnd, more: Mapping[str, Callable[..., object]] = MappingProxyType({})) -> None:
    """Serve a device until told to end; ``more`` are further commands."""
    options, faults = device.options, Faults()
    loop = asyncio.get_running_loop()

    def send(data: bytes) -> None:
        delay_s, bent = faults.outgoing(data)
        if delay_s:
            loop.call_later(delay_s, port.write, bent)
        elif not port.write(bent):
            device.overrun()

    def received(data: bytes) -> None:
        if faults.hears():
            for reply in device.take(data):
                send(reply)

    def press(low: str, high: str, duration_s: str, x: str, y: str, radius: str = "1") -> None:
        times = (device.clock(), float(low), float(high), float(duration_s))
        device.press(Touch(float(x), float(y), float(radius), *times))

    def unplug(duration_s: str = "") -> None:
        port.unplug()
        device.restart()
        if duration_s:
            loop.call_later(float(duration_s), port.plug)

    def lose(count: str) -> None:
        device.lose = int(count)

    port = PtyPort(options.link, received)
    port.plug()
    streaming = asyncio.create_task(_stream(device, send))

    async def close() -> None:
        streaming.cancel()
        port.unplug()

    handlers: dict[str, Callable[..., object]] = {
        **faults.handlers(),
        "touch": lambda force, x, y, radius="1": press(force, force, "0", x, y, radius),
        "press": press,
        "release": lambda: press("0", "0", "0", "0", "0"),
        "lose": lose,
        **device.handlers(),
        "unplug": unplug,
        "plug": port.plug,
        **more,
    }
    await serve(str(options.link or port.name), handlers, close)


if __name__ == "__main__":
    asyncio.run(run(FrontEnd(options_parser().parse_args())))
