"""A workcell of real objects on one thread, which takes the steps of ``ownership_model`` and tells the state it is in.

The daemon is its server with loader, clients, verbs and record of stops; a driver is its runtime with handles, engine,
banks and pages; files, sockets, memory and pipes are the kernel's. Replaced are only the clock, who forks a process,
what the kernel says about peers and deaths, and the loops, which here serve what the schedule says.
"""

from __future__ import annotations

import contextlib
import gc
import os
import shutil
import signal
import socket
import tempfile
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from ownership_fakes import (
    CLOCK,
    DAEMON_LEASE_S,
    DEVICES_TABLE,
    DRIVERS,
    FIRST_UID,
    GRANTS,
    LEASE_S,
    NAMES,
    PROCESSES,
    Client,
    Flusher,
    ForkServer,
    Listener,
    Patience,
    Process,
    Timer,
    Users,
)
from ownership_state import (
    ABSENT,
    CLIENTS,
    CLOSING,
    DEAD,
    DEVICES,
    ENDING,
    FAULT,
    IN,
    OPEN,
    ORPHAN,
    OUT,
    PAUSING,
    STARTING,
    TOLD,
    UP,
    Action,
    State,
)

import sioms.daemon.clients
import sioms.daemon.devices
import sioms.daemon.loading
import sioms.daemon.processes
import sioms.daemon.stop_record
import sioms.daemon.suspended
import sioms.sdk.fork_server
from sioms import command
from sioms.daemon.devices import DriverProcess
from sioms.daemon.log import Log
from sioms.daemon.loop import Loop
from sioms.daemon.restarts import LIMIT
from sioms.daemon.rights import Peer
from sioms.daemon.server import Server
from sioms.daemon.stop_record import StopRecord
from sioms.motion.queue import EMERGENCY_STOP
from sioms.protocol.flags import PROTOCOL_VERSION, Request
from sioms.protocol.messages import MAX_PACKET, ClientVerb, HandleVerb, decode, encode
from sioms.protocol.records import BINARY_WRITE
from sioms.protocol.stopfile import open_stop_request
from sioms.sdk.blocks import AxisBlock
from sioms.timestamps import Timestamps
from sioms.turns import Turns


def _of_clients(turns: Turns) -> dict[int, Callable[[], object]]:
    return {fd: source.callbacks[fd] for fd, (_, source) in turns._of.items()}


def _serve(fds: dict[int, Callable[[], None]], fd: int) -> None:
    fds[fd]()


