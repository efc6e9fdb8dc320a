"""A WAGO 750 coupler on TCP: ``python -m sioms.drivers.modbus.simulated.wago --inputs 8 --outputs 8 --analogs 2``.

Pymodbus's TCP server behind a relay with faults. The process image lies as the manual's register mapping says:
functions 1 and 2 both read inputs from 0 and outputs from 0x200, functions 3 and 4 analog words likewise; writes take 0
and 0x200 for outputs. Analog words are 0x7FF0 at 10 V; the series code 750 is in 0x2011. The watchdog, by the manual's
chapter "Watchdog (Fieldbus failure)":

* time in 0x1000 [100 ms] and functions that keep it alive in 0x1001, both refused (exception 3) while it runs;
* it starts when 0x1003 is *modified* to a value other than 0 and the time is not 0; the same value again does nothing;
* 0x1006 reads 1 while it runs; AAAA and 5555 in 0x1005 stop it, 1 in 0x1007 starts its time anew while it runs;
* when it has expired the outputs are zero, and every request is answered with exception 4, but the write of AA55 or
  55AA to 0x1008, which stops it and ends the failure; outputs stay zero until they are written.

Switched off it forgets the outputs and all of these registers. Commands on standard input, beside those of the line:
``di CHANNEL 0|1``, ``ai CHANNEL VOLTS``, ``loop on|off`` (each output wired to the input of its number), ``foreign
output BITS``, ``state``.
"""

from __future__ import annotations

import argparse
import asyncio
import time
from collections.abc import Callable, Sequence

from pymodbus.constants import ExcCodes
from pymodbus.simulator import DataType, SimData, SimDevice

from sioms.simulation.control import number, serve
from sioms.simulation.faults import Faults

from .lines import ILLEGAL_FUNCTION, Asked, TcpLine, bits_from_0, served

READ_BACK = 0x200
TIME, FUNCTIONS, TRIGGER, SHORTEST, STOP, STATUS, RESTART, SIMPLE_STOP = (
    0x1000, 0x1001, 0x1003, 0x1004, 0x1005, 0x1006, 0x1007, 0x1008,
)  # fmt: skip
SERIES = 0x2011
WATCHDOG = range(0x1000, 0x100C)
SIMPLE_STOPS = (0xAA55, 0x55AA)
OFF, RUNS, EXPIRED = 0, 1, 2
TEN_VOLTS = 0x7FF0


