"""The bridge to EPICS: what its clients see, by the library's own client over loopback."""

from __future__ import annotations

import math
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("p4p", reason="needs the extra epics")

from p4p.client.thread import Context, RemoteError

from sioms.bridges import epics
from sioms.bridges.prompt import Prompt
from sioms.bridges.putters import Putters
from sioms.protocol.flags import AnalogStatus, AxisStatus, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo, NodeInfo

PATIENCE_S = 15.0
"""As long as other tests wait for what only has to come [s]."""


class Node:
    """An axis at rest, or that cannot be read."""

    def __init__(self, name: str) -> None:
        channel = ["xaxis", "m", -0.5, 0.5, 0, 0, {"velocity": 0.25}, "the slide"]
        self.info = NodeInfo([name, int(NodeClass.AXIS), True, [channel], -1, 1e3, 16, "mod0", "sim", 2])
        self.lost, self.stops, self.moving, self.status = "", 0, 1, 0

    def read(self) -> Any:
        if self.lost:
            raise OSError(5, self.lost)
        reading = SimpleNamespace(
            position=0.125, commanded_position=0.25, following_error=0.0, in_motion=self.moving, status=self.status
        )
        return Snapshot([reading])

    def stop(self) -> None:
        if self.status:
            raise OSError(1, "stop mod0.readonly: no right to")
        self.stops, self.moving = self.stops + 1, 0

    def release(self) -> None:
        pass

    def __enter__(self) -> Node:
        return self

    def __exit__(self, *_: object) -> None:
        pass


class Snapshot(list[Any]):
    utc = SimpleNamespace(ns=1_000_000_000_500_000_000)


class Cell:
    """A workcell of one axis."""

    def __init__(self, node: Node) -> None:
        self.empty = False
        self.node, self.raised = node, [dict.fromkeys(("node", "text"), "mod0.yaxis") | {"severity": 2}]

    def nodes(self) -> list[Any]:
        if self.empty:
            return []
        return [SimpleNamespace(name="mod0", read_only=False, device="mod0", node_class=3, channels=1, bit=-1)]

    def alarms(self) -> list[dict[str, Any]]:
        return self.raised

    def open(self, name: str) -> Node:
        assert name == "mod0.readonly"
        return self.node

    def close(self) -> None:
        pass


def look(bridge: epics.Bridge) -> None:
    bridge.ask()
    bridge.look()


@pytest.fixture
def cell(monkeypatch: pytest.MonkeyPatch) -> Cell:
    made = Cell(Node("mod0.readonly"))
    monkeypatch.setattr(epics, "Workcell", lambda name: made)
    return made


@pytest.fixture
def bridge(cell: Cell) -> epics.Bridge:
    made = epics.Bridge("lab:", Putters(), Prompt(beats=False))
    look(made)
    return made


@contextmanager
def serving(bridge: epics.Bridge) -> Iterator[Context]:
    with epics.serve(bridge.provider, "127.0.0.1", 0) as server:
        bridge._putters.here = ("127.0.0.1", int(server.conf()["EPICS_PVAS_SERVER_PORT"]))
        place = f"127.0.0.1:{server.conf()['EPICS_PVAS_SERVER_PORT']}"
        conf = {"EPICS_PVA_NAME_SERVERS": place, "EPICS_PVA_ADDR_LIST": "", "EPICS_PVA_AUTO_ADDR_LIST": "NO"}
        with Context("pva", conf=conf, useenv=False) as context:
            yield context


@pytest.fixture
def client(bridge: epics.Bridge) -> Iterator[Context]:
    with serving(bridge) as context:
        yield context


