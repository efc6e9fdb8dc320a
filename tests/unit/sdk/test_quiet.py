"""Ticks by compiled steps show what ticks of the driver show, with commands, limits, stops and walls in between."""

import numpy as np
import pytest
from quiet_rig import PERIOD_NS, Cell

from sioms.motion import CommandError, EventKind
from sioms.motion.axis_step import SETTLING
from sioms.motion.plan_step import may_follow
from sioms.protocol.flags import ControlMode, NodeClass
from sioms.protocol.records import numpy_dtype
from sioms.sdk.driver import TickDriver
from sioms.sdk.handles import Wait, Waits

MODES = (
    (ControlMode.POSITION, "position", 0.3),
    (ControlMode.VELOCITY, "velocity", 0.4),
    (ControlMode.FORCE, "force", 8.0),
)


def test_steps_show_what_the_driver_shows(monkeypatch):
    monkeypatch.setattr("sioms.drivers.sim.axes_world._SLACK_NS", -(10**18))  # plans are made ahead at any time
    plain, quiet = Cell(False), Cell(True)
    rng, now_ns, refused = np.random.default_rng(5), 1_000_000_000, 0
    for tick in range(3000):
        now_ns += PERIOD_NS * (1 if rng.random() < 0.98 else int(rng.choice([2, 3, 7, 40])))
        for cell in (plain, quiet):
            cell.tick(now_ns)
        assert plain.shown() == quiet.shown(), f"tick {tick}"
        draw = rng.random()
        if draw < 0.02:
            mode, column, most = MODES[int(rng.integers(len(MODES)))]
            record = np.zeros(1, numpy_dtype(NodeClass.AXIS))
            record["axis"], record["control_mode"] = rng.integers(3), int(mode)
            record[column] = rng.uniform(-most, most)
        told = [cell.driver.bank.take_events() for cell in (plain, quiet)]
        assert told[0] == told[1], f"tick {tick}"
        for cell in (plain, quiet):
            bank = cell.driver.bank
            if draw < 0.02:
                try:
                    bank.append(record, range(3), now_ns + 300_000, replace=bool(tick % 2))
                except CommandError:
                    refused += 1
            elif draw < 0.022:
                bank.stop([0], now_ns + 200_000)
            elif draw < 0.024:
                bank.emergency_stop([1], now_ns + 200_000)
            elif draw < 0.028:
                bank.reset([0, 1, 2])
    assert quiet.quiet > 2900, "most ticks are steps, those too in which a segment of a profile ends"
    assert 3000 - quiet.quiet > 30, "and some are not"
    assert quiet.driver.blocks[2].edges[0] > 10, "beams were broken, and free again"