class Cell:
    """A workcell in which nothing has happened yet: no daemon, three clients.

    Args:
        folder: for its files.
    """

    def __init__(self, folder: str) -> None:
        self.folder = folder
        self.path = os.path.join(folder, "d.sock")
        self.config = Path(folder) / "cell.toml"
        Path(self.path).touch()
        self.server: Server | None = None
        self.record: StopRecord | None = None
        self.clients = [Client(n) for n in range(CLIENTS)]
        self.dead: dict[int, Client] = {}
        self.answers: dict[int, str] = {}
        self.guest = True
        self.variants = [0] * DEVICES

    # --- steps ---------------------------------------------------------------------------------------

    def take(self, action: Action) -> str:
        """Take a step; return what who acted was answered."""
        CLOCK.now_ns += 1_000
        if self.server is not None:
            self.server.cell.shared.latch.daemon_alive(CLOCK())
        answer = getattr(self, str(action[0]))(*action[1:])
        for client in self.clients:
            client.take()
        if self.server is not None:
            self.server.cell.loop._timers.clear()
        return answer or ""

    def boot(self) -> None:
        self.guest, self.variants = True, [0] * DEVICES
        self._configure()
        loop = Loop()
        self.listener = Listener()
        self.record = StopRecord(self.path + ".stops")
        listening = SimpleNamespace(sock=self.listener, path=self.path)
        self.server = Server(loop, listening, str(self.config), Log(level="error"), self.record)  # type: ignore[arg-type]
        self.latch = self.server.cell.shared.latch
        self._load()

    def _configure(self) -> None:
        guest = ', "client2"' if self.guest else ""
        self.config.write_text(GRANTS.format(guest) + DEVICES_TABLE.format(*self.variants))

    def _load(self) -> None:
        errors: list[str] = []
        assert self.server is not None
        self.server.load(errors.extend)
        assert not errors, errors

    def crash(self) -> None:
        """End the daemon as SIGKILL does."""
        server, record = self.server, self.record
        assert server is not None and record is not None
        for session in server.clients.sessions:
            session.sock.close()
            os.close(session.pidfd)
        for device in [*server.cell.devices.values(), *server.cell.leaving.values()]:
            if device._sock is not None:
                device._sock.close()
                if device._pidfd >= 0:
                    os.close(device._pidfd)
            for fd in (*device.page_fds, device.journal_fd):
                os.close(fd)
        files = server.cell.shared.files
        shared = server.cell.shared
        for fd in (shared.fds[0], shared.fds[3], *files.client_fds, record.drivers_fd):
            os.close(fd)
        os.close(shared.journal.fd)
        os.close(server.door._spare)
        shared.request.close()
        record._journal.close()
        server.cell.timestamps.close()
        server.cell.loop.close()
        self.listener.close()
        self.server = self.record = None
        for process in list(PROCESSES.values()):
            if process.life._held < 0:
                process.end()
        for client in self.clients:
            client.leave()
        self.dead.clear()

    def connect(self, c: int) -> None:
        client, server = self.clients[c], self._server
        self.dead.pop(c, None)
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        CONNECTING.append(client)
        self.listener.coming.append(theirs)
        _serve(self._watched, self.listener.fileno())
        CONNECTING.clear()
        client.sock = ours
        number = client.ask(ClientVerb.HELLO, PROTOCOL_VERSION, f"client{c}")
        self._serve_session(c)
        assert client.take()[number] == "done"
        assert server.clients.sessions

    @property
    def _server(self) -> Server:
        assert self.server is not None
        return self.server

    @property
    def _watched(self) -> dict[int, Callable[[], None]]:
        loop = self._server.cell.loop
        return {**loop._callbacks, **_of_clients(loop.turns)}

    def _session(self, c: int) -> Any:
        pid = self.clients[c].pid if c not in self.dead else self.dead[c].pid
        return next(s for s in self._server.clients.sessions if s.peer.pid == pid)

    def _serve_session(self, c: int) -> None:
        _serve(self._watched, self._session(c).sock.fileno())

    def _ask(self, c: int, verb: ClientVerb, *arguments: object, what: tuple[str, int] | None = None) -> str:
        client = self.clients[c]
        number = client.ask(verb, *arguments)
        if what is not None:
            client.waits[number] = what
        self._serve_session(c)
        return client.take().get(number, "")

    def open(self, c: int, d: int) -> str:
        return self._ask(c, ClientVerb.OPEN, NAMES[d], 3, None, LEASE_S, what=("open", d))

    def give_up(self, c: int, d: int) -> None:
        client = self.clients[c]
        number = next(n for n, what in client.waits.items() if what == ("open", d))
        self._ask(c, ClientVerb.CANCEL, number)
        assert number not in client.waits

    def close(self, c: int, d: int) -> str:
        return self._ask(c, ClientVerb.CLOSE, self.clients[c].numbers[d])

    def stop(self, c: int) -> str:
        return self._ask(c, ClientVerb.EMERGENCY_STOP, "", "", False, 0)

    def reset(self, c: int) -> str:
        return self._ask(c, ClientVerb.RESET, "")

    def stop_node(self, c: int, d: int) -> str:
        return self._order(c, d, ClientVerb.EMERGENCY_STOP, NAMES[d], "", False, 0)

    def reset_node(self, c: int, d: int) -> str:
        return self._order(c, d, ClientVerb.RESET, NAMES[d])

    def _order(self, c: int, d: int, verb: ClientVerb, *arguments: object) -> str:
        others = [p.runtime for p in PROCESSES.values() if p.device != d]
        idle = [other for other in others if other.stops._orders == other.latch.orders]
        answer = self._ask(c, verb, *arguments)
        for other in idle:  # orders to all drivers are counted together; it looks, and finds none
            other.stops.heed_orders()
        return answer

    def request_stop(self, c: int, late_ns: int = 0) -> None:
        request = open_stop_request(self.path)
        assert request is not None
        request.request(CLOCK() - late_ns, self.clients[c].pid)
        request.close()

    def suspend(self, c: int) -> None:
        SUSPENDED.add(self.clients[c].pid)
        self._server.requests.nodes.end_suspended()
        self._server.requests.nodes.end_suspended()
        SUSPENDED.clear()

    def die(self, c: int, words: int) -> None:
        client = self.clients[c]
        if client.sock is not None:
            self.dead[c] = client
            if words == 3:
                client.ask(ClientVerb.EMERGENCY_STOP, "", "", False, 0)
            elif words:
                client.ask(ClientVerb.OPEN, NAMES[words - 1], 3, None, LEASE_S)
        client.end()
        self.clients[c] = Client(c)
        self.clients[c].pid = client.pid + CLIENTS

    def move(self, c: int, d: int) -> str:
        record = BINARY_WRITE.pack(0, 0, 1, 0) if d else command(0, velocity=0.5)
        return self._ask_driver(c, d, HandleVerb.WRITE, 0, 0.0, record)

    def stop_by_handle(self, c: int, d: int) -> str:
        return self._ask_driver(c, d, HandleVerb.IOCTL, int(Request.EMERGENCY_STOP), None, None)

    def reset_by_handle(self, c: int, d: int) -> str:
        return self._ask_driver(c, d, HandleVerb.IOCTL, int(Request.RESET), None, None)

    def _ask_driver(self, c: int, d: int, verb: HandleVerb, *arguments: object) -> str:
        client, process = self.clients[c], self._process(d)
        client.last += 1
        sock = client.handles[d]
        with contextlib.suppress(BlockingIOError, ConnectionError):
            while sock.recv(MAX_PACKET):
                pass
        sock.send(encode(verb, client.last, *arguments))
        handle = next(iter(process.runtime.clients.handles.values()))
        process.runtime.clients._readable(handle)
        with contextlib.suppress(BlockingIOError, ConnectionError):
            while packet := sock.recv(MAX_PACKET):
                message: list[Any] = decode(packet)
                if message[1] == client.last:
                    return "refused" if message[2] else "done"
        return ""

    def _process(self, d: int) -> Process:
        return next(p for p in PROCESSES.values() if p.device == d and p.life._held >= 0)

    def hear(self, d: int) -> None:
        process = self._process(d)
        process.turn()
        process.runtime.stops.heed_orders()
        process.runtime.stops.heed()

    def tick(self, d: int) -> None:
        self._process(d).tick()

    def see_death(self, d: int, how: str) -> None:
        process = self._process(d)
        (handle,) = process.runtime.clients.handles.values()
        _serve(
            {**process.runtime._callbacks, **_of_clients(process.runtime.turns)},
            handle.sock.fileno() if how == "socket" else handle.pidfd,
        )

    def expire(self, c: int, d: int) -> None:
        process = self._process(d)
        CLOCK.now_ns += int(LEASE_S * 1e9)
        for other in PROCESSES.values():
            for handle in other.runtime.clients.handles.values():
                handle.heard_ns = CLOCK() if other is not process else handle.heard_ns
        if self.server is not None:
            self.server.cell.shared.latch.daemon_alive(CLOCK())
        else:
            self.latch.daemon_alive(CLOCK())
        process.tick(1)

    def lapse(self, d: int) -> None:
        process = self._process(d)
        CLOCK.now_ns += 2 * int(DAEMON_LEASE_S * 1e9)
        for other in PROCESSES.values():
            for handle in other.runtime.clients.handles.values():
                handle.heard_ns = CLOCK()
        process.tick(1)
        self._server.cell.shared.latch.daemon_alive(CLOCK())
        process.tick(1)

    def kill(self, d: int) -> None:
        self._process(d).end()

    def leave(self, d: int) -> None:
        process = self._process(d)
        for _ in range(100):
            if not process.runtime.running:
                break
            process.tick(5_000_000)
        assert not process.runtime.running
        process.end()

    def notice(self, c: int, how: str) -> None:
        session = self._session(c)
        fd = session.sock.fileno() if how == "socket" else session.pidfd
        while session in self._server.clients.sessions:  # its last words, then its end
            _serve(self._watched, fd)
        self.dead.pop(c, None)

    def listen(self, d: int) -> None:
        device = self._device(d)
        while (sock := device._sock) is not None:
            try:
                if not sock.recv(1, socket.MSG_PEEK):
                    return
            except ConnectionResetError:
                continue  # reported once, ahead of what is still there to read
            except BlockingIOError:
                return
            device._receive()

    def _device(self, d: int) -> DriverProcess:
        server = self._server
        return server.cell.devices.get(NAMES[d]) or server.cell.leaving[NAMES[d]]

    def bury(self, d: int, how: str) -> None:
        device = self._device(d)
        device.restarts.forget()  # its deaths are minutes apart
        assert device._sock is not None
        if how == "process":
            _serve(self._watched, device._pidfd)
        else:
            self.listen(d)
            device._receive()
        for pidfd in list(device._dying):
            _serve(self._watched, pidfd)

    def fail(self, d: int) -> None:
        device = self._device(d)
        device.restarts.deaths_ns[:] = [CLOCK()] * (LIMIT - 1)
        assert device._sock is not None
        _serve(self._watched, device._pidfd)
        for pidfd in list(device._dying):
            _serve(self._watched, pidfd)

    def start(self, d: int) -> None:
        timer = self._device(d)._timer
        assert timer is not None and timer.callback is not None
        timer.callback()

    def beat(self) -> None:
        self._server._alive()

    def replace(self, d: int) -> None:
        self.variants[d] += 1
        self._configure()
        self._load()

    def regrant(self) -> None:
        self.guest = not self.guest
        self._configure()
        self._load()

    # --- what state it is in ---------------------------------------------------------------------------

    def view(self, model: State) -> State:
        """Return the state it is in; of queues, and of what only the kernel knows, what the model says.

        Raises:
            AssertionError: something is left of what has gone, or two parts do not agree.
        """
        server = self.server
        if server is None:
            devices = tuple(
                expected._replace(driver=tuple(self._view_driver(d, e) for e in expected.driver))
                for d, expected in enumerate(model.devices)
            )
            return model._replace(clients=((OUT, ""),) * CLIENTS, waiting=(), devices=devices)
        self.record.look()  # type: ignore[union-attr]
        state, latch = server.cell.shared.record.state, server.cell.shared.latch
        stopped = bool(latch.stopped_ns) or self._view_request() == 2
        assert stopped == bool(state.workcell or state.requested), "latch, requests and journal agree"
        stopped_nodes = {name for name, *_ in state.nodes()}
        devices = tuple(self._view_device(d, model) for d in range(DEVICES))
        sessions = {s.peer.pid: s for s in server.clients.sessions}
        clients = []
        for c, client in enumerate(self.clients):
            if c in self.dead and self.dead[c].pid in sessions:
                clients.append((DEAD, model.clients[c][1]))
            else:
                clients.append((IN if client.pid in sessions else OUT, ""))
        assert len(sessions) == sum(at != OUT for at, _ in clients), "no session without a client"
        waiting = tuple(
            ((wait.session.peer.pid - FIRST_UID) % CLIENTS, NAMES.index(wait.what.removeprefix("open ")))
            for wait, *_ in server.requests.nodes._opens
        )
        waits = sum(len(s.waits) for s in server.clients.sessions)
        closing = sum(d.claim[1:] == (CLOSING,) for d in devices)
        assert waits == len(waiting) + closing, "nothing waits that nobody answers"
        handles = server.requests.nodes._handles
        assert len(handles) == sum(bool(d.claim) for d in devices), "no handle without an owner"
        assert len(server.requests.nodes._claims) == len(handles), "nothing is owned without a handle"
        return State(
            True,
            stopped,
            tuple(name in stopped_nodes for name in NAMES),
            self._view_request(),
            self.guest,
            tuple(clients),
            waiting,
            devices,
        )

    def _view_request(self) -> int:
        request = self._server.cell.shared.request
        mark = request.mark
        return 0 if mark == self._server.stops._request_seen else 2 if request.obeyed == mark else 1

    def _view_device(self, d: int, model: State) -> Any:
        expected, device = model.devices[d], self._device(d)
        phase = {"starting": STARTING, "up": UP, "ending": ENDING, "restarting": PAUSING, "fault": FAULT}.get(
            device.state.value, ABSENT
        )
        claim: Any = ()
        for handle in self._server.requests.nodes._handles.values():
            if handle.node.device != NAMES[d]:
                continue
            c = (handle.session.peer.pid - FIRST_UID) % CLIENTS
            gone = handle.session not in self._server.clients.sessions
            how = ORPHAN if gone else CLOSING if handle.closing else TOLD if handle.ending else OPEN
            claim = (c, how)
        drivers = tuple(self._view_driver(d, e) for e in expected.driver)
        assert bool(drivers) == device.is_there
        return expected._replace(phase=phase, claim=claim, driver=drivers)

    def _view_driver(self, d: int, expected: Any) -> Any:
        processes = [p for p in PROCESSES.values() if p.device == d]
        if not expected.alive:
            assert not processes
            return expected
        (process,) = processes
        runtime = process.runtime
        held: Any = ()
        if runtime.clients.handles:
            (handle,) = runtime.clients.handles.values()
            pid = int(handle.who.split()[1])
            alive = any(client.pid == pid for client in self.clients)
            held = ((pid - FIRST_UID) % CLIENTS, "" if alive else "dead")
        block = runtime.blocks[0]
        moves = runtime.driver.moves()  # type: ignore[attr-defined]
        if isinstance(block, AxisBlock):
            node_stop = bool(block.bank._queue.latched[0] & EMERGENCY_STOP) and not runtime.stops.stopped
        else:
            node_stop = bool(runtime.stops.latched_outputs)
        if runtime.stops.stopped:
            node_stop = expected.node_stop  # an axis under both does not tell one from the other
        return expected._replace(
            handle=held, moves=moves, node_stop=node_stop, stopped=runtime.stops.stopped,
            ending=bool(runtime._ending_ns), missed=runtime.latch.resets != runtime.stops._seen[1],
            asked=runtime.stops._request.mark not in (runtime.stops._seen[2], runtime.latch.answered_request),
        )  # fmt: skip

    def end(self) -> None:
        """End everything."""
        if self.server is not None:
            self.crash()
        for process in list(PROCESSES.values()):
            process.end()
        for client in self.clients:
            client.end()
        shutil.rmtree(self.folder)


