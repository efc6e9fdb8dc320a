"""DriveBank: take-up by two moves, settling, retries and misses of drives that close their own loop."""

import errno

import numpy as np
import pytest
from motion_rig import MODE, Cell

from sioms.motion import ActionKind, Arrival, Backlash, CommandError, EventKind, Restore
from sioms.protocol.flags import AxisStatus as S

D = 0.1
SLOW = Backlash(D, velocity=0.5, acceleration=1.0)


class Watched(Cell):
    """Keeps every action and every position of drive 0."""

    def __init__(self, **settings):
        self.actions, self.path = [], []
        super().__init__(1, **settings)

    def poll(self, count=1):
        for _ in range(count):
            super().poll()
            self.path.append(self.drives[0].position)

    def send(self):
        take = self.bank.take_actions
        self.bank.take_actions = lambda: self.actions.extend(found := take()) or found
        super().send()
        self.bank.take_actions = take

    def run(self, most=2000):
        for _ in range(most):
            if self.bank.is_idle([0]):
                return
            self.poll()
        raise AssertionError("not idle")

    @property
    def starts_to(self):
        return [(round(a.command.position, 9), a.velocity_max) for a in self.actions if a.kind is ActionKind.START]


def test_from_the_wrong_side_it_takes_two_moves_and_ends_once():
    cell = Watched(backlash=SLOW, start=1.0)
    token = cell.markers.reserve(3)
    cell.write(mode=MODE.POSITION | MODE.SPECIFIED_SIGNAL_MARKER, position=0.5, signal_marker_number=token)
    cell.run()
    assert cell.starts_to == [(0.4, 2.0), (0.5, 0.5)]
    assert cell.actions[1].acceleration_max == 1.0 and cell.actions[0].acceleration_max == 5.0
    kinds = [e.kind for e in cell.events]
    assert kinds.count(EventKind.STARTED) == kinds.count(EventKind.ENDED) == kinds.count(EventKind.IDLE) == 1
    assert [number for number, _ in cell.markers.signals] == [3]
    assert cell.drives[0].position == pytest.approx(0.5)


def test_from_the_right_side_and_onwards_it_goes_straight():
    cell = Watched(backlash=SLOW)
    for place in (0.5, 0.51, 0.52, 0.9):
        cell.write(mode=MODE.POSITION, position=place)
        cell.run()
    assert cell.starts_to == [(p, 2.0) for p in (0.5, 0.51, 0.52, 0.9)]


def test_calibrated_coordinates_count():
    cell = Watched(backlash=SLOW)
    cell.bank.calibrate([0], [1.0])
    cell.write(mode=MODE.POSITION, position=0.5)
    cell.run()
    assert [p for p, _ in cell.starts_to] == [-0.6, -0.5]


@pytest.mark.parametrize("verb", ["stop", "emergency_stop"])
@pytest.mark.parametrize("polls", [3, 10, 31, 40])
def test_a_stop_in_either_move_is_final(verb, polls):
    cell = Watched(backlash=SLOW, start=1.0)
    cell.write(mode=[MODE.POSITION, MODE.POSITION], position=[0.5, 0.0])
    cell.poll(polls)
    assert not cell.bank.is_idle([0])
    sent = len(cell.starts_to)
    getattr(cell.bank, verb)([0], cell.now_ns)
    cell.send()
    place = cell.drives[0].position
    cell.poll(200)
    assert cell.bank.is_idle([0]) and len(cell.starts_to) == sent and cell.drives[0].position == place


def test_after_a_stop_the_next_move_takes_up_again():
    cell = Watched(backlash=SLOW)
    cell.write(mode=MODE.POSITION, position=0.5)
    cell.poll(20)
    cell.bank.stop([0], cell.now_ns)
    cell.poll(5)
    here = cell.drives[0].position
    cell.write(mode=MODE.POSITION, position=here + 0.01)
    cell.run()
    assert [p for p, _ in cell.starts_to][1:] == [round(here + 0.01 - D, 9), round(here + 0.01, 9)]