@pytest.mark.parametrize("seed", range(3))
def test_commands_that_wait_begin_by_steps_as_by_the_driver(monkeypatch, seed):
    """Rows of commands, long and shorter than a tick, with gains, limits and force modes among them, stops between."""
    monkeypatch.setattr("sioms.drivers.sim.axes_world._SLACK_NS", -(10**18))  # plans are made ahead at any time
    plain, quiet = Cell(False), Cell(True)
    rng, now_ns, refused, begun, started = np.random.default_rng(seed), 1_000_000_000, 0, 0, set()
    for tick in range(3000):
        now_ns += PERIOD_NS * (1 if rng.random() < 0.98 else int(rng.choice([2, 3, 7])))
        for cell in (plain, quiet):
            cell.tick(now_ns)
        begun += quiet.begun
        assert plain.shown() == quiet.shown(), f"tick {tick}"
        told = [cell.driver.bank.take_events() for cell in (plain, quiet)]
        assert told[0] == told[1], f"tick {tick}"
        started.update(event.kind for event in told[0])
        draw, records = rng.random(), np.zeros(8, numpy_dtype(NodeClass.AXIS))
        for record in records:
            record["axis"], record["control_mode"] = rng.integers(3), int(ControlMode.POSITION)
            record["position"] = rng.choice([rng.uniform(-0.02, 0.02), rng.uniform(0.0, 1e-8)])
            if rng.random() < 0.1:
                record["control_mode"] |= int(ControlMode.SPECIFIED_MAX_VEL_ACC)
                record["max_velocity"], record["max_acceleration"] = rng.uniform(0.1, 0.5), rng.uniform(1.0, 5.0)
            elif rng.random() < 0.004:
                record["control_mode"], record["force"] = int(ControlMode.FORCE), 5.0
            elif rng.random() < 0.01:
                record["control_mode"], record["velocity"] = int(ControlMode.VELOCITY), rng.uniform(-0.1, 0.1)
        for cell in (plain, quiet):
            bank = cell.driver.bank
            if draw < 0.02:
                try:
                    bank.append(records, range(3), now_ns + 300_000, replace=draw < 0.002)
                except CommandError:
                    refused += 1
            elif draw < 0.022:
                bank.stop([0], now_ns + 200_000)
            elif draw < 0.023:
                bank.emergency_stop([1], now_ns + 200_000)
            elif draw < 0.04:
                bank.reset([0, 1, 2])
    assert {EventKind.STARTED, EventKind.ENDED, EventKind.IDLE} <= started
    assert begun > 40, f"{begun}: most of the commands that follow others"


@pytest.mark.parametrize("way", [1e-8, 0.01])
def test_what_follows_a_short_command_is_the_banks_which_counts_its_pace(way):
    cell, now_ns = Cell(True), 1_000_000_000
    cell.tick(now_ns)
    bank = cell.driver.bank
    records = np.zeros(2, numpy_dtype(NodeClass.AXIS))
    records["control_mode"] = int(ControlMode.POSITION)
    records["position"] = float(bank._sequencer.store.final[0, 0]) + way, 0.1
    bank.append(records, range(3), now_ns)
    bank._settle(now_ns)
    bank.plan_ahead()
    assert bank.is_quiet() and bank.plans.follows and bank.plans.ready[0]
    assert bool(may_follow(bank.plans, 0, now_ns + PERIOD_NS)) == (way > 1e-6)


@pytest.mark.parametrize("awaited", [False, True])
@pytest.mark.parametrize(
    "mode, column, value, gain",
    [(ControlMode.POSITION, "position", 0.02, 1.0), (ControlMode.VELOCITY, "velocity", 0.1, 1.0),
     (ControlMode.POSITION, "position", 0.02, 0.03)],
    ids=["position", "velocity", "a soft axis that settles"],
)  # fmt: skip
def test_a_motion_ends_by_steps_unless_somebody_waits_for_that(monkeypatch, awaited, mode, column, value, gain):
    monkeypatch.setattr("sioms.drivers.sim.axes_world._SLACK_NS", -(10**18))
    plain, quiet = Cell(False), Cell(True)
    for cell in (plain, quiet):
        cell.driver.bank.arrays["k"][:] *= gain
    now_ns, told, by_steps, settling = 1_000_000_000, ([], []), [], 0
    for tick in range(1200):
        now_ns += PERIOD_NS
        if tick % 300 == 5:
            records = np.zeros(2, numpy_dtype(NodeClass.AXIS))
            records["axis"], records["control_mode"] = (0, 1), int(mode | ControlMode.SPECIFIED_TIME)
            records["time"], records[column] = 0.2, value * (1 if tick % 600 == 5 else -1)
            for cell in (plain, quiet):
                cell.driver.bank.append(records, range(3), now_ns - PERIOD_NS)
                cell.driver.bank.plan_ahead()
        done = quiet.quiet
        plain.tick(now_ns)
        quiet.tick(now_ns, awaited)
        assert plain.shown() == quiet.shown(), f"tick {tick}"
        settling += int((quiet.driver.bank.arrays["kind"] == SETTLING).any())
        for cell, events in zip((plain, quiet), told, strict=True):
            new = cell.driver.bank.take_events()
            events += new
            if cell is quiet and any(event.kind in (EventKind.ENDED, EventKind.IDLE) for event in new):
                by_steps.append(quiet.quiet > done)
    assert told[0] == told[1]
    assert len(by_steps) >= 4 and (not any(by_steps) if awaited else any(by_steps))
    assert (settling > 0) == (gain < 1.0)


