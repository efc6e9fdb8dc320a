"""Every verb with every right, bit by bit: granted, refused, and taken away by a reload."""

from __future__ import annotations

import errno
import fnmatch
import os
import socket
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from sioms.daemon import clients as clients_module
from sioms.daemon.alarm_keeper import AlarmKeeper
from sioms.daemon.cell import Cell
from sioms.daemon.clients import Clients
from sioms.daemon.config import GrantTable, NodeTable, QuotaTable, WorkcellTable
from sioms.daemon.devices import State
from sioms.daemon.journals import OwnJournal
from sioms.daemon.log import Log
from sioms.daemon.loop import Loop
from sioms.daemon.names import BlockInfo, DeviceInfo, NameTable
from sioms.daemon.requests import Requests
from sioms.daemon.rights import RIGHTS, Peer, Rights
from sioms.daemon.sessions import Session
from sioms.daemon.users import Users
from sioms.protocol.driver_verbs import Detach
from sioms.protocol.flags import PROTOCOL_VERSION, Access, NodeClass, Right
from sioms.protocol.markers import TABLE_SIZE, MarkerTable
from sioms.protocol.messages import ClientVerb, decode
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.protocol.verbs import FROM_CLIENT, Message

PORT = BlockInfo("", NodeClass.BINARY, (ChannelInfo("do", width=2),), True, 64, 0)
INFOS = {"io0": DeviceInfo("io0", "sim-io", (PORT,), 100.0, (), 0.1)}
BITS = {"grip": NodeTable("io0.bit0")}


class Device:
    """A driver process that takes messages while ``takes``."""

    def __init__(self) -> None:
        self.name, self.state, self.generation, self.pid, self.reason = "io0", State.UP, 1, os.getpid(), ""
        self.info, self.takes, self.trouble = INFOS["io0"], True, ""
        self.page_fds = [os.memfd_create("page")]
        self.restarts = SimpleNamespace(deaths_ns=[])
        self.link, self.started_ns = (SimpleNamespace(name="GOOD"), ""), 0
        self.orders: list[Message] = []
        self.failed_ns = self.reset_ns = 0

    @property
    def is_there(self) -> bool:
        return True

    def send(self, message: Message, fds: Any = ()) -> None:
        if not self.takes:
            raise OSError(errno.EIO, "takes no messages")
        self.orders.append(message)

    def tell_use(self, used: bool) -> None:
        """Nothing: no device reads another here."""

    def hear(self) -> None:
        """Nothing: its driver tells nothing here."""

    def failed_since(self, instant_ns: int, *_: object) -> str:
        return "io0 has failed" if self.failed_ns > instant_ns else ""

    def reset(self, sent_ns: int) -> None:
        self.reset_ns = sent_ns

    def ended(self) -> list[Detach]:
        return [order for order in self.orders if isinstance(order, Detach)]


class InOrder(dict[Session, None]):
    """Sessions in an order that is known."""

    def __init__(self, sessions: Iterator[Session]) -> None:
        super().__init__(dict.fromkeys(sessions))

    def discard(self, session: Session) -> None:
        self.pop(session, None)


