"""The motion watch of drives that close their own loop: what it finds, how soon, and what it must not find."""

import errno

import numpy as np
import pytest
from motion_rig import MODE, POLL_NS, Cell, axis, records

from sioms.motion import ActionKind, CommandError, EventKind, Watch
from sioms.motion.watch import MotionWatch, Order
from sioms.protocol.flags import AxisStatus as S

FAST = 2.0
"""velocity_max of the axes of the rig [m/s]."""
REST = 100
"""Polls after which an axis has settled."""


class Defect(Cell):
    """One axis that has rested for long."""

    def __init__(self, **settings):
        super().__init__(1, **settings)
        self.poll(REST)

    def polls_to_fault(self, most=100):
        for count in range(1, most + 1):
            self.poll()
            if self.status() & S.FAULT:
                return count
        raise AssertionError(f"no fault within {most} polls")

    @property
    def text(self):
        return self.bank.fault_text(0)


@pytest.mark.parametrize("velocity", [0.2 * FAST, FAST, -5 * FAST])
def test_motion_that_nobody_commanded_is_a_fault_within_a_few_polls(velocity):
    cell = Defect()
    stops = len(cell.drives[0].log)
    cell.drives[0].shove = velocity
    assert cell.polls_to_fault() <= (4 if abs(velocity) >= FAST else 8)
    assert ("axis x moves" in cell.text and "0.02 m is allowed" in cell.text) or "axis x moves at" in cell.text
    assert cell.drives[0].log[stops:] == [ActionKind.QUICK_STOP]
    assert not cell.status() & S.POSITION_LOST


def test_an_axis_may_be_pushed_a_little_and_one_that_is_let_go_far():
    cell = Defect(watch=Watch(tolerance=0.05))
    cell.drives[0].shove = 0.49
    cell.poll(10)
    cell.drives[0].shove = 0.0
    cell.poll(50)
    cell.drives[0].shove = -0.98
    cell.poll(10)
    cell.drives[0].shove = 0.0
    cell.poll(50)
    assert not cell.status() & S.FAULT, cell.text
    cell.holds[:] = False
    cell.poll(2)
    cell.drives[0].shove = 1.0
    cell.poll(100)
    cell.drives[0].shove = 0.0
    cell.poll(2)
    cell.holds[:] = True
    cell.poll(100)
    assert not cell.status() & S.FAULT, cell.text
    cell.drives[0].shove = 1.0
    cell.polls_to_fault()


@pytest.mark.parametrize("brakes", [True, False])
def test_an_axis_that_is_found_moving_may_brake_and_no_more(brakes):
    """The driver before this one was killed in motion; the new one has sent a stop before its first poll."""
    watch, now, place, velocity = watch_of_one(), 10**9, 0.0, 1.0
    found = []
    for _ in range(300):
        found.append(watch.look(0, now, place, velocity, moving=velocity > 0))
        now += POLL_NS
        place += velocity * POLL_NS * 1e-9
        velocity = max(0.0, velocity - 5.0 * POLL_NS * 1e-9) if brakes else velocity
    assert any(found) is not brakes
    assert brakes or "nothing was commanded" in next(each for each in found if each).text


def test_an_axis_that_is_guided_by_hand_is_not_watched_for_that_alone():
    cell = Defect(watch=Watch(uncommanded=False))
    cell.drives[0].shove = 1.0
    cell.poll(100)
    assert not cell.status() & S.FAULT
    cell.drives[0].shove = 2 * FAST
    assert cell.polls_to_fault() <= 4
    assert "axis x moves at" in cell.text and "velocity_max is 2 m/s" in cell.text


@pytest.mark.parametrize("factor", [1.5, 2.0, 10.0])
def test_a_speed_above_the_limit_is_a_fault_in_40_ms(factor):
    cell = Defect()
    cell.write(mode=MODE.VELOCITY, velocity=FAST)
    cell.poll(10)
    cell.drives[0].shove = (factor - 1) * FAST
    assert cell.polls_to_fault() * POLL_NS <= 60_000_000
    assert "axis x moves at" in cell.text and "velocity_max is 2 m/s" in cell.text
    assert cell.drives[0].log[-1] is ActionKind.QUICK_STOP


