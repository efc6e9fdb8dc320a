"""The driver of GPIO lines on a fake chip, where there is none: everything above the binding is the real one.

The fake takes the place of ``gpiod.Chip`` and of what it requests; settings, values and events are the binding's
own classes. It does what the kernel's documents say of requests, active-low, sequence numbers and the event buffer (the
newest stay). Lines 0 to 7 drive lines 8 to 15, as wires would; ``LINES`` bears their names.
"""

from __future__ import annotations

import errno
import time
from collections import deque
from types import SimpleNamespace
from typing import Any

import gpiod
from gpiod.line import Direction, Edge, Value

from sioms.drivers.gpio.driver import Gpio

LINES = [f"OUT{i}" for i in range(8)] + [f"IN{i}" for i in range(8)]
levels = [0] * 16
"""Physical levels."""
requests: list[Request] = []


def set_level(offset: int, level: int, now_ns: int | None = None) -> None:
    """Change a physical level, and what is wired to it."""
    if levels[offset] != level:
        levels[offset] = level
        for request in requests:
            request.see(offset, level, now_ns or time.monotonic_ns())
    if offset < 8 and levels[offset + 8] != level:
        set_level(offset + 8, level, now_ns)


class Request:
    """Lines that are held."""

    def __init__(self, lines: dict[int, gpiod.LineSettings], consumer: str, event_buffer_size: int) -> None:
        self.lines, self.consumer = lines, consumer
        self.events: deque[gpiod.EdgeEvent] = deque(maxlen=event_buffer_size)
        self.number = 0
        self.of_line = dict.fromkeys(lines, 0)
        requests.append(self)
        for offset, settings in lines.items():
            if settings.direction is Direction.OUTPUT:
                set_level(offset, settings.output_value.value ^ settings.active_low)

    def see(self, offset: int, level: int, now_ns: int) -> None:
        settings = self.lines.get(offset)
        if settings is None or settings.edge_detection is not Edge.BOTH:
            return
        self.number, self.of_line[offset] = self.number + 1, self.of_line[offset] + 1
        kind = (
            gpiod.EdgeEvent.Type.RISING_EDGE if level ^ settings.active_low else gpiod.EdgeEvent.Type.FALLING_EDGE
        ).value
        self.events.append(gpiod.EdgeEvent(kind, now_ns, offset, self.number, self.of_line[offset]))

    def wait_edge_events(self, timeout: float) -> bool:
        assert timeout == 0, "a driver must not wait"
        return bool(self.events)

    def read_edge_events(self, max_events: int) -> list[gpiod.EdgeEvent]:
        return [self.events.popleft() for _ in range(min(max_events, len(self.events)))]

    def get_values(self, lines: list[int]) -> list[Value]:
        return [Value(levels[offset] ^ self.lines[offset].active_low) for offset in lines]

    def set_values(self, values: dict[int, Value]) -> None:
        for offset, value in values.items():
            assert self.lines[offset].direction is Direction.OUTPUT
            set_level(offset, value.value ^ self.lines[offset].active_low)

    def release(self) -> None:
        requests.remove(self)


class Chip:
    """The chip."""

    def __init__(self, path: str) -> None:
        if path != "/dev/gpiochip0":
            raise FileNotFoundError(errno.ENOENT, "No such file or directory")

    def close(self) -> None:
        pass

    def get_info(self) -> SimpleNamespace:
        return SimpleNamespace(num_lines=len(LINES))

    def get_line_info(self, offset: int) -> SimpleNamespace:
        consumer = next((r.consumer for r in requests if offset in r.lines), "")
        return SimpleNamespace(used=bool(consumer), name=LINES[offset], consumer=consumer)

    def line_offset_from_id(self, line: int | str) -> int:
        if isinstance(line, str):
            if line not in LINES:
                raise FileNotFoundError(errno.ENOENT, "No such file or directory")
            return LINES.index(line)
        if line >= len(LINES):
            raise ValueError("line offset of out range")
        return line

    def request_lines(self, config: dict[int, gpiod.LineSettings], consumer: str, event_buffer_size: int) -> Request:
        if any(offset in held.lines for held in requests for offset in config):
            raise OSError(errno.EBUSY, "Device or resource busy")
        return Request(config, consumer, event_buffer_size)


BINDING: Any = SimpleNamespace(Chip=Chip, LineSettings=gpiod.LineSettings, line=gpiod.line)


class GpioOnFakeChip(Gpio):
    """The driver with the fake below it."""

    binding = staticmethod(lambda: BINDING)


DRIVER = GpioOnFakeChip
