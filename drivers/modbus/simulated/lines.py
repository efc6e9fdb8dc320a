"""What the Modbus simulators share: pymodbus's own servers behind a line that can be disturbed.

Between the line and the server stands the gate: what the device's supply, its refusals and its frozen readings make of
a request, whatever the device. A serial simulator is the drive's UART and a pymodbus RTU server. The UART takes a frame
from the line when its CRC is right or the line falls silent, drops damaged ones, and hands good ones to the server over
a second pty; the server's replies go back through the faults. A TCP simulator is a relay before pymodbus's TCP server.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
import socket
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from pymodbus.constants import ExcCodes
from pymodbus.framer.rtu import FramerRTU
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from sioms.simulation.faults import FOREVER, Faults
from sioms.simulation.ports import PtyPort

# a port that is unplugged under it is no news here
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

ILLEGAL_FUNCTION = ExcCodes.ILLEGAL_FUNCTION
ILLEGAL_VALUE = ExcCodes.ILLEGAL_VALUE
BUSY = 6
WRITES = (5, 6, 15, 16, 22, 23)


class Registers(Protocol):
    """A device as its registers show it; both are called at the time of the request."""

    def read(self, function: int, address: int, count: int) -> list[int] | ExcCodes:
        """Return the registers, or the bits as 0 and 1."""

    def write(self, function: int, address: int, values: list[int]) -> ExcCodes | None:
        """Take registers or bits."""


def bits_from_0(count: int) -> SimData:
    """Return pymodbus's data of this many bits, a multiple of 16, at the addresses from 0.

    As words: of a count, pymodbus checks a list as long as its square, which for 4000 bits takes 2 GB and seconds.
    """
    return SimData(0, values=[0] * (count // 16), datatype=DataType.BITS)


@dataclass(frozen=True, slots=True)
class Asked:
    """A request as pymodbus hands it over.

    Attributes:
        function, address, count: of the request.
        start: address of the first element of ``current``; of bits: of words of 16.
        current: what pymodbus answers a read with.
        values: of a write; None for a read.
    """

    function: int
    start: int
    address: int
    count: int
    current: list[int]
    values: list[int] | None

    def answer(self, words: list[int] | ExcCodes) -> ExcCodes | None:
        """Answer with words, or refuse."""
        if isinstance(words, ExcCodes):
            return words
        self.current[self.address - self.start : self.address - self.start + self.count] = words
        return None

    def answer_bits(self, bits: Sequence[int], base: int = 0) -> ExcCodes | None:
        """Answer with the bits that lie from an address on: pymodbus keeps them packed, and asks for whole words."""
        first = (self.address - base) // 16 * 16
        if self.address - base >= max(1, len(bits)):
            return ExcCodes.ILLEGAL_ADDRESS
        for word in range(self.count):
            part = bits[first + 16 * word : first + 16 * word + 16]
            self.current[(base + first) // 16 - self.start + word] = sum(bit << i for i, bit in enumerate(part))
        return None


def served(unit: int, data: Any, serve: Callable[[Asked], ExcCodes | None]) -> SimDevice:
    """Return pymodbus's device that serves requests, but for the reads of what has just been written.

    Args:
        unit: its address on the line.
        data: pymodbus's SimData, in its four blocks or in one: what there is.
        serve: carries out a write, or answers a read; returns why not.
    """

    async def action(
        function: int,
        start: int,
        address: int,
        count: int,
        current: list[int],
        values: list[int] | list[bool] | None,
    ) -> ExcCodes | None:
        if values is None and function in (5, 6):
            return None  # pymodbus reads back what it just stored, for the echo
        written = None if values is None else [int(value) for value in values]
        return serve(Asked(function, start, address, count, current, written))

    return SimDevice(unit, simdata=data, action=action)


def simulated(unit: int, device: Registers, ranges: Iterable[tuple[int, int]]) -> SimDevice:
    """Return pymodbus's device with holding registers in these (first, count) ranges, all others illegal."""
    data = [SimData(first, count=count, values=0, datatype=DataType.REGISTERS) for first, count in ranges]

    def serve(asked: Asked) -> ExcCodes | None:
        if asked.values is not None:
            return device.write(asked.function, asked.address, asked.values)
        return asked.answer(device.read(asked.function, asked.address, asked.count))

    return served(unit, data, serve)


