"""A driver's unit of axes and its simulated device, on an invented clock and without a line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
from steps_rig import carry_out

from sioms.protocol.markers import TABLE_SIZE, MarkerTable
from sioms.protocol.records import NodeClass, numpy_dtype
from sioms.sdk.driver import LineDriver
from sioms.sdk.exchange import Exchange, LinkError, Pause, Send, Step, Steps
from sioms.sdk.markers import Markers

LIMITS = {"velocity_max": 0.1, "acceleration_max": 1.0}
CHARACTER_S = 10 / 115200


class Joined:
    """Both, and what was sent.

    Args:
        driver: its class.
        table: of the device, without the line.
        make: makes the simulated device on a clock [s].

    Attributes:
        device: the simulated device; it outlives the driver.
        unit: of the present driver.
        sent: messages to the device.
    """

    def __init__(
        self, driver: type[LineDriver], table: dict[str, Any], make: Callable[[Callable[[], float]], Any]
    ) -> None:
        self.now_s = 50.0
        self.device = make(lambda: self.now_s)
        self.sent: list[bytes] = []
        self.markers = Markers(MarkerTable(memoryview(bytearray(TABLE_SIZE))), lambda number: None)
        self._driver, self._table = driver, {"line": {"serial": "/x", "baud": 115200}, **table}
        self.begin()

    def begin(self) -> None:
        """Make a new driver: the one before was killed, the device goes on."""
        settings = msgspec.convert(self._table, self._driver.Settings)
        driver = self._driver("mod0", settings, self)  # type: ignore[arg-type]
        self._overheard, self._recovery_s = driver.overheard, driver.recovery_s
        self.unit: Any = driver.units[0]
        self.unit.clock = lambda: round(self.now_s * 1e9)

    def log(self, level: str, text: str) -> None:
        """Take what the driver says."""

    def command(self, **fields: Any) -> None:
        """Write one command to the bank, as a client does, and send what it wants sent."""
        record = np.zeros(1, numpy_dtype(NodeClass.AXIS))
        for name, value in fields.items():
            record[name] = value
        self.unit.bank.append(record, [0], self.unit.clock())
        self._act()

    def poll(self, count: int = 1, pause_s: float = 0.02) -> None:
        """Poll some times, and send what the bank wants sent, as the kit does."""
        for _ in range(count):
            self.wait(pause_s)
            self.do(self.unit.poll())
            self._act()

    def _act(self) -> None:
        for action in self.unit.bank.take_actions():
            self.do(self.unit.act(action))
            self.unit.bank.action_done(action, self.unit.clock())

    def wait(self, seconds: float, look: Callable[[], object] = lambda: None) -> None:
        """Let time pass, and look at each millisecond."""
        for _ in range(round(seconds * 1000)):
            if said := self.go_on(look):
                self._hear(said)

    def do(self, steps: Steps, look: Callable[[], object] = lambda: None) -> None:
        """Carry out a hook as the kit does; characters take their time."""
        carry_out(steps, lambda step: self._carry(step, look))

    def _carry(self, step: Step, look: Callable[[], object]) -> Any:
        if isinstance(step, Pause):
            self.wait(step.duration_s, look)
            return None
        assert isinstance(step, Send | Exchange)
        self.sent.append(step.data)
        self.wait(max(0.001, len(step.data) * CHARACTER_S), look)
        reply = b"".join(self.device.take(step.data))
        self.wait(len(reply) * CHARACTER_S, look)
        if isinstance(step, Exchange):
            return self._decoded(step, reply, look)
        if reply:
            self._hear(reply)
        return None

    def go_on(self, look: Callable[[], object] = lambda: None) -> bytes:
        """Let a millisecond pass; return what the device says unasked."""
        self.now_s += 0.001
        said = b"".join(self.device.due() or ())
        look()
        return said

    def _hear(self, said: bytes) -> None:
        if self._overheard is not None:
            self._overheard(said, round(self.now_s * 1e9))

    def _decoded(self, exchange: Any, reply: bytes, look: Callable[[], object]) -> Any:
        until_s = self.now_s + exchange.timeout_s
        while (size := exchange.want(reply)) is None or size > len(reply):
            if self.now_s >= until_s:
                if reply:
                    self._hear(reply)
                self.wait(self._recovery_s)
                raise LinkError("no reply")
            reply += self.go_on(look)
        if rest := reply[size:]:
            self._hear(rest)
        return exchange.decode(reply[:size])
