"""A Moxa ioLogik E1200 block on TCP: ``python -m sioms.drivers.modbus.simulated.moxa --port 5020 --model E1212``.

Unit 1 of pymodbus's TCP server behind a relay with faults. Coils are outputs, discrete inputs inputs; input
registers hold counters, analog inputs and the device's name. Commands on standard input, beside those of the
line: ``di CHANNEL 0|1``, ``ai CHANNEL VOLTS``, ``loop on|off`` (each output wired to the input of its number),
``ramp CHANNEL FROM TO SECONDS``, ``foreign output BITS``, ``state``.

``--watchdog-s``, ``--safe`` and ``--power-on`` are what its web page sets, and non-volatile: when no request came for
so long the outputs take the safe values, coil 0x1030 reads 1, and writes are refused until 1 was written there.
Switched off it forgets outputs, counters, alarm and uptime, and comes back with the values of ``--power-on``.
"""

from __future__ import annotations

import argparse
import asyncio
import time
from collections.abc import Callable

from pymodbus.constants import ExcCodes
from pymodbus.simulator import DataType, SimData, SimDevice

from sioms.simulation.control import number, serve
from sioms.simulation.faults import Faults

from .lines import Asked, TcpLine, bits_from_0, served

# model -> discrete inputs, outputs, analog inputs, first register of the analog inputs
MODELS = {
    "E1210": (16, 0, 0, 0), "E1211": (0, 16, 0, 0), "E1212": (8, 8, 0, 0), "E1214": (6, 6, 0, 0),
    "E1240": (0, 0, 8, 0), "E1242": (8, 0, 4, 0x200),
}  # fmt: skip
FULL_SCALE_V = 10.0
WATCHDOG_ALARM = 0x1030


class Block:
    """The block's inputs and outputs; times in seconds of the given clock."""

    def __init__(
        self,
        model: str,
        watchdog_s: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
        safe: int = 0,
        at_power_on: int = 0,
    ) -> None:
        self.inputs, self.outputs, self.analogs, self.first_analog = MODELS[model]
        self.model, self.watchdog_s, self.clock = model, watchdog_s, clock
        self.di = [0] * self.inputs
        self.safe, self.at_power_on = ([bits >> i & 1 for i in range(self.outputs)] for bits in (safe, at_power_on))
        self.do = [0] * self.outputs
        self.looped = False
        self.power_on()
        # channel -> start [s], from [V], to [V], duration [s]
        self.ramps = dict.fromkeys(range(self.analogs), (0.0, 0.0, 0.0, 0.0))

    def power_off(self) -> None:
        """Switch all outputs off."""
        self.do = [0] * self.outputs

    def power_on(self) -> None:
        """Boot."""
        self.counts = [0] * self.inputs
        self.alarm = False
        self.started_s = self.heard_s = self.clock()
        self._write_outputs(0, self.at_power_on)

    def set_input(self, channel: int, value: int) -> None:
        """Set an input and count its rising edge."""
        self.counts[channel] += value > self.di[channel]
        self.di[channel] = value

    def volts(self, channel: int) -> float:
        """Return the present voltage of an analog input [V]."""
        start_s, low, high, duration_s = self.ramps[channel]
        part = 1.0 if duration_s <= 0 else min(1.0, (self.clock() - start_s) / duration_s)
        return low + (high - low) * part

    def due(self) -> None:
        """Let the watchdog act when the last request is too long ago."""
        if self.watchdog_s and self.clock() - self.heard_s > self.watchdog_s and not self.alarm:
            self.alarm = True
            self._write_outputs(0, self.safe)

    def hear(self) -> None:
        """Note a request."""
        self.due()
        self.heard_s = self.clock()

    def foreign(self, kind: str, value: float) -> None:
        """Set the outputs, as another master would."""
        if kind != "output":
            raise ValueError(f"kind {kind}: want output")
        self.due()
        if not self.alarm:
            self._write_outputs(0, [int(value) >> i & 1 for i in range(self.outputs)])

    def _write_outputs(self, first: int, values: list[int]) -> None:
        self.do[first : first + len(values)] = values
        if self.looped:
            for channel, value in enumerate(self.do[: self.inputs]):
                self.set_input(channel, value)

    def read_bits(self, function: int, address: int, count: int) -> list[int] | ExcCodes:
        """Return coils or discrete inputs."""
        if (function, address) == (1, WATCHDOG_ALARM):
            return [int(self.alarm)]
        bits = self.do if function == 1 else self.di
        if address + count > len(bits):
            return ExcCodes.ILLEGAL_ADDRESS
        return bits[address : address + count]

    def write_bits(self, address: int, values: list[int]) -> ExcCodes | None:
        """Set outputs; while the watchdog's alarm stands they stay off."""
        if address == WATCHDOG_ALARM:
            self.alarm = self.alarm and not values[0]
            return None
        if address + len(values) > self.outputs:
            return ExcCodes.ILLEGAL_ADDRESS
        if self.alarm:
            return ExcCodes.DEVICE_FAILURE
        self._write_outputs(address, values)
        return None

    def read_input(self, address: int, count: int) -> list[int] | ExcCodes:
        """Return input registers; what the model does not have is illegal."""
        image = self._image()
        if any(at not in image for at in range(address, address + count)):
            return ExcCodes.ILLEGAL_ADDRESS
        return [image[at] for at in range(address, address + count)]

    def _image(self) -> dict[int, int]:
        name = self.model.encode().ljust(20, b"\0")
        image = {5000 + i: name[2 * i] << 8 | name[2 * i + 1] for i in range(10)}
        uptime = int(self.clock() - self.started_s)
        image |= {5020: uptime >> 16, 5021: uptime & 0xFFFF}
        if self.inputs:
            image[0x30] = sum(bit << i for i, bit in enumerate(self.di))
        for channel, count in enumerate(self.counts):
            image |= {0x10 + 2 * channel: count >> 16 & 0xFFFF, 0x11 + 2 * channel: count & 0xFFFF}
        for channel in range(self.analogs):
            share = min(max(self.volts(channel) / FULL_SCALE_V, 0.0), 1.0)
            image[self.first_analog + channel] = round(share * 65535)
        return image

    def state(self) -> dict[str, object]:
        """Return what a bystander sees."""
        volts = [self.volts(channel) for channel in range(self.analogs)]
        self.due()
        return {
            "di": self.di,
            "do": self.do,
            "ai": volts,
            "alarm": self.alarm,
            "outputs": sum(bit << i for i, bit in enumerate(self.do)),
            "armed": self.watchdog_s > 0 and not self.alarm,
        }


