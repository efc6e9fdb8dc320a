"""A device made of devices on one thread: what it tells the axes that it holds."""

from __future__ import annotations

import errno
import math
import re
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from motion_rig import Markers, records

from sioms.drivers.compound.slits import SlitsDriver
from sioms.motion import CommandError, EventKind
from sioms.protocol.flags import AnalogStatus, AxisStatus, ControlMode
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.driver import AtLimitError
from sioms.sdk.exchange import LinkError
from sioms.sdk.inputs import Input

TICK_NS = 2_000_000
DTYPE = np.dtype([("value", float), ("force", float), ("commanded_velocity", float), ("status", np.uint32)])


class Blades:
    """Two held axes that go at the velocities they are told, up to where something is in the way."""

    name = "blades"
    is_there = True
    channels = tuple(ChannelInfo(name, "m", -1.0, 1.0, 0, 0, {"velocity": 1.0}, "") for name in ("minus", "plus"))

    def __init__(self) -> None:
        self.at, self.rates, self.most, self.stamp_ns = [-0.1, 0.1], [0.0, 0.0], [1.0, 1.0], 0
        self.status = self.as_of_ns = self.shows_reset_ns = 0
        self.resets: list[int] = []
        self.stops = 0
        self.error: OSError | None = None

    def drive(self, velocities: Sequence[float]) -> None:
        self.rates = list(velocities)

    def stop(self) -> None:
        self.rates = [0.0 for _ in self.rates]
        self.stops += 1

    def reset(self, until_ns: int) -> None:
        self.resets.append(until_ns)
        self.shows_reset_ns = 2**62

    def trouble(self) -> OSError | None:
        error, self.error = self.error, None
        return error

    def read(self, now_ns: int) -> Any:
        self.stamp_ns = self.as_of_ns = now_ns
        return np.array([(at, 0.0, rate, self.status) for at, rate in zip(self.at, self.rates, strict=True)], DTYPE)

    def go_on(self) -> None:
        reached = [at + rate * TICK_NS * 1e-9 for at, rate in zip(self.at, self.rates, strict=True)]
        self.at = [min(at, most) for at, most in zip(reached, self.most, strict=True)]


class Slits:
    """Slits over blades; ``run`` ticks them."""

    def __init__(self, inputs: dict[str, Any] | None = None, blades: Sequence[Blades] = (), **keys: Any) -> None:
        self.held = list(blades) or [Blades()]
        self.blades, self.now_ns = self.held[0], 1_000_000_000
        nodes = {held.name: held for held in self.held}
        kit: Any = SimpleNamespace(
            markers=Markers(), held=nodes, now_ns=lambda: self.now_ns, inputs={**nodes, **(inputs or {})}
        )
        axis = {"velocity_max": 0.2, "acceleration_max": 2.0} | keys
        table = {"axes": list(nodes), "axis": [axis | {"name": name} for name in ("centre", "gap")]}
        self.driver = SlitsDriver("slits", msgspec.convert(table, SlitsDriver.Settings), kit)
        self.bank = self.driver.bank
        self.driver.open()
        self.run(0.01)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 1e9 / TICK_NS)):
            self.now_ns += TICK_NS
            for held in self.held:
                held.go_on()
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
    blades = slits.blades  # what they were told last lasts until the next tick
    stood = [at + rate * TICK_NS * 1e-9 for at, rate in zip(blades.at, blades.rates, strict=True)]
    blades.most = [1.0, 1.0]  # what was in the way gives way
    slits.run(1.0)
    assert blades.at == pytest.approx(stood, abs=1e-4)


def test_a_stop_of_coordinates_that_follow_keeps_their_course() -> None:
    slits = Slits()
    slits.bank.append(records(mode=ControlMode.VELOCITY, velocity=0.2), [0], slits.now_ns)
    slits.run(0.4)
    slits.bank.stop([0, 1], slits.now_ns)
    began = slits.blades.at[1]
    slits.run(1.0)
    assert slits.blades.at[1] - began == pytest.approx(0.2**2 / (2 * 2.0), rel=0.15)