CONNECTING: list[Client] = []
PEERS: weakref.WeakKeyDictionary[socket.socket, Peer] = weakref.WeakKeyDictionary()
SUSPENDED: set[int] = set()


def _peer_of(sock: socket.socket, users: object) -> Peer:
    if sock not in PEERS:
        client = CONNECTING[-1]
        PEERS[sock] = Peer(client.pid, FIRST_UID + client.number, f"client{client.number}", frozenset())
    return PEERS[sock]


def _pidfd_of(sock: socket.socket, pid: int) -> int:
    return os.dup(CONNECTING[-1].life.seen)


def _send_signal(pidfd: int, number: int) -> None:
    """Kill the process of a descriptor."""
    for process in list(PROCESSES.values()):
        if process.life._held >= 0 and os.path.samestat(os.fstat(pidfd), os.fstat(process.life.seen)):
            process.end()
            return
    raise ProcessLookupError


@contextlib.contextmanager
def cells() -> Iterator[Callable[[], Cell]]:
    """Give a function that makes cells, each after the last one has ended."""
    made: list[Cell] = []

    def make() -> Cell:
        if made:
            made.pop().end()
        if len(os.listdir("/proc/self/fd")) > 500:
            gc.collect()  # mappings that a ring of objects keeps, each with a descriptor of its own
        made.append(Cell(tempfile.mkdtemp(prefix="sioms-", dir="/dev/shm" if os.path.isdir("/dev/shm") else None)))
        return made[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(time, "monotonic_ns", CLOCK)
        patch.setattr(time, "sleep", lambda _: None)
        patch.setattr("sioms.sdk.ticking.TimerFd", Timer)
        patch.setattr(Timestamps, "monotonic_ns", lambda *_: CLOCK())  # a request is served as soon as it is sent
        patch.setattr(sioms.daemon.clients, "Users", Users)
        patch.setattr(sioms.daemon.clients, "peer_of", _peer_of)
        patch.setattr(sioms.daemon.clients, "pidfd_of", _pidfd_of)
        patch.setattr(sioms.daemon.loading, "ForkServer", ForkServer)
        patch.setattr(sioms.daemon.processes, "ForkServer", ForkServer)
        patch.setattr(sioms.daemon.stop_record, "_Flusher", Flusher)
        patch.setattr(sioms.daemon.devices, "Patience", Patience)
        patch.setattr(sioms.daemon.suspended, "is_stopped", SUSPENDED.__contains__)
        patch.setattr(sioms.sdk.fork_server, "find_driver", lambda name, folder: DRIVERS[name])
        patch.setattr(signal, "pidfd_send_signal", _send_signal)
        try:
            yield make
        finally:
            for cell in made:
                cell.end()
