"""A device at rest whom nobody looks at ticks seldom; nobody can tell by what it does afterwards."""

import random
from typing import Any

import numpy as np
import pytest
from own_writes_rig import CLOCK, World, own_time

from sioms.drivers.sim.axes import SimAxes
from sioms.drivers.sim.force import SimForce
from sioms.drivers.sim.io import SimIo
from sioms.protocol.driver_verbs import DriverVerb
from sioms.protocol.flags import ControlMode, NodeClass
from sioms.protocol.records import AXIS_WRITE, WRITE
from sioms.sdk.driver import Driver
from sioms.sdk.idling import Idling

LIMITS = {"position_min": -1.0, "position_max": 1.0, "velocity_max": 0.5, "acceleration_max": 5.0}
AXES = {
    "axis": [
        {"name": "x", **LIMITS, "motor": {"mass": 1.0, "coulomb": 1.0, "stiction": 1.5}, "force_max": 60.0},
        {"name": "s", **LIMITS, "stepper": {"mass": 0.5, "step": 2e-4, "hold_force": 40.0, "coulomb": 1.0}},
    ]
}
PERIOD_NS = 1_000_000


def rested(driver: type[Driver], table: dict[str, Any], made: list[World], *, used: bool, ticks: int = 1400) -> World:
    """Return a world in which nothing has happened for so many ticks."""
    made[:] = [World(driver, table, random.Random(1))]
    world = made[0]
    world.order(DriverVerb.IN_USE, used)
    world.runtime._control_readable()
    for _ in range(ticks):
        world.tick()
    return world


def periods(world: World) -> int:
    """Return how many periods lie between two ticks."""
    return world.runtime._idling.periods


def test_idle_after_a_second_within_the_lease_and_awake_at_once() -> None:
    idling = Idling(PERIOD_NS, lease_ns=100_000_000)
    idling.wake(0)
    assert not idling.rest(999_999_999)
    assert idling.rest(1_000_000_000) and idling.periods == 25
    assert not idling.rest(1_025_000_000)
    assert idling.wake(1_030_000_000) and idling.periods == 1
    assert not idling.wake(1_030_000_001)
    assert Idling(PERIOD_NS, lease_ns=100_000_000).rest(5_000_000_000), "from its start"
    seldom = Idling(30_000_000, lease_ns=1_000_000_000)
    seldom.wake(0)
    assert not seldom.rest(2_000_000_000)


def test_missed_turns_of_a_world_at_rest_need_not_be_made_up() -> None:
    traces = []
    for used in (True, False):
        made: list[World] = []
        with own_time(made):
            world = rested(SimAxes, AXES, made, used=used)
            assert periods(world) == (1 if used else 40)
            bank = world.runtime.blocks[0].bank  # type: ignore[attr-defined]
            turns = 0
            advance = world.runtime.driver._world.servos.advance  # type: ignore[attr-defined]

            def count(force: Any, advance: Any = advance) -> None:
                nonlocal turns
                turns += 1
                advance(force)

            world.runtime.driver._world.servos.advance = count  # type: ignore[attr-defined]
            for _ in range(10):
                world.tick()
            assert turns <= 20
            client = world.open(0, [0, 1], exclusive=True)
            world.runtime._wake()
            given = {"control_mode": int(ControlMode.POSITION), "position": 0.1, "velocity": 0.5, "acceleration": 5.0}
            record = AXIS_WRITE.pack(*(given.get(name, 0) for name in WRITE[NodeClass.AXIS]))
            client.write(record * 2, replace=True)
            assert periods(world) == 1
            trace = []
            for _ in range(300):
                world.tick()
                trace.append(bank.fields[0].copy())
            traces.append(np.array(trace))
            world.close()
    assert np.abs(traces[0][-1]).max() > 0.02
    assert traces[0] == pytest.approx(traces[1], abs=1e-5)


def test_an_order_a_stop_and_an_input_wake_it() -> None:
    made: list[World] = []
    with own_time(made):
        world = rested(SimAxes, AXES, made, used=False)
        world.order(DriverVerb.IN_USE, True)
        world.runtime._control_readable()
        assert periods(world) == 1
        world.order(DriverVerb.IN_USE, False)
        world.runtime._control_readable()
        for _ in range(1100):
            world.tick()
        assert periods(world) == 40
        world.order(DriverVerb.NODE_STOP, 0, [0], -1, "eva", world.latch.resets, CLOCK())
        world.runtime._control_readable()
        assert periods(world) == 1
        world.close()


@pytest.mark.parametrize("woken", [False, True])
def test_a_tick_that_was_announced_before_another_beat_is_none_of_it(*, woken: bool) -> None:
    """A device of several in a process ticks on while it waits for its turn: it may be found at rest, and woken, with
    its next tick announced. Counted from the new beat that tick lay ahead for ever.
    """
    made: list[World] = []
    with own_time(made):
        world = rested(SimAxes, AXES, made, used=False, ticks=900)
        runtime = world.runtime
        assert periods(world) == 1
        CLOCK.now_ns += 10**9
        runtime._announced, runtime._expired = 1, 1
        runtime._be_idle(CLOCK.now_ns)
        assert periods(world) == 40
        if woken:
            runtime._wake()
        assert (runtime._announced, runtime._expired) == (0, 0)
        due_ns, last = runtime._scheduled_ns + periods(world) * PERIOD_NS, runtime.tick
        for _ in range(5 * periods(world)):
            world.tick()
        assert runtime.tick > last and runtime._scheduled_ns >= due_ns
        world.close()


