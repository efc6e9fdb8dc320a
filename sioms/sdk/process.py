"""The driver process of one device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from .driver import Driver
from .rt import name_process
from .runtime import Runtime


def run(
    driver: type[Driver],
    device: str,
    settings: Any,
    generation: int,
    options: Mapping[str, Any],
    fds: Sequence[int],
) -> int:
    """Be the driver process of a device; returns the exit status when the daemon says so or is gone.

    Args:
        driver: the driver's class.
        device: device name.
        settings: its validated settings.
        generation: number of this process among the device's.
        options: stop_sources, alarms, daemon_lease_s, lease_s, realtime_priority, user, phase of the tick [period],
            state_folder, stopped: what of the device is stopped, see ``Stops.restore``.
        fds: control socket, latch page, stop-request file, file of the requests taken, marker table, journal of stops,
            journal.
    """
    name_process(f"sioms:{device}")
    runtime = Runtime(driver, device, settings, generation, options, fds)
    return runtime.run(int(options["realtime_priority"]), str(options["user"]))
