"""Writes to devices of one process, served by steps, whatever else happens there, and in whatever order.

An answer comes to each, nothing that is acknowledged is lost but by a stop that came behind it, nothing is acknowledged
under a stop, and no connection ends by that.
"""

from __future__ import annotations

import errno
import os
import random
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import msgspec
import pytest
from beat_rig import CLOCK, Device, Process, processes
from own_writes_rig import SEED
from sent_rig import SentTimes

from sioms.descriptors import enable_timestamps
from sioms.drivers.sim.axes import SimAxes
from sioms.motion.axis_step import HOLD, RATE
from sioms.protocol.driver_verbs import Attach, DriverVerb
from sioms.protocol.flags import Access, AxisStatus, ControlMode, NodeClass, Right
from sioms.protocol.messages import decode_reply
from sioms.protocol.records import AXIS_WRITE, WRITE
from sioms.protocol.verbs import Write

TRIALS = int(os.environ.get("SIOMS_SHARED_WRITES", "3"))
"""With each set of devices."""
AXIS = {"name": "a", "velocity_max": 1.0, "acceleration_max": 50.0, "force_max": 200.0, "motor": {"mass": 1.0}}
AXIS["bandwidth_hz"] = 5.0
SENT = SentTimes(lambda: CLOCK.now_ns)


@dataclass
class Client:
    """Who owns the axis of a device.

    Attributes:
        sent: what has yet to be answered: the velocity, and whether it was sent under a stop.
        wanted: velocity that was acknowledged last, 0.0 since a stop.
        number: of the last write.
    """

    device: Device
    sock: socket.socket
    sent: dict[int, tuple[float, bool]] = field(default_factory=dict)
    wanted: float = 0.0
    number: int = 0


class World:
    """A process of several devices, their owners, and whether they are stopped."""

    def __init__(self, process: Process, chance: random.Random) -> None:
        self.process, self.chance = process, chance
        self.is_stopped, self.stopped_ns, self.handles = False, 0, 0
        self.refused = self.taken = 0
        self.clients = [self.open(device) for device in process.devices]

    def open(self, device: Device) -> Client:
        """Open a device's node as the daemon does."""
        self.handles += 1
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        enable_timestamps(theirs)
        readable, wake = os.pipe2(os.O_NONBLOCK)
        os.close(readable)
        access = int(Access.READ | Access.WRITE)
        attach = Attach(
            self.handles, 0, [0], -1, access, True, int(Right.ALL), 0, "eva", 1000, [256, 128], "dev"
        )  # fmt: skip
        socket.send_fds(device.control, [attach.packed(0)], [theirs.fileno(), wake])
        theirs.close()
        os.close(wake)
        return Client(device, ours)

    def write(self) -> None:
        """Have a client write: what steps serve, mostly, and sometimes what they leave."""
        self.write_to(self.chance.choice(self.clients))

    def write_to(self, client: Client) -> None:
        """Have this one write."""
        chance = self.chance
        client.number += 1
        velocity, mode = chance.choice([-0.02, 0.02]), ControlMode.VELOCITY
        columns = {"velocity": velocity, "control_mode": int(mode)}
        if chance.random() < 0.2:
            columns |= {"time": 1e3, "control_mode": int(mode | ControlMode.SPECIFIED_TIME)}
        record = AXIS_WRITE.pack(*(dict.fromkeys(WRITE[NodeClass.AXIS], 0) | columns).values())
        client.sent[client.number] = velocity, self.is_stopped
        SENT.note()
        client.sock.send(Write(1, 0.0, record).packed(client.number))

    def hear(self) -> None:
        """Take the answers that have come."""
        for client in self.clients:
            for reply in _replies(client.sock):
                number, errno_ = reply[1], reply[2]
                assert number, f"the connection has ended: {reply[3]}"
                velocity, was_stopped = client.sent.pop(number)
                if errno_:
                    assert errno_ in (errno.EPERM, errno.ECANCELED), reply[3]  # the latter: sent before the reset
                    self.refused += 1
                else:
                    assert not was_stopped or not self.is_stopped, "acknowledged under a stop"
                    client.wanted = velocity if reply[5] > self.stopped_ns else 0.0
                    self.taken += 1

    def pass_time(self) -> None:
        """Let time pass up to the next timer, or somewhere before it, or for longer."""
        ahead_ns = max(CLOCK.due_ns() - CLOCK.now_ns, 0)
        missed_ns = self.chance.choice([0] * 8 + [300_000, 5_000_000, 25_000_000])
        CLOCK.go_to(CLOCK.now_ns + int(ahead_ns * self.chance.choice([0.1, 0.5, 1.0, 1.0, 1.001])) + missed_ns)
        self.process.latch.daemon_alive(CLOCK.now_ns)

    def stop(self) -> None:
        """Stop the workcell, by the file or the latch."""
        self.hear()
        if self.chance.random() < 0.5:
            self.process.request_stop()
        else:
            self.process.latch.stop(CLOCK.now_ns, "eva")
            self.process.order(self.chance.choice(self.process.devices), DriverVerb.STOP_CHANGED)
        self.is_stopped, self.stopped_ns = True, CLOCK.now_ns
        for client in self.clients:
            client.wanted = 0.0

    def reset(self) -> None:
        """Reset it, when all have seen that stop, or when nobody may have been served since."""
        if self.is_stopped:
            if not self.process.latch.stopped_ns:  # the daemon has heard of the request first
                self.process.latch.stop(CLOCK.now_ns, "eva")
            if self.chance.random() < 0.5:
                self.calm()
                for client in self.clients:
                    assert client.device.driver.bank.rows["status"][0] & AxisStatus.EMERGENCY_STOP
            self.process.latch.reset(CLOCK.now_ns, self.process.devices[0].runtime.stops._request.mark)
            for device in self.process.devices:
                self.process.order(device, DriverVerb.STOP_CHANGED)
            self.is_stopped = False

    def leave(self) -> None:
        """Have a client go, and another one come."""
        self.hear()
        client = self.chance.choice(self.clients)
        client.sock.close()
        self.clients.remove(client)
        self.calm()  # the daemon hears that the channels are free
        assert not client.device.runtime.clients.handles
        self.clients.append(self.open(client.device))

    def calm(self) -> None:
        """Give the process its turns until all is done."""
        until_ns = CLOCK.now_ns + 60_000_000
        while CLOCK.now_ns < until_ns:
            CLOCK.go_to(CLOCK.due_ns())
            self.process.latch.daemon_alive(CLOCK.now_ns)
            for _ in range(3):
                self.process.look()
                self.process.serve_all()
        self.hear()

    def check(self) -> None:
        """See that all was answered and is as it was asked for."""
        self.calm()
        assert self.process.group._busy[0] == 0, "of nobody are writes kept"
        for client in self.clients:
            bank = client.device.driver.bank
            assert not client.sent, "each write has an answer"
            assert client.device.runtime._quiet.desk.record.kept == 0
            assert int(bank.arrays["kind"][0]) == (RATE if client.wanted else HOLD)
            assert bank.rows["commanded_velocity"][0] == pytest.approx(client.wanted)


