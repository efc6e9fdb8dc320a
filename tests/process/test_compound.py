"""Devices made of devices, over real processes: they drive what they hold, alone, and all halt together."""

from __future__ import annotations

import errno
import importlib
import os
import random
import signal
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from daemon_rig import Daemon, axes, raises, reads, wait_for

import sioms

EXAMPLES = Path(__file__).resolve().parents[2] / "drivers" / "compound"
COORDINATE = """
[[device.bridge.axis]]
name = "{}"
velocity_max = {}
acceleration_max = {}
"""
CELL = (
    '[workcell]\nname = "gantry"\n'
    + axes("mod0", "y1", "y2")  # of one device: one that the machine keeps waiting would skew the bridge
    + axes("mod1", "x")
    + """
[device.bridge]
driver = "gantry"
axes = ["mod1.x", "mod0"]
span_m = 1.0
lease_s = 0.5
late_max_s = 0.5
history = 4096
"""
    + COORDINATE.format("x", 0.5, 4.0)
    + COORDINATE.format("y", 0.5, 4.0)
    + COORDINATE.format("skew", 0.1, 1.0)
)


SLOW = (
    CELL.replace("span_m = 1.0", "span_m = 1.0\ntick_hz = 2.0")
    .replace("lease_s = 0.5", "lease_s = 2.5\nhang_s = 2.5")
    .replace("acceleration_max = 4.0\n", "acceleration_max = 4.0\ngain = 0.1\n")
    .replace("acceleration_max = 1.0\n", "acceleration_max = 1.0\ngain = 0.1\n")
)


def go(node: sioms.Node, **fields: list[float]) -> None:
    """Write a command to each coordinate."""
    node.write([sioms.command(i, **{name: values[i] for name, values in fields.items()}) for i in range(3)])


def _good(node: sioms.Node) -> bool:
    try:
        return not int(np.bitwise_or.reduce(node.read().status)) & 0xC0
    except OSError:
        return False


def _recovered(cell: sioms.Workcell) -> sioms.Node:
    """Open the bridge again, reset it and wait until it is good."""
    node = cell.open("bridge", "rw", timeout=10.0)
    wait_for(lambda: reads(node), "the bridge has found its axes")
    node.reset()
    wait_for(lambda: _good(node), "the bridge is good")
    return node