def test_what_moves_by_itself_is_not_idle() -> None:
    made: list[World] = []
    with own_time(made):
        waves = {"inputs": 1, "wave": [{"bit": 0, "period_s": 0.1, "high_s": 0.05}]}
        world = rested(SimIo, waves, made, used=False)
        assert periods(world) == 1
        world.close()
        world = rested(SimForce, {}, made, used=False)
        assert periods(world) == 40
        world.close()


def test_a_driver_that_ticks_seldom_sleeps_before_its_tick() -> None:
    """It does the work of the slack first, and begins the tick by a timer."""
    made: list[World] = []
    with own_time(made):
        world = rested(SimForce, {"tick_hz": 100.0}, made, used=True, ticks=2)
        runtime, worked = world.runtime, []
        world.runtime.driver.slack = lambda *times: worked.append(times)  # type: ignore[method-assign]
        CLOCK.now_ns = runtime._scheduled_ns + runtime.period_ns - runtime._lead_ns
        before, begun_ns = runtime.statistics.ticks, CLOCK.now_ns
        runtime._timer.expired = 1  # type: ignore[attr-defined]
        runtime._on_timer()
        assert CLOCK.now_ns < begun_ns + 1000, "nothing but to look at the clock takes time here: it has spun"
        assert (len(worked), runtime.statistics.ticks) == (1, before)
        assert runtime._line_due_ns == runtime._scheduled_ns + runtime.period_ns
        runtime._on_line_timer()
        assert (len(worked), runtime.statistics.ticks) == (1, before), "it was for another tick, and is set anew"
        CLOCK.now_ns = runtime._line_due_ns
        runtime._on_line_timer()
        assert (len(worked), runtime.statistics.ticks) == (1, before + 1)
        world.close()


@pytest.mark.parametrize(("tenths", "another"), [(3, True), (6, False)])
def test_a_stop_that_an_early_tick_heeds_has_no_other_at_once(tenths: int, *, another: bool) -> None:
    """It began after the instant of that tick, and shows in another: a quarter of a period later, or on the grid."""
    made: list[World] = []
    with own_time(made):
        table = {"axis": [axis | {"bandwidth_hz": 5.0} for axis in AXES["axis"]], "tick_hz": 100.0}
        world = rested(SimAxes, table, made, used=True, ticks=2)
        runtime = world.runtime
        CLOCK.now_ns = runtime._scheduled_ns + tenths * runtime.period_ns // 10
        before = runtime.tick
        world.latch.stop(CLOCK.now_ns, "eva")
        runtime._early_tick()
        assert runtime.stops.stopped and runtime.tick == before + 1
        assert runtime._line_due_ns == (runtime._ticked_ns + runtime.period_ns // 4 if another else None)
        world.close()


def test_an_early_tick_that_did_not_come_comes_with_that_of_the_grid() -> None:
    """Its timer has expired, and is looked at behind the other one."""
    made: list[World] = []
    with own_time(made):
        world = rested(SimAxes, AXES, made, used=True, ticks=2)
        runtime = world.runtime
        CLOCK.now_ns = runtime._scheduled_ns + runtime.period_ns // 3
        runtime._tick_soon()
        assert runtime._line_due_ns
        CLOCK.now_ns = runtime._scheduled_ns + runtime.period_ns
        runtime._tick_on_time(1)
        before = runtime.tick
        runtime._on_line_timer()
        assert runtime.tick == before
        world.close()


def test_seldom_and_idle_ticks_are_steps() -> None:
    """Slack before the tick, tick, rest: nothing of it needs the loop, until something happens."""
    made: list[World] = []
    with own_time(made):
        table = {"axis": [axis | {"bandwidth_hz": 5.0} for axis in AXES["axis"]], "tick_hz": 100.0}
        world = rested(SimAxes, table, made, used=True, ticks=20)
        before = world.quiet
        for _ in range(50):
            world.tick()
        assert world.quiet - before == 50
        assert world.runtime.statistics.ticks >= 70
        scheduled_ns = world.runtime._scheduled_ns
        world.tick(skipped=2)
        world.tick()
        assert world.runtime._scheduled_ns - scheduled_ns == 4 * world.runtime.period_ns, "ticks that are missed count"
        client = world.open(0, [0, 1], exclusive=True)
        record = AXIS_WRITE.pack(
            *({"control_mode": int(ControlMode.POSITION), "position": 0.1}.get(n, 0) for n in WRITE[NodeClass.AXIS])
        )
        client.write(record)
        bank = world.runtime.blocks[0].bank  # type: ignore[attr-defined]
        moving = world.quiet
        for _ in range(300):
            bank.plan_ahead()  # no time passes between ticks here
            world.tick()
        assert world.quiet - moving > 250 and bank._desired[0] == pytest.approx(0.1, abs=1e-9)
        world.close()
        world = rested(SimAxes, AXES, made, used=False)
        assert periods(world) == 40
        before = world.quiet
        for _ in range(50):
            world.tick()
        assert world.quiet - before == 50 and periods(world) == 40
        world.close()