def test_noise_and_overshoot_are_no_speed_above_the_limit():
    watch, rng = watch_of_one(), np.random.default_rng(1)
    watch.order(0, Order.RUN, FAST)
    now, place = 10**9, 0.0
    for i in range(5000):
        now += POLL_NS
        place += FAST * POLL_NS * 1e-9 * (1.15 if i % 100 < 10 else 1.0)
        noise = rng.normal(0, 0.2 * FAST)
        late_ns = 45_000_000 if i % 50 == 0 else 0  # stamped after a reply that was asked for twice
        assert watch.look(0, now + late_ns, place, FAST + noise) is None
        now += late_ns
        place += FAST * late_ns * 1e-9 if late_ns else 0.0


@pytest.mark.parametrize("fault", [0.0, 0.5])
def test_readings_that_a_busy_machine_stamps_late_are_no_finding(fault):
    """Stamps are up to 0.3 s late, the least late ones last: each interval looks shorter than it was."""
    watch = watch_of_one()
    watch.order(0, Order.RUN, FAST)
    speed, found = (1 + fault) * FAST, []
    for i in range(400):
        taken, late = i * 0.06, max(0.0, 0.3 - 0.04 * (i % 40))
        stamp_ns, late_ns = 10**9 + round((taken + late) * 1e9), round((late + 0.004) * 1e9)
        found.append(watch.look(0, stamp_ns, taken * speed, 1.5 * speed, moving=True, late_ns=late_ns))
    assert any(found) == bool(fault)


def watch_of_one(**settings):
    one = axis(k=None, **settings)
    return MotionWatch([one], np.array([one.velocity_max]), np.array([one.acceleration_max]))


def test_a_move_that_runs_the_other_way_is_a_fault():
    cell = Defect()
    cell.write(mode=MODE.POSITION, position=1.0)
    cell.poll(5)
    place = cell.drives[0].position
    cell.drives[0].shove = -2 * FAST  # it goes back at the speed at which it should go on
    cell.polls_to_fault()
    assert "away from its target 1 m" in cell.text
    assert cell.drives[0].position > place - 0.3


def test_a_velocity_that_runs_the_other_way_is_a_fault():
    cell = Defect()
    cell.write(mode=MODE.VELOCITY, velocity=0.5)
    cell.poll(5)
    cell.drives[0].shove = -1.5
    cell.polls_to_fault()
    assert "0.5 m/s were commanded" in cell.text


def test_a_replaced_move_may_brake_and_turn_and_pass_its_target_a_little():
    cell = Defect()
    cell.write(mode=MODE.POSITION, position=2.0)
    cell.poll(30)
    cell.write(mode=MODE.POSITION, position=-1.0, replace=True)
    drive = cell.drives[0]
    for velocity in np.linspace(2.0, 0.05, 40):  # it brakes at its acceleration before it turns
        cell.drives[0].shove = 2.0 + velocity
        cell.poll()
    cell.drives[0].shove = 0.0
    cell.poll(200)
    assert not cell.status() & S.FAULT, cell.text
    assert drive.position == pytest.approx(-1.0)
    cell.drives[0].shove = -0.5
    cell.poll(2)
    cell.drives[0].shove = 0.5
    cell.poll(2)
    cell.drives[0].shove = 0.0
    cell.poll(50)
    assert not cell.status() & S.FAULT, cell.text


def test_one_damaged_reading_is_no_finding():
    cell = Defect()
    for mode in (MODE.VELOCITY, MODE.POSITION):
        cell.write(mode=mode, velocity=0.1, position=1.0)
        cell.poll(10)
        cell.drives[0].position += 7.0
        cell.poll()
        cell.drives[0].position -= 7.0
        cell.poll(10)
        assert not cell.status() & S.FAULT, cell.text
    cell.poll(200)
    cell.drives[0].position += 7.0
    cell.poll()
    cell.drives[0].position -= 7.0
    cell.poll(10)
    assert not cell.status() & S.FAULT, cell.text


