"""A driver that raises in mid-motion: the stop is sent before the process ends, also on a line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from daemon_rig import wait_for
from wire_rig import SLIDE, Wire

DRIVER = '''
import os
from sioms.drivers.modbus.axis import ModbusAxis
from sioms.sdk.exchange import LinkError


class Failing(ModbusAxis):
    """Raises in a poll once a file is there."""

    def __init__(self, name, settings, kit):
        super().__init__(name, settings, kit)
        for unit in self.units:
            poll, open_ = unit.poll, unit.open

            def failing(poll=poll):
                yield from poll()
                if os.path.exists("{folder}/fail"):
                    os.rename("{folder}/fail", "{folder}/failed")
                    raise ZeroDivisionError("as planned")

            def opening(open_=open_):
                # The next process must not be the one that stops the drive.
                if os.path.exists("{folder}/failed"):
                    raise LinkError("out of order")
                return open_()

            unit.poll, unit.open = failing, opening


DRIVER = Failing
'''


def test_a_driver_that_raises_sends_the_stop_first(start: Any, short_folder: Path) -> None:
    wire = Wire(start, short_folder, "modbus.simulated.leadshine")
    (short_folder / "failing.py").write_text(DRIVER.replace("{folder}", str(short_folder)))
    wire.serve(SLIDE.replace('"modbus-axis"', '"./failing.py"'))
    wire.wait_up("slide0")
    # A path goes on to its end by itself: only a stop that is sent can end it early.
    axis = wire.client.open("slide0", "rw")
    axis.move(1.0, max_velocity=0.05, max_acceleration=1.0)
    wait_for(lambda: wire.state("moving") == 1, "the drive moving")
    (short_folder / "fail").touch()
    wire.daemon.wait_line("driver failed", 10.0)
    wait_for(lambda: wire.state("moving") == 0, "the drive at rest", 2.0)
    assert wire.state("feedback") < 0.5 / 0.01 * 10000
    assert any("ZeroDivisionError" in line for line in wire.daemon.lines)


WRITER = '''
from sioms.drivers.sim.io import SimIo


class Careless(SimIo):
    """Raises what a client's own mistake would raise, in a write."""

    def write_outputs(self, block, channels, values):
        if values[0] == 5:
            {}["outputs"]
        super().write_outputs(block, channels, values)


DRIVER = Careless
'''


def test_an_exception_in_a_write_is_told_as_the_drivers_with_its_place(start: Any, short_folder: Path) -> None:
    (short_folder / "careless.py").write_text(WRITER)
    wire = Wire(start, short_folder, "modbus.simulated.leadshine")
    wire.serve('[device.io0]\ndriver = "./careless.py"\noutputs = 4\nsafe = 0\n')
    wire.wait_up("io0")
    node, pid = wire.client.open("io0", "rw"), wire.pid("io0")
    node.set(3)
    with pytest.raises(OSError, match="io0") as caught:
        node.set(5)
    assert "malformed" not in str(caught.value)
    line = wire.daemon.wait_line("driver failed", 10.0).string
    assert "KeyError('outputs')" in line and "write_outputs" in line and "careless.py" in line
    assert not any("malformed" in each for each in wire.daemon.lines)
    wait_for(lambda: wire.pid("io0") not in (0, pid), "a new driver")
    wire.wait_up("io0")
