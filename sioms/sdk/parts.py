"""The parts of a driver process, as they are handed to those that work with them; none of them knows the process.

The loop (runtime.py) makes each part once and owns it. A part takes what it needs when it is made: what engines need is
Parts, what the requests of clients need is Service.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from msgspec import Struct

from .blocks import AnyBlock
from .driver import Driver
from .effects import Effects
from .engine import Engine, Loop
from .handles import Waits
from .outputs import Outputs
from .pages import Pages
from .stops import Stops

Log = Callable[[str, str], None]
"""Write a line, of a level, to the daemon's log."""


class Report(Protocol):
    """What GET_STATISTICS tells."""

    def __call__(self, uid: int, last: int, *, fresh: bool) -> dict[str, object] | None:
        """Return it; None when it is not ``fresh`` and may be made only between ticks, or a user has had his turn."""


class Parts(Struct, frozen=True):
    """What an engine works with."""

    loop: Loop
    blocks: Sequence[AnyBlock]
    outputs: Outputs
    effects: Effects
    waits: Waits
    pages: Pages
    stops: Stops
    log: Log


class Service(Parts, frozen=True):
    """What the requests of clients work with."""

    driver: Driver
    engine: Engine
    statistics: Report