@pytest.mark.parametrize("late", [False, True])
def test_a_device_that_is_late_plans_ahead_and_goes_on_by_steps(monkeypatch, late):
    """Else its late tick is the loop's, and all after it, each later than the one before."""
    now_ns = 1_000_000_000
    clock_ns = now_ns + 20 * PERIOD_NS
    monkeypatch.setattr("time.monotonic_ns", lambda: clock_ns)
    cell = Cell(True)
    cell.tick(now_ns)
    records = np.zeros(2, numpy_dtype(NodeClass.AXIS))
    records["control_mode"], records["velocity"] = int(ControlMode.VELOCITY | ControlMode.SPECIFIED_TIME), 0.1
    records["time"] = 0.3
    cell.driver.bank.append(records, range(3), now_ns)
    for _ in range(2):
        now_ns += PERIOD_NS
        cell.driver.tick(now_ns)
        cell.driver.slack(now_ns, now_ns + PERIOD_NS)
    if not late:
        clock_ns = now_ns + PERIOD_NS // 2
    assert cell.steps.is_ready(True) == late
    if not late:  # where the next tick is always as near, each of them would be the loop's
        world = cell.driver._world
        world.tick_ns = PERIOD_NS // 5
        clock_ns = now_ns + world.tick_ns - world.tick_ns // 20
        assert not cell.steps.is_ready(True)
        clock_ns = now_ns + world.tick_ns // 2
        assert cell.steps.is_ready(True)


@pytest.mark.parametrize("at_ms", [300, 570], ids=["as steps", "from an edge on in Python"])
def test_turns_that_steps_make_up_for_are_shown_each_at_its_time(monkeypatch, at_ms):
    monkeypatch.setattr("sioms.drivers.sim.axes_world._SLACK_NS", -(10**18))
    cell, now_ns = Cell(True), 1_000_000_000
    cell.tick(now_ns)
    record = np.zeros(1, numpy_dtype(NodeClass.AXIS))
    record["control_mode"], record["velocity"] = int(ControlMode.VELOCITY), 0.1
    cell.driver.bank.append(record, range(3), now_ns)
    for _ in range(at_ms):
        now_ns += PERIOD_NS
        cell.tick(now_ns)
    axes, _, port = cell.driver.blocks
    first, quiet, edges = cell.pages.number(axes), cell.quiet, int(port.edges[0])
    now_ns += 80 * PERIOD_NS
    cell.tick(now_ns)
    assert (cell.quiet > quiet) == (edges == port.edges[0]) == (at_ms == 300)
    for block in cell.driver.blocks:
        record = cell.pages.record(block)
        assert cell.pages.number(block) >= first + 80 // cell.driver._world.stride
        words = record.words[32:]
        stamps = [int(words[(n & record.mask) * record.slot + 1]) for n in range(first, cell.pages.number(block) + 1)]
        assert stamps[0] == now_ns - 80 * PERIOD_NS and stamps[-1] == now_ns
        assert max(np.diff(stamps)) <= cell.driver._world.stride * PERIOD_NS, "no turn is missing"


