"""A device ticks as its beat says, whatever its process, its clients and the daemon do, and in whatever order.

After any of that a process that gets its turns has each device tick within two periods of its present beat, on the grid
of its period, for an instant that has come, and never sooner than a quarter of a period after the tick before.
"""

from __future__ import annotations

import gc
import os
import random
import weakref
from collections.abc import Callable
from itertools import pairwise

import pytest
from beat_rig import CLOCK, Device, Process, processes
from own_writes_rig import SEED

from sioms.protocol.driver_verbs import DriverVerb

TRIALS = int(os.environ.get("SIOMS_BEATS", "6"))
"""With each set of devices."""


def _pass(process: Process, chance: random.Random) -> None:
    """Let time pass up to the next timer, or somewhere before it; sometimes for longer: the process got no turn."""
    ahead_ns = max(CLOCK.due_ns() - CLOCK.now_ns, 0)
    factor = chance.choice([0.1, 0.5, 1.0, 1.0, 1.0, 1.001])
    missed_ns = chance.choice([0] * 8 + [300_000, 5_000_000, 25_000_000, 2_000_000_000])
    CLOCK.go_to(CLOCK.now_ns + int(ahead_ns * factor) + missed_ns)
    process.latch.daemon_alive(CLOCK.now_ns)


def _use(process: Process, chance: random.Random) -> None:
    process.order(chance.choice(process.devices), DriverVerb.IN_USE, chance.random() < 0.3)


def _stop(process: Process, chance: random.Random) -> None:
    if chance.random() < 0.5:
        process.request_stop()
        return
    process.latch.stop(CLOCK.now_ns, "eva")
    process.order(chance.choice(process.devices), DriverVerb.STOP_CHANGED)


def _reset(process: Process, chance: random.Random) -> None:
    process.latch.reset(CLOCK.now_ns)
    for device in process.devices:
        if chance.random() < 0.8:
            process.order(device, DriverVerb.STOP_CHANGED)


def _order(process: Process, chance: random.Random) -> None:
    about = 0, [0], -1, "eva", process.latch.resets, CLOCK.now_ns
    process.order(chance.choice(process.devices), DriverVerb.NODE_STOP, *about)
    process.latch.ordered()


def _change(process: Process, chance: random.Random) -> None:
    driver = chance.choice(process.devices).driver
    driver.rests, driver.leaves, driver.brakes = (chance.random() < p for p in (0.8, 0.2, 0.7))


EVENTS: list[tuple[Callable[[Process, random.Random], None], float]] = [
    (_pass, 6.0),
    (lambda process, _: process.look(), 6.0),
    (lambda process, _: process.serve(), 3.0),
    (_use, 0.7),
    (_stop, 0.2),
    (_reset, 0.2),
    (_order, 0.2),
    (_change, 0.4),
]


def _check_ticks(device: Device) -> None:
    ticks, period_ns = device.driver.ticks, device.runtime.period_ns
    for for_ns, at_ns in ticks:
        assert for_ns <= at_ns, "for an instant that has come"
    for (before_ns, _), (for_ns, _) in pairwise(ticks):
        assert for_ns - before_ns >= period_ns // 4, "not too soon after the one before"


def _see_it_tick(process: Process) -> None:
    """Give the process its turns, and see that all tick as their beats say."""
    for device in process.devices:
        device.driver.leaves = False
    process.look()
    process.serve_all()
    for device in process.devices:
        before, until_ns = len(device.driver.ticks), CLOCK.now_ns + 2 * device.beat_ns
        while CLOCK.now_ns < until_ns:
            CLOCK.go_to(CLOCK.due_ns())
            process.latch.daemon_alive(CLOCK.now_ns)
            process.look()
            process.serve_all()
        assert len(device.driver.ticks) > before, "within two periods"
        runtime = device.runtime
        last_ns = device.member.quiet.record.scheduled_ns if device.member.quiet else runtime._scheduled_ns
        assert last_ns % runtime.period_ns == device.grid_ns, "on its grid"
        assert CLOCK.now_ns - last_ns < 2 * device.beat_ns, "not behind"


@pytest.mark.parametrize("hz", [(100.0, 100.0, 100.0), (100.0, 20.0, 250.0), (1000.0, 100.0)])
def test_every_device_ticks_as_its_beat_says(hz: tuple[float, ...]) -> None:
    for trial in range(TRIALS):
        chance = random.Random(trial + 100_000 * SEED)
        with processes() as make:
            process = make(hz, [chance.random() for _ in hz])
            for _ in range(3):
                for _ in range(chance.randrange(150)):
                    chance.choices([event for event, _ in EVENTS], [weight for _, weight in EVENTS])[0](process, chance)
                try:
                    _see_it_tick(process)
                    for device in process.devices:
                        _check_ticks(device)
                except AssertionError as error:
                    raise AssertionError(f"{error}; trial {trial}") from error


def test_all_tick_on_while_they_wait_to_tell_of_a_stop_and_its_reset() -> None:
    """A hundred devices of four axes wait for some 0.3 s, and longer beside other work."""
    with processes() as make:
        process = make([100.0] * 12, [0.0] * 12)
        for device in process.devices:
            device.driver.rests = False
        _see_it_tick(process)
        for number, device in enumerate(process.devices):
            device.driver.brakes = number % 4 > 0  # steps cannot begin the stop of some for now
        process.request_stop()
        process.latch.stop(CLOCK.now_ns, "eva")
        process.look()
        process.latch.reset(CLOCK.now_ns, process.devices[0].runtime.stops._request.mark)
        served = 0
        while process.group._due:
            CLOCK.go_to(CLOCK.due_ns())
            process.latch.daemon_alive(CLOCK.now_ns)
            process.look()
            process.serve()
            served += 1
            for device in process.devices:
                device.driver.brakes = True
                assert CLOCK.now_ns - device.driver.ticks[-1][0] < 3 * device.beat_ns, f"not behind, {served} served"
        assert served > 12


def test_nothing_is_left_of_a_device_that_has_ended() -> None:
    """A device that is restarted or changed comes back to the process that is there."""
    with processes() as make:
        process = make((100.0, 100.0), (0.0, 0.5))
        group, device = process.group, process.devices.pop()
        ended, fd = weakref.ref(device.runtime), device.runtime.poll_fd
        device.runtime.running = False
        group._go_on(fd, group._members[fd])
        device.let_go()
        del device
        was = len(os.listdir("/proc/self/fd"))
        gc.disable()
        try:
            group._clear_away()
            assert ended() is None and len(os.listdir("/proc/self/fd")) < was, "memory and what it maps"
        finally:
            gc.enable()