def crc_is_right(frame: bytes) -> bool:
    """Tell whether a frame ends in its CRC."""
    return len(frame) >= 4 and FramerRTU.compute_CRC(frame[:-2]).to_bytes(2, "big") == frame[-2:]


def with_crc(body: bytes) -> bytes:
    """Return a frame."""
    return body + FramerRTU.compute_CRC(body).to_bytes(2, "big")


class Powered(Protocol):
    """A device whose supply can be switched."""

    def power_off(self) -> None:
        """Lose what a device without supply loses at once: torque, outputs."""

    def power_on(self) -> None:
        """Boot: what is not non-volatile is as delivered."""


class Gate:
    """What a request meets before the server: a supply that is off, a refusal, a frozen answer.

    Args:
        devices: that are switched together.

    Attributes:
        is_on: whether there is supply.
        refusals: writes that are still answered "busy" (exception 6) and not carried out.
        frozen: reads that are still answered as they were the last time.
        changed: called when the supply was switched.
    """

    def __init__(self, devices: Iterable[Powered]) -> None:
        self.is_on = True
        self.refusals = self.frozen = 0
        self.changed: Callable[[], None] = lambda: None
        self._devices = list(devices)
        self._answers: dict[bytes, bytes] = {}
        self._boot: asyncio.TimerHandle | None = None

    def answer(self, unit: int, pdu: bytes) -> bytes | None:
        """Return what the device answers without looking at its registers, None when it looks."""
        if pdu[0] in WRITES and self.refusals > 0:
            self.refusals -= 1
            return bytes((pdu[0] | 0x80, BUSY))
        if pdu[0] not in WRITES and self.frozen > 0 and bytes((unit,)) + pdu in self._answers:
            self.frozen -= 1
            return self._answers[bytes((unit,)) + pdu]
        return None

    def note(self, unit: int, pdu: bytes, reply: bytes) -> None:
        """Note the answer to a read, for when the readings stand still."""
        if pdu[0] not in WRITES:
            self._answers[bytes((unit,)) + pdu] = reply

    def power_cycle(self, seconds: str = "0.2") -> None:
        """Switch the supply off for a time."""
        if self.is_on:
            self.is_on = False
            for device in self._devices:
                device.power_off()
            self.changed()
        if self._boot is not None:
            self._boot.cancel()
        self._boot = asyncio.get_running_loop().call_later(float(seconds), self._on)

    def _on(self) -> None:
        self._answers.clear()
        for device in self._devices:
            device.power_on()
        self.is_on = True
        self.changed()

    def handlers(self) -> dict[str, Callable[..., object]]:
        """Return the commands ``power_cycle [SECONDS]``, ``refuse COUNT``, ``freeze [COUNT]``."""

        def refuse(count: str) -> None:
            self.refusals = int(count)

        def freeze(count: str = "") -> None:
            self.frozen = int(count) if count else FOREVER

        return {"power_cycle": self.power_cycle, "refuse": refuse, "freeze": freeze}


