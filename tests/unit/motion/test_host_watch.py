"""The motion watch of axes whose loop the host closes: what it finds, how soon, and what it must not find."""

import numpy as np
import pytest
from motion_rig import MODE, Rig, axis

from sioms.motion import AxisKind, CommandError, Watch
from sioms.protocol.flags import AxisStatus as S

FAST = 2.0
"""velocity_max of the axes of the rig [m/s]; 0.02 m are then the tolerance."""
SETTLED = 600
"""Ticks after which an axis that holds is watched."""


class Shoved(Rig):
    """Axes that follow exactly, and are carried along by somebody else on top of it."""

    def __init__(self, *axes, **arguments):
        self.shoved, self.shove, self.turned = np.zeros(len(axes)), np.zeros(len(axes)), 1.0
        super().__init__(axes, plant=self._follow, **arguments)
        self.tick(SETTLED)

    def _follow(self, output, dt):
        self.shoved += self.shove * dt
        bank = self.bank
        self.shoved[bank._limp] = self.shove[bank._limp] * dt  # it is commanded to be where it is
        return (
            self.turned * np.where(bank.stepper, output, bank.rows["commanded_position"] - bank._offset) + self.shoved
        )

    def ticks_to_fault(self, most=200):
        for count in range(1, most + 1):
            self.tick()
            if self.field("status") & S.FAULT:
                return count
        raise AssertionError(f"no fault within {most} ticks")

    @property
    def text(self):
        return self.bank.fault_text(0)


def rest(**changes):
    return Shoved(axis(**changes))


@pytest.mark.parametrize("velocity", [0.3 * FAST, -FAST])
def test_motion_that_nobody_commanded_is_a_fault(velocity):
    rig = rest()
    rig.shove[0] = velocity
    assert rig.ticks_to_fault() <= 30 + 1000 * 0.02 / abs(velocity)
    assert "axis x moves though nothing was commanded" in rig.text and "0.02 m is allowed" in rig.text
    assert rig.field("force") == 0.0 and not rig.field("status") & S.POSITION_LOST
    other = rest(watch=Watch(uncommanded=False))
    other.shove[0] = velocity
    other.tick(200)
    assert not other.field("status") & S.FAULT, "guided by hand"


@pytest.mark.parametrize("factor", [1.5, 3.0])
def test_a_speed_above_the_limit_is_a_fault_in_80_ms(factor):
    rig = rest()
    rig.write(mode=MODE.VELOCITY, velocity=FAST)
    rig.tick(600)
    rig.shove[0] = (factor - 1) * FAST
    assert rig.ticks_to_fault() <= 80
    assert "axis x moves at" in rig.text and "velocity_max is 2 m/s" in rig.text


@pytest.mark.parametrize("mode", [MODE.VELOCITY, MODE.POSITION])
def test_an_axis_that_runs_the_wrong_way_is_a_fault(mode):
    """Its motor is connected the wrong way round."""
    rig = rest()
    rig.turned = -1.0
    rig.write(mode=mode, velocity=1.0, position=1.0)
    assert rig.ticks_to_fault(500) and abs(rig.raw[0]) < 0.15
    assert "m/s were commanded" in rig.text
    assert rig.text.index("runs at -") < rig.text.index("m/s;")


@pytest.mark.parametrize("kind", list(AxisKind))
@pytest.mark.parametrize("moves", [True, False])
def test_a_jump_is_a_lost_place_in_the_next_tick_and_one_damaged_reading_is_none(kind, moves):
    rig = rest(kind=kind, k=None if kind is AxisKind.STEPPER else 100.0)
    if moves:
        rig.write(mode=MODE.VELOCITY, velocity=0.5)
        rig.tick(400)
    rig.shoved[0] += 0.3
    rig.tick()
    rig.shoved[0] -= 0.3
    rig.tick(100)
    assert not rig.field("status") & S.FAULT, rig.text
    rig.shoved[0] -= 0.3
    assert rig.ticks_to_fault() <= 3
    assert rig.field("status") & S.POSITION_LOST and "position lost: axis x read" in rig.text
    rig.tick(1000)
    rig.bank.reset([0])
    rig.tick(100)
    assert not rig.field("status") & S.FAULT and rig.field("status") & S.POSITION_LOST
    with pytest.raises(CommandError, match="position lost"):
        rig.write(mode=MODE.POSITION, position=0.1)


