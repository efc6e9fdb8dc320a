"""Any sequence of opens, closes, deaths and markers keeps one owner, and no marker satisfies the wrong waiter."""

from __future__ import annotations

import errno
from typing import Any

import hypothesis.strategies as st
from hypothesis import settings
from hypothesis.stateful import Bundle, RuleBasedStateMachine, consumes, invariant, precondition, rule

from sioms.daemon.claims import Claims
from sioms.daemon.config import NodeTable
from sioms.daemon.marker_owners import MarkerError, MarkerOwners
from sioms.daemon.names import BlockInfo, DeviceInfo, NameTable, Node
from sioms.daemon.restarts import LIMIT, WINDOW_NS, Restarts
from sioms.motion import CommandError
from sioms.protocol.flags import NodeClass
from sioms.protocol.markers import MARKERS, TABLE_SIZE, MarkerTable, split_token
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.markers import Markers

AXES = BlockInfo("", NodeClass.AXIS, tuple(ChannelInfo(n) for n in "xyz"), True, 64, 16)
PORT = BlockInfo("io", NodeClass.BINARY, tuple(ChannelInfo(n, width=3) for n in "ab"), True, 64, 0)
NAMES = NameTable(
    {"d": DeviceInfo("d", "sim", (AXES, PORT), 1e3, (), 0.1)},
    {
        "xz": NodeTable("d", ["x", "z"]),
        "zy": NodeTable("d", ["z", "y"]),
        "grip": NodeTable("d.io.a.bit1"),
        "b": NodeTable("d.io", ["b"]),
    },
)
NODES = sorted(NAMES.nodes)
OUTPUTS = [n for n in NODES if not NAMES.nodes[n].read_only]


def pieces(node: Node) -> set[tuple[int, int, int]]:
    """Return what a node can command, bit by bit: an independent account of what it owns."""
    if node.read_only:
        return set()
    block = NAMES.block(node)
    widths = {c: range(block.channels[c].width or 1) for c in node.channels}
    return {(node.block, c, b) for c in node.channels for b in (widths[c] if node.bit < 0 else (node.bit,))}


class Ownership(RuleBasedStateMachine):
    """Opens and closes as the daemon does them, against the sets of single bits."""

    held = Bundle("held")

    def __init__(self) -> None:
        super().__init__()
        self.claims: Claims[int] = Claims()
        self.owned: dict[int, str] = {}
        self.next = 0

    @rule(target=held, name=st.sampled_from(NODES))
    def open(self, name: str) -> int:
        node = NAMES.nodes[name]
        wanted = pieces(node)
        in_the_way = {i for i, other in self.owned.items() if pieces(NAMES.nodes[other]) & wanted}
        holder = self.claims.holder(node)
        assert (holder is None) == (not in_the_way)
        assert holder is None or holder in in_the_way
        self.next += 1
        if holder is None:
            self.claims.take(node.claims(), self.next)
            self.owned[self.next] = name
        return self.next

    @rule(handle=consumes(held))
    def close(self, handle: int) -> None:
        name = self.owned.pop(handle, None)
        if name is not None:
            self.claims.release(NAMES.nodes[name].claims())

    @invariant()
    def everything_owned_has_one_owner(self) -> None:
        seen: set[tuple[int, int, int]] = set()
        for name in self.owned.values():
            mine = pieces(NAMES.nodes[name])
            assert not mine & seen
            seen |= mine
        for name in OUTPUTS:
            assert (self.claims.holder(NAMES.nodes[name]) is None) == (not pieces(NAMES.nodes[name]) & seen)

    @invariant()
    def nothing_is_left_when_all_is_closed(self) -> None:
        assert self.owned or len(self.claims) == 0


