"""The daemon's clients: sessions, opens and closes, markers, stops.

Concurrency: everything runs in the daemon's loop. A session that sends nonsense, or more than its
bounds allow, is ended with a line in the log, and nothing else.
"""

from __future__ import annotations

import errno
import itertools
import os
import socket
import time
import traceback
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from sioms.protocol.flags import PROTOCOL_VERSION, Access, Right
from sioms.protocol.messages import (
    MAX_PACKET,
    ClientVerb,
    DriverVerb,
    MalformedMessage,
    decode,
    refusal,
    reply,
)
from sioms.wording import did_you_mean

from .claims import Claims
from .config import WorkcellTable
from .devices import DriverProcess, State
from .marker_owners import MarkerError
from .marker_verbs import MarkerVerbs
from .names import READONLY, Node
from .rights import RIGHTS, Rights
from .sessions import LATER, Handle, Refused, Session, Wait, peer_of, pidfd_of
from .users import Users

if TYPE_CHECKING:
    from .server import Server

LONGEST_WAIT_S = 7 * 24 * 3600.0
_SEND_BUFFER = 1 << 18


class _Malformed(Exception):
    """A request whose arguments have no business being there; ends the session."""


class Clients:
    """All sessions of a daemon.

    Args:
        server: the daemon.
        listener: the listening SOCK_SEQPACKET socket.
    """

    def __init__(self, server: Server, listener: socket.socket) -> None:
        self.users = Users()
        self.rights = Rights([], os.getuid(), self.users)
        self.address = str(listener.getsockname())
        self._server = server
        self._listener = listener
        self._sessions: set[Session] = set()
        self._handles: dict[int, Handle] = {}
        self._claims: Claims[Handle] = Claims()
        self.markers = MarkerVerbs(server.shared.markers, self)
        self._opens: list[tuple[Wait, Callable[[], bool]]] = []
        self._numbers = itertools.count(1)
        listener.setblocking(False)

    @property
    def bounds(self) -> WorkcellTable:
        """The bounds of the configuration."""
        return self._server.config.workcell if self._server.config else WorkcellTable()

    # --- connections -----------------------------------------------------------------------------

    def welcome(self) -> None:
        """Begin to accept clients; those that came while the configuration was loading have waited."""
        self._server.loop.watch(self._listener.fileno(), self._accept)

    def _accept(self) -> None:
        try:
            sock, _ = self._listener.accept()
        except OSError as error:
            if error.errno in (errno.EMFILE, errno.ENFILE, errno.ENOMEM):
                # The listener stays readable: look away for a while instead of spinning.
                self._server.log("error", "session refused", why=error.strerror)
                self._server.loop.unwatch(self._listener.fileno())
                self._server.loop.after(0.2, self.welcome)
            return
        sock.setblocking(False)
        peer = peer_of(sock, self.users)
        if len(self._sessions) >= self.bounds.max_sessions:
            self._server.log("warning", "session refused", peer=peer, why="too many sessions")
            sock.close()
            return
        session = Session(sock, peer, pidfd_of(sock, peer.pid))
        self._sessions.add(session)
        self._server.loop.watch(sock.fileno(), lambda: self._receive(session))
        if session.pidfd >= 0:
            # A child that it forked may hold the socket open after its death.
            self._server.loop.watch(session.pidfd, lambda: self._end_session(session, ""))

    def _receive(self, session: Session) -> None:
        for _ in range(16):  # a chatty client gets its turn, not the loop
            if session not in self._sessions:
                return
            try:
                packet = session.sock.recv(MAX_PACKET + 1)
            except BlockingIOError:
                return
            except OSError:
                packet = b""
            if not packet:
                self._end_session(session, "")
                return
            try:
                self._dispatch(session, decode(packet) if len(packet) <= MAX_PACKET else None)
            except (MalformedMessage, _Malformed) as error:
                self._end_session(session, str(error))
                return
            except Exception as error:  # our own mistake costs one session, not the workcell
                trace = "".join(traceback.format_exception(error)[-3:])
                self._server.log("error", "internal error", peer=session, trace=trace)
                if session in self._sessions:
                    self._end_session(session, f"internal error: {error!r}")
                return

    def _dispatch(self, session: Session, message: list[Any] | None) -> None:
        if message is None:
            raise _Malformed(f"packet longer than {MAX_PACKET} bytes")
        try:
            verb = ClientVerb(message[0])
        except ValueError:
            raise _Malformed(f"verb {message[0]} is none") from None
        number, arguments = message[1], message[2:]
        if number == 0 or number in session.waits:
            raise _Malformed(f"message number {number} is zero or in use")
        try:
            value = self._verb(session, verb, number, arguments)
        except Refused as error:
            self._send(session, refusal(number, error.errno, str(error)))
        except MarkerError as error:
            self._send(session, refusal(number, error.errno, str(error)))
        except (ValueError, TypeError, LookupError, OverflowError) as error:
            raise _Malformed(f"{verb.name} with arguments {arguments!r:.80}: {error}") from None
        else:
            if value is not LATER:
                self._send(session, reply(number, value))

    def _verb(self, session: Session, verb: ClientVerb, number: int, arguments: list[Any]) -> Any:
        match verb:
            case ClientVerb.HELLO:
                return self._hello(session, number, *arguments)
            case ClientVerb.OPEN:
                return self._open(session, number, *arguments)
            case ClientVerb.CLOSE:
                return self._close(session, number, *arguments)
            case ClientVerb.LIST:
                return self._list(session)
            case ClientVerb.INFO:
                return self._server.names.pack(self._node(session, "get information", *arguments))
            case ClientVerb.STATUS:
                return self._status()
            case ClientVerb.RESERVE_MARKER:
                return self.markers.reserve(session, *arguments)
            case ClientVerb.FREE_MARKER:
                return self.markers.free(*arguments)
            case ClientVerb.SIGNAL_MARKER:
                return self.markers.signal(*arguments)
            case ClientVerb.WAIT_MARKER:
                return self.markers.wait(session, number, *arguments)
            case ClientVerb.EMERGENCY_STOP:
                return self._emergency_stop(session, *arguments)
            case ClientVerb.RESET:
                return self._reset(session, *arguments)
            case ClientVerb.RELOAD:
                return self._reload(session, number)
            case ClientVerb.CANCEL:
                return self._cancel(session, *arguments)

    def _send(self, session: Session, packet: bytes, fds: list[int] | None = None) -> None:
        try:
            if fds:
                socket.send_fds(session.sock, [packet], fds)
            else:
                session.sock.send(packet)
        except OSError as error:
            # Also when its buffer is full: a client that does not read its replies is a dead client.
            if session in self._sessions:
                self._end_session(session, f"reply could not be sent: {error.strerror}")

    def _end_session(self, session: Session, why: str) -> None:
        self._sessions.discard(session)
        if why:
            self._server.log("warning", "session ended", peer=session, why=why)
        self._server.loop.unwatch(session.sock.fileno())
        session.sock.close()
        for wait in list(session.waits.values()):
            self._drop_wait(wait)
        self.markers.end_session(session)
        for handle in list(session.handles.values()):
            self._detach(handle)
        if session.pidfd >= 0:
            self._server.loop.unwatch(session.pidfd)
            os.close(session.pidfd)

    # --- waiting requests ------------------------------------------------------------------------

    def wait(self, session: Session, number: int, timeout_s: float | None, what: str) -> Wait:
        """Keep a request to be answered later, or refused when its time is over [s; None = never]."""
        if len(session.waits) >= self.bounds.max_waits:
            raise Refused(
                errno.EAGAIN,
                f"{what}: {len(session.waits)} requests are waiting already; at most {self.bounds.max_waits}",
            )
        wait = Wait(number, session, None, what)
        if timeout_s is not None:
            limit = min(max(float(timeout_s), 0.0), LONGEST_WAIT_S)
            wait.timer = self._server.loop.after(limit, lambda: self._timed_out(wait, limit))
        session.waits[number] = wait
        return wait

    def answer(self, wait: Wait, packet: bytes, fds: list[int] | None = None) -> None:
        """Answer a request that was kept, unless it has ended in another way."""
        if self._drop_wait(wait):
            self._send(wait.session, packet, fds)

    def _drop_wait(self, wait: Wait) -> bool:
        if wait.timer is not None:
            wait.timer.cancel()
        self._opens = [entry for entry in self._opens if entry[0] is not wait]
        self.markers.forget(wait)
        return wait.session.waits.pop(wait.number, None) is not None

    def _timed_out(self, wait: Wait, limit_s: float) -> None:
        why = f": {wait.why()}" if wait.why is not None else ""
        self.answer(
            wait, refusal(wait.number, errno.ETIMEDOUT, f"{wait.what}: not within {limit_s:g} s{why}")
        )

    def _cancel(self, session: Session, number: int) -> bool:
        wait = session.waits.get(int(number))
        if wait is None:
            return False
        self.answer(wait, refusal(wait.number, errno.ECANCELED, f"{wait.what}: cancelled"))
        return True

    # --- names, opens, closes --------------------------------------------------------------------

    def _hello(self, session: Session, number: int, version: int, name: str) -> Any:
        if version != PROTOCOL_VERSION:
            raise Refused(
                errno.EPROTO, f"hello: protocol version {version}; this daemon speaks {PROTOCOL_VERSION}"
            )
        session.name = str(name)[:80]
        rights = self.rights.on_workcell(session.peer)
        value = [PROTOCOL_VERSION, self.bounds.name, int(rights)]
        fds = [self._server.shared.request_fd] if rights & Right.STOP else []
        self._send(session, reply(number, value), fds)
        return LATER

    def _node(self, session: Session, what: str, name: str) -> Node:
        node = self._server.names.nodes.get(str(name))
        if node is None:
            raise Refused(
                errno.ENOENT,
                f"{what} of {name}: no such node{did_you_mean(str(name), self._server.names.nodes)}",
            )
        if not self.rights.on_node(session.peer, node.name) & Right.READ:
            raise Refused(
                errno.EACCES,
                f"{what} of {name}: {session.peer.user} has no right to read it; ask for a [[grant]]",
            )
        return node

    def _open(
        self, session: Session, number: int, name: str, mode: int, timeout_s: float | None, lease_s: float
    ) -> Any:
        node = self._node(session, "open", name)
        access = Access(int(mode))
        rights = self.rights.on_node(session.peer, node.name)
        if not access:
            raise Refused(errno.EINVAL, f"open {name}: mode 0; want read, write or both")
        if access & Access.WRITE and node.read_only:
            raise Refused(
                errno.EACCES, f"open {name} for writing: it is a read-only node; open it for reading"
            )
        if not node.read_only and not rights & Right.WRITE:
            raise Refused(
                errno.EACCES,
                f"open {name}: {session.peer.user} has no right to write it; use {name}{READONLY} to observe",
            )
        if not 0 <= float(lease_s) <= 3600:
            raise Refused(errno.EINVAL, f"open {name}: lease {lease_s} s; want 0 (none) to 3600")
        if len(session.handles) >= self.bounds.max_handles:
            raise Refused(
                errno.EMFILE, f"open {name}: this session has {len(session.handles)} open handles; close some"
            )
        obstacle = self._obstacle(node)
        if obstacle is None:
            self._grant(session, number, node, access, float(lease_s))
            return LATER
        if timeout_s is not None and float(timeout_s) <= 0:
            raise obstacle
        wait = self.wait(session, number, timeout_s, f"open {name}")
        wait.why = lambda: str(self._obstacle(node) or "it has just become free").removeprefix(
            f"open {name}: "
        )

        def retry() -> bool:
            if self._server.names.nodes.get(node.name) != node:  # a reload came in between
                why = f"open {name}: it has been removed or changed meanwhile; open it again"
                self.answer(wait, refusal(wait.number, errno.EIO, why))
                return True
            if self._obstacle(node) is not None:
                return False
            if self._drop_wait(wait):
                try:
                    self._grant(session, number, node, access, float(lease_s))
                except Refused as error:
                    self._send(session, refusal(number, error.errno, str(error)))
            return True

        self._opens.append((wait, retry))
        return LATER

    def _obstacle(self, node: Node) -> Refused | None:
        """Return why a node cannot be opened now, or None."""
        holder = self._claims.holder(node)
        if holder is not None:
            held_s = (time.monotonic_ns() - holder.since_ns) / 1e9
            other = "" if holder.node.name == node.name else f" through {holder.node.name}"
            return Refused(
                errno.EBUSY,
                f"open {node.name}: held by {holder.session} for {held_s:.1f} s{other}; use {node.name}{READONLY} to observe",
            )
        device = self._server.devices.get(node.device)
        if device is None or device.state is not State.UP:
            state, reason = (
                (device.state.value, device.reason) if device else ("gone", "not configured any more")
            )
            return Refused(
                errno.EIO,
                f"open {node.name}: device {node.device} is {state}" + (f": {reason}" if reason else ""),
            )
        return None

    def _grant(self, session: Session, number: int, node: Node, access: Access, lease_s: float) -> None:
        device = self._server.devices[node.device]
        rights = self.rights.on_node(session.peer, node.name)
        now_ns = time.monotonic_ns()
        handle = Handle(next(self._numbers), session, node, access, now_ns, device.generation, rights)
        if node.read_only:
            access &= ~Access.WRITE
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        theirs.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        readable, wake = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        try:
            fds = [theirs.fileno(), wake] + ([session.pidfd] if session.pidfd >= 0 else [])
            exclusive = not node.read_only
            try:
                device.send(
                    DriverVerb.ATTACH, handle.number, node.block, node.channels, node.bit, int(access), exclusive,
                    int(rights), int(lease_s * 1e9), str(session), node.name, fds=fds,
                )  # fmt: skip
            except OSError as error:
                raise Refused(errno.EIO, f"open {node.name}: {error.strerror}") from None
            self._handles[handle.number] = session.handles[handle.number] = handle
            self._claims.take(handle.claims, handle)
            value = [handle.number, self._server.names.pack(node), node.channels, node.bit]
            self._send(session, reply(number, value), [device.page_fds[node.block], readable, ours.fileno()])
        finally:
            os.close(readable)
            os.close(wake)
            ours.close()
            theirs.close()

    def retry_opens(self) -> None:
        """Try the waiting opens again, the oldest first."""
        for _, retry in list(self._opens):
            retry()

    def _close(self, session: Session, number: int, handle_number: int) -> Any:
        handle = session.handles.get(handle_number)
        if handle is None:
            raise Refused(errno.EBADF, f"close: this session has no handle {handle_number}")
        if handle.claims and self._detach(handle):
            handle.closing = number
            session.waits[number] = Wait(number, session, None, f"close {handle.node.name}")
            return LATER
        self._forget(handle)
        return None

    def _detach(self, handle: Handle) -> bool:
        """Ask the driver to end a handle; its channels are free when the driver says so.

        Returns:
            Whether there is a driver to wait for.
        """
        device = self._server.devices.get(handle.node.device)
        there = device is not None and device.generation == handle.generation and device.state is State.UP
        if device is not None and there:
            device.tell(DriverVerb.DETACH, handle.number)
            if handle.claims:
                return True
        self._forget(handle)
        return False

    def take_up_rights(self, rights: Rights) -> None:
        """Let new grants hold, also for what is open already: a handle that lost a right ends."""
        self.rights = rights
        for handle in list(self._handles.values()):
            lost = handle.rights & ~rights.on_node(handle.session.peer, handle.node.name)
            device = self._server.devices.get(handle.node.device)
            if lost and device is not None and device.generation == handle.generation:
                names = ", ".join(name for name, right in RIGHTS.items() if right & lost)
                text = f"{handle.node.name}: the right to {names} it was taken away; open it again"
                device.tell(DriverVerb.DETACH, handle.number, text)

    def detached(self, device: DriverProcess, number: int) -> None:
        """The driver has ended a handle: its axes are being halted."""
        handle = self._handles.get(number)
        if handle is not None and handle.node.device == device.name:
            self._forget(handle)

    def _forget(self, handle: Handle) -> None:
        if self._handles.pop(handle.number, None) is None:
            return
        handle.session.handles.pop(handle.number, None)
        self._claims.release(handle.claims)
        wait = handle.session.waits.get(handle.closing)
        if wait is not None:
            self.answer(wait, reply(handle.closing))
        if self._opens:
            self.retry_opens()

    def device_gone(self, device: DriverProcess, reason: str) -> None:
        """Void all handles of a driver process that is no more."""
        for handle in [h for h in self._handles.values() if h.node.device == device.name]:
            self._forget(handle)

    def _list(self, session: Session) -> list[object]:
        names = self._server.names
        listed: list[object] = []
        for node in names.nodes.values():
            if self.rights.on_node(session.peer, node.name) & Right.READ:
                holder = self._claims.holder(node)
                device = self._server.devices.get(node.device)
                state = device.state.value if device else "gone"
                listed.append([
                    node.name, int(names.block(node).node_class), len(node.channels), node.read_only,
                    node.device, state, str(holder.session) if holder else "", node.bit,
                ])  # fmt: skip
        return listed

    def _status(self) -> dict[str, object]:
        server = self._server
        now = time.monotonic_ns()
        latch = server.shared.latch
        return {
            "workcell": self.bounds.name,
            "pid": os.getpid(),
            "stopped_ns": latch.stopped_ns,
            "stop_source": latch.source if latch.stopped_ns else "",
            "devices": [
                {
                    "name": d.name, "driver": d.info.driver, "state": d.state.value, "pid": d.pid,
                    "generation": d.generation, "reason": d.reason, "link": d.link[0].name.lower(),
                    "link_reason": d.link[1], "tick_hz": d.info.tick_hz, "deaths": len(d.restarts.deaths_ns),
                    "age_s": (now - d.started_ns) / 1e9 if d.started_ns else 0.0,
                }
                for d in server.devices.values()
            ],
            "sessions": [[str(s), len(s.handles), len(s.waits), self.markers.count(s)] for s in self._sessions],
            "holders": [[h.node.name, str(h.session), (now - h.since_ns) / 1e9] for h in self._handles.values() if h.claims],
        }  # fmt: skip

    # --- stops -----------------------------------------------------------------------------------

    def _emergency_stop(self, session: Session, name: str, why: str) -> None:
        source = f"{session}" + (f": {str(why)[:80]}" if why else "")
        if not name:
            if not self.rights.on_workcell(session.peer) & Right.STOP:
                raise Refused(
                    errno.EPERM,
                    f"emergency stop: {session.peer.user} has no right to stop; ask for a [[grant]]",
                )
            self._server.stop_workcell(source)
            return
        node = self._node(session, "emergency stop", name)
        if not self.rights.on_node(session.peer, node.name) & Right.STOP:
            raise Refused(
                errno.EPERM, f"emergency stop of {name}: {session.peer.user} has no right to stop it"
            )
        self._to_device(node, DriverVerb.NODE_STOP, source)
        self._server.log("warning", "emergency stop", node=name, source=source)

    def _reset(self, session: Session, name: str) -> None:
        if not name:
            if not self.rights.on_workcell(session.peer) & (Right.ADMINISTER | Right.WRITE):
                raise Refused(
                    errno.EPERM, f"reset: {session.peer.user} has no right to write or administer every node"
                )
            self._server.reset_workcell(str(session))
            return
        node = self._node(session, "reset", name)
        if not self.rights.on_node(session.peer, node.name) & (Right.ADMINISTER | Right.WRITE):
            raise Refused(errno.EPERM, f"reset {name}: {session.peer.user} has no right to write it")
        device = self._server.devices.get(node.device)
        if device is not None and device.state is State.FAULT:
            device.reset()
            return
        latch = self._server.shared.latch
        if latch.stopped_ns:
            raise Refused(
                errno.EPERM, f"reset {name}: the whole workcell is stopped ({latch.source}); reset that"
            )
        self._to_device(node, DriverVerb.NODE_RESET, str(session))

    def _to_device(self, node: Node, verb: DriverVerb, text: str) -> None:
        device = self._server.devices.get(node.device)
        try:
            if device is None:
                raise OSError(errno.EIO, "not configured any more")
            device.send(verb, node.block, node.channels, text)
        except OSError as error:
            raise Refused(errno.EIO, f"{verb.name.lower()} {node.name}: {error.strerror}") from None

    def _reload(self, session: Session, number: int) -> Any:
        if not self.rights.on_workcell(session.peer) & Right.ADMINISTER:
            raise Refused(errno.EPERM, f"reload: {session.peer.user} has no right to administer every node")
        wait = self.wait(session, number, None, "reload")

        def done(errors: list[str]) -> None:
            self.answer(wait, reply(number, errors))

        self._server.load(done)
        return LATER
