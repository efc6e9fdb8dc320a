"""A device made of devices on one thread: what it tells the axes that it holds."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from motion_rig import Markers, records

from sioms.drivers.compound.slits import SlitsDriver
from sioms.protocol.flags import AxisStatus, ControlMode
from sioms.protocol.nodeinfo import ChannelInfo

TICK_NS = 2_000_000
DTYPE = np.dtype([("value", float), ("force", float), ("status", np.uint32)])


class Blades:
    """Two held axes that go at the velocities they are told, up to where something is in the way."""

    name = "blades"
    is_there = True
    channels = tuple(ChannelInfo(name, "m", -1.0, 1.0, 0, 0, {"velocity": 1.0}, "") for name in ("minus", "plus"))

    def __init__(self) -> None:
        self.at, self.rates, self.most, self.stamp_ns = [-0.1, 0.1], [0.0, 0.0], [1.0, 1.0], 0

    def drive(self, velocities: Sequence[float]) -> None:
        self.rates = list(velocities)

    def stop(self) -> None:
        self.rates = [0.0, 0.0]

    def reset(self) -> None: ...

    def trouble(self) -> None: ...

    def read(self, now_ns: int) -> Any:
        self.stamp_ns = now_ns
        return np.array([(value, 0.0, 0) for value in self.at], DTYPE)

    def go_on(self) -> None:
        reached = [at + rate * TICK_NS * 1e-9 for at, rate in zip(self.at, self.rates, strict=True)]
        self.at = [min(at, most) for at, most in zip(reached, self.most, strict=True)]


class Slits:
    """Slits over blades; ``run`` ticks them."""

    def __init__(self, **keys: Any) -> None:
        self.blades, self.now_ns = Blades(), 1_000_000_000
        kit: Any = SimpleNamespace(
            markers=Markers(), held={"blades": self.blades}, inputs={"blades": self.blades}, now_ns=lambda: self.now_ns
        )
        axis = {"velocity_max": 0.2, "acceleration_max": 2.0} | keys
        table = {"axes": ["blades"], "axis": [axis | {"name": name} for name in ("centre", "gap")]}
        self.driver = SlitsDriver("slits", msgspec.convert(table, SlitsDriver.Settings), kit)
        self.bank = self.driver.bank
        self.driver.open()
        self.run(0.01)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 1e9 / TICK_NS)):
            self.now_ns += TICK_NS
            self.blades.go_on()
            self.driver.tick(self.now_ns)


def test_a_stop_begins_where_blocked_coordinates_are_and_not_where_their_set_points_have_run_to() -> None:
    slits = Slits()
    slits.blades.most = [-0.05, 0.15]
    slits.bank.append(records(mode=ControlMode.VELOCITY, velocity=0.2), [0], slits.now_ns)
    slits.run(0.45)
    ahead = float(slits.bank.arrays["desired"][0] - slits.bank.arrays["position"][0])
    assert ahead > 0.02 and slits.blades.rates[1] > 0.15  # it presses
    assert slits.driver.blocks[0].bank.rows["status"][0] & AxisStatus.SATURATED
    slits.bank.stop([0, 1], slits.now_ns)
    stood = list(slits.blades.at)
    slits.blades.most = [1.0, 1.0]  # what was in the way gives way
    slits.run(1.0)
    assert slits.blades.at == pytest.approx(stood, abs=1e-3)


def test_a_stop_of_coordinates_that_follow_keeps_their_course() -> None:
    slits = Slits()
    slits.bank.append(records(mode=ControlMode.VELOCITY, velocity=0.2), [0], slits.now_ns)
    slits.run(0.4)
    slits.bank.stop([0, 1], slits.now_ns)
    began = slits.blades.at[1]
    slits.run(1.0)
    assert slits.blades.at[1] - began == pytest.approx(0.2**2 / (2 * 2.0), rel=0.15)


def test_limits_that_cannot_be_are_refused_with_a_sentence() -> None:
    with pytest.raises(ValueError, match="velocity_max 0; want a positive number"):
        Slits(velocity_max=0.0)