# --- a place that is lost -------------------------------------------------------------------------


def lost(cell):
    assert cell.status() & S.POSITION_LOST and cell.status() & S.FAULT
    assert "position lost" in cell.text
    assert not cell.status() & S.HOMED


@pytest.mark.parametrize("order", ["rest", "move", "velocity"])
def test_a_jump_of_the_position_is_a_lost_place(order):
    cell = Defect(start=-1.0)
    if order != "rest":
        cell.write(mode=MODE.POSITION if order == "move" else MODE.VELOCITY, position=2.5, velocity=0.4)
        cell.poll(20)
    cell.drives[0].position -= 1.5
    assert cell.polls_to_fault(3) <= 3
    lost(cell)
    assert cell.drives[0].log[-1] is ActionKind.QUICK_STOP


@pytest.mark.parametrize("silent_s", [0.3, 4.0])
@pytest.mark.parametrize("order", ["rest", "towards", "latched"])
def test_a_false_zero_after_a_silence_is_a_lost_place(silent_s, order):
    cell = Defect(start=0.5)
    if order == "towards":
        cell.write(mode=MODE.POSITION, position=2.5)
        cell.poll(10)
    elif order == "latched":
        cell.bank.fault([0], "the link is lost", cell.now_ns)
        cell.poll(5)
    cell.now_ns += int(silent_s * 1e9)
    cell.drives[0].position, cell.drives[0].wish = 0.0, 0.0
    assert not cell.status() & S.POSITION_LOST
    cell.poll(2)
    lost(cell)


@pytest.mark.parametrize("order", ["rest", "move", "velocity"])
def test_a_silence_in_which_the_axis_did_what_it_was_told_loses_nothing(order):
    cell = Defect()
    if order != "rest":
        cell.write(mode=MODE.POSITION if order == "move" else MODE.VELOCITY, position=2.5, velocity=0.4)
        cell.poll(10)
    cell.now_ns += 2 * 10**9
    for _ in range(200):
        cell.drives[0].step(POLL_NS * 1e-9)
    cell.poll(20)
    assert not cell.status() & S.FAULT, cell.text


def test_an_order_that_the_drive_may_have_heard_before_a_silence_loses_nothing():
    cell = Defect()
    cell.bank.append(records(mode=MODE.POSITION, position=2.5), [0], cell.now_ns)
    (action,) = cell.bank.take_actions()
    cell.drives[0].take(action)
    cell.bank.action_failed(action, "its reply was damaged", cell.now_ns)
    for _ in range(30):
        cell.drives[0].step(POLL_NS * 1e-9)
    cell.now_ns += 10**9
    cell.send()  # the stop of a link that is there again
    cell.poll(5)
    assert not cell.status() & S.POSITION_LOST, cell.text
    assert cell.drives[0].velocity == 0


def test_reset_alone_gives_no_positions_to_an_axis_that_lost_its_place():
    cell = Defect()
    cell.drives[0].position = 1.0
    cell.poll(3)
    lost(cell)
    cell.bank.reset([0])
    cell.poll(5)
    assert not cell.status() & S.FAULT and cell.status() & S.POSITION_LOST
    for mode in (MODE.POSITION, MODE.POSITION | MODE.RELATIVE):
        with pytest.raises(CommandError, match=r"position lost.*HOME it, or CALIBRATE_DEVICE") as caught:
            cell.write(mode=mode, position=0.1)
        assert caught.value.errno == errno.EPERM
    cell.write(mode=MODE.VELOCITY, velocity=0.1)  # it may be driven to where it can be seen
    cell.poll(10)
    cell.bank.stop([0], cell.now_ns)
    cell.poll(10)
    cell.bank.calibrate([0], [0.2])
    cell.write(mode=MODE.POSITION, position=0.3)
    cell.poll(50)
    assert not cell.status() & (S.FAULT | S.POSITION_LOST)
    assert cell.bank.rows["position"][0] == pytest.approx(0.3)