class RtuLine:
    """The line with its drives: pty, UART, faults and pymodbus's server.

    Args:
        devices: pymodbus's devices, one a unit.
        link: path for the port.
        faults: of the line.
        baud, bits: when baud is not 0 a reply comes no earlier than the line would carry it.
        answers_damage: units answer a damaged request with exception 8 instead of silence.
        powered: the drives, for their supply.
    """

    def __init__(
        self,
        devices: list[SimDevice],
        link: Path | None,
        faults: Faults,
        *,
        baud: int = 0,
        bits: int = 10,
        answers_damage: bool = False,
        powered: Iterable[Powered] = (),
    ) -> None:
        self.gate = Gate(powered)
        self.gate.changed = self._silence
        self.port = PtyPort(link, self._from_line)
        self._inner = PtyPort(None, self._from_server)
        self._devices, self._faults = devices, faults
        self._units = {device.id for device in devices}
        self._character_s = bits / baud if baud else 0.0
        self._answers_damage = answers_damage
        self._frame = b""
        self._reply = b""
        self._asked = b""
        self._boots = 0
        self._arrived_s = 0.0
        self._gap: asyncio.TimerHandle | None = None
        self.requests = 0

    async def start(self) -> None:
        """Plug the port in and start the server."""
        self._inner.plug()
        self._server = ModbusSerialServer(self._devices, port=self._inner.name, baudrate=115200)
        await self._server.serve_forever(background=True)
        self.port.plug()

    async def close(self) -> None:
        """Unplug and stop."""
        self.port.unplug()
        await self._server.shutdown()  # type: ignore[no-untyped-call]
        self._inner.unplug()

    def handlers(self) -> dict[str, Callable[..., object]]:
        """Return the commands of the line."""
        loop = asyncio.get_running_loop()

        def unplug(duration_s: str = "") -> None:
            self.port.unplug()
            if duration_s:
                loop.call_later(float(duration_s), self.port.plug)

        def garbage(count: str) -> None:
            self.port.write(self._faults.chance.randbytes(int(count)))

        return {
            **self._faults.handlers(),
            **self.gate.handlers(),
            "unplug": unplug,
            "plug": self.port.plug,
            "garbage": garbage,
            "requests": lambda: self.requests,
        }

    def _silence(self) -> None:
        """Forget what is on its way: the supply was switched."""
        self._frame = self._reply = self._asked = b""
        self._boots += 1

    def _from_line(self, data: bytes) -> None:
        if not self.gate.is_on:
            return
        loop = asyncio.get_running_loop()
        self._frame = (self._frame + data)[-256:]  # no frame is longer
        if self._gap is not None:
            self._gap.cancel()
        if crc_is_right(self._frame):
            self._take()
        else:
            self._gap = loop.call_later(max(0.005, 3.5 * self._character_s), self._damaged)

    def _take(self) -> None:
        frame, self._frame, self._reply = self._frame, b"", b""
        self._arrived_s = asyncio.get_running_loop().time() + len(frame) * self._character_s
        if frame[0] in self._units and self._faults.hears():
            self.requests += 1
            self._asked = frame
            ready = self.gate.answer(frame[0], frame[1:-2])
            if ready is None:
                self._inner.write(frame)
            else:
                self._send(with_crc(frame[:1] + ready))

    def _damaged(self) -> None:
        frame, self._frame = self._frame, b""
        if self._answers_damage and len(frame) >= 4 and frame[0] in self._units:
            self._send(with_crc(bytes((frame[0], frame[1] | 0x80, 8))))

    def _from_server(self, data: bytes) -> None:
        self._reply += data
        if crc_is_right(self._reply):
            reply, self._reply = self._reply, b""
            if self._asked:
                self.gate.note(reply[0], self._asked[1:-2], reply[1:-2])
                self._send(reply)

    def _send(self, reply: bytes) -> None:
        loop = asyncio.get_running_loop()
        delay_s, data = self._faults.outgoing(reply)
        ready_s = self._arrived_s + (3.5 + len(reply)) * self._character_s + delay_s
        loop.call_at(max(ready_s, loop.time()), self._write, data, self._boots)

    def _write(self, data: bytes, boots: int) -> None:
        if self.gate.is_on and boots == self._boots:
            self.port.write(data)


