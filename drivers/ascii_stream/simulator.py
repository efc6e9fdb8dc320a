"""A sensor board that prints its samples on a pty or TCP port: ``python -m sioms.drivers.ascii_stream.simulator --link
PATH``.

A load-cell amplifier of ``--columns`` channels as hobby boards are programmed: a banner before the first sample, a line
of counts for each sample, its own clock in the first column (``--time``), a 12-bit converter that clips. Each channel
follows its load with a lag of
first order. Commands on standard input, beside those of the line: ``load CHANNEL NEWTON``, ``say TEXT`` (a line of
one's own: a comment, a cut line ...), ``lose COUNT`` (lines that are not sent), ``restart``, ``power_cycle [SECONDS]``,
``freeze [COUNT]`` (the last line again), ``hold on|off`` (lines go on, clock and readings stand still), ``foreign
start|stop 0`` (another host's word), ``state``.
"""

from __future__ import annotations

import argparse
import asyncio
import math
import random
import time
from collections.abc import Callable

from sioms.simulation import wire
from sioms.simulation.supply import Standstill, Supply

CLOCKS = {"none": 0.0, "us": 1e6, "ms": 1e3, "s": 1.0}
"""Counts of the board's clock in a second; seconds are printed with six digits."""
TOP = 4095
ZERO = 200
"""Counts without a load."""


class Board:
    """The board; times in seconds of the given clock."""

    def __init__(self, options: argparse.Namespace, clock: Callable[[], float] = time.monotonic) -> None:
        self.options, self.clock = options, clock
        self.loads = [0.0] * options.columns
        self.chance = random.Random(options.seed)
        self.lose = 0
        self._said: list[bytes] = []
        self._heard = b""
        self.held_s = 0.0
        self._body = ""
        self.supply, self.standstill = Supply(clock, self.boot), Standstill()
        self.restart()

    def restart(self) -> None:
        """Begin anew at once."""
        self.boot(self.clock())

    def boot(self, at_s: float) -> None:
        """Begin anew: clock and banner, or silent until the word comes that it waits for."""
        self.born_s = self.next_s = at_s
        self.felt = list(self.loads)
        self.lines = 0
        self.runs = False
        self._said.clear()
        if not self.options.wait_for:
            self._run(at_s)

    def _run(self, at_s: float) -> None:
        """Greet and begin to send."""
        self.runs, self.next_s = True, at_s
        if self.options.banner:
            self.say(f"# {self.options.banner}")

    def say(self, text: str) -> None:
        """Print a line."""
        self._said.append((text + ("\r\n" if self.options.crlf else "\n")).encode())

    def connected(self) -> list[bytes]:
        """Nothing: it does not know."""
        return []

    def take(self, data: bytes) -> list[bytes]:
        """Obey the word that starts it, and the letter that ends it."""
        if not self.supply.is_on:
            return []
        self._heard = (self._heard + data)[-200:]
        *lines, self._heard = self._heard.split(b"\n")
        for line in lines:
            if line.strip() == self.options.wait_for.encode() and line.strip():
                self._run(self.clock())
            elif line.strip() == b"x":
                self.runs = False
        return []

    def due(self) -> list[bytes]:
        """Return the lines of the samples taken until now."""
        if not self.supply.is_on:
            return []
        while self.runs and self.next_s <= self.clock():
            self._sample(self.next_s)
            self.next_s += 1 / self.options.rate
        said, self._said = self._said, []
        return said

    def _sample(self, at_s: float) -> None:
        if self.held_s:
            self._print(self._body)
            return
        step = 1 - math.exp(-1 / self.options.rate / self.options.lag_s)
        self.felt = [felt + (load - felt) * step for felt, load in zip(self.felt, self.loads, strict=True)]
        counts = [
            round(ZERO + felt * self.options.counts_per_newton + self.chance.gauss(0, self.options.noise))
            for felt in self.felt
        ]
        words = [str(min(max(count, 0), TOP)) for count in counts]
        if self.options.time != "none":
            words.insert(0, self._time(at_s))
        self.lines += 1
        if self.lose:
            self.lose -= 1
            return
        body = self.options.separator.join(words)
        if self.options.checksum:
            check = 0
            for character in body.encode():
                check ^= character
            body += f"*{check:02X}"
        self._body = body
        self._print(body)

    def _print(self, body: str) -> None:
        self.say(self.standstill.bend(body.encode()).decode())

    def _time(self, at_s: float) -> str:
        """Return the board's clock, a counter of 32 bits."""
        passed_s = (at_s - self.born_s) * (1 + self.options.clock_ppm * 1e-6) + self.options.clock_start_s
        per_s = CLOCKS[self.options.time]
        if self.options.time == "s":
            return f"{passed_s % (2**32 / 1e6):.6f}"
        return str(int(passed_s * per_s) % 2**32)

    def handlers(self) -> dict[str, Callable[..., object]]:
        """Return the commands on standard input."""

        def load(channel: str, newton: str) -> None:
            self.loads[int(channel)] = float(newton)

        def lose(count: str) -> None:
            self.lose = int(count)

        def hold(word: str) -> None:
            self.held_s = self.clock() if word == "on" else 0.0

        def foreign(kind: str, value: str = "0") -> None:
            if kind not in ("start", "stop"):
                raise ValueError(f"{kind}; want one of start, stop")
            if kind == "start":
                self._run(self.clock())
            else:
                self.runs = False

        def state() -> dict[str, object]:
            return {"lines": self.lines, "felt": self.felt, "runs": self.runs, "on": self.supply.is_on}

        return {
            "load": load, "lose": lose, "state": state, "restart": self.restart, "hold": hold,
            "power_cycle": self.supply.cycle, "freeze": self.standstill.set, "foreign": foreign,
            "say": lambda *words: self.say(" ".join(words)),
        }  # fmt: skip


def options_parser() -> argparse.ArgumentParser:
    """Return the options."""
    parser = wire.parser("simulated sensor board that prints lines of numbers", tcp=True)
    parser.add_argument("--columns", type=int, default=2)
    parser.add_argument("--rate", type=float, default=80.0, help="lines per second")
    parser.add_argument("--time", choices=CLOCKS, default="none", help="unit of the time in the first column")
    parser.add_argument("--separator", default=",")
    parser.add_argument("--crlf", action="store_true")
    parser.add_argument("--checksum", action="store_true")
    parser.add_argument("--banner", default="load cells 1.4", help="comment before the first sample; '' for none")
    parser.add_argument("--wait-for", default="", help="send nothing before this word came in a line")
    parser.add_argument("--counts-per-newton", type=float, default=100.0)
    parser.add_argument("--lag-s", type=float, default=0.02)
    parser.add_argument("--noise", type=float, default=0.5, help="standard deviation [counts]")
    parser.add_argument("--clock-ppm", type=float, default=2000.0, help="a ceramic resonator's error")
    parser.add_argument("--clock-start-s", type=float, default=0.0)
    parser.add_argument("--seed", type=int, default=1)
    return parser


async def main() -> None:
    """Serve until told to end."""
    options = options_parser().parse_args()
    board = Board(options)
    await wire.run(board, options, board.handlers())


if __name__ == "__main__":
    asyncio.run(main())
