"""A force/torque driver and its simulated sensor, on an invented clock and without a line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest
from steps_rig import carry_out

from sioms.protocol.flags import AnalogStatus
from sioms.sdk.driver import Driver
from sioms.sdk.exchange import Exchange, LinkError, Pause, Send, SideExchange, Step, Steps

SATURATED, INVALID, OVERRUN = (int(AnalogStatus[name]) for name in ("SATURATED", "INVALID", "OVERRUN"))
LOAD = (10.0, -20.0, 30.0, 1.0, -2.0, 3.0)


class Rig:
    """A driver and a sensor joined without a line, on one clock; keeps what was published and said."""

    def __init__(self, driver: type[Driver], table: dict[str, Any]) -> None:
        self.now_s = 50.0
        self.published: list[tuple[int, np.ndarray, int]] = []
        self.said: list[str] = []
        settings = msgspec.convert(table, driver.Settings)
        driver.describe("f0", settings)
        self.driver: Any = driver.variant(settings)("f0", settings, self)
        self.on_line: Callable[[bytes], bytes] = lambda data: b""
        self.side_line: Callable[[bytes], bytes] = lambda data: b""
        self.delay_s = 0.0002
        self.rest = b""

    def now(self) -> float:
        return self.now_s

    def log(self, level: str, text: str) -> None:
        self.said.append(f"{level}: {text}")

    def publish(self, block: Any, stamp_ns: int) -> None:
        self.published.append((stamp_ns, block.data.copy(), int(block.flags[0])))

    def arrive(self, data: bytes) -> int:
        return int(self.driver.feed(data, round((self.now_s + self.delay_s) * 1e9)))

    def do(self, steps: Steps) -> Any:
        """Carry out a hook, as the kit does it."""
        value = carry_out(steps, self._carry)
        rest, self.rest = self.rest, b""
        if rest:
            self.arrive(rest)  # what came behind a reply is fed, as the kit does it
        return value

    def _carry(self, step: Step) -> Any:
        match step:
            case Pause(duration_s):
                self.now_s += duration_s
            case Send(data):
                self.now_s += len(data) * 10 / 19200
                self.on_line(data)
            case SideExchange():
                return self._ask(step.exchange, self.side_line)
            case Exchange():
                return self._ask(step, self.on_line)
        return None

    def _ask(self, exchange: Exchange, send: Callable[[bytes], bytes]) -> Any:
        reply = send(exchange.data)
        size = exchange.want(reply)
        if size is None and not reply:
            raise LinkError("no reply")
        self.rest = b"" if size is None else reply[size:]
        return exchange.decode(reply if size is None else reply[:size])

    @property
    def data(self) -> list[float]:
        return [float(value) for value in self.published[-1][1]]

    @property
    def flags(self) -> int:
        return self.published[-1][2]


def steps_of(published: list[tuple[int, np.ndarray, int]]) -> np.ndarray:
    return np.diff([stamp for stamp, _, _ in published])


def check_refused(driver: type[Driver], table: dict[str, Any], words: str) -> None:
    """Check that a driver's description refuses a table with these words."""
    settings = msgspec.convert(table, driver.Settings)
    with pytest.raises(ValueError, match=words):
        driver.describe("f0", settings)
