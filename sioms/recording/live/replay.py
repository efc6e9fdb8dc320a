"""Serves a recording as a workcell of read-only nodes: the daemon's protocol, spoken by a process that has no devices.

Pages are filled with the snapshots as they were recorded, so a value is reproduced bit for bit; stamps are moved to the
present, and stretched by the rate.
"""

from __future__ import annotations

import errno
import fcntl
import mmap
import os
import select
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from sioms.protocol import verbs
from sioms.protocol.flags import PROTOCOL_VERSION, READONLY, Access, NodeClass, PageState, Right
from sioms.protocol.journal import HEADER, JOURNAL_SIZE, JournalWriter
from sioms.protocol.messages import MAX_PACKET, MalformedMessage, refusal, reply
from sioms.protocol.page import PageWriter, page_size
from sioms.recording import mcap
from sioms.recording.messages import Event
from sioms.recording.notes import noted
from sioms.recording.reader import NodeRecord, Recording

SLOTS = 8192
LEASE_NS = 5_000_000_000
"""A replay that hangs is stale after so long."""
_SEALS = fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | 0x0010 | fcntl.F_SEAL_SEAL  # 0x10: F_SEAL_FUTURE_WRITE
_BACKLOG = 64


@dataclass(slots=True, eq=False)
class Served:
    """A node that is served.

    Attributes:
        record: what it is in the recording.
        page: where it is published; fd: of its memory.
        readers: writing ends of the pipes of who subscribed, with how often and how long until then.
    """

    record: NodeRecord
    page: PageWriter
    fd: int
    readers: dict[int, list[int]] = field(default_factory=dict)

    def publish(self, row: Any, stamp_ns: int) -> None:
        """Publish a snapshot of the recording."""
        self.page.alive(time.monotonic_ns())
        self.page.publish(row[4:].view("u1").data, stamp_ns, int(row[2]), stamp_ns)
        for pipe, counts in self.readers.items():
            counts[1] -= 1
            if counts[1] <= 0:
                counts[1] = max(counts[0], 1)
                try:
                    os.write(pipe, b"\1")
                except OSError:
                    continue  # full, or its reader has gone


class Journal:
    """A journal that is served.

    Attributes:
        fd: of its memory; writer: notes in it.
    """

    def __init__(self) -> None:
        self.fd = os.memfd_create("sioms:replay:journal", os.MFD_CLOEXEC)
        os.ftruncate(self.fd, HEADER + JOURNAL_SIZE)
        self.writer = JournalWriter(memoryview(mmap.mmap(self.fd, HEADER + JOURNAL_SIZE)))


@dataclass(slots=True, eq=False)
class Peer:
    """A connection: a session, or the handle of a node."""

    sock: socket.socket
    serve: Callable[[Peer, int, verbs.Message], None]
    vocabulary: verbs.Socket
    node: Served | None = None
    pipe: int = -1
    handles: dict[int, Peer] = field(default_factory=dict)


