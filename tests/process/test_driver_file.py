"""A driver of one's own in a file beside the configuration: analog outputs, requests, failures in each of its hooks."""

from __future__ import annotations

import errno
import math
from collections.abc import Callable, Iterator

import pytest
from daemon_rig import Daemon, daemons, raises, wait_for

import sioms
from sioms.protocol.flags import Request

DRIVER = """
import errno
import msgspec
from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import AnalogBlock, BlockSpec, Description
from sioms.sdk.driver import Refusal, TickDriver
from sioms.sdk.exchange import LinkError

class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    opens_at: int = 1
    fails_at: int = 0

class Heater(TickDriver):
    Settings = Settings

    @classmethod
    def describe(cls, name, settings):
        channels = (ChannelInfo("left", "V", -10.0, 10.0), ChannelInfo("right", "V", None, 5.0))
        return Description((BlockSpec("", NodeClass.ANALOG, channels, True, safe=(0.5, None)),), 500.0)

    def __init__(self, name, settings, kit):
        super().__init__(name, settings, kit)
        self._block = AnalogBlock(self.describe(name, settings).blocks[0])
        self._wanted, self._opens, self._ticks = [0.0, 0.0], 0, 0

    @property
    def blocks(self):
        return (self._block,)

    def open(self):
        self._opens += 1
        if self._opens < self.settings.opens_at:
            raise LinkError(f"attempt {self._opens}: nobody there")

    def tick(self, now_ns):
        self._ticks += 1
        if self.settings.fails_at and self._ticks >= self.settings.fails_at:
            raise RuntimeError("bad day")
        self._block.data[:] = self._wanted

    def write_outputs(self, block, channels, values):
        if 3.0 in values:
            raise Refusal(errno.ENXIO, "3 V is unlucky; 2 or 4 would be right")
        for channel, value in zip(channels, values):
            self._wanted[channel] = value

    def ioctl(self, block, request, channels, argument):
        if request.name == "HOME":
            return [list(channels), argument]
        return super().ioctl(block, request, channels, argument)

DRIVER = Heater
"""
CONFIG = '[device.heat]\ndriver = "./heater.py"\n[device.late]\ndriver = "./heater.py"\nopens_at = 3\n'


@pytest.fixture(scope="module")
def heater() -> Iterator[Daemon]:
    with daemons() as start:
        yield start(CONFIG, files={"heater.py": DRIVER})


@pytest.fixture
def cell(heater: Daemon) -> Iterator[sioms.Workcell]:
    with heater.cell("tester") as opened:
        opened.reset()
        yield opened


def shows(node: sioms.AnalogNode, *values: float) -> None:
    wait_for(lambda: node.read().data == values, f"{values}")


def test_analog_outputs_are_checked_and_set(cell: sioms.Workcell) -> None:
    with cell.open("heat", "rw") as node:
        wait_for(lambda: node.set(1.5, 2.5), "set")
        shows(node, 1.5, 2.5)
        for value in (math.nan, math.inf, -math.inf):
            with raises(errno.EINVAL, "left", "finite"):
                node.set(value, 0.0)
            with raises(errno.EINVAL, "right", "finite"):
                node.set(0.0, value)
        for values, words in (
            ((10.5, 0.0), "10.5 V; want -10 to 10 V"),
            ((0.0, 5.5), "5.5 V; want -inf to 5 V"),
        ):
            with raises(errno.ERANGE, "heat", words):
                node.set(*values)
        with raises(errno.ENXIO, "3 V is unlucky"):
            node.set(3.0, 0.0)
        shows(node, 1.5, 2.5)
        with cell.open("heat.readonly") as seen, raises(errno.EBADF, "not open for writing"):
            seen.set(0.0, 0.0)


def test_each_output_becomes_safe_as_configured(cell: sioms.Workcell) -> None:
    with cell.open("heat.readonly") as seen:
        with cell.open("heat", "rw") as node:
            node.set(1.0, 2.0)
            shows(node, 1.0, 2.0)
        shows(seen, 0.5, 2.0)  # the second keeps its last value
        with cell.open("heat.left", "rw") as left, cell.open("heat.right", "rw") as right:
            left.set(4.0)
            right.set(4.0)
            shows(seen, 4.0, 4.0)
            cell.emergency_stop()
            shows(seen, 0.5, 4.0)
            with raises(errno.EPERM, "heat.right"):
                right.set(1.0)


def test_requests_go_to_the_driver_and_its_refusals_come_back(cell: sioms.Workcell) -> None:
    with cell.open("heat", "rw") as node:
        assert node.ioctl(Request.HOME, {"x": 1}) == [[0, 1], {"x": 1}]
        with raises(errno.ENOTTY, "CALIBRATE_DEVICE on heat"):
            node.ioctl(Request.CALIBRATE_DEVICE)
    with cell.open("heat.right", "rw") as node:
        assert node.ioctl(Request.HOME) == [[1], None]


def test_a_device_that_is_not_there_yet_is_tried_again(heater: Daemon, cell: sioms.Workcell) -> None:
    assert heater.wait_up("late")["generation"] == 1, "opened again by the same process"
    with cell.open("late", "rw") as node:
        node.set(1.0, 1.0)
        shows(node, 1.0, 1.0)


def test_a_driver_that_raises_ends_alone_and_says_why(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(
        CONFIG + '[device.bad]\ndriver = "./heater.py"\nfails_at = 100\n', files={"heater.py": DRIVER}
    )
    with daemon.cell() as cell:
        pid = daemon.device("heat")["pid"]
        daemon.said(r"driver failed: RuntimeError\(.bad day.\)")
        wait_for(lambda: daemon.device("bad")["state"] == "fault", "too many deaths")
        with raises(errno.EIO, "open bad", "fault"):
            cell.open("bad")
        with cell.open("heat", "rw") as node:
            node.set(1.0, 1.0)
            shows(node, 1.0, 1.0)
        assert daemon.device("heat")["pid"] == pid


def test_what_a_driver_tells_while_it_is_made_waits_for_room_and_not_for_the_daemon_to_say_something() -> None:
    """Whatever it told later waited behind that: faults, a lost link, its own stops."""
    made = "        super().__init__(name, settings, kit)\n"
    loud = "        for n in range(1000):\n            self.kit.log('info', f'line {n}')\n"
    with daemons() as start:
        rig = start(CONFIG.replace("3", "1000000"), files={"heater.py": DRIVER.replace(made, made + loud)})
        with rig.cell("tester") as cell:
            wait_for(lambda: cell.status()["devices"][1]["link"] == "link_lost", "link", 5.0)
