"""Dynamixel: the driver under the real daemon against simulated servos, and the vendor's client against those."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import at_rest, raises, wait_for
from wire_rig import Wire

from sioms.protocol.flags import AxisStatus

CONFIG = """
[device.arm0]
driver = "dynamixel"
line = { serial = "{port}", baud = 1000000 }
watchdog_s = 1.0
poll_hz = 30.0
[[device.arm0.axis]]
name = "a"
id = 1
model = 1020
unit = "rad"
zero = 2048
velocity_max = 6.0
acceleration_max = 20.0
[[device.arm0.axis]]
name = "b"
id = 2
mode = "velocity"
unit = "rad"
travel_per_turn = -6.283185307179586
velocity_max = 6.0
acceleration_max = 20.0
[[device.arm0.axis]]
name = "gone"
id = 9
unit = "rad"
velocity_max = 6.0
acceleration_max = 20.0
"""

OTHER = """
[[device.arm0.axis]]
name = "other"
id = 3
model = 1030
unit = "rad"
velocity_max = 6.0
acceleration_max = 20.0
"""


def test_modes_stops_and_shutdown(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Wire(start, short_folder, "dynamixel.simulator", "--ids", "1,2,3")
    cell = wire.serve(CONFIG + OTHER)
    wire.wait_up("arm0.a")
    wire.wait_up("arm0.b")
    wire.daemon.wait_line("model 1020")  # of the third, which should be another
    assert not wire.reads("arm0.other")
    assert (wire.state("mode", 1), wire.state("mode", 2), wire.state("watchdog", 1)) == (4, 1, 50)
    with cell.open("arm0.b", "rw") as b:
        b.command(velocity=3.0)
        wait_for(lambda: b.read().velocity[0] > 2.8, "motion")
        assert wire.state("velocity", 2) < -1800
        with raises(22, "cannot do POSITION"):
            b.move(1.0)
        b.stop()
        at_rest(b)
    with cell.open("arm0.a", "rw") as a:
        a.move(6.5)  # beyond one turn
        a.wait_until_idle(15.0)
        assert a.read().position[0] == pytest.approx(6.5, abs=0.002)
        assert wire.state("position", 1) == pytest.approx(2048 + 6.5 / 6.283185 * 4096, abs=1)
        # a stop brakes and holds; an emergency stop frees the shaft, and the next command takes it again
        a.move(0.0)
        wait_for(lambda: wire.state("velocity", 1) < -1000, "motion")
        a.stop()
        at_rest(a)
        assert wire.state("torque", 1) == 1 and a.read().position[0] > 0.5
        a.stop_all()
        wait_for(lambda: wire.state("torque", 1) == 0, "the torque off", 2.0)
        a.reset()
        a.move(0.2)
        a.wait_until_idle(15.0)
        assert wire.state("torque", 1) == 1
        # a shutdown is named, and cleared by the restart that RESET brings
        wire.tell("hardware 32 1")
        wait_for(lambda: a.read().status[0] & AxisStatus.FAULT, "the fault")
        with raises(5, "overload"):
            a.move(0.0)
        a.reset()
        wait_for(lambda: not a.read().status[0] & AxisStatus.FAULT, "the restart")
        a.move(0.0)
        a.wait_until_idle(15.0)
    assert not wire.reads("arm0.gone")


def test_the_vendors_client_agrees_with_the_simulator(
    start: Callable[..., Any], short_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sdk = pytest.importorskip("dynamixel_sdk")
    # it asks once and waits 34 ms, turning without a pause: a simulator that has to wait for a processor is no mute one
    monkeypatch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", 1000)
    wire = Wire(start, short_folder, "dynamixel.simulator", "--ids", "1,2")
    port, packets = sdk.PortHandler(wire.port), sdk.PacketHandler(2.0)
    assert port.openPort() and port.setBaudRate(57600)
    assert packets.ping(port, 1) == (1020, 0, 0)
    assert packets.write1ByteTxRx(port, 1, 64, 1) == (0, 0)
    assert packets.write1ByteTxRx(port, 1, 11, 4)[1] == 7  # EEPROM, torque on: access
    assert packets.write4ByteTxRx(port, 1, 116, 3000) == (0, 0)
    wait_for(lambda: packets.read4ByteTxRx(port, 1, 132)[0] == 3000, "the position")
    group = sdk.GroupSyncRead(port, packets, 132, 4)
    assert group.addParam(1) and group.addParam(2) and group.txRxPacket() == 0
    assert (group.getData(1, 132, 4), group.getData(2, 132, 4)) == (3000, 2048)
    port.closePort()