def test_a_false_zero_after_a_silence_is_a_lost_place():
    rig = Shoved(axis(), late_max_s=10.0)
    rig.shoved[0] = rig.raw[0] = -0.3
    rig.now_ns += 500_000_000
    assert rig.ticks_to_fault() <= 3
    assert rig.field("status") & S.POSITION_LOST


def test_what_the_loop_does_by_itself_is_no_finding():
    """Replaced moves with overshoot and late ticks, calibration, stops, and a force that pushes it along."""
    rng = np.random.default_rng(1)
    rig = rest()
    for _ in range(12):
        rig.write(mode=MODE.POSITION, position=rng.uniform(-1.0, 1.0), replace=True)
        rig.tick(int(rng.integers(20, 600)))
        rig.now_ns += int(rng.integers(0, 30)) * 1_000_000
        rig.shoved[0] = rng.uniform(-0.001, 0.001)
    rig.bank.stop([0], rig.now_ns)
    rig.tick(1500)
    rig.bank.calibrate([0], [0.7])
    rig.tick(800)
    rig.write(mode=MODE.FORCE | MODE.SPECIFIED_TIME, force=3.0, time=0.5)
    rig.shove[0] = 0.3
    rig.tick(500)
    rig.shove[0] = 0.0
    rig.tick(1000)
    assert not rig.field("status") & S.FAULT, rig.text


def test_each_axis_is_judged_by_itself():
    rig = Shoved(axis(name="slow", velocity_max=0.1), axis(name="quick", velocity_max=20.0))
    rig.shove[:] = 0.1
    rig.tick(100)
    assert rig.field("status", 0) & S.FAULT and not rig.field("status", 1) & S.FAULT
    assert "0.001 m is allowed" in rig.text


class Delayed(Shoved):
    """Axes whose readings come late, and are read twice, while ``stalled``: then all at once."""

    stalled = False

    def tick(self, ticks=1, **_):
        for _ in range(ticks):
            self.now_ns += self.tick_ns
            if not self.stalled:
                self.read, self.read_ns = self.raw.copy(), self.now_ns
            output = self.bank.tick(self.now_ns, self.read, seen_ns=self.read_ns)
            self.raw = self.plant(output, self.tick_ns * 1e-9)
            self.bank.plan_ahead()


@pytest.mark.parametrize("ms", [5, 50, 190, 350])
def test_readings_that_come_late_and_twice_are_judged_by_when_they_were_taken(ms):
    rig = Delayed(axis(following_error_max=10.0), late_max_s=10.0)
    for velocity in (FAST, -FAST, 0.3 * FAST, 0.0):
        rig.write(mode=MODE.VELOCITY, velocity=velocity, replace=True)
        rig.tick(5)
        rig.stalled = True
        rig.tick(ms)
        rig.stalled = False
        rig.tick(400 if velocity else 5)
        assert not rig.field("status") & S.FAULT, rig.text
        assert abs(rig.field("velocity")) < 1.2 * FAST
    rig.bank.stop([0], rig.now_ns)
    rig.tick(SETTLED)
    rig.stalled = True
    rig.shove[0] = FAST
    rig.tick(50)
    rig.stalled = False
    assert rig.ticks_to_fault() <= 50, "what moves all the same is found"


def test_one_damaged_reading_that_is_read_again_and_again_stops_nothing():
    rig = Delayed(axis(), late_max_s=10.0)
    rig.shoved[0] += 0.3
    rig.tick(2)
    rig.stalled = True
    rig.tick(30)
    rig.shoved[0] -= 0.3
    rig.tick()
    rig.stalled = False
    rig.tick(100)
    assert not rig.field("status") & S.FAULT, rig.text


def test_the_first_readings_after_a_loss_are_believed_where_that_is_said():
    rig = rest()
    rig.shoved[0] += 0.5
    rig.raw[0] += 0.5
    rig.bank.believe()
    rig.tick(100)
    assert not rig.field("status") & S.FAULT, rig.text
    rig.shoved[0] += 0.5
    assert rig.ticks_to_fault() <= 3
