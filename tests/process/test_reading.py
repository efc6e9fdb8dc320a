"""Reading and waiting: consistent snapshots, readiness in every event loop, edges, history, zero and gains."""

from __future__ import annotations

import asyncio
import errno
import math
import select
import selectors
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest
from daemon_rig import Client, Daemon, raises, wait_for

import sioms
import sioms.aio
from sioms.descriptors import is_readable
from sioms.protocol.flags import Request
from sioms.protocol.records import BINARY_WRITE
from sioms.protocol.verbs import Ioctl


def test_all_channels_carry_one_tick_under_a_hasty_reader(cell: sioms.Workcell) -> None:
    """Two axes get the same motion at the same synch; a snapshot that mixed ticks would show a difference."""
    with cell.open("mod0", "rw") as axes:
        for axis in (0, 1):
            axes.command(axis, velocity=0.3, time=0.5, synch=True)
        axes.synch(time.monotonic_ns() + 20_000_000)
        seen, apart = 0, 0.0
        deadline = time.monotonic() + 0.5
        last = 0
        while time.monotonic() < deadline:
            snapshot = axes.read()
            assert snapshot.number >= last, "never an older one"
            seen += snapshot.number > last
            last = snapshot.number
            apart = max(apart, abs(snapshot.commanded_position[0] - snapshot.commanded_position[1]))
        assert seen > 50 and apart == pytest.approx(
            abs(axes.read().commanded_position[0] - axes.read().commanded_position[1]), abs=1e-9
        )
        axes.stop()
        axes.wait_until_idle(5.0)
        for axis in (0, 1):
            axes.move(0.0, axis)
        axes.wait_until_idle(5.0)


