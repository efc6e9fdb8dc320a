"""A Modbus TCP driver of an I/O block and the block's register model, on an invented clock and without a line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
from steps_rig import Exchanging

from sioms.drivers.modbus.io import IoUnit, ModbusIo
from sioms.drivers.modbus.simulated import moxa, wago
from sioms.sdk.codec.modbus import frame_tcp
from sioms.sdk.exchange import Exchange

EXCHANGE_S = 0.002


class Kit:
    """What a driver of a block needs of the kit."""

    def __init__(self) -> None:
        self.said: list[str] = []

    def log(self, level: str, text: str) -> None:
        """Take what the driver says."""
        self.said.append(text)


class Joined(Exchanging):
    """A block and its driver; each exchange takes 2 ms.

    Attributes:
        device: the register model; it outlives the driver.
        unit: of the present driver.
        sent: PDUs of the requests, in hex.
        busy: requests that are still answered "busy" and not carried out.
        kit: what the present driver has said.
    """

    def __init__(self, make: Callable[[Callable[[], float]], Any], **table: Any) -> None:
        super().__init__(EXCHANGE_S)
        self.device = make(lambda: self.now_s)
        self.sent: list[str] = []
        self.busy = 0
        self._table = {"line": {"tcp": "h:502"}, **table}
        self.begin()

    def begin(self) -> None:
        """Make a new driver: the one before was killed, the device goes on."""
        self.kit = Kit()
        driver = ModbusIo("io0", msgspec.convert(self._table, ModbusIo.Settings), self.kit)  # type: ignore[arg-type]
        unit = driver.units[0]
        assert isinstance(unit, IoUnit)
        self.unit = unit
        unit.clock = lambda: round(self.now_s * 1e9)

    def open(self) -> None:
        """Open the device."""
        self.run(self.unit.open())

    def poll(self, duration_s: float = 0.0) -> None:
        """Poll once, or at 50 Hz for a time."""
        end_s = self.now_s + duration_s
        self.run(self.unit.poll())
        while self.now_s < end_s:
            self.now_s += 0.02
            self.run(self.unit.poll())

    def write(self, port: str, value: int) -> None:
        """Write a port of outputs."""
        spec = next(block.spec for block in self.unit.blocks if block.spec.channels[0].name == port)
        self.run(self.unit.write_outputs(spec, [0], [value]))

    def reply(self, exchange: Exchange) -> bytes:
        """Return what the block answers."""
        request = exchange.data
        self.sent.append(request[7:].hex(" "))
        return frame_tcp(int.from_bytes(request[:2], "big"), request[6], self._answer(request[7:]))

    def _answer(self, pdu: bytes) -> bytes:
        function, address = pdu[0], int.from_bytes(pdu[1:3], "big")
        count = int.from_bytes(pdu[3:5], "big")
        if self.busy:
            self.busy -= 1
            return bytes((function | 0x80, 6))
        values = None
        if function in (5, 6):
            values = [count if function == 6 else int(count == 0xFF00)]
        elif function == 15:
            values = [int.from_bytes(pdu[6:], "little") >> i & 1 for i in range(count)]
        elif function == 16:
            values = np.frombuffer(pdu[6:], ">u2").tolist()
        ask = self._coupler if isinstance(self.device, wago.Coupler) else self._block
        found = ask(function, address, count, values)
        if isinstance(found, int):
            return bytes((function | 0x80, found))
        if values is not None:
            return pdu[:5]
        if function in (3, 4):
            return bytes((function, 2 * count)) + np.array(found, ">u2").tobytes()
        bits, size = sum(bit << i for i, bit in enumerate(found or [])), (count + 7) // 8
        return bytes((function, size)) + bits.to_bytes(size, "little")

    def _coupler(self, function: int, address: int, count: int, values: list[int] | None) -> Any:
        coupler: wago.Coupler = self.device
        coupler.hear(function)
        if coupler.fails(address, values):
            return 4
        outputs = address >= wago.READ_BACK
        first = address - wago.READ_BACK if outputs else address
        if function in (5, 15) and values is not None:
            coupler.set_outputs(first, values)
            return None
        if values is not None:
            return coupler.write(address, values)
        if function in (1, 2):
            return (coupler.do if outputs else coupler.di)[first : first + count]
        return coupler.read(function, address, count)

    def _block(self, function: int, address: int, count: int, values: list[int] | None) -> Any:
        block: moxa.Block = self.device
        block.hear()
        if values is not None:
            return block.write_bits(address, values)
        return block.read_input(address, count) if function == 4 else block.read_bits(function, address, count)