class Workcell:
    """A daemon's clients around one device, without processes. Eva and Tom are users with sessions."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.peers = {"eva": Peer(1, 1001, "eva", frozenset()), "tom": Peer(2, 1002, "tom", frozenset())}
        self.device = Device()
        self.loop = Loop()
        self.loads: list[tuple[Callable[..., None], Callable[[], bool]]] = []
        self.done: list[str] = []
        latch = SimpleNamespace(stopped_ns=0, source="")
        record = SimpleNamespace(look=lambda: None, shown=lambda _: None, state=SimpleNamespace(nodes=list))
        shared: Any = SimpleNamespace(
            markers=MarkerTable(memoryview(bytearray(TABLE_SIZE))), latch=latch, record=record,
            files=SimpleNamespace(client_fds=[]), journal=OwnJournal(),
        )  # fmt: skip
        self.cell = Cell(self.loop, Log(level="error"), shared)
        self.cell.names, self.cell.devices = NameTable(INFOS, BITS), {"io0": self.device}  # type: ignore[dict-item]
        stops: Any = SimpleNamespace(
            hear_request=str,
            stop_for=lambda pid, word, source, by: self.done.append("stop"),
            stop_workcell=lambda source, by=0: self.done.append("stop"),
            reset_workcell=lambda who, sent_ns, by: self.done.append("reset"),
            stop_node=lambda node, source, by: self.done.append(f"stop {node.name}"),
            stopped_since=lambda *_: False,
            reset_node=lambda node, who, sent_ns, by: self.done.append(f"reset {node.name}"),
        )
        self.alarms = AlarmKeeper(self.cell, stops, "/nowhere/alarms")
        self.clients = Clients(self.cell)
        self.requests = Requests(
            self.cell, self.clients, stops, self.alarms, lambda done, begin: self.loads.append((done, begin)), str
        )
        self.sessions: dict[str, Session] = {}
        self.ends: dict[str, socket.socket] = {}
        self._number = 0
        whose = {}
        for name, peer in self.peers.items():
            ours, self.ends[name] = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            self.sessions[name] = Session(ours, peer, -1)
            self.clients.sessions.add(self.sessions[name])
            self.loop.watch(ours.fileno(), lambda: None)
            self.ends[name].setblocking(False)
            whose[ours] = name

        def peer_of(sock: socket.socket, _users: Users) -> Peer:
            assert sock.fileno() >= 0, "of an open socket"
            return self.peers[whose[sock]]

        monkeypatch.setattr(clients_module, "peer_of", peer_of)

    def grant(self, *grants: tuple[list[str], str, str]) -> None:
        """Let grants (rights, user, pattern) hold, as a reload does."""
        users = Users()
        users.uid = {"eva": 1001, "tom": 1002}.get  # type: ignore[method-assign, assignment]
        tables = [GrantTable(list(rights), [user], [], [nodes]) for rights, user, nodes in grants]  # type: ignore[arg-type]
        tables.append(GrantTable(["read"], ["somebody else"]))
        self.requests.take_up_rights(Rights(tables, 0, users))
        self.requests.nodes.retry_opens()

    def ask(self, who: str, verb: ClientVerb, *arguments: object) -> int | None:
        """Ask for something; return the errno of the answer, None when there is none yet."""
        self._number += 1
        self.requests._dispatch(self.sessions[who], self._number, FROM_CLIENT[int(verb)].of([*arguments]))
        return self.answer(who)

    def answer(self, who: str) -> int | None:
        try:
            packet, fds, _, _ = socket.recv_fds(self.ends[who], 65536, 8)
        except BlockingIOError:
            return None
        for fd in fds:
            os.close(fd)
        self.value: Any
        _, _, errno_, self.value, *_ = decode(packet)
        return int(errno_)

    def open(self, who: str, node: str, timeout_s: float | None = 0.0) -> int | None:
        mode = Access.READ if node.endswith("readonly") else Access.READ | Access.WRITE
        return self.ask(who, ClientVerb.OPEN, node, int(mode), timeout_s, 0.0)

    def detached(self, number: int) -> None:
        self.requests.nodes.detached(self.device, number)  # type: ignore[arg-type]

    def close(self) -> None:
        for session in self.sessions.values():
            if session.leash is not None:
                session.leash.cut()
        for each in (*self.ends.values(), *(s.sock for s in self.sessions.values())):
            each.close()
        self.requests.close()
        os.close(self.device.page_fds[0])
        os.close(self.cell.shared.journal.fd)
        self.loop.close()


@pytest.fixture
def cell(monkeypatch: pytest.MonkeyPatch) -> Iterator[Workcell]:
    made = Workcell(monkeypatch)
    yield made
    made.close()


EITHER, ANY = Right.WRITE | Right.ADMINISTER, Right.ALL
ON_NODES: dict[str, tuple[Callable[[Workcell, str], int | None], list[Right]]] = {
    "open": (lambda c, node: c.open("eva", node), [Right.READ, Right.WRITE]),
    "observe": (lambda c, node: c.open("eva", f"{node}.readonly"), [Right.READ]),
    "info": (lambda c, node: c.ask("eva", ClientVerb.INFO, node), [Right.READ]),
    "stop": (lambda c, node: c.ask("eva", ClientVerb.EMERGENCY_STOP, node, "", False, 0), [Right.STOP]),
    "reset": (lambda c, node: c.ask("eva", ClientVerb.RESET, node), [EITHER]),
    "acknowledge": (lambda c, node: c.ask("eva", ClientVerb.ACKNOWLEDGE, node, ""), [EITHER]),
    "tell": (lambda c, node: c.ask("eva", ClientVerb.TELL_ALARM, node, "drift", 1, "worn"), [EITHER]),
}
"""What is asked for on a node, and the rights that it takes: one of each entry."""
ON_ALL: dict[str, tuple[Callable[[Workcell], int | None], Right]] = {
    "stop": (lambda c: c.ask("eva", ClientVerb.EMERGENCY_STOP, "", "", False, 0), Right.STOP),
    "reset": (lambda c: c.ask("eva", ClientVerb.RESET, ""), EITHER),
    "supervise": (lambda c: c.ask("eva", ClientVerb.SUPERVISE, 0.5), Right.STOP),
    "reload": (lambda c: c.ask("eva", ClientVerb.RELOAD), Right.ADMINISTER),
    "journal": (lambda c: c.ask("eva", ClientVerb.JOURNAL, ""), Right.ADMINISTER),
}
ON_NOTHING: dict[ClientVerb, tuple[list[object], int]] = {
    ClientVerb.RESERVE_MARKER: ([1, False], 0),
    ClientVerb.WAIT_MARKER: ([5, 0.0], errno.EINVAL),
    ClientVerb.SIGNAL_MARKER: ([5], errno.EINVAL),
    ClientVerb.REPORT: (["info", "all is well"], 0),
}
"""What belongs to no node, and the answer to somebody with any right."""
FREE: dict[ClientVerb, tuple[list[object], int]] = {
    ClientVerb.HELLO: ([PROTOCOL_VERSION, "test"], 0),
    ClientVerb.LIST: ([], 0),
    ClientVerb.STATUS: ([], 0),
    ClientVerb.ALARMS: ([], 0),
    ClientVerb.CANCEL: ([77], 0),
    ClientVerb.CLOSE: ([77], errno.EBADF),
    ClientVerb.FREE_MARKER: ([5], errno.EINVAL),
    ClientVerb.REPRESENT: (["kate", "lab2", []], errno.EPERM),
}
"""What needs no right: to look whether there is a workcell, and to give back."""
SUBSETS = [[name for i, name in enumerate(RIGHTS) if bits >> i & 1] for bits in range(16)]


def test_no_verb_is_left_out() -> None:
    on_nodes = {
        ClientVerb.OPEN,
        ClientVerb.INFO,
        ClientVerb.EMERGENCY_STOP,
        ClientVerb.SUPERVISE,
        ClientVerb.RESET,
        ClientVerb.ACKNOWLEDGE,
        ClientVerb.TELL_ALARM,
        ClientVerb.RELOAD,
        ClientVerb.JOURNAL,
    }
    assert on_nodes | {*ON_NOTHING} | {*FREE} | {ClientVerb.SAID} == {*ClientVerb}  # that is a gateway's alone


@pytest.mark.parametrize("rights", SUBSETS, ids="+".join)
@pytest.mark.parametrize("pattern", ["io0.bit0*", "io0", "grip*", "*"])
def test_a_verb_on_a_node_takes_its_right_on_that_node(cell: Workcell, rights: list[str], pattern: str) -> None:
    granted = Right(sum(RIGHTS[name] for name in rights))
    cell.grant((rights, "eva", pattern))
    for name, (ask, needs) in ON_NODES.items():
        for node in ("io0", "io0.bit0", "io0.bit1", "grip"):
            shown = f"{node}.readonly" if name == "observe" else node
            may = fnmatch.fnmatchcase(shown, pattern) and all(granted & need for need in needs)
            answer = ask(cell, node)
            assert (answer == 0) is may, (name, node, answer, cell.value)
            assert may or answer in (errno.EPERM, errno.EACCES), (name, node, answer)
            for number in list(cell.sessions["eva"].handles):
                cell.detached(number)


def test_a_stop_by_a_wrong_name_stops_all_for_who_may_and_asks_for_it(cell: Workcell) -> None:
    for rights, or_all, wanted in ((["stop"], True, ["stop"]), (["stop"], False, []), (["read"], True, [])):
        cell.grant((rights, "eva", "io0"))
        cell.done.clear()
        assert cell.ask("eva", ClientVerb.EMERGENCY_STOP, "io9", "it burns", or_all, 0) == errno.ENOENT
        assert cell.done == wanted
        assert cell.value.endswith("; the whole workcell has been stopped instead") is bool(wanted), cell.value


def test_a_reset_leaves_a_device_that_has_failed_after_it_was_sent(cell: Workcell) -> None:
    cell.grant((["write"], "eva", "*"))
    cell.device.state, cell.device.failed_ns = State.FAULT, 5
    assert cell.ask("eva", ClientVerb.RESET, "io0") == errno.EAGAIN and not cell.device.reset_ns
    assert "io0 has failed after this was sent" in cell.value
    cell.sessions["eva"].timestamp_ns = time.time_ns()
    assert cell.ask("eva", ClientVerb.RESET, "io0") == 0 and cell.device.reset_ns > 5


@pytest.mark.parametrize("rights", SUBSETS, ids="+".join)
@pytest.mark.parametrize("pattern", ["io0.bit0", "*"])
def test_a_verb_on_the_workcell_takes_its_right_on_every_node(cell: Workcell, rights: list[str], pattern: str) -> None:
    granted = Right(sum(RIGHTS[name] for name in rights))
    cell.grant((rights, "eva", pattern))
    for name, (ask, need) in ON_ALL.items():
        may = bool(granted & need) and (pattern == "*" or name in ("stop", "supervise"))
        assert ask(cell) == ((None if name == "reload" else 0) if may else errno.EPERM), name
    for verb, (arguments, answer) in ON_NOTHING.items():
        assert cell.ask("eva", verb, *arguments) == (answer if granted else errno.EPERM), verb
    for verb, (arguments, answer) in FREE.items():
        assert cell.ask("eva", verb, *arguments) == answer, verb
        if verb is ClientVerb.LIST:
            shown = [entry[0] for entry in cell.value]
            wanted = [n for n in cell.cell.names.nodes if fnmatch.fnmatchcase(n, pattern)]
            assert shown == (wanted if granted & Right.READ else [])


def test_alarms_are_seen_and_acknowledged_by_who_has_the_rights(cell: Workcell) -> None:
    cell.grant((["read"], "eva", "*"), (["write"], "eva", "io0.bit1"), (["write"], "eva", "grip"))
    for bit in (0, 1):
        cell.alarms.take(f"io0.bit{bit}", "io0", "data", 2, "it reads 1")
    cell.alarms.of_device("io0", "link", "unplugged")
    assert cell.ask("tom", ClientVerb.ALARMS) == 0 and cell.value == []
    assert cell.ask("eva", ClientVerb.ALARMS) == 0 and len(cell.value) == 3
    assert cell.ask("tom", ClientVerb.ACKNOWLEDGE, "", "") == errno.EPERM
    assert cell.ask("eva", ClientVerb.ACKNOWLEDGE, "io9", "") == errno.ENOENT
    assert cell.ask("eva", ClientVerb.ACKNOWLEDGE, "io0", "") == errno.EPERM, "it is more than the two bits"
    assert cell.ask("eva", ClientVerb.ACKNOWLEDGE, "grip", "looked at it") == 0
    assert [(a["node"], a["state"], a["note"]) for a in cell.value] == [("io0.bit0", "acknowledged", "looked at it")]
    assert "eva" in cell.value[0]["by"]
    assert cell.ask("eva", ClientVerb.ACKNOWLEDGE, "", "") == 0 and [a["node"] for a in cell.value] == ["io0.bit1"]


@pytest.mark.parametrize("taken", ["write", "stop", "administer", "read"])
@pytest.mark.parametrize("node", ["io0", "io0.bit0", "grip", "io0.readonly"])
def test_a_right_that_a_reload_takes_away_ends_the_handle(cell: Workcell, taken: str, node: str) -> None:
    cell.grant(([*RIGHTS], "eva", "*"))
    assert cell.open("eva", node) == 0
    number = cell.value[0]
    cell.grant(([*RIGHTS], "eva", "*"))
    assert not cell.device.ended(), "nothing was taken away"
    told: list[str] = []
    cell.grant(([name for name in RIGHTS if name != taken], "eva", "*"))
    cell.requests.nodes.when_ended(lambda: told.append("ended"))
    assert cell.device.ended() == [
        (number, errno.EACCES, f"{node}: the right to {taken} it was taken away; open it again")
    ]
    assert not told, "the reload is not done before that"
    cell.grant(([], "eva", "*"))
    assert len(cell.device.ended()) == 1, "it is told once"
    cell.detached(number)
    assert told == ["ended"]


def test_a_right_that_is_taken_on_one_bit_ends_what_that_bit_was_opened_by(cell: Workcell) -> None:
    cell.grant((["read", "write"], "eva", "io0.bit*"))
    assert cell.open("eva", "io0.bit0") == 0
    bit0 = cell.value[0]
    assert cell.open("eva", "io0.bit1") == 0
    cell.grant((["read", "write"], "eva", "io0.bit1*"))
    assert [arguments[0] for arguments in cell.device.ended()] == [bit0]


def test_an_end_that_the_driver_had_no_room_for_is_told_again(cell: Workcell) -> None:
    cell.grant((["read", "write"], "eva", "*"))
    assert cell.open("eva", "io0") == 0
    cell.device.takes = False
    cell.grant((["read"], "eva", "*"))
    assert not cell.device.ended()
    cell.device.takes = True
    for _ in range(100):
        cell.loop.step()
        if cell.device.ended():
            return
    raise AssertionError("the driver was not told again")


@pytest.mark.parametrize("left", [[], ["read"], ["write"], ["read", "stop", "administer"]])
def test_an_open_that_waits_is_refused_when_its_right_is_taken_away(cell: Workcell, left: list[str]) -> None:
    cell.grant((["read", "write"], "eva", "*"), (["read", "write"], "tom", "*"))
    assert cell.open("tom", "io0") == 0
    held = cell.value[0]
    assert cell.open("eva", "io0.bit0", None) is None, "it waits"
    cell.grant((left, "eva", "*"), (["read", "write"], "tom", "*"))
    assert cell.answer("eva") == errno.EACCES and "has no right to" in cell.value
    cell.detached(held)
    assert cell.answer("eva") is None
    assert not cell.sessions["eva"].handles and not cell.sessions["eva"].waits


def test_an_open_that_waits_and_may_still_is_granted(cell: Workcell) -> None:
    cell.grant((["read", "write"], "eva", "*"), (["read", "write"], "tom", "*"))
    assert cell.open("tom", "io0") == 0
    held = cell.value[0]
    assert cell.open("eva", "io0.bit0", None) is None
    cell.grant((["read", "write"], "eva", "io0.bit0"))
    assert cell.answer("eva") is None
    cell.detached(held)
    assert cell.answer("eva") == 0


def test_a_name_that_shows_something_else_ends_what_was_opened_by_it(cell: Workcell) -> None:
    cell.grant((["read", "write"], "eva", "grip*"))
    assert cell.open("eva", "grip") == 0
    number = cell.value[0]
    cell.cell.names = NameTable(INFOS, {"grip": NodeTable("io0.bit1")})
    cell.grant((["read", "write"], "eva", "grip*"))
    assert [(a[0], a[1]) for a in cell.device.ended()] == [(number, errno.EIO)]


def test_who_loses_the_last_right_loses_markers_and_waits_for_them(cell: Workcell) -> None:
    cell.grant((["read"], "eva", "*"), (["stop"], "tom", "io0.bit0"))
    assert cell.ask("tom", ClientVerb.RESERVE_MARKER, 1, False) == 0
    [theirs] = cell.value
    assert cell.ask("eva", ClientVerb.RESERVE_MARKER, 1, False) == 0
    [mine] = cell.value
    assert cell.ask("eva", ClientVerb.WAIT_MARKER, theirs, None) is None
    assert cell.ask("tom", ClientVerb.WAIT_MARKER, mine, None) is None
    cell.grant((["read"], "eva", "*"))
    assert cell.answer("tom") == errno.EPERM and "no longer has a right on any node" in cell.value
    assert cell.answer("eva") == errno.EPIPE, "the marker that it waits for went with its owner's rights"


def test_who_may_read_journals_no_more_is_told_at_once(cell: Workcell) -> None:
    cell.grant((["administer"], "eva", "*"), (["administer"], "tom", "*"))
    assert cell.ask("eva", ClientVerb.JOURNAL, "") == 0 and cell.ask("eva", ClientVerb.JOURNAL, "") == 0
    leash = cell.sessions["eva"].leash
    assert leash is not None
    mine = os.dup(leash.read_fd)
    try:
        cell.grant((["administer"], "eva", "*"))
        with pytest.raises(BlockingIOError):
            os.read(mine, 1)
        cell.grant((["administer"], "eva", "io0*"))
        assert os.read(mine, 1) == b"" and cell.sessions["eva"].leash is None
        assert cell.ask("eva", ClientVerb.JOURNAL, "") == errno.EPERM
    finally:
        os.close(mine)


def test_a_reload_that_waits_is_refused_when_the_one_before_took_the_right(cell: Workcell) -> None:
    cell.grant((["administer"], "eva", "*"))
    assert cell.ask("eva", ClientVerb.RELOAD) is None
    [(done, begin)] = cell.loads
    assert begin()
    cell.grant((["read"], "eva", "*"))
    assert not begin()
    assert cell.answer("eva") == errno.EPERM
    done([])
    assert cell.answer("eva") is None


def test_who_has_left_a_group_is_seen_at_a_reload(cell: Workcell) -> None:
    users = Users()
    users.gid = {"lab": 20}.get  # type: ignore[method-assign, assignment]
    cell.peers["eva"] = Peer(1, 1001, "eva", frozenset({20}))
    rights = Rights([GrantTable(["read", "write"], [], ["lab"])], 0, users)
    cell.requests.take_up_rights(rights)
    assert cell.open("eva", "io0") == 0
    cell.peers["eva"] = Peer(1, 1001, "eva", frozenset())
    cell.requests.take_up_rights(rights)
    assert [arguments[1] for arguments in cell.device.ended()] == [errno.EACCES]


def test_what_becomes_free_is_offered_to_who_waits_for_it_alone(
    cell: Workcell, monkeypatch: pytest.MonkeyPatch
) -> None:
    cell.grant((["read", "write"], "eva", "*"), (["read", "write"], "tom", "*"))
    assert cell.open("eva", "io0.bit0") == 0 == cell.open("eva", "io0.bit1")
    first, second = list(cell.requests.nodes._handles)
    assert [cell.open("tom", "io0.bit0", None) for _ in range(20)] == [None] * 20
    nodes, tried = cell.requests.nodes, []
    monkeypatch.setattr(nodes, "_obstacle", lambda node: tried.append(node))
    nodes.detached(cell.device, second)  # type: ignore[arg-type]
    assert not tried
    nodes.detached(cell.device, first)  # type: ignore[arg-type]
    assert len(tried) == 1 and cell.answer("tom") == 0 and cell.answer("tom") is None


def test_an_open_of_a_device_that_is_reloaded_waits_until_it_is_back(cell: Workcell) -> None:
    cell.grant((["read", "write"], "eva", "*"))
    cell.cell.devices = {}
    assert cell.open("eva", "io0.bit0") == errno.EIO, "it is no longer configured"
    cell.cell.leaving = {"io0": cell.device}  # type: ignore[dict-item]
    cell.cell.config = SimpleNamespace(devices=INFOS, workcell=WorkcellTable(), quota=QuotaTable())  # type: ignore[assignment]
    assert cell.open("eva", "io0.bit0") is None
    cell.cell.leaving, cell.cell.devices = {}, {"io0": cell.device}  # type: ignore[dict-item]
    cell.requests.nodes.retry_opens()
    assert cell.answer("eva") == 0


def test_markers_persist_for_users_with_a_right(cell: Workcell) -> None:
    def reserved() -> int:
        return len(cell.requests.markers._owners.owners())

    cell.grant((["read"], "eva", "*"), (["read"], "tom", "*"))
    assert (
        cell.ask("eva", ClientVerb.RESERVE_MARKER, 2, True) == 0 == cell.ask("tom", ClientVerb.RESERVE_MARKER, 1, True)
    )
    cell.grant((["read"], "eva", "io0"), (["read"], "tom", "*"))
    assert reserved() == 3
    cell.grant((["read"], "tom", "*"))
    assert reserved() == 1


# --- keys: on whose behalf a gateway speaks ------------------------------------------------------


@pytest.fixture
def gateway(cell: Workcell) -> Workcell:
    """The workcell, where Eva is the user of a gateway."""
    cell.cell.config = SimpleNamespace(workcell=WorkcellTable(gateway_user="eva"), quota=QuotaTable(sessions=1))  # type: ignore[assignment]
    cell.clients.users.uid = {"eva": 1001}.get  # type: ignore[method-assign, assignment]
    return cell


def _keys(*grants: tuple[list[str], list[str], list[str]]) -> Rights:
    return Rights([GrantTable(rights, [], groups, ["*"], keys) for rights, groups, keys in grants], 0, Users())  # type: ignore[arg-type]


def test_a_gateway_has_the_rights_of_the_key_that_it_speaks_for_and_no_others(gateway: Workcell) -> None:
    gateway.requests.take_up_rights(_keys((["read", "write"], [], ["kate"]), (["read"], ["guests"], [])))
    assert gateway.open("eva", "io0") == errno.EACCES
    assert gateway.ask("tom", ClientVerb.REPRESENT, "kate", "lab2", []) == errno.EPERM
    assert gateway.ask("eva", ClientVerb.REPRESENT, "kate", "lab2", []) == 0
    assert gateway.ask("eva", ClientVerb.REPRESENT, "root", "lab2", []) == errno.EPERM, "once"
    assert gateway.ask("eva", ClientVerb.HELLO, PROTOCOL_VERSION, "devout") == 0
    assert gateway.value[2] == Right.READ | Right.WRITE
    assert gateway.open("eva", "io0") == 0
    assert str(gateway.sessions["eva"]) == "kate@lab2 through sioms serve (devout)"
    assert gateway.sessions["eva"].peer.uid >= 1 << 32
    gateway.requests.take_up_rights(_keys((["read"], [], ["kate"])))
    assert [order[1] for order in gateway.device.ended()] == [errno.EACCES]


def test_groups_of_a_key_and_all_keys_are_granted_but_everybody_is_no_key(gateway: Workcell) -> None:
    assert gateway.ask("eva", ClientVerb.REPRESENT, "kate", "lab2", ["ops"]) == 0
    peer = gateway.sessions["eva"].peer
    assert _keys((["read"], ["ops"], [])).anywhere(peer) == Right.READ == _keys((["read"], [], ["*"])).anywhere(peer)
    assert not _keys((["read"], ["guests"], [])).anywhere(peer) and not _keys((["read"], [], ["tom"])).anywhere(peer)
    assert not Rights([GrantTable(["read"], ["*", "kate"])], 0, Users()).anywhere(peer)
    assert _keys().anywhere(peer) == Right.READ | Right.WRITE | Right.STOP, "as for users: no grant, no bounds"


def test_nobody_is_represented_after_hello_or_by_a_strange_name(gateway: Workcell) -> None:
    for key, groups in (("", []), ("a b", []), ("kate\n", []), ("x" * 65, []), ("kate", [1]), ("kate", ["a b"])):
        assert gateway.ask("eva", ClientVerb.REPRESENT, key, "lab2", groups) == errno.EINVAL, key
    assert gateway.ask("eva", ClientVerb.HELLO, PROTOCOL_VERSION, "test") == 0
    assert gateway.ask("eva", ClientVerb.REPRESENT, "kate", "lab2", []) == errno.EPERM


def test_a_key_has_the_quotas_of_a_user_of_its_own(gateway: Workcell) -> None:
    kates = Peer(1, gateway.clients.number_of("kate"), "kate", frozenset(), "kate", "lab1")
    gateway.sessions["tom"].peer = kates
    assert gateway.ask("eva", ClientVerb.REPRESENT, "kate", "lab2", []) == errno.EUSERS
    assert gateway.ask("eva", ClientVerb.REPRESENT, "ben", "lab2", []) == 0


def test_sessions_of_keys_end_when_their_gateway_is_none_any_more(gateway: Workcell) -> None:
    assert gateway.ask("eva", ClientVerb.REPRESENT, "kate", "lab2", []) == 0
    gateway.cell.config = SimpleNamespace(workcell=WorkcellTable(), quota=QuotaTable())  # type: ignore[assignment]
    gateway.requests.take_up_rights(_keys())
    assert gateway.sessions["eva"] not in gateway.clients.sessions


def test_a_session_that_ends_while_rights_are_taken_up_is_asked_nothing_more(gateway: Workcell) -> None:
    """Its client reads no answers, and one comes: the marker that it waits for is freed with the key's session."""
    assert gateway.ask("eva", ClientVerb.REPRESENT, "kate", "lab2", []) == 0
    assert gateway.ask("eva", ClientVerb.RESERVE_MARKER, 1, False) == 0
    (token,) = gateway.value
    assert gateway.ask("tom", ClientVerb.WAIT_MARKER, token, None) is None
    with pytest.raises(BlockingIOError):
        while True:
            gateway.sessions["tom"].sock.send(bytes(1024), socket.MSG_DONTWAIT)
    gateway.sessions["tom"].sock.setblocking(False)
    gateway.cell.config = SimpleNamespace(workcell=WorkcellTable(), quota=QuotaTable())  # type: ignore[assignment]
    gateway.clients.sessions = InOrder(gateway.sessions[name] for name in ("eva", "tom"))  # type: ignore[assignment]
    gateway.requests.take_up_rights(_keys())
    assert not gateway.clients.sessions


def test_a_client_tells_drifts_of_single_channels_and_nothing_else(cell: Workcell) -> None:
    cell.grant((["write"], "eva", "*"))

    def tell(*arguments: object) -> int | None:
        return cell.ask("eva", ClientVerb.TELL_ALARM, *arguments)

    assert tell("io0", "drift", 1, "worn") == 0
    (alarm,) = cell.alarms
    assert (alarm.node, alarm.what, alarm.severity) == ("io0", "drift", 1)
    assert alarm.text == "worn [told by pid 1 (eva)]"
    for what in ("fault", "link", "driver", "data", ""):  # what drivers and the daemon tell is theirs
        assert tell("io0", what, 1, "") == errno.EINVAL
    for severity in (-1, 3, 4, 1 << 40):
        assert tell("io0", "drift", severity, "") == errno.EINVAL
    assert tell("nowhere", "drift", 1, "") == errno.ENOENT
    assert tell("io0", "drift", 0, "") == 0 and [a.state for a in cell.alarms] == ["returned"]
