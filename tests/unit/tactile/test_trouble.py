"""What goes wrong on a finger, at 400 Hz through the driver of framed samples: each case ends in the state that is
true, and goes by.

The frames come from the plant (`sioms.plant.finger`: finite elements, indenters and contact point by point), whose
mechanics share nothing with the estimator's, in counts of the converter, with noise and steps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from sioms.drivers.framed_adc import codec as stream
from sioms.drivers.framed_adc.cobs import frame
from sioms.drivers.framed_adc.driver import FramedAdc
from sioms.plant.finger import FingerShape, TactileArray
from sioms.protocol.flags import AnalogStatus
from sioms.tactile.chain import RECOVER_S
from sioms.tactile.quality import Quality, State, state_of
from sioms.tactile.sensing import CHANNELS

pytestmark = pytest.mark.usefixtures("one_estimator")
FINGER = str(Path(__file__).parents[3] / "etc" / "finger.toml")
RATE = 400
NAMES = [name for name, _, _ in CHANNELS]
PLANT = TactileArray(FingerShape(gain=3.0))
NONE = np.zeros(16)


def touch(degrees: float, load: float, rc: float = 6e-3) -> np.ndarray:
    """Return the outputs [%] under a touch, a pull where the load is negative."""
    output: np.ndarray = -100.0 / 3.0 * math.copysign(1.0, load) * PLANT.strain(abs(load), math.radians(degrees), rc)
    return output


class Finger:
    """The driver, fed with frames of floating point or whole counts on an invented clock."""

    def __init__(self, noise: float = 0.023, step: float = 0.01, seed: int = 0) -> None:
        self.noise, self.step, self.random = noise, step, np.random.default_rng(seed)
        self.offset = self.random.uniform(-3.0, 3.0, 16)
        settings = {
            "line": {"serial": "/x", "baud": 12_000_000}, "channels": 16, "rate_hz": RATE, "scale": step, "unit": "%",
            "format": "f32", "shape": {"finger_file": FINGER, "compiled": True},
        }  # fmt: skip
        self.now_ns = 0
        kit: Any = SimpleNamespace(publish=lambda block, stamp_ns: None, inputs={}, now_ns=lambda: self.now_ns)
        self.driver = FramedAdc("t0", msgspec.convert(settings, FramedAdc.Settings), kit)
        steps = self.driver.open()
        next(steps)
        steps.send(stream.Hello(1, 16, stream.Format.F32, 1000, "FINGER16"))
        assert next(steps, None) is None
        self.number = 0
        self.seen: list[dict[str, float]] = []
        self.go(0.25)

    def go(self, seconds: float, output: np.ndarray = NONE) -> dict[str, float]:
        """Feed frames; `seen` is then what was published with each, the last of which is returned."""
        self.seen = []
        for _ in range(round(seconds * RATE)):
            self.number += 1
            raw = self.offset + output + self.noise * self.random.normal(size=16)
            counts = tuple(np.round(raw / self.step).tolist())
            time_us = self.number * 1_000_000 // RATE
            block = stream.SampleBlock(1, self.number % stream.SEQUENCE_MODULUS, time_us, 0, counts)
            data = frame(stream.build_samples(block, stream.Format.F32))
            self.now_ns = time_us * 1000 + 10_000_000
            taken = self.driver.feed(data, self.now_ns)
            assert taken == 1 or self.number == 1  # the first after the opening may be an old one
            self.seen.append(dict(zip(NAMES, self.driver.blocks[2].data.tolist(), strict=True)))
        return self.seen[-1]

    @property
    def states(self) -> list[State]:
        """Return the state of each frame last fed."""
        return [state_of(Quality(int(one["quality"]))) for one in self.seen]

    def works(self) -> None:
        """A touch is told as it is, and its end."""
        rest = self.go(0.3)
        assert state_of(Quality(int(rest["quality"]))) is State.UNTOUCHED and rest["load"] == 0.0
        self.go(0.15, touch(70.0, 200.0))
        assert {State.TOUCHED} == set(self.states)
        for name, truth, most in (
            ("load", 200.0, 3.0),
            ("angle", math.radians(70.0), 3e-3),
            ("equivalent_radius", 4.07e-3, 3e-4),
        ):
            assert np.mean([one[name] for one in self.seen]) == pytest.approx(truth, abs=most)  # fmt: skip
        rest = self.go(0.05)
        assert rest["touched"] == 0.0 and rest["load"] == 0.0


def cases(*values: Any) -> Any:
    return pytest.mark.parametrize("case", values, ids=str)


@cases((range(16), 150.0), (range(2, 15), 0.0), (range(3, 16), 150.0), (range(4, 11), 0.0), (range(4, 11), 150.0))
def test_blind_is_not_untouched(case: tuple[range, float]) -> None:
    """All or most elements read nothing, in the midst of them what is touched: 5 cases."""
    holes, load = case
    finger, missing = Finger(seed=len(holes)), np.where(np.isin(np.arange(16), list(holes)), np.nan, 0.0)
    finger.go(0.3, missing + (touch(75.0, load) if load else 0.0))
    if load and len(holes) < 12:  # those beside the hole feel that there is something
        assert set(finger.states) <= {State.BLIND, State.DOUBTFUL, State.TOUCHED}
    else:
        assert set(finger.states) == {State.BLIND}
    for one in finger.seen:
        if state_of(Quality(int(one["quality"]))) is State.BLIND:
            assert math.isnan(one["touched"]) and math.isnan(one["load"])
    assert finger.driver.blocks[2].flags[2] & int(AnalogStatus.INVALID) or load
    finger.works()


@cases(
    *((0.5, load, rc) for load, rc in ((100.0, 6e-3), (100.0, 12.3e-3), (200.0, 6e-3), (300.0, 12.3e-3))),
    *((0.25, load, rc) for load, rc in ((100.0, 12.3e-3), (200.0, 6e-3))),
)
def test_a_held_touch_of_a_coarse_quiet_converter_stays(case: tuple[float, float, float]) -> None:
    """Every frame of a second and a half is equal, thrice as many as a dead element's: 6 cases."""
    step, load, rc = case
    finger = Finger(noise=0.02, step=step, seed=3)
    assert {State.UNTOUCHED} == {state_of(Quality(int(finger.go(0.5)["quality"])))}
    held = finger.go(1.5, touch(81.0, load, rc))
    assert {one["touched"] for one in finger.seen} == {1.0} and State.BLIND not in finger.states
    assert held["load"] == pytest.approx(load, abs=4.0 * math.sqrt(held["var_load"]) + 1.0)
    assert held["load"] == pytest.approx(load, rel=0.2)
    assert finger.go(0.2)["load"] == 0.0


