"""Which engine a driver has."""

from __future__ import annotations

from .driver import Driver, LineDriver, StreamDriver, TickDriver
from .engine import Engine
from .line_engine import LineEngine
from .parts import Parts
from .stream_engine import StreamEngine
from .tick_engine import TickEngine


def make_engine(parts: Parts, driver: Driver, tick_hz: float) -> Engine:
    """Return the engine for a driver of one of the three kinds.

    Raises:
        TypeError: it is of none of them.
    """
    if isinstance(driver, TickDriver):
        return TickEngine(parts, driver, tick_hz)
    if isinstance(driver, LineDriver):
        return LineEngine(parts, driver, tick_hz)
    if isinstance(driver, StreamDriver):
        return StreamEngine(parts, driver)
    raise TypeError(f"{type(driver).__name__} is not a TickDriver, LineDriver or StreamDriver")
