"""A model of who owns which bit of a port and whose a marker is, and the real daemon and drivers that follow it.

Beside ``ownership_model``, which looks at every message between processes: here each step is taken until all that
it brings about has happened, and in return the bits of a port are owned, stopped and revoked one by one, and markers
are reserved, signalled and freed. It has an end: all states are gone through, and each step from each of them.

    python tests/ownership_bits.py            # on the real objects
"""

from __future__ import annotations

import contextlib
import gc
import os
import random
import socket
import sys
import tempfile
from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple

from ownership_cell import Cell, _of_clients, cells
from ownership_fakes import CLOCK, DEVICES_TABLE, FIRST_UID, GRANTS, LEASE_S, PROCESSES, Client

from sioms.descriptors import is_readable
from sioms.protocol.messages import MAX_PACKET, ClientVerb, HandleVerb, decode, encode
from sioms.protocol.records import BINARY_WRITE

CLIENTS = 3
GUEST = CLIENTS - 1
"""The client who may write one bit, while that is granted, and stop everything."""
NODES = {"port": (0, 1), "port.bit0": (0,), "port.bit1": (1,)}
GRANTED = "port.bit1"
Action = tuple[Any, ...]


class State(NamedTuple):
    """The port and one marker.

    Attributes:
        owners: of each node, -1 for nobody.
        on, stopped: of each bit.
        granted: whether GUEST may write GRANTED.
        marker: whose it is, -1 for nobody's; and whether it is signalled.
    """

    owners: tuple[int, ...] = (-1, -1, -1)
    on: tuple[bool, ...] = (False, False)
    stopped: tuple[bool, ...] = (False, False)
    granted: bool = True
    marker: tuple[int, bool] = (-1, False)


def actions(s: State) -> Iterator[Action]:
    """Return all steps that can come next."""
    for c in range(CLIENTS):
        yield ("die", c)
        for n, node in enumerate(NODES):
            if s.owners[n] == c:
                yield ("close", c, node)
                yield ("write", c, node, True)
                yield ("write", c, node, False)
            else:
                yield ("open", c, node)
            yield ("stop", c, node)
            yield ("reset", c, node)
        yield ("reserve", c) if s.marker[0] < 0 else ("signal", c)
        if s.marker[0] >= 0:
            yield ("free", c)
    yield from (("regrant",), ("kill",), ("crash",))


def may_write(s: State, c: int, node: str) -> bool:
    """Tell whether a client may open a node for writing, and reset it."""
    return c != GUEST or (s.granted and node == GRANTED)


def follow(s: State, action: Action) -> tuple[State, str]:
    """Return the state after a step and all that it brings about, and what was answered."""
    name, *rest = action
    match name:
        case "die":
            return _gone(s, rest[0]), ""
        case "regrant":
            after = s._replace(granted=not s.granted)
            mine = after.owners[list(NODES).index(GRANTED)] == GUEST
            return (_free(after, list(NODES).index(GRANTED)) if s.granted and mine else after), ""
        case "kill":  # the driver, which starts again
            return s._replace(owners=(-1,) * len(NODES), on=(False, False)), ""
        case "crash":  # the daemon, and with it its drivers, which start again by a configuration that grants
            return State(stopped=s.stopped), ""
        case "reserve":
            return s._replace(marker=(rest[0], False)), "done"
        case "signal":
            return s._replace(marker=(s.marker[0], True)), "done"
        case "free":
            return s._replace(marker=(-1, False)), "done"
    c, node = rest[:2]
    number, bits = list(NODES).index(node), NODES[node]
    match name:
        case "open":
            taken = any(o >= 0 and set(NODES[n]) & set(bits) for o, n in zip(s.owners, NODES, strict=True))
            if taken or not may_write(s, c, node):
                return s, "refused"
            return s._replace(owners=_with(s.owners, [number], c)), "done"
        case "close":
            return _free(s, number), "done"
        case "write":
            if rest[2] and any(s.stopped[b] for b in bits):
                return s, "refused"  # 0 is what is safe: that it takes
            return s._replace(on=_with(s.on, bits, rest[2])), "done"
        case "stop":
            return s._replace(stopped=_with(s.stopped, bits, True), on=_with(s.on, bits, False)), "done"
        case "reset":
            if not may_write(s, c, node):
                return s, "refused"
            return s._replace(stopped=_with(s.stopped, bits, False)), "done"
    raise ValueError(name)


def _with(of: tuple[Any, ...], which: Any, value: Any) -> tuple[Any, ...]:
    return tuple(value if i in which else each for i, each in enumerate(of))


def _free(s: State, number: int) -> State:
    """Take a node from its owner: its outputs become safe."""
    bits = list(NODES.values())[number]
    return s._replace(owners=_with(s.owners, [number], -1), on=_with(s.on, bits, False))


def _gone(s: State, c: int) -> State:
    for number, owner in enumerate(s.owners):
        if owner == c:
            s = _free(s, number)
    return s._replace(marker=(-1, False)) if s.marker[0] == c else s


# --- the real objects ------------------------------------------------------------------------------------

