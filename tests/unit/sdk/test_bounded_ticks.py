"""What a driver does for its clients is bounded per tick, and nobody waits for another's turn."""

import random
from collections.abc import Iterator

import pytest
from own_writes_rig import CLOCK, World, own_time

from sioms.drivers.sim.axes import SimAxes
from sioms.protocol.flags import ControlMode, NodeClass, Request
from sioms.protocol.records import AXIS_WRITE, WRITE
from sioms.protocol.verbs import Heard


@pytest.fixture
def world() -> Iterator[World]:
    made: list[World] = []
    with own_time(made):
        axis = {"position_min": -1.0, "position_max": 1.0, "velocity_max": 0.5, "acceleration_max": 5.0}
        axes = [{"name": f"a{i}", **axis, "motor": {"mass": 1.0}, "force_max": 60.0} for i in range(8)]
        made.append(World(SimAxes, {"axis": axes}, random.Random(1)))
        yield made[0]
        made[0].clients = [c for c in made[0].clients if c.node.handle in made[0].runtime.clients.handles]
        made[0].close()


def jog() -> bytes:
    """Return the record of a velocity."""
    given = {"control_mode": int(ControlMode.VELOCITY), "velocity": 0.1}
    return AXIS_WRITE.pack(*(given.get(name, 0) for name in WRITE[NodeClass.AXIS]))


def test_all_leases_that_have_run_out_end_in_one_tick(world: World) -> None:
    clients = [world.open(0, [i], exclusive=True) for i in range(8)]
    for client in clients:
        client.write(jog(), replace=True)
        handle = world.runtime.clients.handles[client.node.handle]
        handle.lease_ns = 50_000_000
        world.runtime.clients._leased.append(handle)
    world.tick()
    assert len(world.runtime.clients.handles) == 8
    CLOCK.now_ns += 100_000_000
    world.tick()
    assert not world.runtime.clients.handles


def test_waits_of_one_user_are_answered_a_few_a_tick_and_anothers_at_once(world: World) -> None:
    flood = [world.open(0, list(range(8)), exclusive=False, uid=1) for _ in range(8)]
    owner = world.open(0, [0], exclusive=True, uid=2)
    other = world.open(0, [0], exclusive=False, uid=3)
    owner.write(jog(), replace=True)
    world.tick()
    answers: list[tuple[int, object]] = []
    for i in range(320):
        flood[i % 8].ioctl(Request.WAIT_UNTIL_IDLE, done=lambda value: answers.append((1, value)))
    assert len(answers) == 64 and "waits of [quota]" in str(answers[0][1])
    other.ioctl(Request.WAIT_UNTIL_IDLE, done=lambda value: answers.append((3, value)))
    answers.clear()
    owner.ioctl(Request.STOP)
    ticks = []
    for _ in range(400):
        world.tick()
        for client in (*flood, other):
            client.take()
        ticks.append(len(answers))
        if len(answers) == 257:
            break
    assert ticks[0] <= 2 * 16 + 1, "of each user a few"
    assert 3 in [uid for uid, _ in answers[: 2 * 16 + 1]]
    assert len(answers) == 257 and len(ticks) >= 8


def test_statistics_are_worked_out_seldom_and_after_a_tick(world: World) -> None:
    client = world.open(0, [0], exclusive=False)
    told: list[object] = []
    done = []
    work = world.runtime.statistics.summary
    before = world.runtime.tick
    world.runtime.statistics.summary = lambda last: done.append(world.runtime.tick > before) or work(last)  # type: ignore[method-assign, func-returns-value]
    for last in range(1, 41):
        client.ioctl(Request.GET_STATISTICS, last, told.append)
    assert not told and not done
    for _ in range(30):
        world.tick()
    assert 1 <= len(done) <= 3 and all(done)
    client.ioctl(Request.GET_STATISTICS, None, told.append)


def test_a_long_tick_leaves_less_time_for_clients_work_and_one_in_four_always_some(world: World) -> None:
    runtime = world.runtime
    period_ns, due_ns = runtime.period_ns, runtime._scheduled_ns
    left = {}
    for share in (0.1, 0.4, 0.9):
        ticked_ns = due_ns + int(share * period_ns)
        left[share] = []
        for runtime.tick in range(4):
            left[share].append(round((runtime._spare_until(ticked_ns) - ticked_ns) / period_ns, 3))
    assert left == {0.1: [0.25] * 4, 0.4: [0.25, 0.1, 0.1, 0.1], 0.9: [0.25, -0.4, -0.4, -0.4]}


def test_what_a_gateway_passes_on_renews_from_when_it_was_said(world: World) -> None:
    lease_ns = 50_000_000
    client = world.open(0, [0], exclusive=True)
    handle = world.runtime.clients.handles[client.node.handle]
    handle.lease_ns = lease_ns
    world.runtime.clients._leased.append(handle)
    said_ns = CLOCK.now_ns
    CLOCK.now_ns += lease_ns - 10_000_000
    client.channel.notice(Heard(said_ns).packed())
    world.serve(client)
    client.write(jog(), replace=True)  # late, but within the lease: it is carried out, and extends nothing
    world.serve(client)
    assert world.runtime.clients.until_ns() == said_ns + lease_ns and handle.number in world.runtime.clients.handles
    for at_ns in (said_ns - 1, CLOCK.now_ns + 1_000_000_000):
        client.channel.notice(Heard(at_ns).packed())
        world.serve(client)
    assert handle.heard_ns <= CLOCK.now_ns, "not later than now, whatever is said"
    client.channel.notice(Heard(said_ns).packed())
    world.serve(client)
    assert handle.heard_ns > said_ns, "nor earlier than before"
    CLOCK.now_ns += lease_ns + 1
    client.channel.keepalive()
    world.serve(client)
    world.tick()
    assert handle.number not in world.runtime.clients.handles