@cases((0, 5.0), (5, -5.0), (8, 5.0), (8, 1.0), (15, -5.0), (15, 1.0))
def test_an_element_that_moves_alone_is_no_touch(case: tuple[int, float]) -> None:
    """At rest, under a true touch while it is away, and back: 6 cases."""
    element, jump = case
    finger = Finger(seed=element)
    off = jump * np.eye(16)[element]
    one = finger.go(0.4, off)
    assert one["touched"] == 0.0 and one["load"] == 0.0
    assert Quality.BAD_ELEMENTS in Quality(int(one["quality"]))
    if abs(jump) == 5.0:  # a small one may be a light edge, for the first frames
        assert {frame["touched"] for frame in finger.seen} == {0.0} and State.TOUCHED not in finger.states
    under = finger.go(0.15, off + touch(70.0, 200.0))
    assert under["load"] == pytest.approx(200.0, abs=8.0)
    finger.go(RECOVER_S + 0.3, off)
    finger.offset = finger.offset + off
    finger.works()  # with its new baseline


@cases(*((step, under) for step in (3.0, -3.0, 1.0) for under in (False, True)))
def test_a_step_of_all_elements_is_no_touch_and_leaves_nothing(case: tuple[float, bool]) -> None:
    """For a second and shorter, with scatter, at rest and under a touch; three times: 6 cases."""
    step, under = case
    finger = Finger(seed=round(10.0 * step) % 7)
    shift = step * (1.0 + 0.03 * finger.random.normal(size=16))
    held = touch(60.0, 200.0) if under else NONE
    for seconds in (1.0, 0.3, 0.3):
        finger.go(0.15, held)
        one = finger.go(seconds, shift + held)
        assert one["load"] == pytest.approx(200.0 if under else 0.0, abs=15.0)
        if not under:
            assert set(finger.states) == {State.UNTOUCHED}
        finger.go(0.15, held)
    finger.works()


@cases((400.0, math.inf, 50.0), (450.0, 12.3e-3, 78.0), (400.0, 6e-3, 50.0), (250.0, math.inf, 78.0))
def test_r_is_within_its_deviation_at_high_loads(case: tuple[float, float, float]) -> None:
    """Wide contacts: 4 cases."""
    load, rc, place = case
    finger = Finger(seed=int(load))
    finger.go(0.5, touch(place, load, rc))
    radius = 1.0 / (1.0 / 12.7e-3 + 1.0 / rc)
    off = np.mean([one["equivalent_radius"] - radius for one in finger.seen])
    assert abs(off) < 2.0 * math.sqrt(finger.seen[-1]["var_radius"])
    assert finger.seen[-1]["load"] == pytest.approx(load, rel=0.02)
    assert State.DOUBTFUL not in finger.states