def test_a_stop_ends_with_its_braking_and_brings_nothing_back() -> None:
    slits = Slits(blades=[Late("minus", 3), Late("plus", 3)])
    slits.bank.append(records(mode=ControlMode.VELOCITY, velocity=0.2), [0], slits.now_ns)
    slits.run(0.4)
    slits.bank.stop([0, 1], slits.now_ns)
    slits.run(0.2 / 2.0 + 0.006)
    assert [held.rates for held in slits.held] == [[0.0], [0.0]], "braked at 2 m/s^2, and no longer"
    assert slits.bank.is_idle([0, 1]) and slits.bank.rows["following_error"] == pytest.approx(0.0, abs=1e-4)
    stood = [held.at[0] for held in slits.held]
    slits.run(0.5)
    assert [held.at[0] for held in slits.held] == stood
    assert [held.stops for held in slits.held] == [1, 1], "they hold by themselves, and are idle"


def test_a_coordinate_that_is_stopped_alone_brings_nothing_back_while_another_moves() -> None:
    slits = Slits(blades=[Late("minus", 3), Late("plus", 3)])
    slits.bank.append(records(mode=ControlMode.VELOCITY, velocity=0.2), [0], slits.now_ns)
    slits.bank.append(records(mode=ControlMode.VELOCITY, velocity=0.05), [1], slits.now_ns)
    slits.run(0.4)
    slits.bank.stop([0], slits.now_ns)
    slits.run(0.2 / 2.0 + 0.03)
    (minus,), (plus,) = (held.rates for held in slits.held)
    assert 0.5 * (minus + plus) == pytest.approx(0.0, abs=1e-3) and plus - minus == pytest.approx(0.05, abs=1e-3)


def test_a_held_axis_that_came_to_its_own_limit_sooner_than_foreseen_is_the_end_of_reach() -> None:
    slits = Slits()
    slits.bank.append(records(mode=ControlMode.VELOCITY, velocity=0.2), [0], slits.now_ns)
    slits.run(0.2)
    slits.bank.take_events()
    slits.blades.error = AtLimitError(errno.ERANGE, "stopped at the limit of position")
    slits.run(0.2)
    (event,) = [event for event in slits.bank.take_events() if event.kind is EventKind.DROPPED]
    assert event.errno == errno.ERANGE and "the end of reach: stopped at the limit" in event.text
    assert slits.blades.rates == [0.0, 0.0] and not slits.bank.fault_text(0)


def test_limits_that_cannot_be_are_refused_with_a_sentence() -> None:
    with pytest.raises(ValueError, match="axis centre: velocity_max 0; want 1e-09 to 10000"):
        Slits(velocity_max=0.0)


class Feeler(Input):
    """A force sensor's node as its page gives it."""

    def __init__(self) -> None:
        super().__init__("wrist.fz")
        self.force, self.flags, self.late_ns, self.is_up = 0.0, 0, 0, True

    def read(self, now_ns: int) -> Any:
        self.stamp_ns = now_ns - self.late_ns
        return {"value": np.array([self.force]), "flags": np.array([self.flags])} if self.is_up else None


def _pressing() -> tuple[Slits, Feeler]:
    """Return slits that close with 4 N on what gives no way, half a second after they began to."""
    feeler = Feeler()
    slits = Slits({"wrist.fz": feeler}, damper=0.01, force_node="wrist.fz", force_max=20.0)
    slits.bank.append(records(axis=1, mode=ControlMode.FORCE, force=4.0), [0, 1], slits.now_ns)
    slits.run(0.5)
    assert slits.blades.rates[1] == pytest.approx(0.5 * 0.01 * 4.0)
    return slits, feeler


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"flags": int(AnalogStatus.INVALID)}, r"wrist\.fz: it reads 0, flagged 0x2; want .*INVALID"),
        ({"flags": int(AnalogStatus.SATURATED)}, "flagged 0x1"),
        ({"force": math.nan}, "it reads nan"),
        ({"force": -math.inf}, "it reads -inf"),
        ({"late_ns": 110_000_000}, r"its last reading is 0\.110 s old; want at most 0\.100 s"),
        ({"is_up": False}, "cannot be read"),
    ],
)
def test_a_force_that_is_not_known_stops_what_relies_on_it_at_once(change: dict[str, Any], why: str) -> None:
    slits, feeler = _pressing()
    for name, value in change.items():
        setattr(feeler, name, value)
    slits.run(2 * TICK_NS * 1e-9)
    assert slits.blades.rates == [0.0, 0.0]
    assert re.search(why, slits.bank.fault_text(1)), slits.bank.fault_text(1)
    assert (slits.bank.rows["status"] & int(AxisStatus.FAULT)).all()
    for name in change:
        setattr(feeler, name, getattr(Feeler(), name))
    slits.run(0.1)
    assert slits.blades.rates == [0.0, 0.0]  # nothing goes on by itself


