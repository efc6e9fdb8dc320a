"""Requests that are cancelled or interrupted: done whole or not at all, and a stop that has begun stops."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import gc
import os
import random
import signal
import warnings
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

import pytest
from daemon_rig import Daemon, wait_for

import sioms
import sioms.aio
from sioms.aio import AsyncAxisNode, AsyncWorkcell
from sioms.protocol.flags import AxisStatus

TURNS = (-1, 1, 2, 3, 4, 6, 10, 20, 60)
MANY = 6000
"""Commands of one write: it is sent in parts, and judged in pieces."""
Ask = Callable[[], Coroutine[Any, Any, Any]]


async def cancelled(turn: int, ask: Ask, answered_by: Any) -> bool:
    """Cancel a request after so many turns of the loop; return whether it was done by then.

    0: its answer has come, and its task has yet to hear of it; -1: that comes before the task has heard of the cancel.
    """
    task = asyncio.create_task(ask())
    await asyncio.sleep(0)
    if turn < 0:
        task.cancel()
    if turn <= 0:
        requests = answered_by._waiter
        while requests._futures:
            requests._readable()
    for _ in range(turn):
        await asyncio.sleep(0)
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task
    return not task.cancelled()


def story(daemon: Daemon, play: Callable[[AsyncWorkcell, AsyncAxisNode], Awaitable[None]]) -> None:
    async def told() -> None:
        async with await sioms.aio.connect(daemon.socket) as cell, await cell.open("mod0", "rw") as node:
            await play(cell, node)

    asyncio.run(told())


async def buffered(node: AsyncAxisNode) -> list[int]:
    """Return how many commands of each axis are there, running or not, when all that was sent has been served."""
    while True:
        await node.statistics(1)
        reading = await node.fresh()
        counts = [int(n) + bool(moves) for n, moves in zip(reading.buffered, reading.in_motion, strict=True)]
        await asyncio.sleep(0.02)
        reading = await node.fresh()
        if counts == [int(n) + bool(m) for n, m in zip(reading.buffered, reading.in_motion, strict=True)]:
            return counts


@pytest.mark.parametrize("many", [2, MANY])
def test_a_write_is_taken_whole_or_not_at_all(daemon: Daemon, many: int) -> None:
    found = set()

    async def play(_: AsyncWorkcell, node: AsyncAxisNode) -> None:
        records = [sioms.command(i % 2, position=0.1 if i % 4 < 2 else -0.1, time=30.0) for i in range(many)]
        for turn in (0, *TURNS):
            done = await cancelled(turn, lambda: node.write(records), node)
            counts = await buffered(node)
            assert counts in ([0, 0], [many // 2, many // 2]), f"turn {turn}: {counts}"
            assert counts[0] or (not done and turn > 0), f"turn {turn}: acknowledged, and not there"
            found.add(counts[0])
            await node.stop()

    story(daemon, play)
    assert many // 2 in found


def test_a_move_is_made_or_not(daemon: Daemon) -> None:
    async def play(_: AsyncWorkcell, node: AsyncAxisNode) -> None:
        for turn in (0, *TURNS):
            before = (await node.fresh()).commanded_position[0]
            done = await cancelled(turn, lambda: node.move(before + 0.002, 0), node)  # noqa: B023
            await node.statistics(1)
            await node.wait_until_idle(5.0)
            moved = (await node.fresh()).commanded_position[0] - before
            assert min(abs(moved), abs(moved - 0.002)) < 1e-9, f"turn {turn}: {moved}"
            assert abs(moved) > 1e-3 or (not done and turn > 0)

    story(daemon, play)


@pytest.mark.parametrize("what", ["stop", "emergency_stop", "of the node", "of the workcell", "of no node"])
def test_a_stop_that_has_begun_stops(daemon: Daemon, what: str) -> None:
    async def play(cell: AsyncWorkcell, node: AsyncAxisNode) -> None:
        ask: Ask = {
            "stop": node.stop, "emergency_stop": node.emergency_stop,
            "of the node": lambda: cell.emergency_stop("mod0"), "of the workcell": cell.emergency_stop,
            "of no node": lambda: cell.emergency_stop("mod0.xaxsi"),
        }[what]  # fmt: skip
        for turn in (0, *TURNS):
            await node.jog(0.05)
            with contextlib.suppress(FileNotFoundError):
                await cancelled(turn, ask, cell if what.startswith("of") else node)
            until = asyncio.get_running_loop().time() + 2.0
            latched = AxisStatus(0) if what == "stop" else AxisStatus.EMERGENCY_STOP
            # A jog that has just been taken begins at no velocity, before the stop.
            while (reading := await node.fresh()).commanded_velocity[0] or reading.status[0] & latched != latched:
                assert asyncio.get_running_loop().time() < until, f"turn {turn}"
                await asyncio.sleep(0.002)
            await cell.status()
            await (cell.reset() if what in ("of the workcell", "of no node") else node.reset())

    story(daemon, play)


def test_a_reset_is_made_or_not(daemon: Daemon) -> None:
    async def play(cell: AsyncWorkcell, node: AsyncAxisNode) -> None:
        asks: list[tuple[Ask, Any]] = [(node.reset, node), (lambda: cell.reset("mod0"), cell)]
        for ask, answered_by in asks:
            for turn in (0, *TURNS):
                await node.emergency_stop()
                done = await cancelled(turn, ask, answered_by)
                await cell.status()
                await node.statistics(1)
                await asyncio.sleep(0.01)
                latched = [bool(status & AxisStatus.EMERGENCY_STOP) for status in (await node.fresh()).status]
                assert len({*latched}) == 1, f"turn {turn}: {latched}"
                assert not latched[0] or (not done and turn > 0)
                refused = 0
                try:
                    await node.move(0.0, 0)
                except OSError as error:
                    refused = error.errno or 0
                assert refused == (errno.EPERM if latched[0] else 0)
                await node.reset()

    story(daemon, play)


def test_limits_are_set_together_or_not(daemon: Daemon) -> None:
    async def play(_: AsyncWorkcell, node: AsyncAxisNode) -> None:
        await node.stop()
        await node.wait_until_idle(5.0)
        wide = await node.limits()
        for turn in (0, *TURNS):
            done = await cancelled(turn, lambda: node.set_limits(position_max=0.5, velocity_max=0.25), node)
            limits = await node.limits()
            set_ = [limits["position_max"] == [0.5, 0.5], limits["velocity_max"] == [0.25, 0.25]]
            assert len({*set_}) == 1 and (set_[0] or (not done and turn > 0)), f"turn {turn}: {limits}"
            await node.set_limits(position_max=None, velocity_max=None)
            assert await node.limits() == wide

    story(daemon, play)


def test_a_wait_leaves_nothing_behind(daemon: Daemon, cell: sioms.Workcell) -> None:
    async def play(_: AsyncWorkcell, node: AsyncAxisNode) -> None:
        await node.jog(0.001)
        with cell.open("mod0.readonly") as seen:
            for turn in TURNS[1:]:
                assert not await cancelled(turn, lambda: node.wait_until_idle(30.0), node)
                await node.statistics(1)
                wait_for(lambda: seen.cancel_waits() == 0, f"no wait left of turn {turn}", 2.0)
                assert (await node.fresh()).in_motion[0], "the wait alone has ended"
        await node.stop()

    story(daemon, play)


def test_every_interrupt_comes_out_of_what_it_interrupts(daemon: Daemon, cell: sioms.Workcell) -> None:
    """By signals, at random instants: Python shows and forgets what is raised where it lets go of something. What
    nobody has taken is closed; what is half way into a node may leave a page open, which holds nothing.
    """
    chance, raised, came, is_on = random.Random(16), 0, 0, False

    def interrupt(*_: object) -> None:
        nonlocal raised
        if is_on:
            raised += 1
            raise KeyboardInterrupt

    def opened() -> None:
        with cell.open("mod0.readonly"):
            pass

    cell.status()
    gc.collect()
    before, handler = len(os.listdir("/proc/self/fd")), signal.signal(signal.SIGALRM, interrupt)
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", RuntimeWarning)
            for number in range(2000):
                try:
                    try:
                        is_on = True
                        signal.setitimer(signal.ITIMER_REAL, chance.random() * 5e-4 + 1e-6)
                        chance.choice((cell.status, cell.nodes, opened))()
                    finally:
                        is_on = False
                except KeyboardInterrupt:
                    came += 1
                if number % 4 == 0:
                    cell.status()  # takes what nobody waits for any more
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, handler)
    gc.collect()
    assert came == raised > 300
    assert not [each for each in told if "never awaited" in str(each.message)]
    cell.status()
    assert len(os.listdir("/proc/self/fd")) - before < came / 10
