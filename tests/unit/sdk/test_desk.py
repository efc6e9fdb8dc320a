"""A write that steps have served does what it does when the loop serves it, whatever comes before and after it."""

import errno
import random
from types import SimpleNamespace

import numpy as np
import pytest
from own_writes_rig import CLOCK, World, worlds
from served_writes_rig import packets

from sioms.drivers.sim.axes import SimAxes
from sioms.protocol.driver_verbs import DriverVerb
from sioms.protocol.flags import ControlMode, NodeClass, Request
from sioms.protocol.journal import JournalReader, Note
from sioms.protocol.messages import HandleVerb
from sioms.protocol.records import AXIS_WRITE, WRITE
from sioms.protocol.verbs import Heard, Passed

LIMITS = {"position_min": -1.0, "position_max": 1.0, "velocity_max": 0.5, "acceleration_max": 5.0, "force_max": 60.0}
TABLE = {"axis": [{"name": f"a{i}", **LIMITS, "motor": {"mass": 1.0}} for i in range(4)]}


@pytest.fixture
def make():
    with worlds() as of:
        yield of


def record(axis=0, **given):
    values = {"axis": axis, "control_mode": int(ControlMode.VELOCITY), "velocity": 0.1} | given
    return AXIS_WRITE.pack(*(values.get(name, 0) for name in WRITE[NodeClass.AXIS]))


def events(world):
    """Return what the journal tells of commands, without the instants."""
    reader = JournalReader(world.runtime.journal._bytes)
    return [event.values() for event in reader.read() if event.kind in (Note.COMMAND, Note.REFUSAL)]


def lived(world: World, by_steps: float):
    """Let three clients write, wait and stop, and one of them send what it likes; return all that can be seen of it."""
    chance, seen = random.Random(3), []
    made = packets(random.Random(4))
    world.by_steps = by_steps
    owners = [world.open(0, [i], exclusive=True, uid=i) for i in range(3)]
    for turn in range(600):
        stranger = turn % 7 == 0
        client = owners[chance.randrange(3)]
        draw, target = chance.random(), chance.uniform(-0.3, 0.3)
        if stranger:
            odd = world.open(0, [3], exclusive=True, uid=9)
            for _ in range(chance.randrange(1, 4)):
                packet = next(made)[0]
                if odd.node.handle in world.runtime.clients.handles and packet:
                    odd.channel.notice(packet)
                    world.serve(odd)
            seen.append(odd.node.handle in world.runtime.clients.handles)
            if seen[-1]:
                world.close_node(odd)
            else:
                world.clients.remove(odd)
                odd.node.release()
        elif draw < 0.8:
            mode = chance.choice([ControlMode.POSITION, ControlMode.VELOCITY])
            data = record(0, control_mode=int(mode), position=target, velocity=target, force=target)
            client.write(data * chance.choice([1, 1, 2]), seen.append, replace=chance.random() < 0.8)
        elif draw < 0.85:
            client.ioctl(Request.WAIT_UNTIL_IDLE, None, seen.append)
        elif draw < 0.9:
            client.ioctl(Request.EMERGENCY_STOP)
            client.write(record(), seen.append)
            client.ioctl(Request.RESET)
        else:
            client.ioctl(Request.SET_LIMITS, {"velocity_max": 0.05}, seen.append)
        if chance.random() < 0.5:
            world.tick()
            seen.append(world.runtime.blocks[0].bank.fields.copy())
    readings = [each for each in seen if isinstance(each, np.ndarray)]
    answers = [str(each) if isinstance(each, OSError) else each for each in seen if not isinstance(each, np.ndarray)]
    return answers, np.array(readings), events(world), world.served


def test_the_same_comes_of_it_either_way(make):
    by_loop = lived(make(SimAxes, TABLE, 1), 0.0)
    by_steps = lived(make(SimAxes, TABLE, 1), 1.0)
    assert (by_loop[3], by_steps[3] > 100) == (0, True)
    assert by_steps[0] == by_loop[0] and len(by_loop[0]) > 300
    assert by_steps[2] == by_loop[2] and len(by_loop[2]) > 300
    # The clock of the rig moves at each look, of which there are not as many.
    np.testing.assert_allclose(by_steps[1], by_loop[1], rtol=0, atol=1e-3)
    assert np.ptp(by_loop[1][:, 0, 0]) > 0.002