GUESTS = f'[[grant]]\nusers = ["client2"]\nrights = ["read", "write"]\nnodes = ["{GRANTED}"]\n'


class BitCell(Cell):
    """A workcell of real objects whose clients open bits."""

    def __init__(self, folder: str) -> None:
        super().__init__(folder)
        self.handles: dict[str, tuple[Client, int, Any]] = {}
        self.token = 0
        self.boot()
        self.settle()
        for c in range(CLIENTS):
            self.connect(c)

    def _configure(self) -> None:
        guests = GUESTS if self.guest else ""
        self.config.write_text(GRANTS.format("") + guests + DEVICES_TABLE.format(0, 0))

    def settle(self) -> None:
        """Let all happen that happens by itself."""
        for _ in range(3):
            for session in list(self._server.clients.sessions):
                while session in self._server.clients.sessions and _is_readable(session.sock):
                    self._watched[session.sock.fileno()]()
            for process in list(PROCESSES.values()):
                runtime = process.runtime
                process.turn()
                for handle in list(runtime.clients.handles.values()):
                    if _is_readable(handle.sock):
                        {**runtime._callbacks, **_of_clients(runtime.turns)}[handle.sock.fileno()]()
                process.tick()
            for d in range(2):
                self.listen(d)
            self._server.cell.shared.latch.daemon_alive(CLOCK())

    def ask(self, c: int, verb: ClientVerb, *arguments: object) -> tuple[bool, Any, list[int]]:
        """Ask the daemon; return whether it was done, the answer, and descriptors."""
        client = self.clients[c]
        number = client.ask(verb, *arguments)
        self._serve_session(c)
        self.settle()
        assert client.sock is not None
        while True:
            packet, fds, _, _ = socket.recv_fds(client.sock, MAX_PACKET, 8)
            message: list[Any] = decode(packet)
            if message[1] == number:
                return not message[2], message[3], fds

    def step(self, action: Action) -> str:
        """Take a step; return what was answered."""
        CLOCK.now_ns += 1_000
        self._server.cell.shared.latch.daemon_alive(CLOCK())
        answer = getattr(self, "do_" + action[0])(*action[1:])
        self.settle()
        self._server.cell.loop._timers.clear()
        return "" if answer is None else "done" if answer else "refused"

    def do_die(self, c: int) -> None:
        client = self.clients[c]
        for name in [n for n, (owner, *_) in self.handles.items() if owner is client]:
            self.handles.pop(name)[2].close()
        client.end()
        self.settle()
        self.clients[c] = Client(c)
        self.clients[c].pid = client.pid + CLIENTS
        self.connect(c)

    def do_kill(self) -> None:
        self.kill(1)
        self.bury(1, "process")
        self.start(1)
        self._forget_handles()

    def do_crash(self) -> None:
        self.crash()
        for d in range(2):
            self.hear(d)
            self.leave(d)
        self._forget_handles()
        self.boot()
        self.settle()
        for c in range(CLIENTS):
            self.connect(c)

    def _forget_handles(self) -> None:
        for _, _, sock in self.handles.values():
            sock.close()
        self.handles.clear()
        if len(os.listdir("/proc/self/fd")) > 500:
            gc.collect()  # mappings of processes that are no more, each with a descriptor, in rings of objects

    def do_regrant(self) -> None:
        self.guest = not self.guest
        self._configure()
        self._load()

    def do_open(self, c: int, node: str) -> bool:
        done, value, fds = self.ask(c, ClientVerb.OPEN, node, 3, 0.0, LEASE_S)
        if done:
            self.handles[node] = (self.clients[c], value[0], socket.socket(fileno=fds.pop()))
        for fd in fds:
            os.close(fd)
        return done

    def do_close(self, c: int, node: str) -> bool:
        _, number, sock = self.handles.pop(node)
        done, _, _ = self.ask(c, ClientVerb.CLOSE, number)
        sock.close()
        return done

    def do_write(self, c: int, node: str, on: bool) -> bool:
        client, _, sock = self.handles[node]
        client.last += 1
        data = (1 << len(NODES[node])) - 1
        record = BINARY_WRITE.pack(0, 0, data if on else 0, 0)
        sock.send(encode(HandleVerb.WRITE, client.last, 0, 0.0, record))
        self.settle()
        while True:
            message: list[Any] = decode(sock.recv(MAX_PACKET))
            if message[1] == client.last:
                return not message[2]

    def do_stop(self, c: int, node: str) -> bool:
        return self.ask(c, ClientVerb.EMERGENCY_STOP, node, "", False, 0)[0]

    def do_reset(self, c: int, node: str) -> bool:
        return self.ask(c, ClientVerb.RESET, node)[0]

    def do_reserve(self, c: int) -> bool:
        done, value, _ = self.ask(c, ClientVerb.RESERVE_MARKER, 1, False)
        (self.token,) = value
        return done

    def do_signal(self, c: int) -> bool:
        return self.ask(c, ClientVerb.SIGNAL_MARKER, self.token)[0]

    def do_free(self, c: int) -> bool:
        return self.ask(c, ClientVerb.FREE_MARKER, self.token)[0]

    def state(self) -> State:
        """Return the state that it is in."""
        server, runtime = self._server, self._process(1).runtime
        owners = dict.fromkeys(NODES, -1)
        for handle in server.requests.nodes._handles.values():
            owners[handle.node.name] = (handle.session.peer.pid - FIRST_UID) % CLIENTS
        assert len(runtime.clients.handles) == sum(owner >= 0 for owner in owners.values()), "drivers know the same"
        wanted = int(runtime.driver._wanted)  # type: ignore[attr-defined]
        latched = {bit for _, _, bit in runtime.stops.latched_outputs}
        reservations = server.requests.markers._owners
        whose = [s for s in server.clients.sessions if reservations.owned_by(s)]
        assert len(whose) == sum(owner is not None for owner in reservations.owners()) <= 1
        marker = (-1, False)
        if whose:
            signalled = reservations.is_signalled(reservations.find(self.token, "look at"))
            marker = ((whose[0].peer.pid - FIRST_UID) % CLIENTS, signalled)
        return State(
            tuple(owners.values()), (bool(wanted & 1), bool(wanted & 2)), (0 in latched, 1 in latched), self.guest,
            marker,
        )  # fmt: skip