def test_an_axis_is_seen_as_a_motor_with_alarms_and_stopped_by_a_put(
    client: Context, bridge: epics.Bridge, cell: Cell
) -> None:
    def get(field: str) -> Any:
        return client.get(f"lab:mod0:xaxis{field}", timeout=PATIENCE_S)

    seen = {field: get(field) for field in (".RBV", ".VAL", "", ".VELO", ".LLM", ".HLM", ".DMOV", ".MOVN", ".EGU")}
    assert [*seen.values()] == [0.125, 0.25, 0.25, 0.25, -0.5, 0.5, 0, 1, "m"]
    raw = seen[".RBV"].raw
    assert (raw["display.units"], raw["display.description"]) == ("m", "the slide")
    assert (raw["control.limitLow"], raw["control.limitHigh"]) == (-0.5, 0.5)
    assert (seen[".RBV"].severity, seen[".RBV"].timestamp) == (0, 1_000_000_000.5)

    for field in ("", ".VAL", ".VELO", ".HLM"):
        with pytest.raises(RemoteError, match="only STOP can be put"):
            client.put(f"lab:mod0:xaxis{field}", 0.3, timeout=PATIENCE_S)
    client.put("lab:mod0:xaxis.STOP", 0, timeout=PATIENCE_S)
    assert cell.node.stops == 0
    client.put("lab:mod0:xaxis.STOP", 1, timeout=PATIENCE_S)
    assert cell.node.stops == 1
    look(bridge)
    assert get(".DMOV") == 1

    cell.raised.append({"node": "mod0.xaxis", "severity": 1, "text": "too warm"})
    look(bridge)
    assert (get(".RBV").severity, get(".RBV").raw["alarm.message"]) == (1, "too warm")
    cell.node.status = int(AxisStatus.FAULT)
    look(bridge)
    assert (get(".RBV").severity, get(".RBV").raw["alarm.message"]) == (2, "FAULT")
    with pytest.raises(RemoteError, match=r"put to lab:mod0:xaxis.STOP: stop mod0.readonly: no right to"):
        client.put("lab:mod0:xaxis.STOP", 1, timeout=PATIENCE_S)

    cell.node.lost = "its driver is gone"
    look(bridge)
    assert (get(".RBV").severity, get(".RBV").raw["alarm.message"]) == (3, "its driver is gone")
    assert get(".RBV") == 0.125
    cell.node.status = 0
    client.put("lab:mod0:xaxis.STOP", 1, timeout=PATIENCE_S)
    assert cell.node.stops == 2, "also where it cannot be read"
    cell.node.lost = ""
    look(bridge)
    assert get(".RBV").severity == 1, "the alarm still stands"


def test_nan_stops_and_what_is_reloaded_or_gone_is_not_shown_as_before(
    client: Context, bridge: epics.Bridge, cell: Cell
) -> None:
    client.put("lab:mod0:xaxis.STOP", float("nan"), timeout=PATIENCE_S)
    assert cell.node.stops == 1
    with pytest.raises(RemoteError, match="with --move LEASE and VAL"):
        client.put("lab:mod0:xaxis.VAL", 0.1, timeout=PATIENCE_S)

    cell.node.lost = "its driver is gone"
    look(bridge)
    cell.node.lost = ""
    cell.node.info.channels[0].unit = "rad"
    look(bridge)
    assert client.get("lab:mod0:xaxis.RBV", timeout=PATIENCE_S).raw["display.units"] == "rad"
    cell.empty = True
    look(bridge)
    with pytest.raises(TimeoutError):
        client.get("lab:mod0:xaxis.RBV", timeout=0.1)
    cell.empty = False
    look(bridge)
    assert client.get("lab:mod0:xaxis.RBV", timeout=PATIENCE_S) == 0.125


