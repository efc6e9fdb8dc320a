"""A wait that comes when a motion has been ended is told why, once, and by nothing that its writer has done himself."""

from __future__ import annotations

import errno
import random
from collections.abc import Iterator
from typing import Any

import pytest
from own_writes_rig import CLOCK, Client, World, own_time

from sioms import command
from sioms.drivers.sim.axes import SimAxes
from sioms.protocol.driver_verbs import DriverVerb
from sioms.protocol.flags import Request
from sioms.sdk.desk import WriteDesk

AXIS = {"velocity_max": 0.5, "acceleration_max": 5.0, "motor": {"mass": 1.0}, "force_max": 60.0}


class Writer:
    """A client that owns both axes."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.client: Client = world.open(0, [0, 1], exclusive=True)
        self.handle = world.runtime.clients.handles[self.client.node.handle]
        self.answers: list[Any] = []

    def jog(self, axis: int = 0) -> None:
        assert self._done(self.client.node._write(command(axis, velocity=0.1), 0.0, False)) == [None]
        self.world.tick()

    def ask(self, request: Request) -> int | None:
        """Send a request; return the errno that it is answered with, None: done."""
        (answer,) = self._done(self.client.node._ioctl(request, None, 1.0)) or [None]
        return answer

    def _done(self, call: Any) -> list[int | None]:
        answers: list[Any] = []
        self.client.post(call, answers.append)
        self.world.runtime.clients._readable(self.handle)
        for _ in range(400):
            self.client.take()
            if answers:
                break
            self.world.tick()
        return [answer.errno if isinstance(answer, OSError) else None for answer in answers]

    def stopped_by_another(self, axis: int) -> None:
        for verb in (DriverVerb.NODE_STOP, DriverVerb.NODE_RESET):
            self.world.tick()
            sent = [CLOCK()] * (verb == DriverVerb.NODE_RESET)
            self.world.order(verb, 0, [axis], -1, "eva", self.world.latch.resets, CLOCK(), *sent)


@pytest.fixture
def writer() -> Iterator[Writer]:
    made: list[World] = []
    with own_time(made):
        made.append(World.__new__(World))
        axes = {"axis": [{"name": "x", **AXIS}, {"name": "y", **AXIS}]}
        made[0].__init__(SimAxes, axes, random.Random(1), None)  # type: ignore[misc]
        yield Writer(made[0])
        made[0].close()


def test_a_wait_behind_a_stop_is_told_once(writer: Writer) -> None:
    writer.jog()
    writer.stopped_by_another(0)
    assert writer.ask(Request.WAIT_UNTIL_IDLE) == errno.ECANCELED
    assert writer.ask(Request.WAIT_UNTIL_IDLE) is None


def test_who_waited_has_been_told(writer: Writer) -> None:
    writer.jog()
    answers: list[Any] = []
    writer.client.post(writer.client.node._ioctl(Request.WAIT_UNTIL_IDLE, None, 1.0), answers.append)
    writer.world.runtime.clients._readable(writer.handle)
    writer.stopped_by_another(0)
    writer.client.take()
    assert [answer.errno for answer in answers] == [errno.ECANCELED]
    assert writer.ask(Request.WAIT_UNTIL_IDLE) is None


@pytest.mark.parametrize("axis", [0, 1])
def test_another_command_of_that_axis_ends_it(writer: Writer, axis: int) -> None:
    writer.jog()
    writer.stopped_by_another(0)
    writer.jog(axis)
    assert writer.ask(Request.STOP) is None
    assert writer.ask(Request.WAIT_UNTIL_IDLE) is None, "it has stopped all of it itself"
    writer.jog()
    writer.stopped_by_another(0)
    writer.jog(axis)
    assert [*writer.handle.cut_short] == [0] * axis


def test_steps_serve_no_client_that_is_yet_to_be_told(writer: Writer) -> None:
    runtime = writer.world.runtime
    of_process = runtime.clients, runtime.stops, runtime.pages, runtime._request_fd
    desk = WriteDesk(runtime.blocks, *of_process, False, 10**6, runtime.busy)
    desk.lend()
    assert desk.record.count == 1
    writer.jog()
    writer.stopped_by_another(0)
    desk.lend()
    assert desk.record.count == 0
