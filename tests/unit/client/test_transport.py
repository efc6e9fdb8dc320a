"""A node of both faces on a transport of its own: neither socket nor shared memory nor a descriptor that was passed."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from typing import Any

import pytest

import sioms
from sioms.aio import AsyncAxisNode
from sioms.client.channel import Answer, Call
from sioms.client.node import AxisNode
from sioms.client.snapshot import AxisSnapshot
from sioms.protocol.flags import NodeClass, PageState
from sioms.protocol.nodeinfo import NodeInfo
from sioms.protocol.page import PageReader, PageWriter, page_size
from sioms.protocol.records import AXIS_WRITE, READ, READ_SIZE, WRITE
from sioms.protocol.verbs import Ioctl, Message, Subscribe, Write


class Memory(PageReader):
    """Readings in a piece of memory, told of by a pipe: what a link to elsewhere would fill."""

    def __init__(self) -> None:
        self.memory = bytearray(page_size(NodeClass.AXIS, 1, 8))
        self.writer = PageWriter(memoryview(self.memory), NodeClass.AXIS, 1, 8, 10**12, 1, 77)
        self.readable, self.told = os.pipe2(os.O_NONBLOCK)
        self.closed = False
        super().__init__(self.memory)
        self.set_position(0.0)
        self.writer.set_state(PageState.GOOD)

    def set_position(self, position: float) -> None:
        payload = memoryview(bytearray(READ_SIZE[NodeClass.AXIS])).cast("d")
        payload[list(READ[NodeClass.AXIS]).index("position")] = position
        now_ns = time.monotonic_ns()
        self.writer.alive(now_ns)
        self.writer.publish(payload.cast("B"), now_ns, 1, now_ns)
        os.write(self.told, b"\1")

    def fileno(self) -> int:
        return self.readable

    def drain(self) -> None:
        with suppress(BlockingIOError):
            os.read(self.readable, 4096)

    def release(self) -> None:
        if not self.closed:
            self.closed = True
            super().release()
            os.close(self.readable)
            os.close(self.told)


class Link:
    """What carries requests: it answers them out of its own head, and an axis is at once where it is to go."""

    keepalive_s = 0.0
    closed = False
    clock = None
    acknowledged: Callable[[int], None]

    def __init__(self, readings: Memory) -> None:
        self.readings, self.sent = readings, list[Message]()

    def short_call(self, _: tuple[Any, ...], call: Callable[[], Call]) -> Any:
        return self.call(call()).value

    def call(self, call: Call) -> Answer:
        message = call.message
        self.sent.append(message)
        if isinstance(message, Write):
            position = AXIS_WRITE.unpack(message.records)[list(WRITE[NodeClass.AXIS]).index("position")]
            self.readings.set_position(position)
        self.acknowledged(1)
        return Answer(1 if isinstance(message, Write) else None, [])

    def close(self) -> None:
        self.closed = True


class Waiter:
    """What waits for it, in either face: nothing takes any time."""

    def __init__(self, link: Link) -> None:
        self.link = link

    async def call(self, call: Call) -> Answer:
        return self.link.call(call)

    async def readable(self, fds: Iterable[int], timeout_s: float | None) -> set[int]:
        return set(fds)

    async def pause(self, seconds: float) -> None:
        raise AssertionError("nothing is owed")

    def close(self) -> None:
        self.link.close()


class Cell:
    """A session that knows of nothing but the end of a node."""

    async def _closed_handle(self, handle: int) -> None:
        self.closed = handle


@pytest.fixture
def memory() -> Iterator[Memory]:
    readings = Memory()
    yield readings
    readings.release()


def _core(link: Link) -> tuple[Any, ...]:
    info = NodeInfo(["far", int(NodeClass.AXIS), False, [["x", "m"]], -1, 100.0, 64, "dev", "test", 2])
    return info, 5, link.readings, [0], -1, link


def test_the_blocking_face(memory: Memory) -> None:
    link, cell = Link(memory), Cell()
    with AxisNode(_core(link), cell, Waiter(link)) as node:  # type: ignore[arg-type]
        first = node.read()
        assert isinstance(first, AxisSnapshot) and first.position == (0.0,)
        assert node.move(0.25) == 1
        assert node.write(sioms.command(position=0.5)) == 1
        assert node.wait_new(first.number, 1.0).position == (0.5,)
        assert [snapshot.position[0] for snapshot in node.history(0)] == [0.0, 0.25, 0.5]
        node.stop()
    assert [type(message) for message in link.sent] == [Write, Write, Subscribe, Ioctl]
    assert (cell.closed, memory.closed, link.closed) == (5, True, True)
    with pytest.raises(OSError, match="it is closed"):
        node.read()


def test_the_asyncio_face(memory: Memory) -> None:
    async def go() -> None:
        link, cell = Link(memory), Cell()
        async with AsyncAxisNode(_core(link), cell, Waiter(link)) as node:  # type: ignore[arg-type]
            first = node.read()
            assert await node.move(0.5) == 1
            assert (await node.wait_new(first.number, 1.0)).position == (0.5,)
            await node.emergency_stop()
        assert [type(message) for message in link.sent] == [Write, Subscribe, Ioctl]
        assert (cell.closed, memory.closed, link.closed) == (5, True, True)

    asyncio.run(go())