def test_homing_finds_the_place_again_and_sets_its_counter_as_it_likes():
    from sioms.motion import Homing

    cell = Defect(homing=Homing(0.1, 0.01))
    cell.bank.lose_place([0], "position lost: the board restarted", cell.now_ns)
    cell.poll()
    lost(cell)
    cell.bank.reset([0])
    cell.poll()
    cell.bank.home([0], cell.now_ns)
    cell.send()
    cell.drives[0].target, cell.drives[0].wish = -0.3, 0.1
    cell.poll(200)
    cell.poll(100)
    cell.drives[0].position, cell.drives[0].target = 0.0, 0.0  # some time after "done"
    cell.poll(20)
    assert cell.status() & S.HOMED
    assert not cell.status() & (S.FAULT | S.POSITION_LOST), cell.text
    cell.write(mode=MODE.POSITION, position=0.1)
    cell.poll(30)


def test_a_place_that_is_lost_is_told_once_and_kept_from_the_next_process():
    class Keeper:
        def __init__(self):
            self.rests = []

        def restored(self, raw):
            return np.zeros(1), np.ones(1, dtype=bool)

        def note(self, at_rest, homed, raw, position, now_ns):
            self.rests.append(bool(at_rest[0]))

    cell = Defect()
    keeper = cell.bank.keeper = Keeper()
    cell.poll(2)
    assert keeper.rests[-1]
    cell.events.clear()
    for _ in range(5):
        cell.bank.lose_place([0], "position lost: it says so", cell.now_ns)
        cell.poll()
    assert not any(keeper.rests[-4:])
    assert [e.kind for e in cell.events].count(EventKind.FAULT) == 1


# --- stops that are not obeyed --------------------------------------------------------------------


class Deaf(Defect):
    """A drive whose stops fail while ``failing``, or are confirmed and not obeyed while ``deaf``."""

    failing = deaf = False

    def __init__(self, **settings):
        self.stops = []
        super().__init__(**settings)

    def send(self):
        for action in self.bank.take_actions():
            if action.is_stop:
                self.stops.append((self.now_ns, action.kind))
                if self.failing:
                    self.bank.action_failed(action, "busy", self.now_ns)
                    continue
            if not (action.is_stop and self.deaf):
                self.drives[0].take(action)
            self.bank.action_done(action, self.now_ns)


@pytest.mark.parametrize("verb", ["stop", "emergency_stop"])
@pytest.mark.parametrize("cause", ["failing", "deaf"])
def test_a_stop_is_sent_until_the_drive_obeys(verb, cause):
    cell = Deaf()
    cell.write(mode=MODE.VELOCITY, velocity=0.1)
    cell.poll(10)
    setattr(cell, cause, True)
    getattr(cell.bank, verb)([0], cell.now_ns)
    cell.poll(500)
    assert len(cell.stops) >= 5
    assert cell.status() & S.FAULT and cell.status() & S.STOPPING
    assert ("busy" in cell.text) if cause == "failing" else ("does not stop" in cell.text)
    assert max(np.diff([at for at, _ in cell.stops])) <= 1.6e9
    setattr(cell, cause, False)
    cell.poll(200)
    assert cell.drives[0].velocity == 0 and cell.bank.is_idle([0])
    sent = len(cell.stops)
    cell.poll(300)
    assert len(cell.stops) == sent, "a drive that rests is told no more"


def test_a_drive_that_refuses_to_be_stopped_at_rest_is_believed_after_a_while():
    cell = Deaf()
    cell.failing = True
    cell.bank.stop([0], cell.now_ns)
    cell.poll(50)
    assert not cell.bank.is_idle([0])
    cell.poll(150)
    assert cell.bank.is_idle([0])