class Coupler:
    """The coupler and its modules; times in seconds of the given clock."""

    def __init__(self, inputs: int, outputs: int, analogs: int, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock = clock
        self.di, self.do = [0] * inputs, [0] * outputs
        self.ai, self.ao = [0] * analogs, [0] * analogs
        self.looped = False
        self.power_on()

    def power_off(self) -> None:
        """Switch all outputs off."""
        self.status = OFF
        self.clear_outputs()

    def power_on(self) -> None:
        """Boot: the watchdog's registers as the manual's defaults."""
        self.registers = dict.fromkeys(WATCHDOG, 0) | {SHORTEST: 0xFFFF, RESTART: 1}
        self.status = OFF
        self._stops = 0
        self._kept_s = self.clock()

    def due(self) -> None:
        """Let the watchdog expire when its time is over."""
        if self.status == RUNS and self.clock() - self._kept_s > self.registers[TIME] / 10:
            self.status = EXPIRED
            self.clear_outputs()

    def hear(self, function: int) -> None:
        """Note a request; those of the mask keep the watchdog alive."""
        self.due()
        if self.registers[FUNCTIONS] >> (function - 1) & 1:
            self._kept_s = self.clock()

    def fails(self, address: int, values: Sequence[int] | None) -> bool:
        """Tell whether a request is answered with a device failure: all are when the watchdog has expired, but its
        stop.
        """
        ends = address == SIMPLE_STOP and values and int(values[0]) in SIMPLE_STOPS
        return self.status == EXPIRED and not ends

    def clear_outputs(self) -> None:
        """Set all outputs to zero."""
        self.set_outputs(0, [0] * len(self.do))
        self.ao = [0] * len(self.ao)

    def set_outputs(self, first: int, values: list[int]) -> None:
        """Set outputs, and the inputs that are wired to them."""
        self.do[first : first + len(values)] = values
        if self.looped:
            self.di[: len(self.do)] = self.do[: len(self.di)]

    def read(self, function: int, address: int, count: int) -> list[int] | ExcCodes:
        """Return registers: functions 3 and 4 read the same."""
        image = dict(enumerate(self.ai)) | {READ_BACK + i: word for i, word in enumerate(self.ao)}
        image |= {**self.registers, SERIES: 750, STATUS: self.status}
        if any(at not in image for at in range(address, address + count)):
            return ExcCodes.ILLEGAL_ADDRESS
        return [image[at] for at in range(address, address + count)]

    def write(self, address: int, values: list[int]) -> ExcCodes | None:
        """Take registers: analog outputs, or those of the watchdog."""
        first = address - READ_BACK if address >= READ_BACK else address
        if first + len(values) <= len(self.ao):
            self.ao[first : first + len(values)] = values
            return None
        if address not in WATCHDOG or address in (SHORTEST, STATUS):
            return ExcCodes.ILLEGAL_ADDRESS
        return self._write_watchdog(address, values[0])

    def _write_watchdog(self, address: int, value: int) -> ExcCodes | None:
        runs = self.status == RUNS
        modified = value != self.registers[address]
        if runs and address in (TIME, FUNCTIONS, FUNCTIONS + 1):
            return ExcCodes.ILLEGAL_VALUE
        if address == STOP:
            self._stops = 1 if value == 0xAAAA else self._stops + 1 if value == 0x5555 and self._stops == 1 else 0
            self.status = OFF if runs and self._stops == 2 else self.status
        elif address == SIMPLE_STOP and value in SIMPLE_STOPS:
            self.status = OFF
        elif (address == RESTART and value == 1 and runs) or (address == TRIGGER and runs and modified):
            self._kept_s = self.clock()
        elif address == TRIGGER and modified and value and self.registers[TIME]:
            self.status, self._kept_s = RUNS, self.clock()
        self.registers[address] = value
        return None

    def foreign(self, kind: str, value: float) -> None:
        """Set the outputs, as another master would."""
        if kind != "output":
            raise ValueError(f"kind {kind}: want output")
        self.due()
        if self.status != EXPIRED:
            self.set_outputs(0, [int(value) >> i & 1 for i in range(len(self.do))])

    def state(self) -> dict[str, object]:
        """Return what a bystander sees."""
        self.due()
        return {
            "di": self.di,
            "do": self.do,
            "ai": self.ai,
            "ao": self.ao,
            "outputs": sum(bit << i for i, bit in enumerate(self.do)),
            "armed": self.status == RUNS,
            "watchdog": self.status == RUNS,
            "tripped": self.status == EXPIRED,
        }


def simulated(coupler: Coupler) -> SimDevice:
    """Return pymodbus's device for the coupler."""

    def serve(asked: Asked) -> ExcCodes | None:
        function, address, values = asked.function, asked.address, asked.values
        coupler.hear(function)
        if coupler.fails(address, values):
            return ExcCodes.DEVICE_FAILURE
        if function in (1, 2):  # both read the same
            return asked.answer_bits(coupler.do, READ_BACK) if address >= READ_BACK else asked.answer_bits(coupler.di)
        if function in (5, 15) and values is not None:
            first = address - READ_BACK if address >= READ_BACK else address
            if first + len(values) > len(coupler.do):
                return ExcCodes.ILLEGAL_ADDRESS
            coupler.set_outputs(first, values)
            return None
        if function in (6, 16) and values is not None:
            return coupler.write(address, values)
        if function not in (3, 4):
            return ILLEGAL_FUNCTION
        return asked.answer(coupler.read(function, address, asked.count))

    bits, inputs = [bits_from_0(READ_BACK + 512)], [bits_from_0(READ_BACK + 512)]
    holding = [SimData(0, count=SERIES + 8, values=0, datatype=DataType.REGISTERS)]
    registers = [SimData(0, count=SERIES + 8, values=0, datatype=DataType.REGISTERS)]
    return served(1, (bits, inputs, holding, registers), serve)


async def run() -> None:
    """Serve until told to end."""
    parser = argparse.ArgumentParser(description="simulated WAGO 750 coupler")
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--inputs", type=int, default=8)
    parser.add_argument("--outputs", type=int, default=8)
    parser.add_argument("--analogs", type=int, default=2)
    options = parser.parse_args()
    coupler = Coupler(options.inputs, options.outputs, options.analogs)
    line = TcpLine([simulated(coupler)], options.port, Faults(), [coupler])
    await line.start()

    def di(channel: str, value: str) -> None:
        coupler.di[int(channel)] = int(value)

    def ai(channel: str, volts: str) -> None:
        coupler.ai[int(channel)] = round(float(volts) / 10 * TEN_VOLTS)

    def loop(state: str) -> None:
        coupler.looped = state == "on"

    def foreign(kind: str, value: str) -> None:
        coupler.foreign(kind, number(value))

    handlers = {
        **line.handlers(), "di": di, "ai": ai, "loop": loop, "foreign": foreign, "state": coupler.state,
    }  # fmt: skip
    await serve(f"127.0.0.1:{line.port}", handlers, line.close)


if __name__ == "__main__":
    asyncio.run(run())
