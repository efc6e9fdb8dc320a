"""The linear stage of ``linear_stage.py``, simulated: ``python linear_stage_device.py --link PATH``.

Written from its manual, not from the driver: a carriage with limited acceleration, limit switches, a watchdog.
Commands on standard input, beside those of the line (mute, noise, cut, unplug ...): ``place METRES``, ``state``.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable

from sioms.simulation import wire

SWITCHES = (-300_000.0, 300_000.0)
FASTEST = 200_000.0
TICK_S = 0.001


class Stage:
    """The stage; steps and seconds of the given clock."""

    def __init__(self, model: str, clock: Callable[[], float] = time.monotonic) -> None:
        self.model, self.clock = model, clock
        self.position = self.velocity = 0.0
        self.target: float | None = None
        self.wanted, self.rate = 0.0, 1e6
        self.fault, self.watchdog_s = 0, 0.0
        self.heard_s = self.seen_s = clock()
        self._line = b""

    def connected(self) -> list[bytes]:
        """Nothing: a serial line tells nobody."""
        return []

    def due(self) -> list[bytes]:
        """Let time pass."""
        now_s = self.clock()
        if self.watchdog_s and now_s - self.heard_s > self.watchdog_s:
            self._run(0.0)
        while self.seen_s + TICK_S <= now_s:
            self.seen_s += TICK_S
            self._step()
        return []

    def _step(self) -> None:
        wanted = self.wanted
        if self.target is not None:
            left = self.target - self.position
            wanted = math.copysign(min(self.wanted, math.sqrt(2 * self.rate * abs(left))), left)
            if abs(left) < 1.0 and abs(self.velocity) <= 2 * self.rate * TICK_S:
                self.position, self.velocity, self.target, self.wanted = self.target, 0.0, None, 0.0
                return
        change = self.rate * TICK_S
        self.velocity += min(max(wanted - self.velocity, -change), change)
        self.position += self.velocity * TICK_S
        if not SWITCHES[0] <= self.position <= SWITCHES[1]:
            self.position = min(max(self.position, SWITCHES[0]), SWITCHES[1])
            self.fault, self.velocity = 1, 0.0
            self._run(0.0)

    def _run(self, velocity: float) -> None:
        self.target, self.wanted = None, velocity

    def take(self, data: bytes) -> list[bytes]:
        """Answer lines."""
        self.due()
        *lines, self._line = (self._line + data)[-1000:].split(b"\n")
        answers = [answer for line in lines if (answer := self._answer(line.decode("latin-1"))) is not None]
        return [f"{answer}*{sum(answer.encode()) % 256:02X}\n".encode() for answer in answers]

    def _answer(self, line: str) -> str | None:
        body, _, check = line.strip().rpartition("*")
        if check != f"{sum(body.encode('latin-1')) % 256:02X}":
            return None
        self.heard_s = self.clock()
        verb, *words = body.split()
        try:
            numbers = [int(word) for word in words]
        except ValueError:
            return "NO 1"
        match verb, numbers:
            case "ID?", []:
                return f"{self.model},1.04"
            case "ST?", []:
                letter = "F" if self.fault else "M" if self.velocity or self.target is not None else "I"
                return f"{letter} {round(self.position)} {round(self.velocity)} {self.fault}"
            case "MV" | "RV", _ if self.fault:
                return "NO 3"
            case "MV", [target, velocity, rate] if 0 < velocity <= FASTEST and rate > 0:
                self.target, self.wanted, self.rate = float(target), float(velocity), float(rate)
                return "OK"
            case "RV", [velocity, rate] if abs(velocity) <= FASTEST and rate > 0:
                self._run(float(velocity))
                self.rate = float(rate)
                return "OK"
            case "HA", [rate] if rate > 0:
                self._run(0.0)
                self.rate = float(rate)
                return "OK"
            case "WD", [milliseconds] if 0 <= milliseconds <= 10_000:
                self.watchdog_s = milliseconds / 1000
                return "OK"
            case "CE", []:
                self.fault = 0
                return "OK"
            case "MV" | "RV" | "HA" | "WD", _:
                return "NO 2"
        return "NO 1"

    def handlers(self) -> dict[str, Callable[..., object]]:
        """Return the commands on standard input."""

        def place(metres: str) -> None:
            self.position = float(metres) * 1e6

        def state() -> dict[str, object]:
            self.due()
            return {"position": self.position, "velocity": self.velocity, "watchdog_s": self.watchdog_s}

        return {"place": place, "state": state}


async def main() -> None:
    """Serve until told to end."""
    parser = wire.parser("simulated linear stage")
    parser.add_argument("--model", default="LINA-2")
    options = parser.parse_args()
    stage = Stage(options.model)
    await wire.run(stage, options, stage.handlers())


if __name__ == "__main__":
    asyncio.run(main())