class TcpLine:
    """A relay with faults before pymodbus's TCP server; both listen on the loopback interface.

    A device without supply says nothing, not even that a connection is gone; after booting it resets the connections
    that it does not know any more when something comes on them.
    """

    def __init__(self, devices: list[SimDevice], port: int, faults: Faults, powered: Iterable[Powered] = ()) -> None:
        self.port = port
        self.gate = Gate(powered)
        self.gate.changed = self._silence
        self._boots = 0
        self._devices, self._faults = devices, faults
        self._public: asyncio.Server | None = None
        self._writers: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._serving: set[asyncio.Task[None]] = set()

    async def start(self) -> None:
        """Start the server and listen; ``port`` 0 becomes a free one."""
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self._inner = int(probe.getsockname()[1])
        self._server = ModbusTcpServer(self._devices, address=("127.0.0.1", self._inner))
        await self._server.serve_forever(background=True)
        await self.plug()

    async def plug(self) -> None:
        """Listen."""
        if self._public is None:
            self._public = await asyncio.start_server(self._serve, "127.0.0.1", self.port)
            self.port = self._public.sockets[0].getsockname()[1]

    async def unplug(self) -> None:
        """Stop listening and drop the connections."""
        if self._public is not None:
            self._public.close()
            self._public = None
        for writer in list(self._writers):
            writer.transport.abort()

    async def close(self) -> None:
        """Stop everything."""
        await self.unplug()
        await asyncio.gather(*self._serving, return_exceptions=True)
        await self._server.shutdown()  # type: ignore[no-untyped-call]

    def handlers(self) -> dict[str, Callable[..., object]]:
        """Return the commands of the line."""

        def start(coroutine: Callable[[], object]) -> Callable[..., None]:
            def run(after_s: str = "") -> None:
                task = asyncio.ensure_future(coroutine())  # type: ignore[call-overload]
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)
                if after_s:
                    asyncio.get_running_loop().call_later(float(after_s), start(self.plug))

            return run

        return {
            **self._faults.handlers(),
            **self.gate.handlers(),
            "unplug": start(self.unplug),
            "plug": start(self.plug),
        }

    def _silence(self) -> None:
        self._boots += 1

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        if task is not None:
            self._serving.add(task)
            task.add_done_callback(self._serving.discard)
        inner_reader, inner_writer = await asyncio.open_connection("127.0.0.1", self._inner)
        self._writers |= {writer, inner_writer}
        asked: dict[bytes, bytes] = {}
        boots = self._boots
        outward = asyncio.create_task(self._outward(inner_reader, writer, asked, boots))
        try:
            while frame := await _frame(reader):
                if not self.gate.is_on:
                    continue
                if boots != self._boots:
                    writer.transport.abort()
                    return
                if self._faults.hears():
                    ready = self.gate.answer(frame[6], frame[7:])
                    if ready is None:
                        asked[frame[:2]] = frame[7:]
                        inner_writer.write(frame)
                    else:
                        head = frame[:4] + (len(ready) + 1).to_bytes(2, "big") + frame[6:7]
                        self._send(writer, head + ready, boots)
        except (ConnectionError, asyncio.IncompleteReadError):
            pass
        finally:
            outward.cancel()
            self._writers -= {writer, inner_writer}
            inner_writer.close()
            writer.close()

    async def _outward(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        asked: dict[bytes, bytes],
        boots: int,
    ) -> None:
        with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
            while frame := await _frame(reader):
                self.gate.note(frame[6], asked.pop(frame[:2], b"\x10"), frame[7:])
                self._send(writer, frame, boots)

    def _send(self, writer: asyncio.StreamWriter, frame: bytes, boots: int) -> None:
        def write(data: bytes) -> None:
            if self.gate.is_on and boots == self._boots:
                writer.write(data)

        delay_s, data = self._faults.outgoing(frame)
        asyncio.get_running_loop().call_later(delay_s, write, data)


async def _frame(reader: asyncio.StreamReader) -> bytes:
    """Return the next message, b'' at the end of the stream."""
    head = await reader.read(1)
    if not head:
        return b""
    head += await reader.readexactly(5)
    return head + await reader.readexactly(int.from_bytes(head[4:6], "big"))


def serial_parser(description: str) -> argparse.ArgumentParser:
    """Return the options that all serial simulators have."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--link", type=Path, help="fixed path of the port")
    parser.add_argument("--units", default="1", help="addresses on the line, e.g. 1,2,3")
    parser.add_argument("--baud", type=int, default=0, help="let replies take the time of a line of this speed")
    return parser


def unit_list(text: str) -> list[int]:
    """Return the addresses in ``1,2,3``."""
    return [int(part) for part in text.split(",")]