def test_steps_that_have_no_time_leave_turns_to_later_ticks_as_the_driver_does(monkeypatch):
    monkeypatch.setattr("sioms.drivers.sim.axes_world._SLACK_NS", -(10**18))
    plain, quiet = Cell(False, make_up_ns=0), Cell(True, make_up_ns=0)
    record, now_ns = np.zeros(1, numpy_dtype(NodeClass.AXIS)), 1_000_000_000
    record["control_mode"], record["velocity"] = int(ControlMode.VELOCITY), 0.1
    for tick in range(450):
        now_ns += PERIOD_NS * (60 if tick in (300, 310) else 1)
        for cell in (plain, quiet):
            cell.tick(now_ns)
            if not tick:
                cell.driver.bank.append(record, range(3), now_ns)
        assert plain.shown() == quiet.shown(), f"tick {tick}"
        late_ns = now_ns - quiet.driver._world.last_ns
        if tick in (300, 310):
            assert late_ns > 50 * PERIOD_NS
    assert late_ns == 0 and quiet.quiet > 350


def test_idle_ticks_by_steps_show_what_those_of_the_driver_show(monkeypatch):
    monkeypatch.setattr("sioms.drivers.sim.axes_world._SLACK_NS", -(10**18))
    plain, quiet = Cell(False), Cell(True)
    now_ns, idle = 1_000_000_000, 0
    for cell in (plain, quiet):
        cell.tick(now_ns)
    for target in (0.05, -0.05, 0.1):
        record = np.zeros(1, numpy_dtype(NodeClass.AXIS))
        record["control_mode"], record["position"] = int(ControlMode.POSITION), target
        for cell in (plain, quiet):
            cell.driver.bank.append(record, range(3), now_ns)
        quiet.quiet = 0
        for _ in range(1500):
            now_ns += PERIOD_NS * (40 if idle else 1)
            rests = [cell.rest(now_ns) for cell in (plain, quiet)]
            assert rests[0] == rests[1]
            assert plain.shown() == quiet.shown()
            idle += rests[0]
            if idle > 50:
                break
        assert idle > 50 and quiet.quiet > 50, "it has come to rest, and was ticked by steps"
        idle = 0


def test_who_is_looked_at_or_has_effects_does_not_rest_by_steps():
    cell, now_ns = Cell(True), 1_000_000_000
    for _ in range(100):
        now_ns += PERIOD_NS
        cell.rest(now_ns)
    assert cell.rest(now_ns + PERIOD_NS)
    assert not cell.rest(now_ns + 2 * PERIOD_NS, watched=True)
    cell.driver._world.has_effects = True
    assert not cell.rest(now_ns + 3 * PERIOD_NS)


def test_a_driver_in_plain_python_has_no_steps():
    assert TickDriver.quiet_steps(object(), None, None) is None


class Handle:
    uid = 1

    def __init__(self):
        self.waits = {}
        self.quota = type("Quota", (), {"waits": 64})


def waits_of(*kinds):
    waits = Waits(None, None, print)
    for number, (deadline_ns, on_events) in enumerate(kinds):
        waits.add(Wait(Handle(), number, "wait", deadline_ns, lambda: None, on_events=on_events))
    return waits


def test_only_waits_for_events_leave_ticks_alone():
    assert waits_of().until_ns() == 2**62
    assert waits_of((None, True), (700, True), (900, True)).until_ns() == 700
    assert waits_of((700, True), (None, False)).until_ns() == 0
    assert waits_of(*[(None, True)] * 40).until_ns() == 0


def test_behind_a_rest_the_world_is_on_the_grid_of_ticks_again():
    cell, now_ns = Cell(True), 1_000_000_000
    for _ in range(200):
        now_ns += PERIOD_NS
        cell.tick(now_ns)
    assert cell.driver.is_at_rest() or cell.driver.is_at_rest()
    now_ns += 40 * PERIOD_NS
    cell.driver.tick(now_ns + 300_000)  # woken in between two ticks
    cell.driver.slack(now_ns, now_ns + 10 * PERIOD_NS)
    for _ in range(3):
        now_ns += PERIOD_NS
        cell.quiet = 0
        cell.tick(now_ns)
    assert cell.quiet == 1
