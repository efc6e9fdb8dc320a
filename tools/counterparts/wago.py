"""A WAGO 750 coupler on TCP: ``python -m sioms.tools.counterparts.wago --inputs 8 --outputs 8 --analogs 2``.

Pymodbus's TCP server behind a relay with faults. The process image lies as the coupler's manual says: inputs as discrete inputs
from 0, outputs as coils from 0 and read back from 0x200, analog inputs as input registers and analog outputs as holding
registers from 0, 0x7FF0 at 10 V; the series code 750 in 0x2011. The watchdog: time in 0x1000 [100 ms], started by a trigger other than 0
in 0x1003, stopped by AAAA and 5555 in 0x1005, status in 0x1006, restarted by 1 in 0x1007. When it has tripped the
outputs are off and every request but the restart is answered with exception 4. Commands on standard input, beside those of the
line: ``di CHANNEL 0|1``, ``ai CHANNEL VOLTS``, ``loop on|off`` (each output wired to the input of its number), ``state``.
"""

from __future__ import annotations

import argparse
import asyncio
import time
from collections.abc import Callable

from pymodbus.constants import ExcCodes
from pymodbus.simulator import DataType, SimData, SimDevice

from .control import serve
from .faults import Faults
from .modbus import ILLEGAL_FUNCTION, TcpLine

READ_BACK = 0x200
TIME, TRIGGER, STOP, STATUS, RESTART, SERIES = 0x1000, 0x1003, 0x1005, 0x1006, 0x1007, 0x2011
WATCHDOG = range(0x1000, 0x100C)
TEN_VOLTS = 0x7FF0
WORDS = {1: "coils", 2: "discrete inputs"}