@pytest.mark.parametrize("felt", [-30.0, 38.0])
def test_a_coordinate_that_presses_keeps_its_greatest_velocity(felt: float) -> None:
    """Though its damper asks for more, and the held axes could."""
    slits, feeler = _pressing()
    feeler.force = felt  # 34 N away from what is wanted, at 0.01 m/(s N): 0.34 m/s
    slits.run(0.01)
    opening = math.copysign(1.0, felt) * slits.blades.rates[0]
    assert 0.05 < opening <= 0.1 + 1e-9, "half of 0.2 m/s for each blade; the damper asks for 0.17"
    assert slits.blades.rates[1] == -slits.blades.rates[0]


def test_a_force_that_is_late_but_young_enough_is_followed() -> None:
    slits, feeler = _pressing()
    feeler.late_ns, feeler.flags = 90_000_000, int(AnalogStatus.OVERRUN | AnalogStatus.HIHI)
    slits.run(0.1)
    assert slits.blades.rates[1] == pytest.approx(0.5 * 0.01 * 4.0)


def test_coordinates_of_an_axis_that_has_lost_its_place_are_lost() -> None:
    slits = Slits()
    slits.blades.status = int(AxisStatus.POSITION_LOST)
    slits.run(0.01)
    assert (slits.bank.rows["status"] & int(AxisStatus.POSITION_LOST)).all()
    slits.bank.reset([0, 1])
    slits.run(0.02)
    with pytest.raises(CommandError, match="lost its place"):
        slits.bank.append(records(mode=ControlMode.POSITION, position=0.1), [0], slits.now_ns)


def test_a_held_position_that_is_not_a_number_is_a_lost_link() -> None:
    slits = Slits()
    slits.bank.append(records(mode=ControlMode.VELOCITY, velocity=0.1), [0], slits.now_ns)
    slits.run(0.1)
    slits.blades.at[1] = math.nan
    with pytest.raises(LinkError, match="blades: its position is not a finite number"):
        slits.run(0.01)
    assert slits.blades.rates == [0.0, 0.0]


def test_a_reset_is_of_what_the_held_axes_showed_while_all_was_halted_and_of_nothing_later() -> None:
    slits = Slits()
    slits.blades.status = int(AxisStatus.EMERGENCY_STOP)
    slits.run(0.01)
    assert slits.bank.fault_text(0)
    shown_ns = slits.blades.as_of_ns
    slits.bank.reset([0, 1])
    slits.run(0.2)
    assert slits.blades.resets == [shown_ns], "once, and nothing that came after that reading"
    assert not slits.bank.fault_text(0), "what is shown before the answer does not count"
    slits.blades.shows_reset_ns = slits.now_ns + 1
    slits.run(0.01)
    assert "blades: emergency stop" in slits.bank.fault_text(0), "it is stopped still, or again"


class Late(Blades):
    """One of two devices with a blade each; it shows where its blade was some ticks ago."""

    def __init__(self, name: str, ticks: int) -> None:
        super().__init__()
        self.name, self.channels, self._ticks, self._shown = name, Blades.channels[:1], ticks, list[float]()
        self.at, self.rates, self.most = [0.1 if name == "plus" else -0.1], [0.0], [1.0]

    def read(self, now_ns: int) -> Any:
        self._shown.append(self.at[0])
        reading = super().read(now_ns)
        back = min(self._ticks, len(self._shown) - 1)
        self.stamp_ns -= back * TICK_NS
        reading["value"] = self._shown[-1 - back]
        return reading