@cases((-30.0, 20.0), (-30.0, 79.6), (-150.0, 75.0), (-400.0, 20.0), (-400.0, 79.6))
def test_a_pull_is_called_one(case: tuple[float, float]) -> None:
    """Something sticks and pulls: 5 cases."""
    load, place = case
    finger = Finger(seed=-int(load))
    finger.go(0.3, touch(place, load))
    for one in finger.seen:
        assert Quality.WRONG_SIGN in Quality(int(one["quality"])) and math.isnan(one["load"])
    assert set(finger.states) == {State.DOUBTFUL}
    finger.works()


@cases(*((apart, load, rc) for apart, load, rc in (
    (12.0, 100.0, 6e-3), (12.0, 200.0, 0.5e-3), (10.0, 100.0, 1e-3), (10.0, 150.0, 3e-3), (9.0, 150.0, 1e-3), (8.0, 150.0, 1e-3), (7.0, 200.0, 0.5e-3),  # noqa: E501
    (7.0, 200.0, 6e-3), (10.0, 200.0, math.inf), (8.0, 100.0, math.inf))))  # fmt: skip
def test_two_touches_are_not_one_good_one(case: tuple[float, float, float]) -> None:
    """Five to twelve degrees apart, once they have been held for up to 2.7 seconds: 10 cases."""
    apart, load, rc = case
    finger = Finger(seed=int(apart))
    both = touch(75.0 - apart / 2, load, rc) + touch(75.0 + apart / 2, load, rc)

    def told() -> bool:
        quality = Quality(int(finger.seen[-1]["quality"]))
        return state_of(quality) is State.DOUBTFUL or Quality.FLAT_OR_HOLLOW in quality

    for _ in range(9):
        finger.go(0.3, both)
        if told():
            break
    finger.go(0.05, both)  # and it stays so
    assert finger.seen[-1]["touched"] == 1.0 and told()
    finger.works()


def singles() -> Iterator[tuple[float, float, float]]:
    random = np.random.default_rng(7)
    for _ in range(5):
        yield (
            float(random.uniform(15.0, 133.0)),
            float(random.uniform(40.0, 400.0)),
            float(random.choice([0.5e-3, 3e-3, 6e-3, 12.3e-3])),
        )


@cases(*singles())
def test_a_single_touch_is_not_doubted(case: tuple[float, float, float]) -> None:
    """However long it is held."""
    finger = Finger(seed=11)
    finger.go(0.2)
    finger.go(2.0, touch(*case))
    assert finger.states.count(State.TOUCHED) >= 0.997 * len(
        finger.states
    )  # noise makes one frame of a million look like another
    assert finger.states[-1] is State.TOUCHED
    assert finger.seen[-1]["load"] == pytest.approx(case[1], abs=5.0 * math.sqrt(finger.seen[-1]["var_load"]))
    finger.works()


def test_a_converter_that_sticks_is_told_from_a_quiet_one() -> None:
    """The readings were noisy and all repeat: nobody can say whether what they say still holds."""
    finger = Finger()
    for held in (NONE, touch(75.0, 200.0)):
        finger.go(0.5, held)
        finger.noise, before = 0.0, finger.offset
        finger.go(0.6, held)
        assert finger.states[-1] is State.BLIND and math.isnan(finger.seen[-1]["load"])
        finger.noise = 0.023
        finger.go(0.1, held)
        assert finger.states[-1] is (State.TOUCHED if held.any() else State.UNTOUCHED)
        assert np.array_equal(before, finger.offset)


@cases(("noise", 3.0), ("noise", 30.0), ("hum", 0.1))
def test_loud_readings_are_doubted_and_end_nothing(case: tuple[str, float]) -> None:
    """A wire that has come off, a pump beside the finger: once in hundreds of frames no touch was likely at all, and
    the mean over none ended the driver.
    """
    what, size = case
    finger = Finger(seed=4)
    seen: list[State] = []
    phases = np.random.default_rng(1).uniform(0.0, 2 * math.pi, 16)
    for number in range(RATE):
        if what == "noise":
            finger.noise = 0.023 * size
            finger.go(1 / RATE)
        else:
            finger.go(1 / RATE, size * np.sin(2 * math.pi * 50 * number / RATE + phases))
        seen += finger.states
    assert seen.count(State.TOUCHED) < 0.2 * len(seen) and State.DOUBTFUL in seen
    finger.noise = 0.023
    finger.go(2.5)
    finger.works()
