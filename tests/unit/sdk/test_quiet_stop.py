"""A stop that steps have begun is the bank's own stop: what is published, told and done afterwards is the same."""

from contextlib import suppress

import numpy as np
import pytest
from quiet_rig import PERIOD_NS, Cell

from sioms.motion import CommandError
from sioms.motion.stop_step import is_behind
from sioms.protocol.flags import AxisStatus, ControlMode, NodeClass
from sioms.protocol.records import numpy_dtype

AXES = range(3)
TOLD_LATER = {"status", "in_motion", "buffered"}
"""Columns that show what the loop has yet to do; of the status, that nothing waits and nothing moves any more."""
ENDED = AxisStatus.WAITING_SYNCH | AxisStatus.WAITING_MARKER | AxisStatus.MOVING | AxisStatus.STOPPING


@pytest.fixture(autouse=True)
def _plans(monkeypatch):
    """Plans are made ahead, whatever the time is."""
    monkeypatch.setattr("sioms.drivers.sim.axes_world._SLACK_NS", -(10**18))


def commands(rng, modes=(ControlMode.POSITION, ControlMode.VELOCITY)):
    """Return three commands for each axis, so that a stop has something to drop."""
    records = np.zeros(9, numpy_dtype(NodeClass.AXIS))
    records["axis"], records["control_mode"] = np.repeat(AXES, 3), rng.choice([int(m) for m in modes], 9)
    records["position"], records["velocity"] = rng.uniform(-0.18, 0.14, 9), rng.uniform(-0.4, 0.4, 9)
    records["time"] = 0.3
    records["control_mode"][records["control_mode"] == int(ControlMode.VELOCITY)] |= int(ControlMode.SPECIFIED_TIME)
    return records


def values(cell, but=frozenset()):
    rows = {name: row.tolist() for name, row in cell.driver.bank.rows.items() if name not in but}
    return rows, cell.driver._world.plant.data.tolist()


def stop_by_steps(cell, now_ns, latches=1, since_ns=0):
    """Begin a stop as the loop in compiled code does, as from an instant; tell whether the steps have taken it."""
    steps = cell.steps
    if not steps.is_ready(True) or not cell.pages.lend():
        return False
    taken = steps.stop(steps.record, now_ns, latches, since_ns or now_ns) == 0
    if not taken:
        take_back(cell)
    return taken


def take_back(cell):
    cell.pages.take_back()
    cell.steps.resume()


def tick_owing(cell, now_ns):
    """Do a tick between the stop and the loop's turn; tell whether the steps have done it."""
    steps = cell.steps
    if steps.tick(steps.record, now_ns, now_ns - PERIOD_NS, cell.number + 1):
        return False
    cell.number += 1
    steps.slack(steps.record, now_ns, now_ns + PERIOD_NS, 0)
    return True


def told(cell):
    """Return the events of each axis in order; the loop tells of them later where steps have begun the stop."""
    events = cell.driver.bank.take_events()
    return [[(e.kind, e.errno, e.text) for e in events if axis in e.axes] for axis in AXES]


def both(some, more):
    return [a + b for a, b in zip(some, more, strict=True)]


def stop(cell, now_ns, latches):
    """Stop all axes, latched, or as one does whose owner has gone."""
    bank = cell.driver.bank
    (bank.emergency_stop if latches else bank.stop)(AXES, now_ns)