class MarkerLife(RuleBasedStateMachine):
    """Reserve, free, signal and wait by the daemon and by drivers that heard of it late."""

    tokens = Bundle("tokens")
    waits = Bundle("waits")

    def __init__(self) -> None:
        super().__init__()
        self.table = MarkerTable(memoryview(bytearray(TABLE_SIZE)))
        self.owners = MarkerOwners(self.table)
        for _ in range(MARKERS - 1 - 3):  # three are left, so that numbers come back soon
            self.owners.reserve("taken")
        self.told: list[int] = []
        self.driver = Markers(self.table, self.told.append)
        self.live: dict[int, bool] = {}
        self.ended: set[int] = set()

    @rule(target=tokens, session=st.integers(0, 2))
    def reserve(self, session: int) -> int:
        try:
            token = self.owners.reserve(session)
        except MarkerError as error:
            assert error.errno == errno.EBUSY and len(self.live) == 3
            return 0
        assert token not in self.live and token not in self.ended
        self.live[token] = False
        return token

    @rule(token=tokens)
    def free(self, token: int) -> None:
        try:
            reservation = self.owners.entitled(token, "free")
        except MarkerError:
            assert token not in self.live
            return
        assert token in self.live
        self.owners.free(reservation)
        self._gone(token)

    @rule(session=st.integers(0, 2))
    def end_session(self, session: int) -> None:
        for reservation in self.owners.owned_by(session):
            token = reservation.key << 10 | reservation.number
            assert token in self.live
            self.owners.free(reservation)
            self._gone(token)

    def _gone(self, token: int) -> None:
        del self.live[token]
        self.ended.add(token)

    @rule(token=tokens)
    def signal(self, token: int) -> None:
        try:
            self.owners.signal(self.owners.entitled(token, "signal"), 1)
        except MarkerError:
            assert token not in self.live
            return
        self.live[token] = True

    @rule(target=waits, token=tokens, bare=st.booleans())
    def wait(self, token: int, bare: bool) -> tuple[int, int, int]:
        number = split_token(token)[0]
        asked = number if bare else token
        try:
            captured = self.driver.capture(asked, signal=False)
        except CommandError:
            assert token not in self.live
            return (0, 0, 0)
        mine = next(t for t in self.live if split_token(t)[0] == number)
        assert bare or mine == token
        return (mine, *captured)

    @rule(wait=waits)
    def look(self, wait: tuple[int, int, int]) -> None:
        token, number, generation = wait
        if not token:
            return
        state = self.driver.state(number, generation)
        assert state is self.live.get(token)

    @rule(wait=waits)
    def signal_late(self, wait: tuple[int, int, int]) -> None:
        """A driver that captured the marker long ago signals it now."""
        token, number, generation = wait
        if not token:
            return
        before = len(self.told)
        self.driver.signal(number, generation, 2)
        first = self.live.get(token) is False
        assert (len(self.told) > before) == first, "told once, and only for a marker that is there"
        if token in self.live:
            self.live[token] = True

    @precondition(lambda self: self.live)
    @invariant()
    def table_and_owners_agree(self) -> None:
        for token, signalled in self.live.items():
            reservation = self.owners.find(token, "look at")
            assert self.owners.is_signalled(reservation) == signalled
            assert self.driver.capture(token, signal=True)[0] == reservation.number

    @invariant()
    def what_has_ended_opens_nothing(self) -> None:
        for token in self.ended:
            for call in (self._entitled, self._capture):
                assert call(token) in (errno.EINVAL, errno.EPERM)

    def _entitled(self, token: int) -> int | None:
        try:
            self.owners.entitled(token, "free")
        except MarkerError as error:
            return error.errno
        return None

    def _capture(self, token: int) -> int | None:
        try:
            self.driver.capture(token, signal=True)
        except CommandError as error:
            return error.errno
        return None


class Deaths(RuleBasedStateMachine):
    """A driver that dies at any times."""

    def __init__(self) -> None:
        super().__init__()
        self.restarts = Restarts()
        self.now = 10**12
        self.deaths: list[int] = []

    @rule(step_ns=st.integers(0, WINDOW_NS))
    def die(self, step_ns: int) -> None:
        self.now += step_ns
        self.deaths.append(self.now)
        again: Any = self.restarts.died(self.now)
        recent = sum(self.now - t < WINDOW_NS for t in self.deaths)
        assert (again is None) == (recent >= LIMIT)
        assert again is None or self.now <= again <= self.now + 5 * 10**9
        if again is not None:
            self.now = again


for machine in (Ownership, MarkerLife, Deaths):
    machine.TestCase.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
TestOwnership = Ownership.TestCase
TestMarkerLife = MarkerLife.TestCase
TestDeaths = Deaths.TestCase