def test_a_gantry_drives_what_it_holds_and_all_halt_together(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(CELL)
    with daemon.cell() as cell:
        daemon.wait_up("bridge")
        bridge = cell.open("bridge", "rw")
        with raises(errno.EBUSY, "mod0", "bridge"):
            cell.open("mod0", "rw", timeout=0.0)
        with cell.open("mod0.readonly", "r") as below, cell.open("mod1.readonly", "r") as beside:
            # motion through the map
            go(bridge, position=[0.2, 0.1, 0.005])
            bridge.wait_until_idle(10.0)
            half = 0.5 * np.tan(0.005)
            wait_for(lambda: np.allclose(below.read().position, [0.1 - half, 0.1 + half], atol=1e-4), "y1 and y2 there")
            wait_for(lambda: np.allclose(beside.read().position, [0.2], atol=1e-4), "x is there")
            wait_for(lambda: np.allclose(bridge.read().position, [0.2, 0.1, 0.005], atol=1e-4), "it is shown")
            # refused before anything moves: out of the reach of a held axis, and of the map
            with raises(errno.ERANGE, "mod1.x", "1.5"):
                go(bridge, position=[1.5, 0.1, 0.0])
            with raises(errno.ERANGE, "jam"):
                go(bridge, position=[0.2, 0.1, 0.02])
            # a velocity ends before the reach does
            go(bridge, position=[0.6, 0.1, 0.0])
            bridge.wait_until_idle(10.0)
            cell.open("bridge.x.readonly", "r").close()
            go(bridge, velocity=[0.5, 0.0, 0.0])
            with raises(errno.ERANGE, "end of reach", "mod1"):  # foreseen, or on a busy machine its own limit
                bridge.wait_until_idle(10.0)
            wait_for(lambda: max(map(abs, beside.read().velocity)) < 1e-3, "it stands")
            assert 0.9 < beside.read().position[0] <= 1.0005
            # an emergency stop of one held axis halts all; a reset of the bridge resets it, too
            go(bridge, velocity=[-0.1, -0.05, 0.0])
            time.sleep(0.2)
            cell.emergency_stop("mod1")
            wait_for(lambda: not _good(bridge), "the bridge is in fault")
            with raises(errno.EIO, "mod1", "emergency stop"):
                go(bridge, position=[0.5, 0.0, 0.0])
            wait_for(lambda: max(map(abs, below.read().velocity)) < 1e-3, "all halt")
            bridge.close()
            bridge = _recovered(cell)
            go(bridge, position=[0.5, 0.0, 0.0])
            bridge.wait_until_idle(10.0)
            # a client that goes away, and a driver that is killed
            go(bridge, velocity=[0.1, 0.1, 0.0])
            time.sleep(0.2)
            bridge.close()
            wait_for(lambda: max(map(abs, below.read().velocity)) < 1e-3, "all halt without their client")
            bridge = cell.open("bridge", "rw", timeout=5.0)
            go(bridge, velocity=[0.1, 0.1, 0.0])
            time.sleep(0.2)
            before = daemon.device("bridge")
            os.kill(before["pid"], signal.SIGKILL)
            wait_for(lambda: max(map(abs, below.read().velocity)) < 1e-3, "all halt without what holds them")
            daemon.wait_up("bridge", before["generation"] + 1)
            bridge.close()
            bridge = _recovered(cell)
            go(bridge, position=[0.5, 0.0, 0.0])
            bridge.wait_until_idle(10.0)
            go(bridge, velocity=[0.0, 0.1, 0.0])
            time.sleep(0.2)
            before = daemon.device("mod1")
            os.kill(before["pid"], signal.SIGKILL)
            wait_for(lambda: not _good(bridge), "the bridge is lost")
            with raises(errno.EIO, "mod1"):
                go(bridge, position=[0.5, 0.0, 0.0])
            wait_for(lambda: max(map(abs, below.read().velocity)) < 1e-3, "the others halt")
            bridge.close()
        daemon.wait_up("mod1", before["generation"] + 1)
        bridge = _recovered(cell)
        bridge.close()


def test_a_slow_one_stops_what_is_left_without_waiting_for_its_tick(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(SLOW)
    with daemon.cell() as cell:
        daemon.wait_up("bridge")
        bridge = cell.open("bridge", "rw")
        with cell.open("mod0.readonly", "r") as below:
            wait_for(lambda: reads(bridge), "the bridge has found its axes")
            go(bridge, velocity=[0.02, 0.02, 0.0])
            wait_for(lambda: max(map(abs, below.read().velocity)) > 0.01, "it moves")
            ticked_ns = bridge.read().stamp_ns
            wait_for(lambda: bridge.read().stamp_ns > ticked_ns, "a tick has just been")
            ticked_ns = bridge.read().stamp_ns
            os.kill(daemon.device("mod1")["pid"], signal.SIGKILL)
            wait_for(lambda: max(map(abs, below.read().velocity)) < 1e-3, "the others halt")
            assert below.read().stamp_ns - ticked_ns < 450_000_000, "a tick would come after half a second"


@pytest.mark.parametrize(
    ("name", "goal", "refused", "why"),
    [
        ("arm", [0.3, 0.05, 0.15, 0.3], [0.6, 0.0, 0.15, 0.3], "from the shoulder"),
        ("mill", [0.03, 0.02, 0.15, 0.2, -0.5], [0.03, 0.02, 0.15, 1.3, -0.5], "a tilt of 1.3 rad"),
    ],
)
def test_arm_and_mill_move_the_simulated_axes_of_their_examples(
    start_daemon: Callable[..., Daemon], name: str, goal: list[float], refused: list[float], why: str
) -> None:
    driver: Any = importlib.import_module(f"sioms.drivers.compound.{name}").DRIVER
    text = (EXAMPLES / f"{name}.toml").read_text(encoding="utf-8")
    daemon = start_daemon(text.replace('driver = "sim-axes"', 'driver = "sim-axes"\nlate_max_s = 0.5'))
    with daemon.cell() as cell:
        daemon.wait_up(name)
        with cell.open(name, "rw", timeout=10.0) as node:
            wait_for(lambda: reads(node), "it has found its axes")
            with raises(errno.ERANGE, why):
                _all(node, refused)
            _all(node, goal)
            node.wait_until_idle(20.0)
            wait_for(lambda: np.allclose(node.read().position, goal, atol=2e-4), "it is there")
            keys = {key: value for key, value in tomllib.loads(text)["device"][name].items() if key != "driver"}
            joints = driver.transform(msgspec.convert(keys, driver.Settings)).inverse(goal)
            below = [cell.open(f"{one}.readonly", "r") for one in keys["axes"]]
            wait_for(
                lambda: np.allclose([at for one in below for at in one.read().position], joints, atol=5e-4),
                "its axes are where the map says",
            )


@pytest.mark.parametrize(
    ("name", "middle", "reach"),
    [("slits", [0.0, 0.05], [0.02, 0.02]), ("mill", [0.03, 0.02, 0.15, 0.2, -0.5], [0.03, 0.03, 0.03, 0.1, 0.2])],
)
def test_what_a_compound_tells_at_rest_stands_where_it_is_told(
    start_daemon: Callable[..., Daemon], name: str, middle: list[float], reach: list[float]
) -> None:
    """Moves, turns and stops at random instants: at their ends it stands, and so do the axes that it holds."""
    text = (EXAMPLES / f"{name}.toml").read_text(encoding="utf-8")
    daemon = start_daemon(text.replace('driver = "sim-axes"', 'driver = "sim-axes"\nlate_max_s = 0.5'))
    chance, held = random.Random(1), tomllib.loads(text)["device"][name]["axes"]
    with daemon.cell() as cell:
        daemon.wait_up(name)
        below = [cell.open(f"{one}.readonly", "r") for one in held]
        with cell.open(name, "rw", timeout=10.0) as node:
            wait_for(lambda: reads(node), "it has found its axes")
            limits = np.array([channel.limits["velocity"] for channel in node.info.channels])
            for what in ("move", "move", "stop", "turn", "stop", "turn", "stop", "move"):
                _all(node, [m + chance.uniform(-r, r) for m, r in zip(middle, reach, strict=True)])
                if what != "move":
                    time.sleep(chance.uniform(0.0, 0.4))
                if what == "turn":
                    goal = [m + chance.uniform(-r, r) for m, r in zip(middle, reach, strict=True)]
                    node.write([sioms.command(i, position=at) for i, at in enumerate(goal)], replace=True)
                elif what == "stop":
                    node.stop()
                node.wait_until_idle(20.0)
                told, stood = node.read(), [at for one in below for at in one.read().position]
                assert not any(told.in_motion) and (np.abs(told.velocity) < 0.1 * limits).all(), what
                time.sleep(0.2)
                off = np.abs(np.array(node.read().position) - np.array(told.position))
                assert (off < 2e-3 * limits).all(), (what, off)
                assert np.allclose([at for one in below for at in one.read().position], stood, atol=2e-3), what


def _all(node: sioms.Node, position: list[float]) -> None:
    node.write([sioms.command(i, position=at) for i, at in enumerate(position)])