@pytest.mark.parametrize("latches", [1, 0])
@pytest.mark.parametrize("owed", [0, 1, 5, 100])
def test_a_stop_by_steps_is_the_stop_of_the_bank(owed, latches):
    cells = plain, quiet = Cell(False), Cell(True)
    rng, now_ns, taken, left = np.random.default_rng(owed), 1_000_000_000, 0, 0
    for trial in range(25):
        records = commands(rng)
        for tick in range(int(rng.integers(2, 200))):
            now_ns += PERIOD_NS
            for cell in cells:
                cell.tick(now_ns)
                if tick == 0:
                    with suppress(CommandError):
                        cell.driver.bank.append(records, AXES, now_ns)
        assert told(plain) == told(quiet)
        stop_ns = now_ns + int(rng.integers(PERIOD_NS))
        seen_ns = stop_ns + int(rng.integers(now_ns + PERIOD_NS - stop_ns))  # it is the same whenever steps find it
        owes = stop_by_steps(quiet, seen_ns, latches, stop_ns)
        taken += owes
        if not owes:
            stop(quiet, stop_ns, latches)
        stop(plain, stop_ns, latches)
        events = told(plain)
        while owes and now_ns < stop_ns + (owed - 1) * PERIOD_NS:
            now_ns += PERIOD_NS
            plain.tick(now_ns)
            events = both(events, told(plain))
            if not tick_owing(quiet, now_ns):  # something else has happened: the loop sees to the stop first
                left += 1
                take_back(quiet)
                stop(quiet, now_ns, latches)
                quiet.tick(now_ns)
                owes = False
            assert values(plain, TOLD_LATER) == values(quiet, TOLD_LATER), f"trial {trial}, before it is told"
            was, shown = (cell.driver.bank.rows["status"] for cell in cells)
            stopped = (shown & AxisStatus.EMERGENCY_STOP) > 0
            assert stopped.all() if latches else not stopped.any(), "who brakes for a stop is shown as stopped"
            assert ((was ^ shown) & ~ENDED == 0).all() and (was & ~shown & ENDED == 0).all()
            assert (quiet.driver.bank.rows["in_motion"] >= plain.driver.bank.rows["in_motion"]).all()
        if owes:
            take_back(quiet)
            stop(quiet, now_ns + 1, latches)
        now_ns += PERIOD_NS
        for cell in cells:
            cell.tick(now_ns)
        assert values(plain) == values(quiet), f"trial {trial}, all told"
        assert both(events, told(plain)) == told(quiet)
        for cell in cells:
            cell.driver.bank.reset(AXES)
    assert taken > 15 and left < 9, "most stops are begun, and carried on, by steps"