def test_a_daemon_that_hangs_keeps_nobody_from_seeing_what_drivers_publish(
    client: Context, bridge: epics.Bridge, cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    hangs, asked = threading.Event(), threading.Event()
    monkeypatch.setattr(cell, "alarms", lambda: (asked.set(), hangs.wait(20.0), [])[2])
    asking = threading.Thread(target=bridge.ask)
    asking.start()
    assert asked.wait(5.0)
    cell.node.moving = 0
    bridge.look()
    assert client.get("lab:mod0:xaxis.DMOV", timeout=PATIENCE_S) == 1
    hangs.set()
    asking.join()


def test_a_limit_that_is_not_configured_is_no_limit_at_0() -> None:
    def told(low: float | None, high: float | None) -> tuple[float, float]:
        return epics.bounds(ChannelInfo("x", "m", low, high))

    assert [told(None, None), told(None, 1.0), told(0.2, None)] == [(0, 0), (-math.inf, 1.0), (0.2, math.inf)]


def test_what_is_flagged_invalid_has_that_severity() -> None:
    """MAJOR is a value that one may act upon."""
    flags = AnalogStatus.INVALID | AnalogStatus.OVERRUN
    assert epics.severity_of(NodeClass.ANALOG, SimpleNamespace(flags=int(flags))) == (3, "INVALID, OVERRUN")


def test_a_put_that_is_answered_shows(cell: Cell) -> None:
    """A script waits for .DMOV behind its put: it must not find the motion before."""
    cell.node.moving = 0
    held = SimpleNamespace(move=lambda *_: setattr(cell.node, "moving", 1), shown=lambda _: (0.5, 0, ""), sweep=bool)
    bridge = epics.Bridge("", Putters(), Prompt(beats=False), held)  # type: ignore[arg-type]
    look(bridge)
    with serving(bridge) as client:
        assert client.get("mod0:xaxis.DMOV", timeout=PATIENCE_S) == 1
        client.put("mod0:xaxis.VAL", 0.1, timeout=PATIENCE_S)
        assert client.get("mod0:xaxis.DMOV", timeout=PATIENCE_S) == 0
        client.put("mod0:xaxis.STOP", 1, timeout=PATIENCE_S)
        assert client.get("mod0:xaxis.DMOV", timeout=PATIENCE_S) == 1


def mover() -> tuple[epics.Bridge, list[Any]]:
    """Return a bridge that may move, and the calls that come to who would hold the axes."""
    calls: list[Any] = []
    held = SimpleNamespace(
        put=lambda *words: calls.append(words), move=lambda *words: calls.append(words), shown=lambda _: (0.5, 0, "x"),
        sweep=lambda: None,
    )  # fmt: skip
    return epics.Bridge("", Putters(), Prompt(beats=False), held), calls  # type: ignore[arg-type]


def test_axes_are_moved_only_on_request_and_only_from_this_machine(cell: Cell) -> None:
    bridge, calls = mover()
    look(bridge)
    with serving(bridge) as client:
        client.put("mod0.LEASE", 0.5, timeout=PATIENCE_S)
        client.put("mod0:xaxis.VAL", 0.1, timeout=PATIENCE_S)
        assert client.get("mod0.LEASE", timeout=PATIENCE_S) == 0.5
    who = calls[0][1]
    assert "@127.0.0.1:" in who
    assert calls == [("mod0", who, 0.5), ("mod0", who, "xaxis", 0.1)]
    assert [epics.is_loopback(host) for host in ("127.0.0.1", "::1", "localhost", "*", "10.0.0.1")] == [1, 1, 1, 0, 0]


def test_a_put_that_waits_behind_another_came_before_and_keeps_up_no_stop(cell: Cell) -> None:
    """As while a driver hangs: what was put before somebody stopped and reset all is not of after that."""
    prompt, go_on = Prompt(), threading.Event()
    words: list[int] = []

    def move(*_: object) -> None:
        words.append(Prompt._word.get(0))
        assert go_on.wait(10.0)

    held = SimpleNamespace(move=move, shown=lambda _: (0.5, 0, ""), sweep=bool)
    bridge = epics.Bridge("", Putters(), prompt, held)  # type: ignore[arg-type]
    look(bridge)
    with serving(bridge) as client:

        def put() -> None:
            client.put("mod0:xaxis.VAL", 0.1, timeout=10.0)

        putting = [threading.Thread(target=put) for _ in range(2)]
        for thread in putting:
            thread.start()
            time.sleep(0.3)
        assert len(words) == 1, "the second one waits"
        client.put("mod0:xaxis.STOP", 1, timeout=PATIENCE_S)
        assert cell.node.stops == 1
        reset_ns = time.monotonic_ns()
        go_on.set()
        for thread in putting:
            thread.join()
    assert len(words) == 2 and all(word < reset_ns for word in words)


def test_where_one_cannot_listen_is_told(bridge: epics.Bridge) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(OSError, match="another program does"):
        epics.serve(bridge.provider, "127.0.0.1", taken.getsockname()[1])
    with pytest.raises(OSError, match=r"listen on no\.such\.address:5999: "):
        epics.serve(bridge.provider, "no.such.address", 5999)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to be two users")
def test_a_stranger_of_this_machine_reads_but_puts_nothing(cell: Cell) -> None:
    """He may say of himself what he likes: the kernel knows who has made his connection."""
    bridge, calls = mover()
    look(bridge)
    puts = [("mod0.LEASE", 0.5), ("mod0:xaxis.VAL", 0.1), ("mod0:xaxis.STOP", 1)]
    with serving(bridge):
        here = "{}:{}".format(*bridge._putters.here)
        told = as_stranger(here, puts)
        assert all(f"put to {name}: user {STRANGER}; want one of user root on this machine" in told for name, _ in puts)
        assert "read 0.125" in told
        assert not calls and not cell.node.stops
        bridge._putters._uids.add(STRANGER)
        assert "put to" not in as_stranger(here, puts)
        assert (len(calls), cell.node.stops) == (2, 1)
        bridge._putters = Putters(anybody_stops=True)
        bridge._putters.here = ("*", int(here.rpartition(":")[2]))
        told = as_stranger(here, puts)
        assert told.count("put to") == 2 and "STOP" not in told, told
        assert (len(calls), cell.node.stops) == (2, 2)


STRANGER = 60123


def as_stranger(place: str, puts: list[tuple[str, float]]) -> str:
    """Read and put as another user; return what he was told."""
    program = f"""
import os
os.environ["USER"] = os.environ["LOGNAME"] = "root"
from p4p.client.thread import Context, RemoteError
os.setuid({STRANGER})
conf = {{"EPICS_PVA_NAME_SERVERS": "{place}", "EPICS_PVA_ADDR_LIST": "", "EPICS_PVA_AUTO_ADDR_LIST": "NO"}}
with Context("pva", conf=conf, useenv=False) as context:
    print("read", float(context.get("mod0:xaxis.RBV", timeout=15.0)))
    for name, value in {puts!r}:
        try:
            context.put(name, value, timeout=15.0)
        except RemoteError as error:
            print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30.0, check=True)
    return done.stdout
