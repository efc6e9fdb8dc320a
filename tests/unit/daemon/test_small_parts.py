"""Rights, restarts, marker owners, log, loop and service manager: the daemon's pure parts."""

from __future__ import annotations

import errno
import os
import pwd
import socket
import threading
from pathlib import Path

import pytest

from sioms.daemon.config import GrantTable
from sioms.daemon.log import Log
from sioms.daemon.loop import Loop
from sioms.daemon.marker_owners import MarkerError, MarkerOwners
from sioms.daemon.restarts import FIRST_PAUSE_NS, LIMIT, WINDOW_NS, Restarts
from sioms.daemon.rights import Peer, Rights
from sioms.daemon.sessions import peer_of, pidfd_of
from sioms.daemon.stop_record import StopRecord
from sioms.daemon.users import Users
from sioms.notify import ServiceManager
from sioms.protocol.flags import Right
from sioms.protocol.markers import MARKERS, TABLE_SIZE, MarkerTable, split_token, token_of
from sioms.protocol.stopjournal import workcell_entry

S = 1_000_000_000
EVA = Peer(10, 1000, "eva", frozenset({20, 1000}))
TOM = Peer(11, 1001, "tom", frozenset({30}))
ROOT = Peer(1, 0, "root", frozenset({0}))
OWNER = Peer(2, 900, "sioms", frozenset())
GRANTS = [
    GrantTable(["read", "write"], groups=["lab"], nodes=["mod*", "io0"]),
    GrantTable(["read"], users=["*"]),
    GrantTable(["stop"], users=["tom"], nodes=["mod0"]),
    GrantTable(["administer"], users=["eva"]),
]


class Machine(Users):
    """A machine with two users and a group."""

    def uid(self, name: str) -> int | None:
        return {"eva": 1000, "tom": 1001}.get(name)

    def gid(self, name: str) -> int | None:
        return {"lab": 20}.get(name)


@pytest.mark.parametrize(
    ("peer", "node", "expected"),
    [
        (EVA, "mod0", Right.READ | Right.WRITE | Right.ADMINISTER),
        (EVA, "mod0.xaxis", Right.READ | Right.WRITE | Right.ADMINISTER),
        (EVA, "io0.bit1", Right.READ | Right.ADMINISTER),
        (EVA, "io1", Right.READ | Right.ADMINISTER),
        (TOM, "mod0", Right.READ | Right.STOP),
        (TOM, "mod1", Right.READ),
        (ROOT, "mod0", Right.ALL),
        (OWNER, "mod0", Right.ALL),
    ],
)
def test_rights_on_nodes(peer: Peer, node: str, expected: Right) -> None:
    assert Rights(GRANTS, 900, Machine()).on_node(peer, node) == expected


def test_rights_on_the_workcell() -> None:
    rights = Rights(GRANTS, 900, Machine())
    assert rights.on_workcell(EVA) == Right.READ | Right.ADMINISTER
    assert rights.on_workcell(TOM) == Right.READ | Right.STOP, "who may stop anything may stop everything"
    assert Rights([], 900, Machine()).on_workcell(TOM) == Right.READ | Right.WRITE | Right.STOP
    nobody = Rights([GrantTable(["read"], users=["eva"])], 900, Machine()).on_node(TOM, "mod0")
    assert nobody == Right(0)


def test_a_grant_to_nobody_is_told_and_holds_for_the_others() -> None:
    rights = Rights([GrantTable(["read"], users=["eva", "ewa"], groups=["lap"])], 900, Machine())
    assert rights.unknown == ["user ewa", "group lap"]
    assert rights.on_node(EVA, "mod0") == Right.READ


def test_names_come_from_the_machine() -> None:
    users = Users()
    assert users.name(0) == "root" and users.uid("root") == 0 and users.gid("root") == 0
    assert users.uid("no such user") is None
    assert users.name(4_000_000_000) == "uid 4000000000"


def test_a_name_service_that_hangs_holds_nobody_up(monkeypatch: pytest.MonkeyPatch) -> None:
    gate = threading.Event()
    entry = pwd.getpwuid(0)

    def hang(_: int) -> pwd.struct_passwd:
        gate.wait(10.0)
        return entry

    monkeypatch.setattr(pwd, "getpwuid", hang)
    users = Users(answer_s=0.001)
    assert users.name(1234) == "uid 1234"
    gate.set()
    for _ in range(1000):
        if users.name(1234) == "root":
            return
    raise AssertionError("the answer that came later is not remembered")


def test_where_no_thread_can_be_started_names_are_numbers_and_stops_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(_thread: object) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr("threading.Thread.start", start)
        assert Users().name(os.getuid()) == f"uid {os.getuid()}"
        record = StopRecord(str(tmp_path / "stops"))
        record.note(workcell_entry("somebody", stop=True))
    record.note(workcell_entry("somebody", stop=True))
    assert record._flusher._thread is not None, "tried again"
    record.close()
    assert StopRecord(str(tmp_path / "stops")).state.workcell == "somebody"


def test_credentials_come_from_the_kernel() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        peer = peer_of(ours, Users())
        assert (peer.pid, peer.uid) == (os.getpid(), os.getuid())
        assert peer.gids == {os.getgid(), *os.getgroups()}
        pidfd = pidfd_of(ours, peer.pid)
        assert pidfd >= 0
        os.close(pidfd)
    assert pidfd_of(socket.socket(), 2**22 + 1) == -1, "no such process"