def test_a_part_shows_its_channel_of_the_group(cell: sioms.Workcell) -> None:
    with cell.open("force0") as group, cell.open("force0.fz") as part:
        assert part.read().data == (pytest.approx(3.0),)
        assert len(group.read()) == 6 and group.read()[2].data == pytest.approx(3.0)
        assert group.read().array("data") == pytest.approx([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
        assert part.info.channels[0].unit == "N" and part.info.read_only and part.info.write_struct_size == 0
        with pytest.raises(KeyError, match="there are: data, flags"):
            group.read().array("force")


def test_stamps_are_of_this_clock_and_rise_by_ticks(cell: sioms.Workcell) -> None:
    with cell.open("mod0.readonly") as node:
        number = node.read().number
        node.wait_new(number + 100, 5.0)
        history = node.history(number)
        stamps = np.array([s.stamp_ns for s in history])
        numbers = [s.number for s in history]
        assert numbers == list(range(number + 1, number + 1 + len(numbers)))
        steps = np.diff(stamps) / 1e6
        assert (np.abs(steps - np.round(steps)) < 1e-6).all() and (steps >= 1.0).all()
        assert abs(time.monotonic_ns() - node.read().stamp_ns) < 1_000_000_000


def test_history_reaches_as_far_as_the_ring(cell: sioms.Workcell) -> None:
    with cell.open("force0") as node:  # a ring of 256
        node.wait_new(400, 5.0)
        history = node.history(0)
        assert 200 <= len(history) <= 256
        assert history[-1].number - history[0].number == len(history) - 1
        assert node.history(history[-1].number + 1000) == []


@pytest.mark.parametrize("wait", ["select", "poll", "selectors", "sioms"])
def test_readiness_in_every_event_loop(cell: sioms.Workcell, wait: str) -> None:
    with cell.open("force0") as quick, cell.open("mod0.readonly") as other:
        nodes = [quick, other]
        seen = {quick.name: 0, other.name: 0}
        with selectors.DefaultSelector() as selector:
            for node in nodes:
                selector.register(node, selectors.EVENT_READ, node)
            poller = select.poll()
            for node in nodes:
                poller.register(node, select.POLLIN)
            deadline = time.monotonic() + 5.0
            while min(seen.values()) < 20:
                assert time.monotonic() < deadline, seen
                match wait:
                    case "select":
                        ready = select.select(nodes, [], [], 1.0)[0]  # noqa: TID251 - ours are few
                    case "poll":
                        fds = {fd for fd, _ in poller.poll(1000)}
                        ready = [node for node in nodes if node.fileno() in fds]
                    case "selectors":
                        ready = [key.data for key, _ in selector.select(1.0)]
                    case _:
                        ready = sioms.select(nodes, timeout=1.0)[0]
                assert ready, "nothing became ready within a second"
                for node in ready:
                    node.read()
                    seen[node.name] += 1


def test_select_waits_for_room(cell: sioms.Workcell) -> None:
    with cell.open("mod0.xaxis", "rw") as axis:
        capacity = axis.info.buffer_capacity
        assert sioms.select(room=[axis], timeout=0.0) == ([], [axis])
        axis.command(velocity=0.0, time=2.0)
        wait_for(lambda: axis.read().in_motion[0], "running")
        axis.write([sioms.command(0, velocity=0.0, time=0.001)] * capacity)
        wait_for(lambda: axis.room() <= 0, "full")
        assert sioms.select(room=[axis], timeout=0.02) == ([], [])
        with pytest.raises(TimeoutError):
            axis.wait_room(1, 0.02)
        assert sioms.select(room=[axis], timeout=5.0) == ([], [axis])
        axis.wait_room(20, 5.0)
        axis.write([sioms.command(0, velocity=0.0, time=0.001)] * 20)
        axis.stop()


def test_subscription_thins_out(cell: sioms.Workcell) -> None:
    with cell.open("force0") as node:
        node.subscribe(50)
        node.read()
        first = node.read().number
        wakes = 0
        while node.read().number < first + 500:
            if is_readable(node._event, 1.0):
                node.read()
                wakes += 1
        assert 1 <= wakes <= 15, "every 50th of 500"
        with raises(errno.EINVAL, "every -2"):
            node.subscribe(-2)
        node.subscribe(0)
        node.read()
        assert not is_readable(node._event, 0.05)


def test_asyncio_face(daemon: Daemon, cell: sioms.Workcell) -> None:
    async def story() -> None:
        async with await sioms.aio.connect(daemon.socket, "async") as mine:
            async with await mine.open("mod0.xaxis", "rw") as axis, await mine.open("force0") as force:

                async def watch() -> int:
                    count = 0
                    async for snapshot in force.snapshots(10):
                        assert snapshot.data[0] == pytest.approx(1.0)
                        count += 1
                        if count == 5:
                            break
                    return count

                await axis.move(0.01)
                await axis.tweak(0.01)
                await axis.write(sioms.command(0, position=0.0))
                idle, watched = await asyncio.gather(axis.wait_until_idle(5.0), watch())
                assert idle is None and watched == 5
                assert axis.read().position[0] == pytest.approx(0.0, abs=2e-3)
                with raises(errno.EBUSY, "async"):
                    await mine.open("mod0.xaxis", "rw")
                with raises(errno.ERANGE, "position 9 m"):
                    await axis.command(position=9.0)
                token = await mine.reserve_marker()
                waiting = asyncio.create_task(mine.wait_marker(token & 1023))
                await asyncio.sleep(0)
                await mine.signal_marker(token)
                assert await asyncio.wait_for(waiting, 5.0) > 0
                await axis.jog(0.01)
                idle_task = asyncio.create_task(axis.wait_until_idle())
                await asyncio.sleep(0.02)
                idle_task.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await idle_task
                assert axis.read().in_motion[0], "cancelling a wait stops nothing"
            with raises(errno.EBADF):
                await axis.command(velocity=0.1)
        with raises(errno.EBADF):
            await mine.status()

    asyncio.run(story())
    cell.open("mod0.xaxis", "rw", timeout=1.0).close()


def test_no_edge_is_lost_between_two_waits(cell: sioms.Workcell) -> None:
    """200 pulses of 0.5 ms: the reader sleeps and works in between, and gets all 400 edges."""
    with cell.open("io0.bit7", "rw") as trigger, cell.open("io0.in") as inputs:
        last: sioms.Event | sioms.client.snapshot.BinarySnapshot = inputs.read()
        edges_before = inputs.read().edges[0]
        trigger.set(1)
        stamps, states = [], []
        for i in range(400):
            last = inputs.wait_event(0x80, last, 5.0)
            stamps.append(last.stamp_ns)
            states.append(last.final >> 7 & 1)
            if i % 40 == 0:
                time.sleep(0.03)  # 60 edges go by
        assert states == [1, 0] * 200
        widths = np.diff(stamps)[::2] / 1e6
        assert widths == pytest.approx(np.full(200, 0.5), abs=1e-3), "stamps are finer than the tick"
        assert np.diff(stamps[::2]) / 1e6 == pytest.approx(np.full(199, 2.0), abs=1e-3)
        assert inputs.read().edges[0] - edges_before == 400
        with pytest.raises(TimeoutError):
            inputs.wait_event(0x80, last, 0.05)
        trigger.set(0)


def test_wait_event_watches_its_mask_only(cell: sioms.Workcell) -> None:
    with cell.open("io0", "rw") as out, cell.open("io0.in") as inputs, cell.open("io0.in.bit1") as bit:
        start = inputs.read()
        out.set(0b01)
        with pytest.raises(TimeoutError):
            inputs.wait_event(0b10, start, 0.05)
        event = inputs.wait_event(0b01, start, 5.0)
        assert (event.initial & 1, event.final & 1) == (0, 1)
        before = bit.read()
        out.set(0b10)
        assert bit.wait_event(last=before, timeout=5.0).final == 1
    with cell.open("force0") as node, raises(errno.EINVAL, "one binary channel"):
        sioms.BinaryNode.wait_event(node)


def test_a_bit_node_shows_and_waits_for_its_own_bit(cell: sioms.Workcell) -> None:
    """An edge of the neighbour is none of it."""
    with (
        cell.open("io0.bit0", "rw") as zero,
        cell.open("io0.bit1", "rw") as one,
        cell.open("io0.in.bit0") as seen,
    ):
        before = seen.read()
        one.set(1)
        with pytest.raises(TimeoutError):
            seen.wait_event(last=before, timeout=0.05)
        zero.set(1)
        event = seen.wait_event(last=before, timeout=5.0)
        assert (event.initial, event.final) == (0, 1)


def test_edges_wake_a_waiting_client(daemon: Daemon, cell: sioms.Workcell, client: Callable[..., Client]) -> None:
    waiter = client(
        daemon,
        "node = cell.open('io0.in.bit0')\nsay('ready')\n"
        "event = node.wait_event(timeout=20.0)\nsay('woke', (time.monotonic_ns() - event.stamp_ns) / 1e6)",
    )
    with cell.open("io0.bit0", "rw") as out:
        time.sleep(0.05)
        out.set(1)
        late_ms = float(waiter.wait_line(r"woke ([\d.]+)").group(1))
        print(f"edge to a waiting client awake: {late_ms:.3f} ms")
        assert late_ms < 1000


def test_values_of_outputs_are_checked(cell: sioms.Workcell) -> None:
    with cell.open("io0", "rw") as port, cell.open("io0.readonly") as seen:
        port.set(0b1010)
        wait_for(lambda: seen.read().data[0] == 0b1010, "set")
        for value in (256, -1, 1 << 40):
            with raises(errno.EINVAL, f"data {value}", "0 to 255"):
                port.set(value)
        with raises(errno.EINVAL, "2 values; want 1"):
            port.set(1, 2)
        with raises(errno.EINVAL, "channel 3"):
            port.write(BINARY_WRITE.pack(3, 0, 1, 0))
        port.write(BINARY_WRITE.pack(0, 0, 0b0101, 0b0011))  # under a mask
        wait_for(lambda: seen.read().data[0] == 0b1001, "the masked bits alone")
    wait_for(lambda: _data(cell) == 0, "safe after the close")
    with cell.open("io0.bit2", "rw") as bit, raises(errno.EINVAL, "data 2", "0 or 1"):
        bit.set(2)


def _data(cell: sioms.Workcell) -> int:
    with cell.open("io0.readonly") as node:
        return int(node.read().data[0])


def test_a_bit_that_closes_drops_its_own_bit_only(cell: sioms.Workcell) -> None:
    with cell.open("io0.bit5", "rw") as other:
        other.set(1)
        with cell.open("io0.bit2", "rw") as bit:
            bit.set(1)
            wait_for(lambda: _data(cell) == 0b100100, "both")
        wait_for(lambda: _data(cell) == 0b100000, "one")


def test_zero_and_gains_of_an_analog_node(cell: sioms.Workcell) -> None:
    with cell.open("force0") as node:
        was = node.zero(samples=50, timeout=5.0)
        assert was == pytest.approx([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
        wait_for(lambda: max(map(abs, node.read().data)) < 1e-9, "zeroed")
        assert node.gains() == np.eye(6).ravel().tolist()
        node.ioctl(Request.ZERO_DEVICE, 1, 5.0)
        rng = np.random.default_rng(1)
        matrix = rng.normal(size=(6, 6))
        node.set_gains(matrix.ravel().tolist())
        assert node.gains() == pytest.approx(matrix.ravel().tolist())
        for bad in ([1.0] * 5, [1.0] * 35 + [math.nan], ["x"] * 6, [True] * 6):
            with raises(errno.EINVAL, "gain"):
                node.ioctl(Request.SET_GAINS, bad)
        assert node.gains() == pytest.approx(matrix.ravel().tolist()), "a refused one changes nothing"
        node.set_gains([2.0] * 6)
        for bad_samples in (0, -1, 1.5, "many"):
            with raises(errno.EINVAL, "samples"):
                node.ioctl(Request.ZERO_DEVICE, bad_samples)
        with cell.open("force0.fz") as part, raises(errno.EINVAL, "whole array of 6"):
            part.gains()
        with raises(errno.ENOTTY, "HOME"):
            node.ioctl(Request.HOME)
        node.set_gains([1.0] * 6)


def test_requests_of_a_class_that_does_not_know_them(cell: sioms.Workcell) -> None:
    with cell.open("io0", "rw") as port, cell.open("mod0", "rw") as axes:
        for node, request in ((port, Request.HOME), (port, Request.SET_GAINS), (axes, Request.SET_GAINS)):
            with raises(errno.ENOTTY, node.name):
                node.ioctl(request, [1.0])
        call = axes._ioctl(Request.STOP)
        call.message = Ioctl(999, None, 0.0)
        with raises(errno.ENOTTY, "999", "no such request"):
            axes._channel.call(call)


def test_statistics_add_up(cell: sioms.Workcell) -> None:
    with cell.open("mod0.readonly") as node:
        first = node.statistics()["ticks"]
        node.wait_new(node.read().number + 50, 5.0)
        after = node.statistics(20)
        assert after["ticks"] >= first + 50 and after["tick_hz"] == 1000.0
        assert 0 <= after["total_ns"]["50.0"] <= after["total_ns"]["99.0"] <= after["longest_ns"]
        with raises(errno.EINVAL, "ticks"):
            node.statistics(0)


def test_many_threads_wait_for_one_node(cell: sioms.Workcell) -> None:
    with cell.open("io0.in.bit0") as inputs, cell.open("io0.bit0", "rw") as out:
        start = inputs.read()
        woken: list[int] = []
        threads = [
            threading.Thread(
                target=lambda: woken.append(inputs.wait_event(last=start, timeout=10.0).final), daemon=True
            )
            for _ in range(5)
        ]
        for thread in threads:
            thread.start()
        out.set(1)
        for thread in threads:
            thread.join(10.0)
        assert woken == [1] * 5


def _readable(node: sioms.Node) -> bool:
    try:
        node.read()
    except OSError:
        return False
    return True


def test_a_node_of_many_axes_and_a_workcell_of_many_nodes(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(
        '[device.big]\ndriver = "sim-axes"\ntick_hz = 100\n[[device.big.axis]]\nname = "a"\ncount = 800\n'
        "velocity_max = 1.0\nacceleration_max = 10.0\nforce_max = 100.0\nbandwidth_hz = 5\nmotor = { mass = 1.0 }\n"
    )
    with daemon.cell() as cell:
        assert len(cell.info("big").channels) == 800
        assert len(cell.nodes()) == 2 + 2 * 800 + 1 + 2 * 800
        daemon.wait_up("big")
        with cell.open("big", "rw") as big:
            wait_for(lambda: _readable(big), "the first publication")
            assert len(big.read()) == 800 and len(big.limits()["velocity_max"]) == 800
            big.write([sioms.command(i, position=0.001) for i in range(800)])
            big.wait_until_idle(20.0)
            wait_for(lambda: big.read().position == pytest.approx([0.001] * 800, abs=5e-4), "settled, at 5 Hz")


def test_edges_that_are_not_kept_are_counted_and_told(start_daemon: Callable[..., Daemon]) -> None:
    """Twenty edges within half a second, of which the page keeps a quarter of a second: all, or a sentence with their
    number.
    """
    daemon = start_daemon('[workcell]\nname = "edges"\n[device.io0]\ndriver = "sim-io"\noutputs = 4\n')
    with daemon.cell() as cell, cell.open("io0", "rw") as port:
        start: sioms.Event | sioms.client.snapshot.BinarySnapshot = port.read()
        for i in range(20):
            port.set(i % 2 + 1)
            time.sleep(0.03)
        with pytest.raises(sioms.EdgesLost, match=r"\d+ edges of its port .* 256 publications are kept") as gap:
            port.wait_event(last=start, timeout=1.0)
        last, told, lost = gap.value.event, 1, gap.value.lost
        assert gap.value.errno == errno.EOVERFLOW
        with pytest.raises(TimeoutError):
            while True:
                last = port.wait_event(last=last, timeout=0.05)
                told += 1
        assert told + lost == 20 and last.final == 2

        async def main() -> None:
            async with await sioms.aio.connect(daemon.socket) as aio, await aio.open("io0.readonly") as eye:
                with pytest.raises(sioms.EdgesLost):
                    await eye.wait_event(last=start, timeout=1.0)

        asyncio.run(main())


def test_two_writes_within_a_tick_are_two_edges(cell: sioms.Workcell) -> None:
    from sioms.client.stream import Stream

    with cell.open("io0", "rw") as port, cell.open("io0.in") as wired:
        port.set(0)
        last, seen = port.read(), wired.read()
        stream = Stream(port)
        for _ in range(50):
            for value in (1, 0):
                stream.write(BINARY_WRITE.pack(0, 0, value, 0))
        stream.drain()
        for i in range(100):
            event = port.wait_event(last=last, timeout=2.0)
            assert event.final == (i + 1) % 2
            last = event
            looped = wired.wait_event(0b1, seen, 2.0)
            assert looped.final & 1 == (i + 1) % 2
            seen = looped
