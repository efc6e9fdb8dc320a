"""A recorded flight is ended once, and whoever ends it finds the recording whole."""

from __future__ import annotations

import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from sioms.bridges.bluesky.flying import FlyScan


def test_whoever_ends_a_flight_waits_for_the_end_of_its_recording(tmp_path: Path) -> None:
    """A plan that is paused ends it in one thread while its completion ends it in another."""
    scan = FlyScan(cast("Any", SimpleNamespace(name="x", check_value=float)), [], 0.0, 0.1, 1.0, tmp_path)
    packed = threading.Event()
    scan._thread = threading.Thread(target=packed.wait, daemon=True)
    scan._thread.start()
    enders = [threading.Thread(target=scan.cancel, daemon=True) for _ in range(2)]
    for ender in enders:
        ender.start()
    enders[1].join(0.2)
    assert all(ender.is_alive() for ender in enders), "the recording is not whole yet"
    packed.set()
    for ender in enders:
        ender.join(20.0)
    assert not any(ender.is_alive() for ender in enders)
    scan.cancel()  # and once more is no harm