def simulated_block(block: Block) -> SimDevice:
    """Return pymodbus's device for the block."""

    def serve(asked: Asked) -> ExcCodes | None:
        block.hear()
        if asked.function in (1, 2):
            if asked.function == 1 and asked.address == WATCHDOG_ALARM:
                asked.current[asked.address // 16 - asked.start] = int(block.alarm)
                return None
            return asked.answer_bits(block.do if asked.function == 1 else block.di)
        if asked.function in (5, 15) and asked.values is not None:
            return block.write_bits(asked.address, asked.values)
        if asked.function == 4:
            return asked.answer(block.read_input(asked.address, asked.count))
        return ExcCodes.ILLEGAL_FUNCTION

    coils = [bits_from_0(WATCHDOG_ALARM + 16)]
    inputs = [SimData(0, count=2, values=0, datatype=DataType.BITS)]
    holding = [SimData(0x20, count=1, values=0, datatype=DataType.REGISTERS)]
    registers = [SimData(0, count=5040, values=0, datatype=DataType.REGISTERS)]
    return served(1, (coils, inputs, holding, registers), serve)


async def run() -> None:
    """Serve until told to end."""
    parser = argparse.ArgumentParser(description="simulated Moxa ioLogik E1200")
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--model", choices=MODELS, default="E1212")
    parser.add_argument("--watchdog-s", type=float, default=0.0)
    parser.add_argument("--safe", type=int, default=0, help="bits of the outputs when the watchdog has acted")
    parser.add_argument("--power-on", type=int, default=0, help="bits of the outputs after switching on")
    options = parser.parse_args()
    block = Block(options.model, options.watchdog_s, safe=options.safe, at_power_on=options.power_on)
    line = TcpLine([simulated_block(block)], options.port, Faults(), [block])
    await line.start()

    def ramp(channel: str, low: str, high: str, duration_s: str) -> None:
        block.ramps[int(channel)] = (block.clock(), float(low), float(high), float(duration_s))

    def loop(state: str) -> None:
        block.looped = state == "on"

    handlers = {
        **line.handlers(),
        "di": lambda channel, value: block.set_input(int(channel), int(value)),
        "ai": lambda channel, volts: ramp(channel, volts, volts, "0"),
        "ramp": ramp,
        "loop": loop,
        "foreign": lambda kind, value: block.foreign(kind, number(value)),
        "state": block.state,
    }
    await serve(f"127.0.0.1:{line.port}", handlers, line.close)


if __name__ == "__main__":
    asyncio.run(run())