@pytest.mark.parametrize(("verb", "goes_straight"), [("stop", True), ("fault", False)])
def test_of_an_axis_that_stands_a_stop_keeps_the_play_taken_up_and_a_fault_does_not(verb, goes_straight):
    cell = Watched(backlash=SLOW)
    cell.write(mode=MODE.POSITION, position=0.5)
    cell.run()
    getattr(cell.bank, verb)([0], *([cell.now_ns] if verb == "stop" else ["broken"]))
    cell.poll(5)
    cell.bank.reset([0])
    cell.poll(5)
    cell.write(mode=MODE.POSITION, position=0.51)
    cell.run()
    assert [p for p, _ in cell.starts_to][1:] == ([0.51] if goes_straight else [0.41, 0.51])


def test_a_target_replaced_in_flight_is_approached_from_its_side():
    cell = Watched(backlash=SLOW)
    cell.write(mode=MODE.POSITION, position=1.0)
    cell.poll(20)
    cell.write(mode=MODE.POSITION, position=0.8, replace=True)
    cell.run()
    assert [p for p, _ in cell.starts_to] == [1.0, 0.7, 0.8]


def test_it_settles_in_motion_before_it_ends():
    cell = Watched(arrival=Arrival(settle_s=0.3))
    cell.write(mode=MODE.POSITION, position=0.5)
    cell.poll(35)
    assert cell.drives[0].position == pytest.approx(0.5) and not cell.bank.is_idle([0])
    assert cell.status() & S.MOVING
    cell.poll(35)
    assert cell.bank.is_idle([0])


@pytest.mark.parametrize(("slips", "retries"), [(2, 3), (9, 3), (1, 0)])
def test_a_miss_is_tried_again_so_often_and_told(slips, retries):
    cell = Watched(arrival=Arrival(0.02, 1e-3, retries), backlash=SLOW)
    left = slips
    cell.write(mode=MODE.POSITION, position=0.5)
    for _ in range(2000):
        if cell.bank.is_idle([0]):
            break
        cell.poll()
        drive = cell.drives[0]
        if left and drive.velocity == 0.0 and drive.target == 0.5 and abs(drive.position - 0.5) < 1e-9:
            drive.position, drive.target, left = 0.48, 0.48, left - 1  # slips back when it has arrived
    assert cell.bank.is_idle([0])
    missed = slips > retries
    assert bool(cell.status() & S.MISSED_TARGET) == missed
    assert cell.drives[0].position == pytest.approx(0.48 if missed else 0.5)
    assert cell.bank.diagnostics([0])["retries"] == [min(slips, retries)]
    assert cell.bank.diagnostics([0])["misses"] == [int(missed)]


def test_a_take_up_outside_the_soft_limits_is_refused():
    cell = Watched(backlash=SLOW)
    with pytest.raises(CommandError) as caught:
        cell.write(mode=MODE.POSITION, position=-2.95)
    assert caught.value.errno == errno.ERANGE
    cell.write(mode=MODE.POSITION | MODE.RELATIVE, position=-2.95)
    assert "approached from" in cell.bank.fault_text(0)
    cell.poll(3)
    assert cell.drives[0].position == 0.0


def test_a_step_below_the_deadband_is_not_sent():
    cell = Watched(deadband=0.01)
    cell.write(mode=[MODE.POSITION] * 3, position=[0.005, -0.005, 0.5])
    cell.run()
    assert [p for p, _ in cell.starts_to] == [0.5]
    assert [e.kind for e in cell.events].count(EventKind.ENDED) == 3


def test_a_keeper_hears_of_a_motion_before_the_drive_does():
    class Keeper:
        def __init__(self):
            self.notes = []

        def restored(self, raw):
            return np.array([0.5]), np.array([True])

        def note(self, at_rest, homed, raw, position, now_ns):
            self.notes.append((bool(at_rest[0]), bool(homed[0]), float(raw[0]), float(position[0])))

    keeper = Keeper()
    cell = Watched(restore=Restore("matching"))
    cell.bank.keeper, cell.bank._seen = keeper, False
    cell.poll()
    assert cell.bank.rows["position"][0] == 0.5 and cell.status() & S.HOMED
    assert keeper.notes[-1] == (True, True, 0.0, 0.5)
    seen = []
    take = cell.drives[0].take
    cell.drives[0].take = lambda action: (seen.append(keeper.notes[-1][0]), take(action))
    cell.write(mode=MODE.POSITION, position=0.6)
    assert seen == [False]
    cell.run()
    assert keeper.notes[-1] == (True, True, pytest.approx(0.1), pytest.approx(0.6))