def stopped_by_steps(cell, now_ns, told_ns):
    """Stop by steps, and have the loop tell of it some ticks later."""
    assert stop_by_steps(cell, now_ns - PERIOD_NS // 3)
    while now_ns < told_ns:
        assert tick_owing(cell, now_ns)
        now_ns += PERIOD_NS
    take_back(cell)
    cell.driver.bank.emergency_stop(AXES, now_ns)
    return now_ns


def go_on(cell, now_ns, ticks):
    for _ in range(ticks):
        cell.tick(now_ns)
        now_ns += PERIOD_NS
    return now_ns


@pytest.mark.parametrize("owed", [0, 3])
def test_a_stop_that_is_over_at_once_lets_nothing_follow(owed):
    cell = Cell(True)
    records = np.zeros(6, numpy_dtype(NodeClass.AXIS))
    records["axis"], records["time"] = np.repeat(AXES, 2), 0.5
    records["control_mode"][::2] = int(ControlMode.VELOCITY | ControlMode.SPECIFIED_TIME)  # of 0 m/s
    records["control_mode"][1::2], records["position"][1::2] = int(ControlMode.POSITION), 0.1
    now_ns = go_on(cell, 1_000_000_000, 20)
    cell.driver.bank.append(records, AXES, now_ns - PERIOD_NS)
    now_ns = go_on(cell, now_ns, 100)
    before = cell.driver.bank.rows["position"].copy()
    now_ns = stopped_by_steps(cell, now_ns, now_ns + owed * PERIOD_NS)
    for _ in range(1000):
        now_ns = go_on(cell, now_ns, 1)
        assert not cell.driver.bank.rows["commanded_velocity"].any()
    assert np.abs(cell.driver.bank.rows["position"] - before).max() < 1e-4
    assert not cell.driver.bank.rows["in_motion"].any()


def test_stops_by_steps_of_stopped_axes_and_what_comes_after_the_reset():
    cell = Cell(True)
    now_ns = go_on(cell, 1_000_000_000, 20)
    cell.driver.bank.emergency_stop(AXES, now_ns - PERIOD_NS)  # that of the node; the workcell's follows
    now_ns = go_on(cell, now_ns, 20)
    now_ns = stopped_by_steps(cell, now_ns, now_ns + 2 * PERIOD_NS)
    now_ns = go_on(cell, now_ns, 20)
    cell.driver.bank.reset(AXES)
    records = np.zeros(60, numpy_dtype(NodeClass.AXIS))  # so many are not left to the next tick
    records["axis"], records["control_mode"] = np.repeat(AXES, 20), int(ControlMode.POSITION)
    records["position"] = 0.02
    cell.driver.bank.append(records, AXES, now_ns)
    for _ in range(500):
        before = cell.driver.bank.rows["commanded_position"].copy()
        now_ns = go_on(cell, now_ns, 1)
        assert np.abs(cell.driver.bank.rows["commanded_position"] - before).max() <= 0.5 * PERIOD_NS * 1.01e-9
    assert np.abs(cell.driver.bank.rows["position"] - 0.02).max() < 2e-3


def test_a_stop_by_steps_begins_neither_before_the_last_tick_nor_before_what_is_under_way():
    cell = Cell(True)
    bank, records = cell.driver.bank, np.zeros(3, numpy_dtype(NodeClass.AXIS))
    records["axis"], records["control_mode"], records["velocity"] = AXES, int(ControlMode.VELOCITY), 0.1
    now_ns = go_on(cell, 1_000_000_000, 20)
    bank.append(records, AXES, now_ns - PERIOD_NS)
    now_ns = go_on(cell, now_ns, 100)
    assert stop_by_steps(cell, now_ns, since_ns=1)
    assert bank.plans.braked_ns == now_ns - PERIOD_NS, "the last tick has shown that they went on"
    take_back(cell)
    bank.emergency_stop(AXES, now_ns)
    bank.reset(AXES)
    now_ns = go_on(cell, now_ns, 300)
    bank.append(records, AXES, now_ns - PERIOD_NS)
    now_ns = go_on(cell, now_ns, 2)
    begun_ns = now_ns - PERIOD_NS + 1000
    bank._sequencer.store.segment_ns[1] = begun_ns
    assert stop_by_steps(cell, now_ns, since_ns=1) and bank.plans.braked_ns == begun_ns


def test_who_is_behind_by_the_step_is_so_by_the_law():
    cell, rng = Cell(True), np.random.default_rng(1)
    law, loop = cell.driver.bank._law, cell.driver.bank.loop
    arrays, seen = cell.driver.bank.arrays, set()
    for _ in range(300):
        for name in ("error", "velocity", "output"):
            arrays[name][:] = rng.choice([-1e-3, 0.0, 1e-3, 0.3, -0.3], 3)
        arrays["saturated"][:], arrays["kind"][:] = rng.integers(2, size=3), rng.integers(7, size=3)
        found = [bool(is_behind(loop, axis)) for axis in AXES]
        assert found == law.is_behind(np.array(AXES)).tolist()
        seen.update(found)
    assert seen == {True, False}


def test_steps_leave_axes_that_run_with_gains_of_a_command_to_the_bank():
    cell = Cell(True)
    bank, records = cell.driver.bank, np.zeros(1, numpy_dtype(NodeClass.AXIS))
    records["control_mode"], records["velocity"] = int(ControlMode.VELOCITY), 0.1
    now_ns = go_on(cell, 1_000_000_000, 20)
    bank.append(records, AXES, now_ns)
    now_ns = go_on(cell, now_ns, 100)
    configured = bank.rows["k"][0]
    records["control_mode"] |= int(ControlMode.SPECIFIED_GAINS)  # all of 0
    bank.append(records, AXES, now_ns, replace=True)
    now_ns = go_on(cell, now_ns, 5)
    assert bank.rows["k"][0] == 0.0
    assert not stop_by_steps(cell, now_ns)
    bank.emergency_stop(AXES, now_ns)
    assert bank.rows["k"][0] == configured
    now_ns = go_on(cell, now_ns, 500)
    assert abs(bank.rows["velocity"][0]) < 1e-3
    bank.reset(AXES)
    now_ns = go_on(cell, now_ns, 20)
    assert stop_by_steps(cell, now_ns)
    take_back(cell)