def _is_readable(sock: socket.socket) -> bool:
    return is_readable(sock)


# --- going through all -------------------------------------------------------------------------------------

Graph = dict[State, list[tuple[Action, State, str]]]


def explore() -> Graph:
    """Return all states that can be reached, with the steps that leave them.

    Raises:
        AssertionError: an output has two owners, or one that is stopped or that nobody owns is on.
    """
    graph: Graph = {}
    queue = [State()]
    while queue:
        state = queue.pop()
        if state in graph:
            continue
        check(state)
        graph[state] = [(action, *follow(state, action)) for action in actions(state)]
        queue += [after for _, after, _ in graph[state] if after not in graph]
    return graph


def check(s: State) -> None:
    """See that the promises hold in a state."""
    for bit in (0, 1):
        owners = [o for o, bits in zip(s.owners, NODES.values(), strict=True) if o >= 0 and bit in bits]
        assert len(owners) <= 1, "a bit has one owner"
        assert not s.on[bit] or (owners and not s.stopped[bit]), "what nobody owns, or what is stopped, is off"
    assert s.owners[0] != GUEST and s.owners[1] != GUEST, "rights go down to the bit"
    assert s.granted or GUEST not in s.owners, "a right that is taken ends what it gave"


class Tour:
    """A walk through a graph on the real objects that takes each step once, as far as it is let."""

    def __init__(self, cell: BitCell, graph: Graph, seed: int) -> None:
        self.cell, self.graph, self.chance = cell, graph, random.Random(seed)
        self.left = {state: [*range(len(steps))] for state, steps in graph.items()}
        for steps in self.left.values():
            self.chance.shuffle(steps)
        self.at, self.taken, self.steps = State(), 0, list[Action]()

    def go(self, most: int) -> int:
        """Take steps, at most so many; return how many were left untaken."""
        while self.taken < most and (route := self._route()):
            for index in route:
                self._take(index)
        return sum(map(len, self.left.values()))

    def _take(self, index: int) -> None:
        action, after, answer = self.graph[self.at][index]
        self.steps.append(action)
        try:
            told = self.cell.step(action)
            assert told == answer, f"answered {told!r}; want {answer!r}"
            seen = self.cell.state()
            assert seen == after, f"{seen}; want {after}"
        except Exception as error:
            raise AssertionError(f"{error!r}, at the end of {self.steps[-25:]}") from error
        if index in self.left[self.at]:
            self.left[self.at].remove(index)
        self.at, self.taken = after, self.taken + 1

    def _route(self) -> list[int]:
        """Return the shortest way to, and along, a step that has not been taken; none when there is none."""
        came: dict[State, tuple[State, int] | None] = {self.at: None}
        queue = deque([self.at])
        while queue:
            state = queue.popleft()
            if self.left[state]:
                route = [self.left[state][-1]]
                while (before := came[state]) is not None:
                    route.append(before[1])
                    state = before[0]
                return route[::-1]
            for index, (_, after, _) in enumerate(self.graph[state]):
                if after not in came:
                    came[after] = (state, index)
                    queue.append(after)
        return []


@contextlib.contextmanager
def bit_cell() -> Iterator[BitCell]:
    """Give a workcell of real objects with its clients."""
    with cells(), tempfile.TemporaryDirectory() as folder:
        cell = BitCell(folder)
        try:
            yield cell
        finally:
            cell._forget_handles()
            cell.end()


def main() -> int:
    """Take each step of all states on the real objects."""
    graph = explore()
    steps = sum(map(len, graph.values()))
    print(f"model: {len(graph)} states, {steps} steps between them", flush=True)
    with bit_cell() as cell:
        tour = Tour(cell, graph, 1)
        left = tour.go(1 << 60)
    print(f"real: {steps - left} of them taken, in {tour.taken}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
