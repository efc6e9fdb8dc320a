"""Requests of clients: what comes from a session is read, served by the verbs, answered, and noted.

Concurrency: everything runs in the daemon's loop. A session that sends nonsense is ended with a line in the log, and
nothing else.
"""

from __future__ import annotations

import errno
import time
import traceback
from collections.abc import Callable
from typing import Any

from sioms.protocol import verbs
from sioms.protocol.journal import Note
from sioms.protocol.messages import MAX_PACKET, MalformedMessage, refusal, reply
from sioms.timestamps import receive

from .alarm_keeper import AlarmKeeper
from .alarm_verbs import AlarmVerbs
from .cell import Cell
from .clients import Clients
from .marker_owners import MarkerError
from .marker_verbs import MarkerVerbs
from .node_verbs import NodeVerbs
from .rights import Rights
from .sessions import LATER, Refused, Session
from .stop_verbs import StopVerbs
from .stops import Stops
from .supervision import Supervision
from .workcell_verbs import Load, WorkcellVerbs

STATUS_NS = 20_000_000
"""How old what STATUS tells may be while nobody asks for anything else."""


class Requests:
    """All that clients can ask for.

    Args:
        cell: the workcell.
        clients: who asks, waits and is answered, and what they may.
        stops: what stops the workcell and nodes.
        alarms: of the workcell.
        load: takes up the configuration anew.
        starting: tells how far the first configuration has come, '' when it is taken up.
    """

    def __init__(
        self, cell: Cell, clients: Clients, stops: Stops, alarms: AlarmKeeper, load: Load, starting: Callable[[], str]
    ) -> None:
        self._cell = cell
        self._clients = clients
        self._starting = starting
        self._status: tuple[int, int, dict[str, object]] | None = None
        self.nodes = NodeVerbs(cell, clients)
        self.markers = MarkerVerbs(cell, clients)
        self.supervision = Supervision(cell.loop, lambda: cell.bounds.supervisor_lease_s, stops.stop_workcell)
        cell.loop.watch(cell.timestamps.fd, cell.timestamps.look_at_clock)
        self._stops = StopVerbs(cell, clients, stops, self.nodes, self.supervision)
        self._alarms = AlarmVerbs(cell, clients, alarms, self.nodes)
        self._workcell = WorkcellVerbs(cell, clients, self.nodes, self.markers, load)
        clients.at_end = self._end_session

    def receive(self, session: Session) -> None:
        """Take what has come from a session."""
        if session not in self._clients.sessions:
            return
        try:
            packet, timestamp_ns = receive(session.sock, MAX_PACKET + 1)
        except BlockingIOError:
            return
        except OSError:
            packet = b""
        if not packet:
            self._clients.end(session, "")
            return
        session.timestamp_ns = 0 if session.early_bytes else timestamp_ns
        session.early_bytes = max(0, session.early_bytes - len(packet))
        try:
            self._dispatch(session, *verbs.take(packet, verbs.FROM_CLIENT, pending=session.waits))
        except MalformedMessage as error:
            self._clients.end(session, str(error))
        except Exception as error:  # our own mistake costs one session, not the workcell
            trace = "".join(traceback.format_exception(error)[-3:])
            self._cell.log("error", "internal error", peer=session, trace=trace)
            if session in self._clients.sessions:
                self._clients.end(session, f"internal error: {error!r}")

    def take_up_rights(self, rights: Rights) -> None:
        """Let new names and grants hold, also for what is open already, and for who has left a group."""
        self._clients.take_up_rights(rights)
        for session in list(self._clients.sessions):
            if not rights.anywhere(session.peer):
                self.markers.end_session(session)
        self.markers.take_up_rights()
        self.nodes.take_up_rights()

    def close(self) -> None:
        """Release the descriptor that is no session's."""
        self._cell.loop.unwatch(self._cell.timestamps.fd)
        self._cell.timestamps.close()

    def _end_session(self, session: Session) -> None:
        """Take from a session that has ended what it had."""
        self.supervision.end_session(session)  # first: it may stop the workcell
        for wait in list(session.waits.values()):
            self._clients.drop(wait)
        self.markers.end_session(session)
        for handle in list(session.handles.values()):
            self.nodes.detach(handle)

    def _dispatch(self, session: Session, number: int, message: verbs.Message) -> None:
        if session.greeting is not None:
            session.greeting.cancel()
            session.greeting = None
        if isinstance(message, verbs.Said):
            if not session.peer.key:
                raise MalformedMessage("how old a word is, is a gateway's to say")
            session.said_ns = message.at_ns
            return
        if not message.query:
            self._clients.changes += 1
        if starting := self._starting():
            text = f"connect: the daemon is starting: {starting}; `sioms wait` waits until it is ready"
            self._clients.send(session, refusal(number, errno.EAGAIN, text))
            return
        try:
            value = self._serve(session, number, message)
        except (Refused, MarkerError) as error:
            # Also then: who closes a handle that its driver has ended already shall see the axes halted.
            self._clients.send(session, refusal(number, error.errno, str(error), _as_of_ns(message)))
            self._note(session, message, error.errno, str(error))
        else:
            if value is not LATER:
                self._clients.send(session, reply(number, value, _as_of_ns(message)))
            if not message.query:
                self._note(session, message, 0, "")

    def _note(self, session: Session, message: verbs.Message, errno_: int, why: str) -> None:
        """Note a request, after its answer has been sent; keys of markers stay between the daemon and their owners."""
        values = [
            value & 1023 if field in ("token", "marker") else value
            for field, value in zip(message.fields, message, strict=True)
        ]
        self._cell.shared.journal.note(
            Note.REQUEST, time.monotonic_ns(), str(session), type(message).__name__, values, errno_, why
        )

    def _serve(self, session: Session, number: int, message: verbs.Message) -> Any:
        if message.somewhere and not self._clients.rights.anywhere(session.peer):
            what = f"{message.somewhere}: {session.peer.user}"
            raise Refused(errno.EPERM, f"{what} has no right on any node; ask for a [[grant]]")
        match message:
            case verbs.Represent():
                self._workcell.represent(session, message)
                turns, fd = self._cell.loop.turns, session.sock.fileno()
                if turns.remove(fd):  # what comes from now on is served as the key's, in turn with that of users
                    turns.add(fd, session.peer.uid, 0, lambda: self.receive(session))
                return None
            case verbs.Hello():
                return self._workcell.hello(session, number, message)
            case verbs.Open():
                return self.nodes.open(session, number, message)
            case verbs.Close(handle):
                return self.nodes.close(session, number, handle)
            case verbs.List():
                return self.nodes.listing(session)
            case verbs.Info(node, right=right):
                return self._cell.names.pack(self.nodes.find(session, "get information", node, right))
            case verbs.Journal(device):
                return self._workcell.journal(session, number, device)
            case verbs.Report():
                return self._workcell.report(session, message)
            case verbs.Status():
                return self._status_now()
            case verbs.ReserveMarker(how_many, persist):
                return self.markers.reserve(session, how_many, persist)
            case verbs.FreeMarker(token):
                return self.markers.free(token)
            case verbs.SignalMarker(token):
                return self.markers.signal(token)
            case verbs.WaitMarker(marker, timeout_s):
                return self.markers.wait(session, number, marker, timeout_s)
            case verbs.EmergencyStop():
                return self._stops.emergency_stop(session, message)
            case verbs.Reset():
                return self._stops.reset(session, message)
            case verbs.Supervise():
                return self._stops.supervise(session, message)
            case verbs.Alarms():
                return self._alarms.listing(session)
            case verbs.Acknowledge():
                return self._alarms.acknowledge(session, message)
            case verbs.TellAlarm():
                return self._alarms.tell(session, message)
            case verbs.Reload():
                return self._workcell.reload(session, number, message)
            case verbs.Cancel(waiting):
                return self._clients.cancel(session, waiting)
            case _:
                raise NotImplementedError(f"{type(message).__name__} is not served")

    def _status_now(self) -> dict[str, object]:
        """Return what STATUS tells: worked out anew when something has been asked for, else once in a while."""
        changes, now_ns = self._clients.changes, time.monotonic_ns()
        if self._status is None or self._status[0] != changes or now_ns - self._status[1] > STATUS_NS:
            self._status = (changes, now_ns, self._workcell.status())
        return self._status[2]


def _as_of_ns(message: verbs.Message) -> int:
    """Return the instant at which a request had its effect on what readings show: now, or never."""
    return time.monotonic_ns() if message.shown else 0