def test_one_restart_at_once_then_growing_pauses_then_fault() -> None:
    restarts, now = Restarts(), 1000 * S
    assert restarts.died(now) == now
    assert restarts.died(now + S) == now + S + FIRST_PAUSE_NS
    assert restarts.died(now + 2 * S) == now + 2 * S + 2 * FIRST_PAUSE_NS
    assert restarts.died(now + 3 * S) == now + 3 * S + 4 * FIRST_PAUSE_NS
    assert restarts.died(now + 4 * S) is None
    restarts.forget()
    assert restarts.died(now + 5 * S) == now + 5 * S


def test_rare_deaths_are_no_fault() -> None:
    restarts = Restarts()
    for i in range(3 * LIMIT):
        now = 1000 * S + i * (WINDOW_NS // (LIMIT - 1) + S)
        assert restarts.died(now) == now


class TestMarkerOwners:
    @pytest.fixture
    def owners(self) -> MarkerOwners:
        return MarkerOwners(MarkerTable(memoryview(bytearray(TABLE_SIZE))))

    def test_numbers_are_handed_out_in_turn_so_that_a_freed_one_rests(self, owners: MarkerOwners) -> None:
        first = owners.reserve("eva")
        owners.free(owners.entitled(first, "free"))
        numbers = [split_token(owners.reserve("eva"))[0] for _ in range(MARKERS - 2)]
        assert numbers == list(range(2, MARKERS))
        assert split_token(owners.reserve("eva"))[0] == 1
        with pytest.raises(MarkerError, match="1023 are taken") as refused:
            owners.reserve("eva")
        assert refused.value.errno == errno.EBUSY

    def test_keys(self, owners: MarkerOwners) -> None:
        token = owners.reserve("eva")
        number, key = split_token(token)
        assert key and token < 2**50 and int(float(token)) == token
        assert owners.find(number, "wait for") == owners.entitled(token, "free")
        with pytest.raises(MarkerError, match="key is missing or wrong") as refused:
            owners.entitled(number, "free")
        assert refused.value.errno == errno.EPERM
        for odd in (token ^ 1 << 30, 0, -1, -token, 1 << 70):
            with pytest.raises(MarkerError) as refused:
                owners.entitled(odd, "free")
            assert refused.value.errno in (errno.EINVAL, errno.EPERM)

    def test_a_late_signal_does_not_satisfy_the_next_reservation(self) -> None:
        keys = iter(range(1, 5000))
        owners = MarkerOwners(MarkerTable(memoryview(bytearray(TABLE_SIZE))), lambda: next(keys))
        old = owners.entitled(owners.reserve("eva"), "free")
        owners.free(old)
        for _ in range(MARKERS - 2):
            owners.reserve("tom")
        new = owners.entitled(owners.reserve("tom"), "free")
        assert new.number == old.number
        owners.signal(old, 5)
        assert not owners.is_signalled(new) and not owners.is_signalled(owners.find(new.number, ""))

    def test_a_token_of_an_earlier_reservation_finds_nothing(self, owners: MarkerOwners) -> None:
        number, key = split_token(owners.reserve("eva"))
        with pytest.raises(MarkerError, match="not reserved") as refused:
            owners.find(token_of(number, key ^ 1), "wait for")
        assert refused.value.errno == errno.EINVAL

    def test_owned_by(self, owners: MarkerOwners) -> None:
        mine, persisting = owners.reserve("eva"), owners.reserve(None)
        assert [r.number for r in owners.owned_by("eva")] == [split_token(mine)[0]]
        assert owners.find(persisting, "x").owner is None


class TestLoop:
    def test_timers_in_order_and_cancelled_ones_not(self) -> None:
        loop, seen = Loop(), []
        loop.at(3, lambda: seen.append("c"))
        loop.at(1, lambda: seen.append("a"))
        loop.at(2, lambda: seen.append("no")).cancel()
        loop.at(2, lambda: seen.append("b"))
        loop.step()
        assert seen == ["a", "b", "c"]
        loop.close()

    def test_a_descriptor_closed_by_an_earlier_callback_of_the_round_is_not_served(self) -> None:
        loop, seen = Loop(), []
        pairs = [socket.socketpair() for _ in range(2)]

        def serve(me: int) -> None:
            seen.append(me)
            other = pairs[1 - me][0]
            loop.unwatch(other.fileno())
            other.close()

        for i, (ours, theirs) in enumerate(pairs):
            loop.watch(ours.fileno(), lambda i=i: serve(i))
            theirs.send(b"x")
        loop.step()
        assert len(seen) == 1
        for ours, theirs in pairs:
            ours.close()
            theirs.close()
        loop.close()


def test_log_lines_are_one_line_with_quoted_values(capsys: pytest.CaptureFixture[str]) -> None:
    log = Log(level="info")
    log("debug", "unseen")
    log("warning", "device lost", device="mod0", reason='said "no"\nand more', empty="", zero=0)
    line = capsys.readouterr().err
    assert line.count("\n") == 1
    assert line.split(" ", 1)[1] == (
        'level=warning event="device lost" device=mod0 reason="said \\"no\\" and more" zero=0\n'
    )
    Log(journal=True)("error", "x")
    assert capsys.readouterr().err == "<3>level=error event=x\n"


@pytest.mark.parametrize(
    ("environment", "watchdog_ns"),
    [
        ({}, 0),
        ({"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "1000"}, 500_000),
        ({"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "1000", "WATCHDOG_PID": str(os.getpid())}, 500_000),
        ({"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"}, 0),
        ({"WATCHDOG_USEC": "1000"}, 0),
        ({"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "soon"}, 0),
    ],
)
def test_watchdog_period(environment: dict[str, str], watchdog_ns: int) -> None:
    manager = ServiceManager(environment)
    assert manager.watchdog_ns == watchdog_ns
    manager.tell("READY=1")  # a manager that is not there is none of our business
