"""Workcell requests of clients: hello, status, emergency stop, reset, reload.

Concurrency: everything runs in the daemon's loop.
"""

from __future__ import annotations

import errno
import os
import re
import time
from typing import TYPE_CHECKING, Any

from sioms.protocol.flags import PROTOCOL_VERSION, Right, Severity
from sioms.protocol.messages import refusal, reply
from sioms.protocol.text import printable

from .alarms import OF_CLIENTS, Alarm
from .devices import State
from .journals import Leash, for_reading
from .names import part_name, shows
from .rights import Peer
from .sessions import LATER, Refused, Session

if TYPE_CHECKING:
    from sioms.protocol.verbs import (
        Acknowledge,
        EmergencyStop,
        Hello,
        Reload,
        Report,
        Represent,
        Reset,
        Supervise,
        TellAlarm,
    )  # fmt: skip

    from .clients import Clients
    from .server import Server


NAMED = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}").fullmatch
"""The name of a key or of a group of keys."""


REPORTS, REPORTED_NS = 16, 3_600_000_000_000
"""So many troubles of clients are kept for the status, so long [ns]."""


class WorkcellVerbs:
    """The workcell as a whole, and stops, on behalf of clients.

    Args:
        server: the daemon.
        clients: who asks, waits and is answered, and what they may.
    """

    def __init__(self, server: Server, clients: Clients) -> None:
        self._server = server
        self._clients = clients
        self._reports: list[tuple[int, str, str, int, str]] = []

    def represent(self, session: Session, message: Represent) -> None:
        """Take a session for one of the holder of a key from now on."""
        key, host, groups = message
        what = f"represent {printable(key, 80)}"
        if session.peer.key or session.greeted or session.handles or session.waits:
            raise Refused(errno.EPERM, f"{what}: this session is somebody's already; it comes once, before hello")
        if not self._clients.may_represent(session.peer):
            why = "name it as gateway_user in [workcell], if it is a gateway's"
            raise Refused(errno.EPERM, f"{what}: user {session.peer.user} may not speak for others; {why}")
        if not NAMED(key) or not all(isinstance(group, str) and NAMED(group) for group in groups):
            raise Refused(errno.EINVAL, f"{what}: want a key and groups of 1 to 64 letters, digits, - . and _")
        peer = Peer(
            session.peer.pid, self._clients.number_of(key), key, frozenset(), key, printable(host, 64),
            frozenset(groups),
        )  # fmt: skip
        has = sum(other.peer.uid == peer.uid for other in self._clients.sessions)
        if why := self._clients.quotas.over(peer, "sessions", has, "sessions"):
            raise Refused(errno.EUSERS, f"{what}: {why}")
        session.peer = peer

    def hello(self, session: Session, number: int, message: Hello) -> Any:
        """Answer a client that says who it is."""
        version, name = message
        if version != PROTOCOL_VERSION:
            raise Refused(errno.EPROTO, f"hello: protocol version {version}; this daemon speaks {PROTOCOL_VERSION}")
        session.name, session.greeted = printable(name, 80), True
        rights = self._clients.rights.on_workcell(session.peer)
        value = [PROTOCOL_VERSION, self._clients.bounds.name, int(rights)]
        fds = self._server.shared.files.client_fds if rights & Right.STOP else []
        self._clients.send(session, reply(number, value), fds)
        return LATER

    def status(self) -> dict[str, object]:
        """Return what `sioms status` shows."""
        server = self._server
        server.shared.record.look()
        now = time.monotonic_ns()
        latch = server.shared.latch
        return {
            "workcell": self._clients.bounds.name,
            "pid": os.getpid(),
            "stopped_ns": latch.stopped_ns,
            "stop_source": latch.source if latch.stopped_ns else "",
            "devices": [
                {
                    "name": d.name,
                    "driver": d.info.driver,
                    "state": d.state.value,
                    "pid": d.pid,
                    "generation": d.generation,
                    "reason": d.reason,
                    "link": d.link[0].name.lower(),
                    "link_reason": d.link[1],
                    "tick_hz": d.info.tick_hz,
                    "deaths": len(d.restarts.deaths_ns),
                    "trouble": d.trouble,
                    "age_s": (now - d.started_ns) / 1e9 if d.started_ns else 0.0,
                }
                for d in server.devices.values()
            ],
            "reports": [
                [who, (now - at) / 1e9, text] for _, _, who, at, text in self._reports if now - at < REPORTED_NS
            ],
            "node_stops": server.shared.record.state.nodes(),
            "sessions": [
                [str(s), len(s.handles), len(s.waits), self._clients.markers.count(s)] for s in self._clients.sessions
            ],
            "holders": [[h.node.name, str(h.session), (now - h.since_ns) / 1e9] for h in self._clients.nodes.holders()],
        }

    def journal(self, session: Session, number: int, device: str) -> Any:
        """Open a journal: all that everybody does is in it, and the keys of the markers that commands signal."""
        what = f"open the journal of {device or 'the daemon'}"
        if not self._clients.rights.on_workcell(session.peer) & Right.ADMINISTER:
            raise Refused(
                errno.EPERM, f"{what}: {session.peer.user} has no right to administer every node; ask for a [[grant]]"
            )
        process = self._server.devices.get(device)
        if device and process is None:
            raise Refused(errno.ENOENT, f"{what}: no such device; there are: {', '.join(self._server.devices)}")
        fd = for_reading(self._server.shared.journal.fd if process is None else process.journal_fd)
        try:
            session.leash = session.leash or Leash()
            fds = [fd, session.leash.read_fd]
            self._clients.send(session, reply(number, process.generation if process else 0), fds)
        finally:
            os.close(fd)
        return LATER

    def report(self, session: Session, message: Report) -> None:
        """Log what a client says, and keep what is wrong for the status."""
        level, text = message
        if level not in ("info", "warning", "error"):
            raise Refused(errno.EINVAL, f"report: level {level!r}; want info, warning or error")
        now_ns, user = time.monotonic_ns(), session.peer.uid
        kept = [each for each in self._reports if each[1] != session.name or each[0] != user]
        if level != "info":
            kept.append((user, session.name, str(session), now_ns, printable(text, 400)))
        self._reports = kept[-REPORTS:]
        self._server.log(level, "report", peer=session, text=printable(text, 1000))

    def alarms(self, session: Session) -> list[dict[str, Any]]:
        """List the alarms on what the session may read."""
        rights = self._clients.rights
        return [
            alarm.packed() for alarm in self._server.alarms if rights.on_node(session.peer, alarm.node) & Right.READ
        ]  # fmt: skip

    def acknowledge(self, session: Session, message: Acknowledge) -> list[dict[str, Any]]:
        """Acknowledge the alarms of a node or device, '' = all that the session may."""
        (name, note), nodes, alarms = message, self._server.names.nodes, self._server.alarms
        what = f"acknowledge {name or 'all alarms'}"
        named = self._clients.nodes.find(session, what, name, message.right) if name in nodes else None
        if name and named is None and name not in self._server.devices:
            raise Refused(errno.ENOENT, f"{what}: no such node or device; `sioms alarms` lists all alarms")
        parts, others = list[Alarm](), list[Alarm]()
        for alarm in alarms:
            there = nodes.get(alarm.node)
            if alarm.node == name or (named and there and shows(named, there)):
                parts.append(alarm)
            elif name in ("", alarm.device):
                others.append(alarm)
        allowed = [a for a in others if self._clients.rights.on_node(session.peer, a.node) & message.right]
        if named is None and others and not parts + allowed:
            raise Refused(errno.EPERM, f"{what}: {session.peer.user} has no right to write or administer it")
        return [alarm.packed() for alarm in alarms.acknowledge(parts + allowed, str(session), note)]

    def tell_alarm(self, session: Session, message: TellAlarm) -> None:
        """Take what a client says of a condition that it watches."""
        name, what, severity, text = message
        where = f"tell an alarm of {name}"
        node = self._clients.nodes.find(session, "tell an alarm", name, message.right)
        if what not in OF_CLIENTS:
            raise Refused(errno.EINVAL, f"{where}: {printable(what, 80)}; want one of: {', '.join(OF_CLIENTS)}")
        if severity not in (Severity.NONE, Severity.MINOR, Severity.MAJOR):
            raise Refused(errno.EINVAL, f"{where}: severity {severity}; want 0, 1 (minor) or 2 (major)")
        if len(node.channels) != 1:
            raise Refused(errno.EINVAL, f"{where}: it has {len(node.channels)} channels; want the node of one")
        part = part_name(self._server.names.devices[node.device], node.block, node.channels[0], node.bit)
        said = f"{printable(text, 300)} [told by {session}]" if severity else ""
        self._server.alarms.take(part, node.device, what, severity, said)

    def emergency_stop(self, session: Session, message: EmergencyStop) -> None:
        """Stop the workcell, or a node."""
        name, why = message
        source = f"{session}" + (f": {printable(why, 80)}" if why else "")
        if not name:
            if not self._clients.rights.on_workcell(session.peer) & message.right:
                raise Refused(
                    errno.EPERM,
                    f"emergency stop: {session.peer.user} has no right to stop; ask for a [[grant]]",
                )
            self._server.hear_request()
            self._server.stop_workcell(source)
            return
        node = self._clients.nodes.find(session, "emergency stop", name, message.right)
        try:
            self._server.stop_node(node, source)
        except OSError as error:
            raise Refused(errno.EIO, f"emergency stop of {name}: {error.strerror}") from None

    def supervise(self, session: Session, message: Supervise) -> float:
        """Take a session for a supervisor of the workcell."""
        if not self._clients.rights.on_workcell(session.peer) & message.right:
            raise Refused(errno.EPERM, f"supervise: {session.peer.user} has no right to stop; ask for a [[grant]]")
        if not message.lease_s > 0:
            raise Refused(errno.EINVAL, f"supervise: lease {message.lease_s:g} s; want more than 0")
        return self._clients.supervision.renew(session, message.lease_s)

    def reset(self, session: Session, message: Reset) -> None:
        """Reset the workcell, or a node, or the fault of its device."""
        (name,) = message
        if not name:
            if not self._clients.rights.on_workcell(session.peer) & message.right:
                raise Refused(errno.EPERM, f"reset: {session.peer.user} has no right to write or administer every node")
            if self._clients.supervision.missing:
                raise Refused(errno.EPERM, "reset: the workcell has no supervisor; start `sioms supervise`")
            if source := self._server.hear_request():
                raise Refused(errno.EAGAIN, f"reset: a stop has just been requested ({source}); reset again")
            self._server.reset_workcell(str(session))
            return
        node = self._clients.nodes.find(session, "reset", name, message.right)
        device = self._server.devices.get(node.device)
        if device is not None and device.state is State.FAULT:
            device.reset()
            self._server.log("info", "reset", node=node.name, device=device.name, by=session)
            return
        latch = self._server.shared.latch
        if latch.stopped_ns:
            raise Refused(errno.EPERM, f"reset {name}: the whole workcell is stopped ({latch.source}); reset that")
        try:
            self._server.reset_node(node, str(session))
        except OSError as error:
            raise Refused(errno.EIO, f"reset {name}: {error.strerror}") from None
        if device is not None:
            device.trouble = ""

    def reload(self, session: Session, number: int, message: Reload) -> Any:
        """Take up the configuration anew, when it has its turn; answered with all errors."""

        def check() -> None:
            if not self._clients.rights.on_workcell(session.peer) & message.right:
                text = f"reload: {session.peer.user} has no right to administer every node"
                raise Refused(errno.EPERM, text)

        def begin() -> bool:
            try:
                check()  # again: the reload before it may have taken the right away
            except Refused as error:
                self._clients.answer(wait, refusal(number, error.errno, str(error)))
                return False
            return True

        def done(errors: list[str]) -> None:
            self._clients.answer(wait, reply(number, errors))

        check()
        wait = self._clients.wait(session, number, None, "reload")
        self._server.load(done, begin)
        return LATER