def test_a_served_write_renews_the_lease_and_counts_in_the_turns(make):
    world = make(SimAxes, TABLE, 1)
    world.by_steps = 1.0
    client = world.open(0, [0], exclusive=True)
    handle = world.runtime.clients.handles[client.node.handle]
    charged = []
    world.runtime.turns.charge = lambda fd, took_ns: charged.append((fd, took_ns > 0))  # type: ignore[method-assign]
    CLOCK.now_ns += 50_000_000
    before_ns = CLOCK.now_ns
    client.write(record())
    assert world.served == 1 and charged == [(handle.sock.fileno(), True)]
    assert handle.heard_ns > before_ns and handle.came_ns == handle.heard_ns
    handle.passed_on = True
    heard_ns = handle.heard_ns
    for _ in range(400):  # until the axis is under way
        world.tick()
    client.write(record(), replace=True)
    assert world.served == 2 and handle.heard_ns == heard_ns, "a gateway tells when the client said it"


def test_steps_hand_over_what_a_gateway_says_of_its_client(make):
    world = make(SimAxes, TABLE, 1)
    world.by_steps = 1.0
    client = world.open(0, [0], exclusive=True)
    handle = world.runtime.clients.handles[client.node.handle]
    said_ns = CLOCK.now_ns
    CLOCK.now_ns += 50_000_000
    client.channel.notice(Heard(said_ns).packed())
    world.serve(client)
    assert handle.came_ns == 0, "the loop has not served it"
    assert (handle.heard_ns, handle.passed_on) == (said_ns, True)
    client.write(record())
    assert world.served == 2 and handle.heard_ns == said_ns, "what comes behind it extends nothing"
    client.channel.notice(Heard(said_ns - 1).packed())
    world.serve(client)
    assert handle.heard_ns == said_ns, "nor earlier than before"
    world.tick()
    count = world.served
    put = client.channel._put
    client.channel._put = lambda packet: put(Passed(said_ns + 1, packet).packed())
    client.write(record(), replace=True)
    assert world.served == count + 1 and handle.heard_ns == said_ns + 1, "both in one packet"
    assert events(world)[-1][2][1] == HandleVerb.WRITE, "the journal has what the client sent"


@pytest.mark.parametrize("in_one", [True, False])
def test_the_first_that_a_gateway_passes_on_may_be_older_than_a_reset(make, in_one):
    """Nothing has told before that the handle is one of a gateway's."""
    world = make(SimAxes, TABLE, 1)
    world.by_steps = 1.0
    client = world.open(0, [0], exclusive=True)
    said_ns, put, answers = CLOCK.now_ns, client.channel._put, []
    for verb in (DriverVerb.NODE_STOP, DriverVerb.NODE_RESET):
        CLOCK.now_ns += 1_000_000
        world.order(verb, 0, [0], -1, "eva", world.latch.resets, CLOCK(), *[CLOCK()] * (verb == DriverVerb.NODE_RESET))
    world.runtime.heed()
    for _ in range(400):
        world.tick()

    def pass_on(packet):
        for each in [Passed(said_ns, packet).packed()] if in_one else [Heard(said_ns).packed(), packet]:
            put(each)

    client.channel._put = pass_on
    for _ in range(2):
        client.write(record(), answers.append)
        for _ in range(4):
            world.serve(client)
            world.tick()
        client.take()
        said_ns = CLOCK.now_ns
    assert [getattr(each, "errno", None) for each in answers] == [errno.ECANCELED, None]


@pytest.mark.parametrize("why", ["a wait", "writes under way", "parts", "halted", "stopped", "admits", "link", "reads"])
def test_what_has_something_to_wait_for_is_the_loops(make, why):
    world = make(SimAxes, TABLE, 1)
    world.by_steps = 1.0
    client = world.open(0, [0], exclusive=why != "reads")
    runtime = world.runtime
    handle = runtime.clients.handles[client.node.handle]
    match why:
        case "a wait":
            handle.waits[7] = SimpleNamespace()
        case "writes under way":
            handle.writing.append(SimpleNamespace())
        case "parts":
            handle.ahead = (1, [b""])
        case "halted":
            handle.halted = True
        case "stopped":
            runtime.stops.stopped = True
        case "admits":
            handle.block.admits = lambda *_: None
        case "link":
            runtime.pages.why_not = lambda _: "gone"
    assert not runtime.clients.writers or runtime.clients.writers == [handle]
    quiet = runtime._quiet = world._run
    assert runtime.lend() is not None
    assert world._writer_of(quiet.record.desk, handle.sock.fileno()) == -1
    runtime.take_back(quiet)
    handle.waits.clear()


def test_what_was_acknowledged_and_is_not_taken_ends_the_handle(make):
    world = make(SimAxes, TABLE, 1)
    world.by_steps = 1.0
    client = world.open(0, [0], exclusive=True)
    bank, handle = world.runtime.blocks[0].bank, client.node.handle
    bank.offer = lambda *_, **__: False
    client.channel.notice(client.node._write(record(), 0.0, False).message.packed(5))
    world.serve(client)
    assert handle not in world.runtime.clients.handles
    del bank.offer
    world.clients.remove(client)
    client.node.release()
