"""Arm and mill over axes that go at the velocities they are told: straight lines, ends of reach, refusals."""

from __future__ import annotations

import errno
import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from motion_rig import Markers, records

from sioms.drivers.compound.arm import ArmDriver
from sioms.drivers.compound.mill import MillDriver
from sioms.motion import CommandError
from sioms.protocol.flags import ControlMode
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.exchange import LinkError

TICK_NS = 2_000_000
DTYPE = np.dtype([("value", float), ("force", float), ("commanded_velocity", float), ("status", np.uint32)])
EXAMPLES = Path(__file__).resolve().parents[3] / "drivers" / "compound"


class Held:
    """The axes of a device of an example, without inertia."""

    is_there = True
    shows_reset_ns = 0

    def __init__(self, name: str, table: dict[str, Any]) -> None:
        self.name, axes = name, table["axis"]
        self.channels = tuple(
            ChannelInfo(
                axis["name"], axis["unit"], axis["position_min"], axis["position_max"], 0, 0,
                {"velocity": axis["velocity_max"]}, "",
            )
            for axis in axes
        )  # fmt: skip
        self.at = [axis["motor"].get("start", 0.0) for axis in axes]
        self.rates = [0.0 for _ in axes]
        self.stamp_ns = self.as_of_ns = 0

    def drive(self, velocities: Sequence[float]) -> None:
        self.rates = list(velocities)

    def stop(self) -> None:
        self.rates = [0.0 for _ in self.rates]

    def trouble(self) -> None:
        return None

    def read(self, now_ns: int) -> Any:
        self.stamp_ns = self.as_of_ns = now_ns
        return np.array([(at, 0.0, rate, 0) for at, rate in zip(self.at, self.rates, strict=True)], DTYPE)


class Machine:
    """A machine of an example; ``run`` ticks it."""

    def __init__(self, kind: Any, name: str, **start: float) -> None:
        devices = tomllib.loads((EXAMPLES / f"{name}.toml").read_text(encoding="utf-8"))["device"]
        keys = {key: value for key, value in devices.pop(name).items() if key != "driver"}
        self.held = [Held(one, table) for one, table in devices.items()]
        for one in self.held:
            one.at = [start.get(channel.name, at) for channel, at in zip(one.channels, one.at, strict=True)]
        nodes = {one.name: one for one in self.held}
        self.now_ns = 1_000_000_000
        kit: Any = SimpleNamespace(markers=Markers(), held=nodes, now_ns=lambda: self.now_ns, inputs=nodes)
        self.driver = kind(name, msgspec.convert(keys, kind.Settings), kit)
        self.bank = self.driver.bank
        self.driver.open()
        self.run(0.01)

    def run(self, seconds: float) -> Any:
        """Return the coordinates in every tick, shape (ticks, n)."""
        shown = []
        for _ in range(round(seconds * 1e9 / TICK_NS)):
            self.now_ns += TICK_NS
            for one in self.held:
                one.at = [at + rate * TICK_NS * 1e-9 for at, rate in zip(one.at, one.rates, strict=True)]
            self.driver.tick(self.now_ns)
            shown.append(list(self.bank.rows["position"]))
        return np.array(shown)

    def go(self, axis: int, **fields: Any) -> None:
        self.bank.append(records(axis=axis, **fields), list(range(self.bank.n)), self.now_ns)

    def admit(self, axis: int, position: float) -> None:
        """Have the driver judge a target, as it judges every write before anything is taken."""
        found = records(axis=axis, mode=ControlMode.POSITION, position=position)
        self.driver.admit([tuple(record) for record in found.tolist()], list(range(self.bank.n)))

    @property
    def at(self) -> list[float]:
        return [float(position) for position in self.bank.rows["position"]]


def test_an_arm_goes_straight_while_its_joints_turn() -> None:
    arm = Machine(ArmDriver, "arm")
    begin, joints = arm.at, list(arm.held[0].at)
    arm.go(1, mode=ControlMode.VELOCITY, velocity=-0.1)
    shown = arm.run(2.0)
    assert shown[-1, 1] < begin[1] - 0.18
    assert np.abs(shown[:, [0, 2, 3]] - np.array(begin)[[0, 2, 3]]).max() < 2e-5, "the other coordinates stay"
    assert abs(arm.held[0].at[0] - joints[0]) > 0.2 and not arm.bank.fault_text(0)


def test_an_arm_ends_before_it_is_stretched_and_comes_back() -> None:
    arm = Machine(ArmDriver, "arm")
    arm.go(0, mode=ControlMode.VELOCITY, velocity=0.1)
    arm.run(4.0)
    _, most = arm.driver.transform(arm.driver.settings).span_m
    assert most - 2e-3 < math.hypot(*arm.at[:2]) <= most + 1e-9
    assert arm.held[0].rates == [0.0] * 4 and not arm.bank.fault_text(0)
    arm.go(0, mode=ControlMode.VELOCITY, velocity=-0.1)
    arm.run(0.5)
    assert math.hypot(*arm.at[:2]) < most - 0.02


def test_targets_out_of_an_arms_reach_are_refused() -> None:
    arm = Machine(ArmDriver, "arm")
    arm.admit(0, 0.4)
    for axis, position, words in (
        (0, 0.6, "from the shoulder; want"), (2, 0.3, "axis joints: lift would be at"),
        (3, 7.0, "axis joints: wrist would be at"),
    ):  # fmt: skip
        with pytest.raises(CommandError, match=words) as refused:
            arm.admit(axis, position)
        assert refused.value.errno == errno.ERANGE


def test_an_arm_that_is_found_stretched_bends_and_one_bent_to_the_other_side_is_none() -> None:
    arm = Machine(ArmDriver, "arm", elbow=0.02)
    x, y = arm.at[:2]
    with pytest.raises(CommandError, match="from the shoulder"):
        arm.admit(0, 1.01 * x)
    arm.admit(0, 0.9 * x)
    arm.go(0, mode=ControlMode.POSITION, position=0.8 * x)
    arm.go(1, mode=ControlMode.POSITION, position=0.8 * y)
    arm.run(4.0)
    assert arm.at[:2] == pytest.approx([0.8 * x, 0.8 * y], abs=1e-4)
    with pytest.raises(LinkError, match="bent to the right"):
        Machine(ArmDriver, "arm", elbow=-0.5)


def test_the_tip_stays_in_the_workpiece_while_the_table_tilts_and_turns() -> None:
    mill = Machine(MillDriver, "mill")
    mill.go(0, mode=ControlMode.POSITION, position=0.05)
    mill.run(2.0)
    begin = mill.at
    mill.go(3, mode=ControlMode.POSITION, position=0.3)
    mill.go(4, mode=ControlMode.VELOCITY, velocity=0.4)
    shown = mill.run(3.0)
    assert shown[-1, 3] == pytest.approx(0.3, abs=1e-3) and shown[-1, 4] > 0.8
    assert np.abs(shown[:, :3] - np.array(begin)[:3]).max() < 5e-5
    with pytest.raises(CommandError, match="bring table and spindle together"):
        mill.admit(3, 1.3)
    with pytest.raises(CommandError, match=r"axis spindle: [xy] would be at"):
        mill.admit(0, 1.0)
