"""Several cells as one: names, stops, markers and starts across cells, over a socket, ZeroMQ and Zenoh."""

from __future__ import annotations

import asyncio
import errno
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import axes, daemons, raises, wait_for
from interrupt_rig import interrupted_everywhere

import sioms
import sioms.aio
from sioms.check.remote import Gateway, Relay, ZenohGateway
from sioms.children import Process
from sioms.client.fleet_verbs import SLICE_S, FleetError
from sioms.tools.front import main


def _cell(name: str) -> str:
    return f'[workcell]\nname = "{name}"\n' + axes("mod0", "xaxis")


@pytest.fixture(scope="module")
def cells() -> Iterator[dict[str, str]]:
    """Addresses of three cells: by a socket, over ZeroMQ and over Zenoh."""
    with daemons() as start:
        one, two, three = (start(_cell(name)) for name in ("left", "right", "top"))
        with Gateway(two.socket) as zmq, ZenohGateway(three.socket) as zenoh:
            for name in ("secret", "trusted"):  # one folder has what both need
                Path(zenoh.own.file(name)).write_bytes(Path(zmq.own.file(name)).read_bytes())
                Path(zenoh.own.file(name)).chmod(0o600)
            yield {"left": one.socket, "right": zmq.socket, "top": zenoh.socket}


@pytest.fixture
def fleet(cells: dict[str, str]) -> Iterator[sioms.Fleet]:
    """Sessions with all of them, nothing stopped."""
    with sioms.Fleet(cells, "tester") as opened:
        opened.reset()
        yield opened


