"""A device in the network has one driver on this machine, whatever daemons there are."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable

from daemon_rig import Daemon, wait_for

SCALE = (
    '[device.scale0]\ndriver = "ascii-stream"\nline = {{ tcp = "127.0.0.1:{port}" }}\ncolumns = ["a"]\nrate_hz = '
    "100.0\n"
)


def why(daemon: Daemon) -> str:
    """Return what the daemon says of the device's link."""
    return str(daemon.device("scale0").get("link_reason", ""))


def test_two_daemons_do_not_drive_one_device(start_daemon: Callable[..., Daemon], free_port: Callable[[], int]) -> None:
    text = SCALE.format(port=free_port())
    first = start_daemon(text)
    wait_for(lambda: "refused" in why(first), "the first has tried to connect")
    second = start_daemon(text)
    driver = first.device("scale0")["pid"]
    wait_for(
        lambda: f"pid {driver} (sioms:scale0, uid {os.getuid()}) has it" in why(second),
        "the second is told who",
    )
    os.kill(driver, signal.SIGKILL)
    wait_for(lambda: first.device("scale0")["generation"] == 2, "the driver is started again")
    assert first.terminate() == 0
    wait_for(lambda: "refused" in why(second), "the lock has ended with its daemon")