class Coupler:
    """The coupler and its modules; times in seconds of the given clock."""

    def __init__(
        self, inputs: int, outputs: int, analogs: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.clock = clock
        self.di, self.do = [0] * inputs, [0] * outputs
        self.ai, self.ao = [0] * analogs, [0] * analogs
        self.registers = dict.fromkeys(WATCHDOG, 0)
        self.running = self.tripped = self.looped = False
        self._stops = 0
        self._heard_s = clock()

    def hear(self) -> None:
        """Note a request; the outputs go off when the one before it is too long ago."""
        now_s = self.clock()
        if self.running and now_s - self._heard_s > self.registers[TIME] / 10:
            self.running, self.tripped = False, True
            self.set_outputs(0, [0] * len(self.do))
            self.ao = [0] * len(self.ao)
        self._heard_s = now_s

    def set_outputs(self, first: int, values: list[int]) -> None:
        """Set outputs, and the inputs that are wired to them."""
        self.do[first : first + len(values)] = values
        if self.looped:
            self.di[: len(self.do)] = self.do[: len(self.di)]

    def bits(self, function: int) -> dict[int, list[int]]:
        """Return first address to bits of a table."""
        return {0: self.di} if function == 2 else {0: self.do, READ_BACK: self.do}

    def read(self, function: int, address: int, count: int) -> list[int] | ExcCodes:
        """Return registers."""
        image = dict(enumerate(self.ai if function == 4 else self.ao))
        if function == 3:
            image |= {**self.registers, SERIES: 750, STATUS: int(self.running)}
        if any(at not in image for at in range(address, address + count)):
            return ExcCodes.ILLEGAL_ADDRESS
        return [image[at] for at in range(address, address + count)]

    def write(self, address: int, values: list[int]) -> ExcCodes | None:
        """Take registers: analog outputs, or those of the watchdog."""
        if address + len(values) <= len(self.ao):
            self.ao[address : address + len(values)] = values
            return None
        if address not in WATCHDOG:
            return ExcCodes.ILLEGAL_ADDRESS
        value = values[0]
        if address == TIME and self.running:
            return ExcCodes.ILLEGAL_VALUE
        if address == STOP:
            self._stops = (
                1 if value == 0xAAAA else self._stops + 1 if value == 0x5555 and self._stops == 1 else 0
            )
            self.running = self.running and self._stops != 2
        elif address == RESTART and value == 1:
            self.running, self.tripped = self.tripped or self.running, False
        elif address == TRIGGER and value:
            self.running = self.registers[TIME] > 0
        self.registers[address] = value
        return None

    def state(self) -> dict[str, object]:
        """Return what a bystander sees."""
        return {
            "di": self.di,
            "do": self.do,
            "ai": self.ai,
            "ao": self.ao,
            "watchdog": self.running,
            "tripped": self.tripped,
        }


def simulated(coupler: Coupler) -> SimDevice:
    """Return pymodbus's device for the coupler."""

    async def action(
        function: int,
        start: int,
        address: int,
        count: int,
        current: list[int],
        values: list[int] | list[bool] | None,
    ) -> ExcCodes | None:
        if function in (5, 6) and values is None:
            return None  # pymodbus reads back what it just stored, for the echo
        coupler.hear()
        if coupler.tripped and (address, values) != (RESTART, [1]):
            return ExcCodes.DEVICE_FAILURE
        if function in WORDS:
            return _bits(coupler, function, start, address, count, current)
        if function in (5, 15) and values is not None:
            if address + len(values) > len(coupler.do):
                return ExcCodes.ILLEGAL_ADDRESS
            coupler.set_outputs(address, [int(value) for value in values])
            return None
        if function in (6, 16) and values is not None:
            return coupler.write(address, [int(value) for value in values])
        if function not in (3, 4):
            return ILLEGAL_FUNCTION
        result = coupler.read(function, address, count)
        if isinstance(result, ExcCodes):
            return result
        current[address - start : address - start + count] = result
        return None

    coils = [SimData(0, count=READ_BACK + 512, values=0, datatype=DataType.BITS)]
    inputs = [SimData(0, count=512, values=0, datatype=DataType.BITS)]
    holding = [SimData(0, count=SERIES + 8, values=0, datatype=DataType.REGISTERS)]
    registers = [SimData(0, count=256, values=0, datatype=DataType.REGISTERS)]
    return SimDevice(1, simdata=(coils, inputs, holding, registers), action=action)


def _bits(
    coupler: Coupler, function: int, start: int, address: int, count: int, current: list[int]
) -> ExcCodes | None:
    """Fill whole words with bits, as pymodbus keeps them."""
    tables = coupler.bits(function)
    base = max(first for first in tables if first <= address)
    bits = tables[base]
    if address - base >= max(1, len(bits)):
        return ExcCodes.ILLEGAL_ADDRESS
    first = (address - base) // 16 * 16
    for word in range(count):
        part = bits[first + 16 * word : first + 16 * word + 16]
        current[(base + first) // 16 - start + word] = sum(bit << i for i, bit in enumerate(part))
    return None


async def run() -> None:
    """Serve until told to end."""
    parser = argparse.ArgumentParser(description="simulated WAGO 750 coupler")
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--inputs", type=int, default=8)
    parser.add_argument("--outputs", type=int, default=8)
    parser.add_argument("--analogs", type=int, default=2)
    options = parser.parse_args()
    coupler = Coupler(options.inputs, options.outputs, options.analogs)
    line = TcpLine([simulated(coupler)], options.port, Faults())
    await line.start()

    def di(channel: str, value: str) -> None:
        coupler.di[int(channel)] = int(value)

    def ai(channel: str, volts: str) -> None:
        coupler.ai[int(channel)] = round(float(volts) / 10 * TEN_VOLTS)

    def loop(state: str) -> None:
        coupler.looped = state == "on"

    handlers = {**line.handlers(), "di": di, "ai": ai, "loop": loop, "state": coupler.state}
    await serve(f"127.0.0.1:{line.port}", handlers, line.close)


if __name__ == "__main__":
    asyncio.run(run())