def test_devices_that_show_their_axes_at_different_times_do_not_seem_to_part() -> None:
    slits = Slits(blades=[Late("minus", 0), Late("plus", 5)])
    slits.bank.append(records(mode=ControlMode.VELOCITY, velocity=0.2), [0], slits.now_ns)
    slits.run(0.3)
    gaps = []
    for _ in range(100):
        slits.run(0.002)
        gaps.append(slits.bank.rows["position"][1])
    assert max(gaps) - min(gaps) < 1e-4
    assert gaps[-1] == pytest.approx(0.2, abs=1e-4)


def test_a_stop_of_one_coordinate_halts_all_until_all_are_reset() -> None:
    slits = Slits()
    slits.bank.append(records(mode=ControlMode.VELOCITY, velocity=0.05), [1], slits.now_ns)
    slits.run(0.2)
    assert slits.blades.rates[1] > 0.01
    slits.bank.emergency_stop([0], slits.now_ns)
    slits.run(0.5)
    stood = list(slits.blades.at)
    assert slits.blades.rates == [0.0, 0.0]
    with pytest.raises(CommandError, match="centre was halted"):
        slits.bank.append(records(mode=ControlMode.VELOCITY, velocity=0.05), [1], slits.now_ns)
    slits.bank.reset([0])
    slits.run(0.5)
    assert slits.blades.at == stood and not slits.blades.resets, "one is latched still"
    slits.bank.reset([0, 1])
    slits.run(0.5)
    assert slits.blades.at == pytest.approx(stood, abs=1e-6), "nothing resumes"


class Stalled(Late):
    """A device that the machine keeps waiting: it shows nothing new, and afterwards all that it has done meanwhile."""

    stalls = False

    def read(self, now_ns: int) -> Any:
        if not self.stalls:
            self._reading = super().read(now_ns).copy()
            self._as_of_ns = self.stamp_ns
        self.stamp_ns = self.as_of_ns = self._as_of_ns
        return self._reading


@pytest.mark.parametrize("ms", [10, 100, 180])
def test_a_held_device_that_is_stalled_and_comes_back_has_not_jumped_and_is_not_skewed(ms: int) -> None:
    slits = Slits(blades=[Stalled("minus", 0), Stalled("plus", 1)])
    slits.bank.append(records(mode=ControlMode.POSITION, position=0.3), [0], slits.now_ns)
    slits.run(0.08)  # it accelerates still
    for _ in range(3):
        slits.held[0].stalls = True
        slits.run(ms * 1e-3)
        gap = slits.bank.rows["position"][1]
        slits.held[0].stalls = False
        slits.run(0.05)
        assert not slits.bank.fault_text(0), slits.bank.fault_text(0)
        assert gap == pytest.approx(0.2, abs=2e-3), "both blades are looked at as of one instant"
        assert abs(slits.bank.rows["velocity"][0]) < 0.25
    slits.run(3.0)
    assert not slits.bank.fault_text(0), slits.bank.fault_text(0)
    assert slits.bank.rows["position"][0] == pytest.approx(0.3, abs=1e-4)


def test_what_held_axes_read_after_they_were_lost_is_believed() -> None:
    slits = Slits()
    slits.blades.status = int(AxisStatus.FAULT)
    slits.run(0.01)
    slits.now_ns += 2_000_000_000
    slits.blades.at, slits.blades.status = [0.3, 0.5], 0
    slits.driver.open()
    slits.run(0.01)
    slits.bank.reset([0, 1])
    slits.blades.shows_reset_ns = 0
    slits.run(0.01)
    slits.blades.shows_reset_ns = 0
    slits.run(0.1)
    assert not slits.bank.rows["status"].any(), slits.bank.fault_text(0)
    assert slits.bank.rows["position"] == pytest.approx([0.4, 0.2])