def test_nodes_have_names_in_the_fleet(
    fleet: sioms.Fleet,
    cells: dict[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert list(fleet) == ["left", "right", "top"]
    names = {entry.name for entry in fleet.nodes()}
    assert {"left:mod0", "right:mod0", "top:mod0.xaxis"} <= names
    with fleet.open("right:mod0", "rw", lease=2.0) as node:
        node.move(0.01)
        assert fleet.info("right:mod0").name == "mod0" and "lease" not in fleet.status()["left"]
    for wrong, why in (
        ("mod0", "want CELL:NODE"),
        ("bottom:mod0", "there are: left, right, top"),
        ("left:none", "no such node"),
    ):
        with pytest.raises(OSError, match=why):
            fleet.open(wrong)
    file = tmp_path / "fleet.toml"
    file.write_text("[cells]\n" + "".join(f'{name} = "{address}"\n' for name, address in cells.items()))
    monkeypatch.setenv("SIOMS_FLEET", str(file))
    assert main(["list", "--all"]) == 0 and "top:mod0" in capsys.readouterr().out
    file.write_text(file.read_text() + 'gone = "/nowhere/siomsd.sock"\n')
    assert main(["list", "--all"]) == 1
    said = capsys.readouterr()
    assert "left:mod0" in said.out and "gone: connect to /nowhere" in said.err
    with pytest.raises(sioms.FleetError, match="1 of 4 cells failed: gone"):
        sioms.Fleet()
    assert main(["stop", "--all"]) == 1 and "gone" in capsys.readouterr().err
    assert all(status["stopped_ns"] for status in fleet.status().values()), "the others have been stopped"


def test_a_name_that_two_cells_claim_is_an_error(cells: dict[str, str]) -> None:
    with raises(errno.EEXIST, f"calls itself 'left', as does the one at {cells['left']}"):
        sioms.Fleet([cells["left"], cells["left"]])
    with raises(errno.EINVAL, "calls itself 'left' and the fleet 'right'"):
        sioms.Fleet({"right": cells["left"]})


def test_a_stop_reaches_all_cells_also_when_a_session_is_lost(fleet: sioms.Fleet) -> None:
    fleet["top"].close()
    fleet["top"]._channel._ended = (errno.EIO, "lost")
    with pytest.raises(OSError):
        fleet["top"].nodes()
    fleet.emergency_stop("enough")
    with sioms.Fleet({name: fleet._addresses[name] for name in fleet}) as again:
        for name, status in again.status().items():
            assert 0 < time.monotonic_ns() - status["stopped_ns"] < 10_000_000_000, name
        again.reset()


def test_markers_pass_from_cell_to_cell(fleet: sioms.Fleet) -> None:
    marker = fleet.reserve_marker()
    with fleet.open("left:mod0", "rw") as left, fleet.open("top:mod0", "rw", lease=5.0) as top:
        here, there = left.read().position[0], top.read().position[0]
        top.command(position=there + 0.01, wait=marker["top"])
        found: list[int] = []
        waiting = threading.Thread(target=lambda: found.append(marker.wait(10.0)))
        waiting.start()
        time.sleep(0.1)
        assert not top.read().in_motion[0]
        left.command(position=here + 0.01, signal=marker[left])
        wait_for(lambda: top.read().position[0] > there + 0.009, "the other cell to start")
        waiting.join()
        assert 0 <= time.monotonic_ns() - found[0] < 10_000_000_000
    with raises(errno.ETIMEDOUT, "3 of 3 cells failed"):
        fleet.reserve_marker().wait(0.2)
    other = fleet.reserve_marker()
    other.signal()
    assert other.wait(2.0)
    other.free()


def _first_motions(nodes: list[Any], begin: list[float]) -> list[int | None]:
    """Return the times of the first snapshots that show motion; None where one more than 15 ms before it is not known.

    A page keeps a quarter of a second, and that of a slow link has gaps: the oldest there need not be the first.
    """
    seen: list[list[Any]] = [[node.read()] for node in nodes]

    def all_have_moved() -> bool:
        for node, known in zip(nodes, seen, strict=True):
            known += node.history(known[-1].number)
        return all(abs(known[-1].position[0] - start) > 0.009 for known, start in zip(seen, begin, strict=True))

    wait_for(all_have_moved, "all to move")
    firsts: list[int | None] = []
    for known in seen:
        moved = [abs(each.commanded_position[0] - known[0].commanded_position[0]) > 1e-6 for each in known]
        first = moved.index(True)
        is_known = first and known[first].stamp_ns - known[first - 1].stamp_ns < 15_000_000
        firsts.append(known[first].stamp_ns if is_known else None)
    return firsts


def test_cells_start_at_one_instant_or_not_at_all(fleet: sioms.Fleet) -> None:
    nodes = [fleet.open(f"{name}:mod0", "rw", lease=5.0) for name in fleet]
    try:
        begin = [node.read().position[0] for node in nodes]
        for node, start in zip(nodes, begin, strict=True):
            node.command(position=start + 0.01, synch=True)
        with raises(errno.ERANGE, "apart, more than 1 us; errors by link and by UTC: left 0 us and"):
            fleet.synch(*nodes, within=1e-6)
        assert not any(node.read().in_motion[0] for node in nodes)
        at_ns = fleet.synch(*nodes, lead=0.3, within=0.1)
        assert at_ns > time.monotonic_ns()
        firsts = _first_motions(nodes, begin)
        for _ in range(5):
            if None not in firsts:
                break
            for node in nodes:
                node.wait_until_idle()
            begin = [node.read().position[0] for node in nodes]
            for node, start in zip(nodes, begin, strict=True):
                node.command(position=start + 0.01, synch=True)
            fleet.synch(*nodes, lead=0.3, within=0.1)
            firsts = _first_motions(nodes, begin)
        known = [first for first in firsts if first is not None]
        assert len(known) == len(nodes), "which snapshots showed it first"
        assert max(known) - min(known) < 45_000_000, "the same tick, as far as two machines' clocks are known"
    finally:
        for node in nodes:
            node.close()


BETWEEN_CELLS = ("sioms.client.fleet", "sioms.client.channel")


READING = ("_read", "_packet", "_decoded", "_fds_of", "_last_word")
"""An answer that a signal takes out of the hand that has just read it is lost; markers end with the session."""


def _markers(watch: dict[str, sioms.Workcell]) -> int:
    """Return how many markers the sessions of all cells have."""
    return sum(row[3] for cell in watch.values() for row in cell.status()["sessions"])


def test_an_interrupt_between_cells_leaves_nothing_behind(fleet: sioms.Fleet, cells: dict[str, str]) -> None:
    watch = {name: sioms.Workcell(address, "watch") for name, address in cells.items()}
    try:
        before, places = _markers(watch), 0
        for at in interrupted_everywhere(fleet.reserve_marker, BETWEEN_CELLS, READING, step=7):
            fleet.status()  # who reads next finds what nobody waits for
            wait_for(lambda: _markers(watch) == before, f"no marker left of place {at}", 2.0)
            places = at
        assert places > 20
    finally:
        for cell in watch.values():
            cell.close()


def test_a_stop_that_is_interrupted_reaches_all_cells(fleet: sioms.Fleet) -> None:
    places = 0
    for at in interrupted_everywhere(lambda: fleet.emergency_stop("enough"), ("sioms.client.fleet",), step=2):
        wait_for(lambda: all(s["stopped_ns"] for s in fleet.status().values()), f"all to stop at place {at}", 2.0)
        _reset(fleet)
        places = at
    assert places > 5
    fleet.reset()


def test_a_stop_that_is_interrupted_while_it_tells_the_cells_reaches_all_or_none(fleet: sioms.Fleet) -> None:
    """None only before the first has been told."""
    stopped = []
    for at in interrupted_everywhere(lambda: fleet.emergency_stop("enough"), ("sioms.client.fleet_verbs",)):
        found = {name: bool(s["stopped_ns"]) for name, s in _settled(fleet).items()}
        assert len({*found.values()}) == 1, f"place {at}: {found}"
        stopped.append(all(found.values()))
        _reset(fleet)
    assert sum(stopped) > 5 and stopped == sorted(stopped), stopped
    fleet.reset()


def test_a_second_interrupt_of_a_stop_leaves_no_cell_out(fleet: sioms.Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first comes when one cell has been asked by its file; the second at every place of what follows."""

    async def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    def stop() -> None:
        with monkeypatch.context() as patch:
            patch.setattr(fleet._together, "calls", interrupted)
            fleet.emergency_stop("enough")

    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        for at in interrupted_everywhere(stop, ("sioms.client.fleet_verbs",), is_signal=True):
            found = {name: bool(status["stopped_ns"]) for name, status in _settled(fleet).items()}
            assert len({*found.values()}) == 1, f"place {at}: {found}"
            _reset(fleet)
            if at > 60:
                break  # the first interrupt ends each of them
    finally:
        signal.signal(signal.SIGINT, before)


def _reset(fleet: sioms.Fleet) -> None:
    """Reset all cells, though a stop that nobody waited for may come as late as that: then it has to be seen first."""

    def is_reset() -> bool:
        try:
            fleet.reset()
        except FleetError as error:
            assert error.errno == errno.EAGAIN
            fleet.status()
            return False
        return True

    wait_for(is_reset, "reset", 2.0)


def _settled(fleet: sioms.Fleet) -> dict[str, dict[str, Any]]:
    """Return the status of the cells when all have had the time to stop."""
    until = time.monotonic() + 0.3
    while not all(s["stopped_ns"] for s in fleet.status().values()) and time.monotonic() < until:
        time.sleep(0.005)
    return fleet.status()


def test_a_start_that_is_interrupted_starts_nothing(fleet: sioms.Fleet) -> None:
    nodes = [fleet.open(f"{name}:mod0", "rw", lease=5.0) for name in fleet]
    try:
        places = 0

        def start() -> None:
            for node in nodes:
                node.command(position=node.read().position[0] + 0.01, synch=True, replace=True)
            fleet.synch(*nodes, lead=0.1, within=0.1)

        for at in interrupted_everywhere(start, ("sioms.client.fleet",), step=3):
            until = time.monotonic() + 0.15
            while time.monotonic() < until:
                assert not any(node.read().in_motion[0] for node in nodes), f"place {at}"
            places = at
        assert places > 3
    finally:
        for node in nodes:
            node.close()


def test_a_wait_that_is_interrupted_ends_in_all_cells(fleet: sioms.Fleet) -> None:
    marker = fleet.reserve_marker()
    main_thread = threading.main_thread().ident
    assert main_thread is not None
    threading.Timer(0.2, signal.pthread_kill, [main_thread, signal.SIGINT]).start()
    with pytest.raises(KeyboardInterrupt):
        marker.wait()
    wait_for(lambda: not any(row[2] for row in _sessions(fleet)), "no wait of ours to be left", 3.0)
    time.sleep(SLICE_S)
    assert not any(row[2] for row in _sessions(fleet)), "and none begins"


def _sessions(fleet: sioms.Fleet) -> list[list[object]]:
    return [row for status in fleet.status().values() for row in status["sessions"] if "tester" in str(row[0])]


def test_the_asyncio_face(cells: dict[str, str]) -> None:
    async def go() -> None:
        async with await sioms.aio.fleet(cells) as fleet:
            assert len(await fleet.nodes()) >= 6
            marker = await fleet.reserve_marker()
            wait = asyncio.create_task(marker.wait(5.0))
            await asyncio.sleep(0.05)
            await marker["left"].signal()
            await wait
            await fleet.emergency_stop("enough")
            assert all(status["stopped_ns"] for status in (await fleet.status()).values())
            await fleet.reset()

    asyncio.run(go())


def test_a_cell_that_asks_for_a_supervisor_stops_without_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = _cell("guarded").replace('"guarded"\n', '"guarded"\nsupervisor_lease_s = 1.0\n')
    with daemons() as start:
        daemon = start(text)
        with Gateway(daemon.socket) as gate, Relay(gate.port) as relay, daemon.cell() as cell:
            assert "no supervisor: start" in cell.status()["stop_source"]
            with raises(errno.EPERM, "has no supervisor"):
                cell.reset()
            file = tmp_path / "fleet.toml"
            file.write_text(f'[cells]\nguarded = "{gate.trusted(relay.port)}"\n')
            monkeypatch.setenv("SIOMS_FLEET", str(file))
            supervisor = Process(["sioms.tools.front", "supervise"], "stops after 1 s", errors=True)
            cell.reset()
            time.sleep(1.5)
            assert not cell.status()["stopped_ns"], "it lives"
            relay.stalled = True
            wait_for(lambda: cell.status()["stopped_ns"], "the stop after a stalled link")
            assert "supervisor eva@127.0.0.1" in cell.status()["stop_source"]
            relay.stalled = False
            wait_for(lambda: _reset(cell), "a supervisor again")
            supervisor.kill()
            wait_for(lambda: cell.status()["stopped_ns"], "the stop after the supervisor's death")
            with raises(errno.EPERM, "has no supervisor"):
                cell.reset()


def _reset(cell: sioms.Workcell) -> bool:
    try:
        cell.reset()
    except OSError:
        return False
    return True
