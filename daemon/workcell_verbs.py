"""Workcell requests of clients: who speaks, status, reports, journals, reload.

Concurrency: everything runs in the daemon's loop.
"""

from __future__ import annotations

import errno
import os
import re
import time
from collections.abc import Callable
from typing import Any, TypeAlias

from sioms.protocol.flags import PROTOCOL_VERSION, Right
from sioms.protocol.messages import refusal, reply
from sioms.protocol.text import printable
from sioms.protocol.verbs import Hello, Reload, Report, Represent

from .cell import Cell
from .clients import Clients
from .journals import Leash, for_reading
from .marker_verbs import MarkerVerbs
from .node_verbs import NodeVerbs
from .rights import Peer
from .sessions import LATER, Refused, Session

Load: TypeAlias = Callable[[Callable[[list[str]], None], Callable[[], bool]], None]
"""Takes up the configuration anew: called with what takes the errors, and what tells whether it is wanted still."""
NAMED = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}").fullmatch
"""The name of a key or of a group of keys."""


REPORTS, REPORTED_NS = 16, 3_600_000_000_000
"""So many troubles of clients are kept for the status, so long [ns]."""


class WorkcellVerbs:
    """The workcell as a whole, on behalf of clients.

    Args:
        cell: the workcell.
        clients: who asks, waits and is answered, and what they may.
        nodes: who has which open.
        markers: who has how many.
        load: takes up the configuration anew.
    """

    def __init__(self, cell: Cell, clients: Clients, nodes: NodeVerbs, markers: MarkerVerbs, load: Load) -> None:
        self._cell = cell
        self._clients = clients
        self._nodes = nodes
        self._markers = markers
        self._load = load
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
        if why := self._cell.quotas.over(peer, "sessions", has, "sessions"):
            raise Refused(errno.EUSERS, f"{what}: {why}")
        session.peer = peer

    def hello(self, session: Session, number: int, message: Hello) -> Any:
        """Answer a client that says who it is."""
        version, name = message
        if version != PROTOCOL_VERSION:
            raise Refused(errno.EPROTO, f"hello: protocol version {version}; this daemon speaks {PROTOCOL_VERSION}")
        session.name, session.greeted = printable(name, 80), True
        rights = self._clients.rights.on_workcell(session.peer)
        value = [PROTOCOL_VERSION, self._cell.bounds.name, int(rights)]
        fds = self._cell.shared.files.client_fds if rights & Right.STOP else []
        self._clients.send(session, reply(number, value), fds)
        return LATER

    def status(self) -> dict[str, object]:
        """Return what `sioms status` shows."""
        cell = self._cell
        now = time.monotonic_ns()
        cell.shared.record.shown(now)
        latch = cell.shared.latch
        return {
            "workcell": self._cell.bounds.name,
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
                for d in cell.devices.values()
            ],
            "reports": [
                [who, (now - at) / 1e9, text] for _, _, who, at, text in self._reports if now - at < REPORTED_NS
            ],
            "node_stops": cell.shared.record.state.nodes(),
            "sessions": [
                [str(s), len(s.handles), len(s.waits), self._markers.count(s)] for s in self._clients.sessions
            ],
            "holders": [[h.node.name, str(h.session), (now - h.since_ns) / 1e9] for h in self._nodes.holders()],
        }

    def journal(self, session: Session, number: int, device: str) -> Any:
        """Open a journal: all that everybody does is in it, and the keys of the markers that commands signal."""
        what = f"open the journal of {device or 'the daemon'}"
        if not self._clients.rights.on_workcell(session.peer) & Right.ADMINISTER:
            raise Refused(
                errno.EPERM, f"{what}: {session.peer.user} has no right to administer every node; ask for a [[grant]]"
            )
        process = self._cell.devices.get(device)
        if device and process is None:
            raise Refused(errno.ENOENT, f"{what}: no such device; there are: {', '.join(self._cell.devices)}")
        fd = for_reading(self._cell.shared.journal.fd if process is None else process.journal_fd)
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
        self._cell.log(level, "report", peer=session, text=printable(text, 1000))

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
        self._load(done, begin)
        return LATER
