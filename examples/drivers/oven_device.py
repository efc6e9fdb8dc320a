"""The oven controller of ``oven.toml``, simulated on Modbus RTU: ``python oven_device.py --link PATH``.

Written from its manual: two zones that warm towards what their heaters give, a two-point controller each, a watchdog
that switches the heaters off. Commands on standard input, beside those of the line: ``state``.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable

from pymodbus.constants import ExcCodes
from pymodbus.simulator import DataType, SimData, SimDevice

from sioms.drivers.modbus.simulated.lines import Asked, RtuLine, serial_parser, served
from sioms.simulation.control import serve
from sioms.simulation.faults import Faults

ROOM_C, HEATER_C, TIME_S = 20.0, 250.0, 2.0
"""Temperature of the room, what a heater would reach, and the time constant of a zone (a quick oven)."""
MODEL = 0x4F56


class Oven:
    """The controller; times in seconds of the given clock."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock = clock
        self.celsius, self.targets, self.on = [ROOM_C, ROOM_C], [0, 0], [0, 0]
        self.watchdog_s, self.heard_s, self.seen_s = 0.0, clock(), clock()

    def pass_time(self) -> None:
        """Warm and cool; look at the watchdog."""
        now_s = self.clock()
        part = 1 - math.exp((self.seen_s - now_s) / TIME_S)
        self.seen_s = now_s
        if self.watchdog_s and now_s - self.heard_s > self.watchdog_s:
            self.on = [0, 0]
        for i in (0, 1):
            heats = self.on[i] and self.celsius[i] < self.targets[i] / 10
            self.celsius[i] += ((HEATER_C if heats else ROOM_C) - self.celsius[i]) * part

    def registers(self) -> dict[int, int]:
        """Return the holding registers as they stand."""
        image = {0x0000: MODEL, 0x0030: round(self.watchdog_s * 10)}
        for i in (0, 1):
            image |= {0x0010 + i: round(self.celsius[i] * 10) & 0xFFFF, 0x0020 + i: self.targets[i]}
        return image

    def write(self, address: int, values: list[int]) -> ExcCodes | None:
        """Take registers."""
        for at, value in enumerate(values, address):
            if at in (0x0020, 0x0021) and value <= 3000:
                self.targets[at - 0x0020] = value
            elif at == 0x0030:
                self.watchdog_s = value / 10
            else:
                return ExcCodes.ILLEGAL_VALUE
        return None

    def state(self) -> dict[str, object]:
        """Return what a bystander sees."""
        self.pass_time()
        return {
            "celsius": self.celsius,
            "targets": self.targets,
            "on": self.on,
            "watchdog_s": self.watchdog_s,
        }


def simulated(oven: Oven) -> SimDevice:
    """Return pymodbus's device: coils of their own, and the same words for both kinds of registers."""

    def serve(asked: Asked) -> ExcCodes | None:
        oven.pass_time()
        oven.heard_s = oven.clock()
        if asked.values is not None:
            if asked.function in (5, 15):
                oven.on[asked.address : asked.address + len(asked.values)] = asked.values[: 2 - asked.address]
                return None
            return oven.write(asked.address, asked.values)
        if asked.function == 1:
            asked.current[0] = oven.on[0] | oven.on[1] << 1
        elif asked.function == 3:
            image, wanted = oven.registers(), range(asked.address, asked.address + asked.count)
            if any(at not in image for at in wanted):
                return ExcCodes.ILLEGAL_ADDRESS
            return asked.answer([image[at] for at in wanted])
        return None

    coils = [SimData(0, count=16, values=0, datatype=DataType.BITS)]
    words = [SimData(0, count=64, values=0, datatype=DataType.REGISTERS)]
    return served(1, (coils, coils, words, words), serve)


async def main() -> None:
    """Serve until told to end."""
    options = serial_parser("simulated oven controller").parse_args()
    oven = Oven()
    line = RtuLine([simulated(oven)], options.link, Faults(), baud=options.baud)
    await line.start()
    await serve(str(options.link or line.port.name), {**line.handlers(), "state": oven.state}, line.close)


if __name__ == "__main__":
    asyncio.run(main())
