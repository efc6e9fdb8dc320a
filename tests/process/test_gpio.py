"""GPIO lines under the real daemon where there is no chip; what needs one is in tests/kernel."""

from __future__ import annotations

from collections.abc import Callable

from daemon_rig import Daemon, wait_for

CONFIG = """
[workcell]
name = "gpio"
[device.io0]
driver = "gpio"
chip = "/dev/gpiochip-none"
[[device.io0.output]]
line = 0
"""


def test_a_missing_chip_is_said_and_waited_for(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(CONFIG)
    daemon.said("open /dev/gpiochip-none: no such chip; gpiodetect lists those there are")
    wait_for(lambda: daemon.device("io0")["link"] == "link_lost", "the link's state")
    assert daemon.device("io0")["state"] == "up", "its process lives and tries again"