def _replies(sock: socket.socket) -> Iterator[list[Any]]:
    while True:
        try:
            packet = sock.recv(1 << 16)
        except BlockingIOError:
            return
        if not packet:
            raise AssertionError("the connection has ended")
        yield decode_reply(packet)


def _table(hz: float) -> Any:
    return msgspec.convert({"axis": [AXIS], "tick_hz": hz, "late_max_s": 10.0}, SimAxes.Settings)


EVENTS: list[tuple[Callable[[World], object], float]] = [
    (World.write, 3.0),
    (World.pass_time, 5.0),
    (lambda world: world.process.look(), 6.0),
    (lambda world: world.process.serve(), 3.0),
    (World.hear, 1.0),
    (World.stop, 0.15),
    (World.reset, 0.3),
    (World.leave, 0.1),
]


@pytest.mark.parametrize("hz", [(100.0, 100.0, 100.0), (1000.0, 100.0)])
def test_what_is_acknowledged_holds_and_nothing_is_taken_under_a_stop(hz: tuple[float, ...]) -> None:
    taken = served = 0
    for trial in range(TRIALS):
        chance = random.Random(trial + 100_000 * SEED)
        with pytest.MonkeyPatch.context() as patch, processes() as make:
            SENT.install(patch)
            world = World(make(hz, [chance.random() for _ in hz], SimAxes, _table), chance)
            try:
                for _ in range(4):
                    world.calm()
                    for _ in range(chance.randrange(120)):
                        chance.choices([event for event, _ in EVENTS], [weight for _, weight in EVENTS])[0](world)
                    world.check()
            except AssertionError as error:
                raise AssertionError(f"{error}; trial {trial}") from error
            taken += world.taken
            served += world.process.served
            for client in world.clients:
                client.sock.close()
    assert 0.3 * taken < served < taken, "most are served by steps, and some are not"


def test_a_device_that_fails_before_its_writes_are_worked_in_leaves_room_for_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Steps keep writes for two devices of a process."""

    def out_of_memory() -> None:
        raise MemoryError

    with processes() as make:
        SENT.install(monkeypatch)
        world = World(make([100.0] * 3, [0.0] * 3, SimAxes, _table), random.Random(1))
        world.calm()
        for client in world.clients[:2]:
            device = client.device
            world.write_to(client)
            world.process.look()
            assert device.runtime._quiet.desk.record.kept == 1
            monkeypatch.setattr(device.runtime.pages, "take_back", out_of_memory)
            CLOCK.go_to(CLOCK.due_ns())
            world.process.look()
            world.process.serve_all()
            assert not device.runtime.running
            world.process.devices.remove(device)
            device.let_go()
        assert world.process.group._busy[0] == 0
        for client in world.clients:
            client.sock.close()
