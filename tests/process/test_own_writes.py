"""No reading is older than what the same process has been acknowledged: each request, through each node, twenty
times.
"""

from __future__ import annotations

import asyncio
import os
import signal
import threading
import time
from collections.abc import Callable

import pytest
from daemon_rig import Daemon, axes

import sioms
import sioms.aio
from sioms import command
from sioms.protocol.flags import AxisStatus, Request

TIMES = 20
STOPPED, WAITING_SYNCH, WAITING_MARKER = (
    int(AxisStatus.EMERGENCY_STOP),
    int(AxisStatus.WAITING_SYNCH),
    int(AxisStatus.WAITING_MARKER),
)


def _stale(once: Callable[[int], object]) -> int:
    """Return how often a reading right after an acknowledgement did not show it."""
    return sum(not once(i) for i in range(TIMES))


@pytest.mark.parametrize("through", ["mod0.xaxis", "mod0.readonly", "mod0.xaxis.readonly"])
def test_what_an_axis_acknowledged(cell: sioms.Workcell, through: str) -> None:
    with (
        cell.open("mod0.xaxis", "rw") as axis,
        cell.open(through) if through != "mod0.xaxis" else axis as eye,
    ):
        start = axis.read().position[0]

        def calibrate(i: int) -> bool:
            axis.calibrate(start + i * 0.001)
            return abs(eye.read().position[0] - start - i * 0.001) < 2e-4

        def zero(_: int) -> bool:
            axis.calibrate(0.3)
            axis.zero()
            return abs(eye.read().position[0]) < 2e-4

        def move(i: int) -> bool:
            axis.move(0.03 if i % 2 else 0.02)
            shown = eye.read()
            return bool(shown.in_motion[0] or shown.buffered[0])

        def queue(_: int) -> bool:
            axis.write([command(position=0.01 * n) for n in (1, 2, 3, 2)])
            return bool(eye.read().buffered[0] >= 3)

        def flush(_: int) -> bool:
            axis.write([command(velocity=0.01), command(position=0.02, synch=True), command(position=0.0)])
            queued = eye.read().buffered[0]
            axis.flush()
            return queued >= 2 and eye.read().buffered[0] <= 1

        def stop(_: int) -> bool:
            axis.jog(0.05)
            moves = eye.read().in_motion[0]
            axis.stop()
            shown = eye.read()
            return moves and (shown.status[0] & int(AxisStatus.STOPPING) or not shown.in_motion[0])

        def emergency_stop(_: int) -> bool:
            axis.stop_all()
            latched = eye.read().status[0] & STOPPED
            axis.reset()
            return bool(latched and not eye.read().status[0] & STOPPED)

        def synch(_: int) -> bool:
            axis.wait_until_idle(5.0)
            axis.command(velocity=0.01, synch=True, time=0.01)
            waits = eye.read().status[0] & WAITING_SYNCH
            axis.synch(time.monotonic_ns() + 100_000_000)
            return bool(waits and not eye.read().status[0] & WAITING_SYNCH)

        def marker(_: int) -> bool:
            one = cell.reserve_marker()
            axis.wait_until_idle(5.0)
            axis.command(velocity=0.01, wait=one, time=0.01)
            waits = eye.read().status[0] & WAITING_MARKER
            one.signal()
            started = not eye.read().status[0] & WAITING_MARKER
            one.free()
            return bool(waits and started)

        def idle(i: int) -> bool:
            axis.move(0.001 * (i % 2))
            axis.wait_until_idle(5.0)
            return not eye.read().in_motion[0]

        for once in (calibrate, zero, move, queue, flush, stop, emergency_stop, synch, marker, idle):
            assert _stale(once) == 0, once.__name__
            axis.stop()
            axis.wait_until_idle(5.0)


@pytest.mark.parametrize("long", [2_000])
def test_a_write_in_pieces_shows_when_it_is_acknowledged(cell: sioms.Workcell, long: int) -> None:
    with cell.open("mod0.xaxis", "rw") as axis:
        for _ in range(5):
            records = [command(position=0.001, synch=True), *[command(position=0.0)] * (long - 1)]
            axis.write(records, timeout=5.0)
            assert axis.read().buffered[0] == long
            axis.flush()
            assert axis.read().buffered[0] == 0


@pytest.mark.parametrize("through", ["io0.out", "io0.out.readonly"])
def test_outputs_of_an_io_block(cell: sioms.Workcell, through: str) -> None:
    out = next(n.name for n in cell.nodes() if n.device == "io0" and not n.read_only and n.bit < 0)
    eye_name = through.replace("io0.out", out)
    with cell.open(out, "rw") as port, cell.open(eye_name) if eye_name != out else port as eye:

        def write(i: int) -> bool:
            port.set(i % 2 * 0x5A)
            return bool(eye.read().data[0] == i % 2 * 0x5A)

        assert _stale(write) == 0
        port.set(0)


def test_zero_and_gains_of_a_sensor(cell: sioms.Workcell) -> None:
    with cell.open("force0") as force:

        def zero(_: int) -> bool:
            force.set_gains([2.0] * 6)
            doubled = force.read().data[0]
            force.set_gains([1.0] * 6)
            single = force.read().data[0]
            force.zero(samples=3)
            return abs(doubled - 2 * single) < 1e-9 and abs(force.read().data[0]) < 1e-9

        assert _stale(zero) == 0


