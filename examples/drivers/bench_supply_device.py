"""The power supply of ``bench_supply.py``, simulated: ``python bench_supply_device.py --link PATH``.

Written from its manual, not from the driver: two outputs with a capacitor and a load each, a current limit, a watchdog.
Commands on standard input, beside those of the line (mute, noise, cut, unplug ...): ``load OUTPUT OHM``, ``state``.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable

from sioms.simulation import wire

HIGHEST_V, LIMIT_A = 30.0, 2.0
RISE_S = 0.05
"""Time constant of an output."""


class Supply:
    """The supply; times in seconds of the given clock."""

    def __init__(self, model: str, clock: Callable[[], float] = time.monotonic) -> None:
        self.model, self.clock = model, clock
        self.wanted, self.volts, self.ohms = [0.0, 0.0], [0.0, 0.0], [1e6, 1e6]
        self.watchdog_s = 0.0
        self.heard_s = self.seen_s = clock()
        self._line = b""

    def connected(self) -> list[bytes]:
        """Nothing: a serial line tells nobody."""
        return []

    def due(self) -> list[bytes]:
        """Let time pass: the outputs follow, the watchdog looks."""
        now_s = self.clock()
        part = 1 - math.exp((self.seen_s - now_s) / RISE_S)
        self.seen_s = now_s
        if self.watchdog_s and now_s - self.heard_s > self.watchdog_s:
            self.wanted = [0.0, 0.0]
        for i in (0, 1):
            self.volts[i] += (min(self.wanted[i], LIMIT_A * self.ohms[i]) - self.volts[i]) * part
        return []

    def take(self, data: bytes) -> list[bytes]:
        """Answer lines."""
        self.due()
        self.heard_s = self.clock()
        *lines, self._line = (self._line + data)[-1000:].split(b"\n")
        return [(self._answer(line.decode("latin-1").strip()) + "\n").encode() for line in lines]

    def _answer(self, line: str) -> str:
        verb, _, rest = line.partition(" ")
        try:
            numbers = [float(word) for word in rest.split(",")] if rest else []
        except ValueError:
            return "ERR 1"
        match verb, numbers:
            case "*IDN?", []:
                return f"TERN,{self.model},00417,1.08"
            case "MEAS?", []:
                return ";".join(self._measured(i) for i in (0, 1))
            case "VSET", [1.0 | 2.0 as output, volts]:
                if not 0 <= volts <= HIGHEST_V:
                    return "ERR 2"
                self.wanted[int(output) - 1] = volts
                return "OK"
            case "WDOG", [seconds] if 0 <= seconds <= 60:
                self.watchdog_s = seconds
                return "OK"
        return "ERR 1"

    def _measured(self, i: int) -> str:
        mode = "CC" if self.wanted[i] > LIMIT_A * self.ohms[i] else "CV"
        return f"{self.volts[i]:.3f},{self.volts[i] / self.ohms[i]:.3f},{mode}"

    def handlers(self) -> dict[str, Callable[..., object]]:
        """Return the commands on standard input."""

        def load(output: str, ohm: str) -> None:
            self.ohms[int(output) - 1] = float(ohm)

        def state() -> dict[str, object]:
            self.due()
            return {"wanted": self.wanted, "volts": self.volts, "watchdog_s": self.watchdog_s}

        return {"load": load, "state": state}


async def main() -> None:
    """Serve until told to end."""
    parser = wire.parser("simulated laboratory power supply")
    parser.add_argument("--model", default="PS-202")
    options = parser.parse_args()
    supply = Supply(options.model)
    await wire.run(supply, options, supply.handlers())


if __name__ == "__main__":
    asyncio.run(main())