class Replay:
    """A recording that is served.

    Args:
        recording: what is served.
        path: of the socket.
        rate: how much faster than it was recorded.

    Raises:
        OSError: the recording holds no nodes, or the socket cannot be made.
    """

    def __init__(self, recording: Recording, path: str, rate: float = 1.0) -> None:
        if not recording.nodes:
            raise OSError(errno.EINVAL, f"replay {recording.path}: no nodes are recorded in it")
        self._recording, self._rate = recording, rate
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listener.bind(path)
        self._listener.listen(_BACKLOG)
        self.path = path
        self._epoll = select.epoll()
        self._epoll.register(self._listener.fileno(), select.EPOLLIN)
        self._peers: dict[int, Peer] = {}
        self._nodes = {name: self._serve_node(record) for name, record in recording.nodes.items()}
        self._journals: dict[str, Journal] = {"daemon": Journal()}
        for record in recording.nodes.values():
            self._serve_journal(record.info.device)
        self._leash = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        self._numbers = 0
        self.opened = False
        self.published = 0

    def _serve_node(self, record: NodeRecord) -> Served:
        info = record.info
        info.read_only = True
        size = page_size(info.node_class, len(info.channels), SLOTS)
        fd = os.memfd_create(f"sioms:replay:{info.name}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.ftruncate(fd, size)
        memory = memoryview(mmap.mmap(fd, size))
        device = int.from_bytes(os.urandom(8), "little") or 1
        page = PageWriter(memory, info.node_class, len(info.channels), SLOTS, LEASE_NS, 1, device)
        page.alive(time.monotonic_ns())
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, _SEALS)
        return Served(record, page, fd)

    def _serve_journal(self, source: str) -> Journal:
        return self._journals.setdefault(source, Journal())

    # --- time ------------------------------------------------------------------------------------

    def _all(self) -> Iterator[tuple[int, Served | None, Any]]:
        """Yield snapshots with their nodes, and events, in the order of their times, within each piece of the file."""
        by_channel = {served.record.channel: served for served in self._nodes.values()}
        events = self._recording.events_channel
        for piece in self._recording.pieces([*by_channel, events]):
            batch: list[tuple[int, Served | None, Any]] = []
            for stamp_ns, data in piece.messages(events):
                with suppress(mcap.Damaged):  # the reader of events tells of it
                    batch.append((stamp_ns, None, Event.of(data)))
            for channel, served in by_channel.items():
                when, rows = piece.rows(channel, 4 + served.record.size)
                if len(rows):
                    words = rows[:, 4:].copy().view("<u8")
                    batch += [(stamp_ns, served, row) for stamp_ns, row in zip(when.tolist(), words, strict=True)]
            batch.sort(key=lambda each: each[0])
            yield from batch

    def run(self, until: Callable[[], bool], *, wait: bool = True) -> None:
        """Serve the recording once.

        Args:
            until: whether it shall end before its end.
            wait: do not begin before a node is opened.
        """
        begin_ns = zero_ns = 0
        before: list[tuple[int, Event]] = []
        for stamp_ns, served, row in self._all():
            if not begin_ns:
                zero_ns = zero_ns or stamp_ns
                if served is None:
                    before.append((stamp_ns, row))
                    continue
                self._tell(served, row, time.monotonic_ns())
                for each in self._nodes.values():
                    each.page.set_state(PageState.GOOD)
                while wait and not self.opened and not until():
                    self._alive()
                    self.look(0.1)
                begin_ns = time.monotonic_ns()
                for at_ns, event in before:
                    self._tell(None, event, begin_ns + int((at_ns - zero_ns) / self._rate))
                continue
            due_ns = begin_ns + int((stamp_ns - zero_ns) / self._rate)
            while (left_ns := due_ns - time.monotonic_ns()) > 0 and not until():
                self._alive()
                self.look(min(left_ns / 1e9, 0.1))
            if until():
                return
            self._tell(served, row, due_ns)
            if self.published % 64 == 0:
                self.look(0.0)

    def _tell(self, served: Served | None, row: Any, due_ns: int) -> None:
        """Publish a snapshot, or note an event."""
        self.published += served is not None
        if served is not None:
            served.publish(row, due_ns)
        elif (note := noted(row)) is not None:
            source = "daemon" if row.source == "recorder" else row.source
            self._serve_journal(source).writer.note(note[0], due_ns, *note[1])

    def _alive(self) -> None:
        for served in self._nodes.values():
            served.page.alive(time.monotonic_ns())

    def close(self) -> None:
        """Tell readers that this is the end."""
        for served in self._nodes.values():
            served.page.set_state(PageState.CLOSED, "the recording has ended")
        for peer in list(self._peers.values()):
            self._drop(peer)
        for fd in (*self._leash, *(journal.fd for journal in self._journals.values())):
            os.close(fd)
        self._listener.close()
        os.unlink(self.path)

    # --- clients ---------------------------------------------------------------------------------

    def look(self, seconds: float) -> None:
        """Serve clients for some time [s]."""
        for fd, _ in self._epoll.poll(seconds):
            if fd == self._listener.fileno():
                self._add(Peer(self._listener.accept()[0], self._session, verbs.FROM_CLIENT))
            elif peer := self._peers.get(fd):
                self._receive(peer)

    def _add(self, peer: Peer) -> None:
        peer.sock.setblocking(False)
        self._peers[peer.sock.fileno()] = peer
        self._epoll.register(peer.sock.fileno(), select.EPOLLIN)

    def _drop(self, peer: Peer) -> None:
        if self._peers.pop(peer.sock.fileno(), None) is None:
            return
        self._epoll.unregister(peer.sock.fileno())
        peer.sock.close()
        if peer.node is not None:
            peer.node.readers.pop(peer.pipe, None)
            os.close(peer.pipe)
        for handle in peer.handles.values():
            self._drop(handle)

    def _receive(self, peer: Peer) -> None:
        try:
            packet = peer.sock.recv(MAX_PACKET + 1)
            if packet:
                number, message = verbs.take(packet, peer.vocabulary)
                peer.serve(peer, number, message)
                return
        except BlockingIOError:
            return
        except (OSError, MalformedMessage):
            pass
        self._drop(peer)

    def _session(self, peer: Peer, number: int, message: verbs.Message) -> None:
        """Serve a request of a client to the daemon."""
        value: Any = None
        match message:
            case verbs.Hello():
                value = [PROTOCOL_VERSION, self._recording.about.get("workcell", ""), int(Right.READ)]
            case verbs.List():
                value = [line for served in self._nodes.values() for line in self._lines(served)]
            case verbs.Info(node):
                served, channels = self._find(node)
                if served is None:
                    peer.sock.send(self._unknown(number, node))
                    return
                value = _packed(served.record, node, channels, self._bit(served, node))
            case verbs.Status():
                value = self._status()
            case verbs.Alarms():
                value = []  # their lines of the log are replayed; what is in force now nobody knows
            case verbs.Journal(device):
                self._journal(peer, number, device)
                return
            case verbs.Open():
                self._open(peer, number, message)
                return
            case verbs.Close(handle):
                if handle in peer.handles:
                    self._drop(peer.handles.pop(handle))
            case verbs.Cancel():
                value = False
            case _:
                peer.sock.send(refusal(number, errno.EROFS, _refused(type(message).__name__.lower())))
                return
        peer.sock.send(reply(number, value))

    def _lines(self, served: Served) -> Iterator[list[Any]]:
        """Yield the lines of a node and its parts in the list of nodes."""
        info, bit = served.record.info, served.record.bit
        yield [info.name, int(info.node_class), len(info.channels), True, info.device, "up", "", bit]
        is_port = info.node_class is NodeClass.BINARY
        count = info.channels[0].width if is_port and len(info.channels) == 1 and bit < 0 else 0
        parts = [(f"bit{number}", number) for number in range(count)]
        if not is_port and len(info.channels) > 1:
            parts = [(channel.name, -1) for channel in info.channels]
        for part, number in parts:
            if (name := f"{info.name}.{part}") not in self._nodes:
                yield [name, int(info.node_class), 1, True, info.device, "up", "", number]

    def _bit(self, served: Served, name: str) -> int:
        """Return which bit of a port a node by this name is, -1 for none."""
        name = name.removesuffix(READONLY)
        if name == served.record.info.name:
            return served.record.bit
        part = name.rpartition(".")[2]
        return int(part[3:]) if served.record.info.node_class is NodeClass.BINARY else -1

    def _journal(self, peer: Peer, number: int, device: str) -> None:
        """Serve a journal: what happened, as far as it is recorded, is noted there again."""
        journal = self._journals.get(device or "daemon")
        if journal is None:
            text = f"open the journal of {device}: nothing of it is recorded; there are: {', '.join(self._journals)}"
            peer.sock.send(refusal(number, errno.ENOENT, text))
            return
        fd = os.open(f"/proc/self/fd/{journal.fd}", os.O_RDONLY | os.O_CLOEXEC)
        try:
            socket.send_fds(peer.sock, [reply(number, 1)], [fd, self._leash[0]])
        finally:
            os.close(fd)

    def _find(self, name: str) -> tuple[Served | None, list[int]]:
        """Return a node by its name, that of its companion, or that of one of its channels, and which these are."""
        name = name.removesuffix(READONLY)
        if served := self._nodes.get(name):
            return served, list(range(len(served.record.info.channels)))
        parent, _, channel = name.rpartition(".")
        served = self._nodes.get(parent)
        if served is not None and name in [line[0] for line in self._lines(served)]:
            is_bit = served.record.info.node_class is NodeClass.BINARY
            return served, [0 if is_bit else [each.name for each in served.record.info.channels].index(channel)]
        return None, []

    def _unknown(self, number: int, name: str) -> bytes:
        return refusal(
            number, errno.ENOENT, f"open {name}: it is not in the recording; there are: {', '.join(self._nodes)}"
        )

    def _open(self, peer: Peer, number: int, message: verbs.Open) -> None:
        name, access, _, _ = message
        served, channels = self._find(name)
        if served is None:
            peer.sock.send(self._unknown(number, name))
            return
        if access & Access.WRITE and not name.endswith(READONLY):
            peer.sock.send(refusal(number, errno.EROFS, _refused(f"open {name} for writing")))
            return
        self._numbers += 1
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        readable, wake = os.pipe2(os.O_CLOEXEC | os.O_NONBLOCK)
        handle = Peer(ours, self._handle, verbs.ON_HANDLE, served, wake)
        self._add(handle)
        peer.handles[self._numbers] = handle
        bit = self._bit(served, name)
        value = [self._numbers, _packed(served.record, name, channels, bit), channels, bit, [os.getpid()] * 2]
        with theirs:
            socket.send_fds(peer.sock, [reply(number, value)], [served.fd, readable, theirs.fileno()])
        os.close(readable)
        self.opened = True

    def _handle(self, peer: Peer, number: int, message: verbs.Message) -> None:
        """Serve a request on a handle."""
        assert peer.node is not None
        match message:
            case verbs.Keepalive() | verbs.Heard() | verbs.Part():
                return
            case verbs.Passed(_, packet):
                number, message = verbs.take(packet, verbs.ON_HANDLE)
                if isinstance(message, verbs.Passed):
                    raise MalformedMessage("a packet that is passed on twice")
                self._handle(peer, number, message)
            case verbs.Subscribe(every):
                peer.node.readers.pop(peer.pipe, None)
                if every:
                    peer.node.readers[peer.pipe] = [every, 0]
                peer.sock.send(reply(number))
            case verbs.CancelOnHandle():
                peer.sock.send(reply(number, False))
            case _:
                what = f"{type(message).__name__.lower()} on {peer.node.record.info.name}"
                peer.sock.send(refusal(number, errno.EROFS, _refused(what)))

    def _status(self) -> dict[str, Any]:
        devices = {s.record.info.device: s.record.info for s in self._nodes.values()}
        return {
            "workcell": self._recording.about.get("workcell", ""), "pid": os.getpid(), "stopped_ns": 0,
            "stop_source": "", "node_stops": [], "sessions": [], "holders": [], "reports": [],
            "devices": [
                {"name": name, "driver": info.driver, "state": "up", "pid": os.getpid(), "generation": 1, "reason": "",
                 "link": "good", "link_reason": "", "tick_hz": info.tick_hz, "deaths": 0, "trouble": "", "age_s": 0.0}
                for name, info in devices.items()
            ],
        }  # fmt: skip


def _refused(what: str) -> str:
    return f"{what}: this is a recording that is replayed; it can only be read"


def _packed(record: NodeRecord, name: str, channels: list[int], bit: int) -> list[Any]:
    info = record.info
    chosen = [info.channels[channel].pack() for channel in channels]
    return [
        name, int(info.node_class), True, chosen, bit, info.tick_hz, info.buffer_capacity, info.device,
        info.driver, PROTOCOL_VERSION,
    ]  # fmt: skip