def test_stop_and_reset_by_the_daemon(cell: sioms.Workcell) -> None:
    """Of a node and of the workcell; they show in all nodes of the process, whichever device they are of."""
    with cell.open("mod0") as one, cell.open("mod1.readonly") as other:

        def node(_: int) -> bool:
            cell.emergency_stop("mod0")
            latched = one.read().status[0] & STOPPED
            cell.reset("mod0")
            return bool(latched and not one.read().status[0] & STOPPED)

        def workcell(_: int) -> bool:
            cell.emergency_stop()
            latched = one.read().status[0] & other.read().status[0] & STOPPED
            cell.reset()
            return bool(latched and not (one.read().status[0] | other.read().status[0]) & STOPPED)

        assert _stale(node) == 0
        assert _stale(workcell) == 0


def test_closing_shows_in_the_companion(cell: sioms.Workcell) -> None:
    with cell.open("mod0.readonly") as eye:

        def close(_: int) -> bool:
            with cell.open("mod0", "rw") as axis:
                axis.jog(0.05)
                moves = eye.read().in_motion[0]
            shown = eye.read()
            return bool(moves and (shown.status[0] & int(AxisStatus.STOPPING) or not shown.in_motion[0]))

        assert _stale(close) == 0


def test_a_node_opened_after_the_acknowledgement(cell: sioms.Workcell) -> None:
    with cell.open("mod0.xaxis", "rw") as axis:

        def late(i: int) -> bool:
            axis.calibrate(0.001 * i)
            with cell.open("mod0.readonly") as eye:
                return abs(eye.read().position[0] - 0.001 * i) < 2e-4

        assert _stale(late) == 0
        axis.calibrate(0.0)


def test_in_an_event_loop(daemon: Daemon) -> None:
    async def main() -> None:
        async with await sioms.aio.connect(daemon.socket) as cell:
            axis, eye = await cell.open("mod0.xaxis", "rw"), await cell.open("mod0.readonly")
            async with axis, eye:
                for i in range(TIMES):
                    await axis.move(0.01 * (i % 2 + 1))
                    assert eye.read().in_motion[0] and axis.read().in_motion[0]
                    await axis.stop()
                    shown = await eye.fresh()
                    assert shown.status[0] & int(AxisStatus.STOPPING) or not shown.in_motion[0]
                    await axis.wait_until_idle(5.0)
                    assert not (await axis.fresh()).in_motion[0] and axis.is_shown()
                    await cell.emergency_stop("mod0")
                    assert eye.read().status[0] & STOPPED
                    await cell.reset("mod0")
                    assert not eye.read().status[0] & STOPPED

    asyncio.run(main())


def test_two_clients_on_bits_of_one_port_at_once(daemon: Daemon) -> None:
    """Each sees its own bit as it was acknowledged, through its own node and through the port, while the other writes
    beside it.
    """
    stale: list[tuple[int, str]] = []

    def turn(number: int, barrier: threading.Barrier) -> None:
        name = f"io0.bit{number}"
        with (
            daemon.cell(f"client {number}") as cell,
            cell.open(name, "rw") as bit,
            cell.open("io0.readonly") as port,
        ):
            barrier.wait(20.0)
            for i in range(3 * TIMES):
                bit.set(i % 2)
                if bit.read().data[0] != i % 2:
                    stale.append((i, name))
                if port.read().data[0] >> number & 1 != i % 2:
                    stale.append((i, "the port"))

    barrier = threading.Barrier(2)
    threads = [threading.Thread(target=turn, args=(number, barrier)) for number in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)
    assert not stale and not any(thread.is_alive() for thread in threads) and not barrier.broken


def test_an_event_loop_beside_a_blocking_client(daemon: Daemon) -> None:
    """What one of them was acknowledged shows to the other in the same process."""

    async def main() -> None:
        with daemon.cell("blocking") as plain, plain.open("mod0.readonly") as eye:
            async with await sioms.aio.connect(daemon.socket) as cell:
                look = await cell.open("mod1.readonly")
                async with look, await cell.open("mod0.xaxis", "rw") as axis:
                    with plain.open("mod1.xaxis", "rw") as other:
                        for i in range(TIMES):
                            await axis.ioctl(Request.CALIBRATE_DEVICE, 0.001 * i)
                            assert abs(eye.read().position[0] - 0.001 * i) < 2e-4, i
                            other.calibrate(0.002 * i)
                            assert abs((await look.fresh()).position[0] - 0.002 * i) < 2e-4, i
                            await axis.move(0.001 * i + 0.01)
                            assert eye.read().in_motion[0], i
                            await axis.wait_until_idle(5.0)
                            assert not eye.read().in_motion[0], i

    asyncio.run(main())


def test_a_slow_driver_and_its_death_while_a_reading_waits(start_daemon: Callable[..., Daemon]) -> None:
    """A reading waits for the tick, however long, and says EIO when none can come."""
    text = '[workcell]\nname = "slow"\n' + axes("slow", "xaxis", extra="tick_hz = 100.0")
    text = text.replace("position_min", "bandwidth_hz = 4.0\nposition_min")
    daemon = start_daemon(text)
    with daemon.cell("slow") as cell, cell.open("slow", "rw") as axis:
        before = axis.read().number
        axis.jog(0.01)
        shown = axis.read()
        assert shown.in_motion[0] and shown.number > before
        waits = []
        for _ in range(5):
            axis.jog(0.02)
            began = time.monotonic()
            axis.read()
            waits.append(time.monotonic() - began)
        assert max(waits) < 0.2 and max(waits) > 0.004
        axis.jog(0.03)
        os.kill(daemon.device("slow")["pid"], signal.SIGKILL)
        with pytest.raises(OSError, match="read slow: "):
            while True:
                axis.read()
                axis.owed_ns = time.monotonic_ns()
