"""Sessions of remote clients: who may, in which order, and for how long without being heard. Pure: no socket, no clock.

A session passes packets of the local protocol on, both ways, and reads three of them: an open, whose lease it sets;
the answer to one; and the greeting, which it does first, on behalf of the key. Everything else is between the client
and the daemon or driver, which judge it as they judge any client's.

Concurrency: one thread.
"""

from __future__ import annotations

import errno
import traceback
from collections.abc import Callable, Collection, Sequence

from sioms.protocol import link, verbs
from sioms.protocol.clock import Wall
from sioms.protocol.journal import JOURNAL_SIZE, pack_events
from sioms.protocol.link import Down, MalformedFrame, Up, Update
from sioms.protocol.messages import (
    MAX_INLINE,
    ClientVerb,
    MalformedMessage,
    decode,
    decode_reply,
    refusal,
    reply,
    value_of,
)
from sioms.protocol.page import as_of_ns

from .parts import Followed, Held, Outside, Principal, Session

KEEPALIVE = verbs.Keepalive().packed()
READ = (
    verbs.Represent, verbs.Said, verbs.Supervise, verbs.Reset, verbs.Journal, verbs.Cancel, verbs.Open,
    verbs.EmergencyStop,
)  # fmt: skip
"""Requests to the daemon of which the gateway reads more than that they are not these."""
PASSED_ON = frozenset(map(int, ClientVerb)) - {int(each.verb) for each in READ}
GATEWAYS = (verbs.Heard.verb, verbs.Passed.verb)
"""What no client may say to a driver."""
SHORT_NUMBERS = frozenset((*range(0x80), 0xCC, 0xCD, 0xCE))
"""First bytes of message numbers below 2**32."""
UNUSUAL = (b"\xdc", b"\xdd")
"""First bytes of arrays of more than 15 parts, or that are packed as if they were."""

OWN_NUMBERS = 1 << 52
"""Message numbers from here on are the gateway's own requests."""
MOST_SESSIONS = 256
MOST_OF_A_KEY = 48
"""Sessions of one key at a time, of these; the daemon's ``sessions`` of [quota] bounds those that it has taken in."""
MOST_WAITING = 64
"""Packets that a client may send before the daemon has taken it in."""
BATCH_BYTES = 48 << 10
"""Bytes of snapshots in one frame; what is older is skipped."""
IDLE_NS = 5_000_000
"""How often the snapshots of a node that nobody waits for are sent, with up to IDLE_NODES of them; more get their turns
the more seldom, so that any number of them takes the same part of a processor.
"""
IDLE_NODES = 16
STATE_NS = 50_000_000
"""How often a page's state is sent when it publishes nothing."""
URGENT_NS = 30_000_000
"""How long after an answer snapshots are sent as they come, at most: until one shows what was acknowledged."""
LOOK_NS = 500_000
"""How often to look for them, and how long after an answer first: who asks again within that does not read."""
IN_A_ROW_NS = 2_000_000
"""How seldom they are sent to who asks without a pause, whose answers they would delay."""
TOLD = 50
"""The driver, which runs the lease out if we cannot, knows the client's last word but for this part of the lease."""
JOURNAL_NS = 20_000_000
"""How often events of journals are sent."""
JOURNAL_BYTES = 48 << 10
"""Bytes of events in one frame, but for the last one; more come with the next."""


def _verb(packet: bytes) -> int:
    """Return the verb of a packet for a driver, however it is packed; -1 for what is none, which the driver judges."""
    if len(packet) > 1 and packet[0] & 0xF0 == 0x90 and packet[1] < 0x80:
        return packet[1]
    if packet[:1] in UNUSUAL or (packet and packet[0] & 0xF0 == 0x90):
        return int(decode(packet)[0])
    return -1


def _is_passed_on(packet: bytes) -> bool:
    """Tell whether a packet is a request that the daemon alone reads, packed as clients do; the daemon judges it."""
    return len(packet) > 2 and packet[0] & 0xF0 == 0x90 and packet[1] in PASSED_ON and packet[2] in SHORT_NUMBERS


def _effect_ns(packet: bytes) -> int:
    """Return the instant from which readings show what an answer acknowledges [ns]; 0: nothing, or it is none, which
    its client judges.
    """
    try:
        return int(decode_reply(packet)[5])
    except MalformedMessage:
        return 0


