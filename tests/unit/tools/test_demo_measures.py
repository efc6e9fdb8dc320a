"""What the demo measures, on a machine that keeps it waiting."""

from __future__ import annotations

import time
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

from sioms.tools.demo import measure


class Beam:
    """A light beam whose edge comes while its client has no processor: before its wait has begun."""

    def __init__(self) -> None:
        self.edges = 0

    def read(self) -> int:
        return self.edges

    def move(self, position: float) -> None:
        self.edges += 1

    def wait_event(self, last: int | None = None, timeout: float = 0.0) -> Any:
        if last is None or last == self.edges:
            raise TimeoutError("no edge came")
        return SimpleNamespace(stamp_ns=time.monotonic_ns())


def test_an_edge_that_comes_before_the_wait_is_measured_too() -> None:
    beam = Beam()
    axis = SimpleNamespace(
        move=beam.move, read=lambda: SimpleNamespace(position=[0.0]), wait_until_idle=lambda timeout: None
    )

    @contextmanager
    def opened(name: str, mode: str = "r", timeout: float = 0.0) -> Any:
        yield beam if name == "beam0" else axis

    assert measure.edge_to_client(SimpleNamespace(open=opened), 3).trials == 3  # type: ignore[arg-type]