class Gateway:
    """All sessions.

    Args:
        outside: sockets.
        now: the time [ns], CLOCK_MONOTONIC, as of the drivers; it is what leases run by.
        wall: tells of the wall clock.

    Attributes:
        due_ns: when ``tick`` is to be called at the latest.
    """

    def __init__(self, outside: Outside, now: Callable[[], int], wall: Callable[[], Wall]) -> None:
        self.sessions: dict[bytes, Session] = {}
        self._outside = outside
        self._now = now
        self._wall = wall
        self._own = OWN_NUMBERS
        self._idle_ns = IDLE_NS
        self.due_ns = 0

    # --- from clients ----------------------------------------------------------------------------

    def frame(self, peer: bytes, who: Principal | None, host: str, frame: bytes) -> None:
        """Take a frame of a client.

        Args:
            peer: its address for the transport.
            who: whose key it is; None: a key that is not allowed, or not any more.
            host: where it is.
            frame: as it came.
        """
        now_ns = self._now()
        session = self.sessions.get(peer)
        if who is None:
            if session is not None:
                self.end(session, errno.EACCES, f"key {session.who.name} has been revoked")
            return
        try:
            kind, channel, number, stamp_ns, body = link.unpack(frame, link.MAX_TO_GATEWAY)
            if session is None:
                self._begin(peer, who, host, (kind, channel, number), now_ns)
                return
            if number <= session.heard:
                return  # had before: nothing is taken twice
            if number != session.heard + 1:
                raise MalformedFrame(f"frame {number} after {session.heard}: what was in between is lost")
            if stamp_ns > now_ns:  # it is told times by the answers to its stops, too, which come another way
                raise MalformedFrame("a frame that repeats a time that it has not been told")
            session.heard, session.heard_ns = number, now_ns
            self._take(session, kind, channel, stamp_ns, body, now_ns)
        except (MalformedFrame, MalformedMessage) as error:
            if session is not None:
                self.end(session, errno.EPROTO, str(error))
        except Exception as error:  # our own mistake costs one session, not all
            trace = "".join(traceback.format_exception(error)[-3:])
            self._outside.log("error", "internal error", peer=who.name, trace=trace)
            if session is not None:
                self.end(session, errno.EPROTO, f"internal error: {error!r}")

    def gone(self, peer: bytes) -> None:
        """The connection of a client has ended: what it held halts, and nothing more can be said to it."""
        if session := self.sessions.get(peer):
            self._outside.log("info", "session lost", peer=str(session))
            self._forget(session)

    def _begin(self, peer: bytes, who: Principal, host: str, head: tuple[int, int, int], now_ns: int) -> None:
        kind, version, number = head
        if kind != Up.HELLO or number != 1:
            return  # of a session that has ended: nothing of it counts any more
        session = Session(peer, who, host, now_ns)
        if version != link.VERSION:
            text = f"the client speaks version {version} of the link and the gateway {link.VERSION}; install the same"
            self._tell_end(session, errno.EPROTO, f"{text} release of SIOMS on both machines")
        elif len(self.sessions) >= MOST_SESSIONS:
            self._tell_end(session, errno.EUSERS, f"{MOST_SESSIONS} sessions are open at the gateway; close one")
        elif sum(other.who.name == who.name for other in self.sessions.values()) >= MOST_OF_A_KEY:
            text = f"key {who.name} has {MOST_OF_A_KEY} sessions open at the gateway, as many as one may; close one"
            self._tell_end(session, errno.EUSERS, text)
        else:
            self.sessions[peer] = session
            self._outside.log("info", "session", peer=str(session))
            self._send(session, Down.BEACON, now_ns=now_ns)

    def _take(self, session: Session, kind: int, channel: int, stamp_ns: int, body: bytes, now_ns: int) -> None:
        match kind:
            case Up.PACKET if channel:
                self._to_driver(session, channel, stamp_ns, body, now_ns)
            case Up.PACKET:
                self._to_daemon(session, body, stamp_ns)
            case Up.CREDIT if channel & link.JOURNAL:
                for followed in session.followed.values():
                    if followed.channel == channel:
                        followed.ahead = max(0, followed.ahead - 1)
            case Up.CREDIT:
                if held := session.held.get(channel):
                    held.ahead = max(0, held.ahead - link.take_credit(body))
                    self._feed(session, held, now_ns)
            case Up.CLOSED:
                if held := session.held.pop(channel, None):
                    held.node.close()
            case Up.PING:
                wall = self._wall()
                pong = link.pong(link.take_ping(body), now_ns, wall.ahead_ns, wall.error_ns, wall.source)
                self._send(session, Down.PONG, body=pong)
            case Up.BYE:
                self._forget(session)
            case _:
                raise MalformedFrame(f"a frame of kind {kind}, which is none")

    def _to_driver(self, session: Session, handle: int, stamp_ns: int, packet: bytes, now_ns: int) -> None:
        held = session.held.get(handle)
        if held is None or held.ended:
            return  # closed or ended: its client has been told, or is about to be
        if held.lease_ns:
            if stamp_ns + held.lease_ns < now_ns:
                self._run_out(session, held)  # first of all: what comes late is not carried out
                return
            held.until_ns = max(held.until_ns, stamp_ns + held.lease_ns)
        try:
            is_silent = packet == KEEPALIVE  # how old what acts is, the driver has to know exactly
            if _verb(packet) in GATEWAYS:
                raise MalformedMessage("how old a word is, is the gateway's to say")
            if stamp_ns - held.told_ns > (held.lease_ns // TOLD if is_silent else 0):
                held.told_ns = stamp_ns
                if not is_silent and len(packet) <= MAX_INLINE:
                    held.node.send(verbs.Passed(stamp_ns, packet).packed())
                    return
                held.node.send(verbs.Heard(stamp_ns).packed())
            if not is_silent:
                held.node.send(packet)
        except OSError:
            self.driver_gone(session, handle)

    def _to_daemon(self, session: Session, packet: bytes, stamp_ns: int) -> None:
        if session.taken_in and _is_passed_on(packet):
            self._to_line(session, packet)
            return
        number, message = verbs.take(packet, verbs.FROM_CLIENT)
        if number >= OWN_NUMBERS or isinstance(message, verbs.Represent | verbs.Said):
            raise MalformedMessage("that is the gateway's to say")
        if session.taken_in:
            self._pass(session, number, message, packet, stamp_ns)
            return
        session.waiting.append((packet, stamp_ns))
        if len(session.waiting) > MOST_WAITING:
            raise MalformedMessage(f"{MOST_WAITING} packets before the first answer")
        if session.line is None:
            try:
                session.line = self._outside.connect(session)
                groups = list(session.who.groups)
                session.line.send(verbs.Represent(session.who.name, session.host, groups).packed(OWN_NUMBERS))
            except OSError as error:
                self._refuse_waiting(session, error.errno or errno.EIO, error.strerror or str(error))

    def _pass(self, session: Session, number: int, message: verbs.Message, packet: bytes, stamp_ns: int) -> None:
        if isinstance(message, verbs.Supervise):  # from when its client was last told the time, as any lease
            left_s = message.lease_s - (self._now() - stamp_ns) / 1e9
            if left_s <= 0:
                text = f"supervise: the link is late by more than the lease of {message.lease_s:g} s"
                self._send(session, Down.PACKET, body=refusal(number, errno.ETIMEDOUT, text))
                return
            packet = verbs.Supervise(left_s).packed(number)
        if isinstance(message, verbs.Reset):
            self._to_line(session, verbs.Said(max(1, stamp_ns)).packed())  # 0 would say nothing
        if isinstance(message, verbs.EmergencyStop):  # requests past the daemon are made by us, one for each stop
            packet = verbs.EmergencyStop(message.node, message.why, message.or_all, 0).packed(number)
        if isinstance(message, verbs.Journal):
            session.asks[number] = message.device
        if isinstance(message, verbs.Cancel) and self._cancelled(session, number, message.number):
            return
        if isinstance(message, verbs.Open):
            if not (message.lease_s == 0 or link.SHORTEST_LEASE_S <= message.lease_s <= link.LONGEST_LEASE_S):
                text = f"open {message.node}: lease {message.lease_s:g} s; from another machine want"
                text = f"{text} {link.SHORTEST_LEASE_S:g} to {link.LONGEST_LEASE_S:g} s"
                answer = refusal(number, errno.EINVAL, text)
                self._send(session, Down.PACKET, body=answer)
                return
            self._own += 1
            session.asked[self._own] = (number, message)
            packet = verbs.Info(message.node).packed(self._own)
        self._to_line(session, packet)

    def _cancelled(self, session: Session, number: int, cancelled: int) -> bool:
        """Drop an open that has not reached the daemon yet, which would not find it; return whether there was one."""
        for own, (asked, message) in session.asked.items():
            if asked == cancelled:
                del session.asked[own]
                text = f"open {message.node}: cancelled"
                self._send(session, Down.PACKET, body=refusal(asked, errno.ECANCELED, text))
                self._send(session, Down.PACKET, body=reply(number, True))
                return True
        return False

    def _to_line(self, session: Session, packet: bytes) -> None:
        try:
            if session.line is not None:
                session.line.send(packet)
        except OSError as error:
            self.end(session, errno.EIO, f"the daemon takes no requests: {error.strerror}")

    def _refuse_waiting(self, session: Session, errno_: int, text: str) -> None:
        """Refuse what a session has asked for before the daemon took it in; its next request is another try."""
        if session.line is not None:
            session.line.close()
            session.line = None
        waiting, session.waiting = session.waiting, []
        for packet, _ in waiting:
            number, _ = verbs.take(packet, verbs.FROM_CLIENT)
            self._send(session, Down.PACKET, body=refusal(number, errno_, text))

    # --- from daemon and drivers -----------------------------------------------------------------

    def daemon_packet(self, session: Session, packet: bytes, fds: Sequence[int] = ()) -> None:
        """Take a packet of the daemon with its descriptors; an empty one: the daemon has gone."""
        now_ns = self._now()
        try:
            message = decode_reply(packet) if packet else None
        except MalformedMessage as error:
            message = [0, 0, errno.EPROTO, str(error), False, 0]
        if message is None or message[1] == 0:
            self._outside.drop(fds)
            errno_, text = (errno.EIO, "the daemon behind the gateway has gone") if message is None else message[2:4]
            if session.taken_in:
                self.end(session, errno_, text)
            else:
                self._refuse_waiting(session, errno_, text)
            return
        number, errno_ = message[1], message[2]
        if number >= OWN_NUMBERS:
            self._outside.drop(fds)
            if number == OWN_NUMBERS:
                self._taken_in(session, errno_, message[3])
            else:
                self._informed(session, number, message)
            return
        asked = session.opens.pop(number, None)
        if asked is not None and not errno_ and len(fds) == 3:
            self._opened(session, asked, value_of(message)[0], packet, fds, now_ns)
            return
        device = session.asks.pop(number, None)
        if device is not None and not errno_ and len(fds) == 2:
            self._follow(session, number, device, packet, fds)
            return
        self._outside.drop(fds)
        self._send(session, Down.PACKET, body=packet)
        self._owe(session, list(session.held.values()), message[5], now_ns)

    def _follow(self, session: Session, number: int, device: str, packet: bytes, fds: Sequence[int]) -> None:
        """Begin to send a journal: what it keeps goes with the answer."""
        try:
            journal = self._outside.follow(session, fds)
        except OSError as error:
            self._send(session, Down.PACKET, body=refusal(number, error.errno or errno.EIO, str(error.strerror)))
            return
        if before := session.followed.pop(device, None):
            before.journal.close()
        channel = link.JOURNAL | number
        session.followed[device] = Followed(channel, journal)
        kept = pack_events(journal.read(JOURNAL_SIZE))
        self._send(session, Down.FOLLOWED, channel, link.followed(packet, kept))

    def unfollow(self, session: Session) -> None:
        """The right of a session to journals has ended."""
        for followed in session.followed.values():
            followed.journal.close()
        session.followed.clear()
        if session.peer in self.sessions:
            self._outside.log(
                "warning", "journals ended", peer=str(session), why="the right to them has ended, or the daemon"
            )
            self._send(session, Down.UNFOLLOWED)

    def _taken_in(self, session: Session, errno_: int, text: str) -> None:
        if errno_:
            self._refuse_waiting(session, errno_, text)
            return
        session.taken_in = True
        waiting, session.waiting = session.waiting, []
        for packet, stamp_ns in waiting:
            self._pass(session, *verbs.take(packet, verbs.FROM_CLIENT), packet, stamp_ns)

    def _informed(self, session: Session, own: int, message: Sequence[object]) -> None:
        """Send an open on, now that it is known whether the node can be written."""
        if own not in session.asked:
            return  # cancelled meanwhile
        number, asked = session.asked.pop(own)
        read_only = not message[2] and bool(value_of(list(message))[2])
        lease_s = 0.0 if read_only else asked.lease_s or link.DEFAULT_LEASE_S
        session.opens[number] = (asked.node, lease_s)
        self._to_line(session, verbs.Open(asked.node, asked.access, asked.timeout_s, lease_s).packed(number))

    def _opened(
        self, session: Session, asked: tuple[str, float], handle: int, packet: bytes, fds: Sequence[int], now_ns: int
    ) -> None:
        node = self._outside.attach(session, handle, fds)
        lease_ns = int(asked[1] * 1e9)
        held = session.held[handle] = Held(handle, asked[0], node, lease_ns, now_ns + lease_ns)
        self._send(session, Down.OPENED, handle, link.opened(node.shape, packet))
        if handle in session.held:
            self._feed(session, held, now_ns, must=True)

    def driver_packet(self, session: Session, handle: int, packet: bytes) -> None:
        """Take a packet of the driver behind a handle."""
        now_ns = self._now()
        self._send(session, Down.PACKET, handle, packet, now_ns)
        if answered := session.held.get(handle):
            device = answered.node.shape.device
            same = [held for held in session.held.values() if held.node.shape.device == device]
            self._owe(session, same, _effect_ns(packet), now_ns)

    def _owe(self, session: Session, nodes: Sequence[Held], effect_ns: int, now_ns: int) -> None:
        """Have the snapshots of nodes sent as they come until they show what has been acknowledged."""
        if not effect_ns:
            return
        for held in nodes:
            held.owed_ns = max(held.owed_ns, effect_ns)
        session.urgent_ns = now_ns + URGENT_NS
        session.due_ns = min(session.due_ns, now_ns + LOOK_NS)
        self.due_ns = min(self.due_ns, session.due_ns)

    def driver_gone(self, session: Session, handle: int) -> None:
        """The driver has ended a handle, or has gone; its page tells what is to be told."""
        if held := session.held.get(handle):
            self._end_handle(session, held, b"")

    def woken(self, session: Session, handle: int) -> None:
        """The driver has woken the subscriber of a handle."""
        if held := session.held.get(handle):
            held.woken = True
            self._feed(session, held, self._now())

    # --- time ------------------------------------------------------------------------------------

    def tick(self) -> int:
        """Do what is due; return when the next thing may be [ns]."""
        now_ns = self._now()
        due_ns = now_ns + int(link.BEACON_S * 1e9)
        nodes = sum(len(session.held) for session in self.sessions.values())
        self._idle_ns = IDLE_NS * max(nodes, IDLE_NODES) // IDLE_NODES
        for session in list(self.sessions.values()):
            if session.due_ns <= now_ns:
                session.due_ns = self._attend(session, now_ns)
            due_ns = min(due_ns, session.due_ns)
        self.due_ns = due_ns
        return due_ns

    def _attend(self, session: Session, now_ns: int) -> int:
        """Do what is due of a session; return when the next thing may be [ns]."""
        due_ns = now_ns + int(link.BEACON_S * 1e9)
        if now_ns - session.heard_ns > link.GONE_S * 1e9:
            self.end(session, errno.ETIMEDOUT, f"nothing came from the client for {link.GONE_S:g} s")
            return due_ns
        owns = False
        for held in list(session.held.values()):
            if held.lease_ns and not held.ended and session.held:
                owns = True
                if held.until_ns < now_ns:
                    self._run_out(session, held)
                else:
                    due_ns = min(due_ns, held.until_ns + 1)
            due_ns = min(due_ns, self._feed(session, held, now_ns))
        if session.followed:
            due_ns = min(due_ns, now_ns + JOURNAL_NS)
            self._feed_journals(session)
        beacon_ns = session.sent_ns + int((link.BEACON_S if owns else link.PING_S) * 1e9)
        if beacon_ns <= now_ns and session.peer in self.sessions:
            self._send(session, Down.BEACON)
        return due_ns

    def _run_out(self, session: Session, held: Held) -> None:
        text = f"{held.name}: its client was silent, or its link late, for longer than its lease of"
        text = f"{text} {held.lease_ns / 1e9:g} s"
        self._outside.log("warning", "lease ran out", peer=str(session), node=held.name)
        self._end_handle(session, held, refusal(0, errno.ETIMEDOUT, text))

    def _end_handle(self, session: Session, held: Held, last_word: bytes) -> None:
        if not held.ended:
            held.ended = True
            held.node.end()  # first: what it owns is halted
            if last_word:
                self._send(session, Down.PACKET, held.handle, last_word)
            self._send(session, Down.PACKET, held.handle)

    def _feed(self, session: Session, held: Held, now_ns: int, must: bool = False) -> int:
        """Send what is new of a page, if its client keeps up; return when to look again [ns]."""
        if held.ahead >= link.WINDOW or session.held.get(held.handle) is not held:  # the session may just have ended
            return now_ns + IDLE_NS
        urgent = held.owed_ns > 0 and session.urgent_ns > now_ns
        next_ns = held.sent_ns + self._idle_ns
        if urgent:
            next_ns = min(session.urgent_ns - URGENT_NS + LOOK_NS, held.sent_ns + IN_A_ROW_NS)
        if not (must or held.woken) and now_ns < next_ns:
            return next_ns
        condition = held.node.page.condition()
        is_late = now_ns - held.sent_ns >= STATE_NS
        if held.node.page.head > held.cursor or must or held.woken or is_late or held.state != condition[1:3]:
            held.sent_ns, held.state = now_ns, condition[1:3]
            self._send_news(session, held, condition)
        return now_ns + (LOOK_NS if urgent else self._idle_ns)

    def _send_news(self, session: Session, held: Held, condition: tuple[int, int, int, bytes]) -> None:
        """Send the snapshots since the last ones, in as many frames as it takes and the client has confirmed."""
        page, shape = held.node.page, held.node.shape
        most, head = max(1, BATCH_BYTES // shape.slot_size), page.head
        frames = link.WINDOW - held.ahead
        first = max(held.cursor + 1, head - shape.slots + 2, head + 1 - frames * most)
        woken, held.woken = held.woken, False
        while session.held.get(held.handle) is held:
            last = min(head, first + most - 1)
            news = page.between(first, last)
            held.cursor, held.ahead = last, held.ahead + 1
            if news and as_of_ns(news[-shape.slot_size :]) >= held.owed_ns:
                held.owed_ns = 0
            alive_ns, driver, daemon, reason = condition
            count = len(news) // shape.slot_size
            update = Update(alive_ns, driver, daemon, reason, woken and last == head, count, news)
            self._send(session, Down.UPDATE, held.handle, update.packed())
            first = last + 1
            if first > head:
                return

    def _feed_journals(self, session: Session) -> None:
        """Send what has been noted since, to a client that keeps up."""
        for followed in list(session.followed.values()):
            if followed.ahead < link.WINDOW and (events := followed.journal.read(JOURNAL_BYTES)):
                followed.ahead += 1
                self._send(session, Down.EVENTS, followed.channel, pack_events(events))

    # --- ends ------------------------------------------------------------------------------------

    def allow(self, keys: Collection[Principal]) -> None:
        """End the sessions of keys that are not allowed any more, or are now other keys or in other groups."""
        for session in list(self.sessions.values()):
            if session.who not in keys:
                text = f"key {session.who.name} has been revoked, or replaced, or has other groups now"
                self.end(session, errno.EACCES, text)

    def end(self, session: Session, errno_: int, text: str) -> None:
        """End a session and say why; what it held halts."""
        self._outside.log("warning", "session ended", peer=str(session), why=text)
        self._forget(session)  # first of all
        self._tell_end(session, errno_, text)

    def _tell_end(self, session: Session, errno_: int, text: str) -> None:
        frame = link.pack(Down.END, errno_, 0, self._now(), text.encode()[:1024])
        self._outside.send(session.peer, frame)

    def _forget(self, session: Session) -> None:
        if self.sessions.pop(session.peer, None) is not None:
            for held in session.held.values():
                held.node.close()
            session.held.clear()
            for followed in session.followed.values():
                followed.journal.close()
            session.followed.clear()
            if session.line is not None:
                session.line.close()

    def _send(
        self, session: Session, kind: int, channel: int = 0, body: bytes = b"", now_ns: int | None = None
    ) -> None:
        now_ns = self._now() if now_ns is None else now_ns
        session.sent_ns = now_ns
        if not self._outside.send(session.peer, link.pack(kind, channel, 0, now_ns, body)):
            if session.peer in self.sessions:
                self._outside.log("info", "session lost", peer=str(session))
            self._forget(session)
