"""The usual write of a client, served by steps: taken off its socket, judged, acknowledged, and kept for the bank; and
what a gateway says ahead of one: how old the word of its client is.

What is not the plain case stays in the socket, untouched, for the loop (attachments.py): it is the only one that
refuses. A write that is kept here is worked in by the loop before anything else happens to the bank, the next tick too,
unless that follows at once.
"""

from __future__ import annotations

from typing import Final

from sioms.motion.plain_step import SIZE, Plain, admits
from sioms.native.language import Bytes, Integers, Record, step
from sioms.native.system import (
    changed_ns,
    clock_ns,
    drop_packet,
    first_word_of,
    give_way,
    look_at_packet,
    send_packet,
    unread,
)
from sioms.protocol.flags import WriteFlag
from sioms.protocol.messages import HandleVerb

MOST_WRITERS: Final = 16
MOST_KEPT: Final = 12
"""Packets that are kept until the loop has its turn."""
ROOM: Final = 4096
"""Bytes of such a packet at most."""
MOST_BUSY: Final = 2
"""Devices of a process that have such packets. The loop takes 2 to 3 ms for each of them, before its next tick and
before a stop."""
REPLY: Final = 40
REPLACE: Final = int(WriteFlag.REPLACE)
WRITE: Final = int(HandleVerb.WRITE)
HEARD: Final = int(HandleVerb.HEARD)
PASSED: Final = int(HandleVerb.PASSED)

# MessagePack.
FIX: Final = 0x80
NIL: Final = 0xC0
FALSE: Final = 0xC2
BYTES_8: Final = 0xC4
BYTES_16: Final = 0xC5
DOUBLE: Final = 0xCB
UINT_8: Final = 0xCC
UINT_64: Final = 0xCF
NOTICE: Final = 0x93
LONG_NOTICE: Final = 0x94
PARTS: Final = 0x95
ANSWER: Final = 0x96
INFINITE: Final = 0x7FF
MOST_NUMBER: Final = 1 << 53


class StopFile(Record):
    """The stop-request ``file``, if it is ``there``, of which ``word`` and ``changed`` have been seen."""

    there: int
    file: int
    word: int
    changed: int


class Desk(Record):
    """Where the writes of clients come in.

    ``count`` writers may be served by steps, with their sockets ``fds``, and the bank axes of each, ``known`` of
    ``axes`` from ``first`` on. A write comes behind a ``request`` to stop.

    ``heard``: the instant that the newest Heard of each writer tells, never one that has yet to come; 0: none came.
    ``reset``: when what each has was reset last [ns]; what a gateway says of before that is the loop's.

    A tick that comes less than ``grace_ns`` behind the first packet that is kept may come before it; one that comes
    less than ``patience_ns`` behind it, while a client has yet to read an answer.

    ``busy``: of how many devices of the process packets are kept. Where there are MOST_BUSY, what is written to others
    waits for its turn, and its device ticks on.

    ``kept`` packets lie in ``packets``, each in ROOM bytes, from ``start`` on, where a gateway has put something ahead,
    with its ``size``, its ``writer``, when it ``came`` and took ``effect``, how long serving it ``took`` [ns], and
    whether its answer could be ``sent``; they hold ``waiting`` commands. ``at`` and ``records`` are the place in, and
    the bytes of, the packet that is looked at.
    """

    plain: Plain
    count: int
    fds: Integers
    first: Integers
    known: Integers
    axes: Integers
    heard: Integers
    reset: Integers
    request: StopFile
    gives_way: int
    grace_ns: int
    patience_ns: int
    packets: Bytes
    busy: Integers
    kept: int
    start: Integers
    size: Integers
    writer: Integers
    came: Integers
    effect: Integers
    took: Integers
    sent: Integers
    waiting: int
    number: int
    replace: int
    at: int
    records: int
    reply: Bytes


@step
def is_requested(f: StopFile) -> int:
    """Return whether somebody has asked for a stop by the file."""
    return f.there and (first_word_of(f.file) != f.word or changed_ns(f.file) != f.changed)


@step
def take_number(d: Desk, end: int) -> int:
    """Take an unsigned integer at ``at``, which moves behind it; -1: there is none."""
    if d.at >= end:
        return -1
    kind = d.packets[d.at]
    d.at += 1
    if kind < FIX:
        return kind
    if kind < UINT_8 or kind > UINT_64:
        return -1
    left = 1 << (kind - UINT_8)
    if d.at + left > end:
        return -1
    value = 0
    if left == 8 and d.packets[d.at] >= FIX:
        return -1
    while left:
        value = (value << 8) | d.packets[d.at]
        d.at += 1
        left -= 1
    return value


@step
def pass_seconds(d: Desk, end: int) -> int:
    """Pass a time-out at ``at``: none, a small whole number or a double; return 0 when it is something else."""
    if d.at >= end:
        return 0
    kind = d.packets[d.at]
    d.at += 1
    if kind == NIL or kind < FIX:
        return 1
    if kind != DOUBLE or d.at + 8 > end:
        return 0
    exponent = ((d.packets[d.at] & 0x7F) << 4) | (d.packets[d.at + 1] >> 4)
    d.at += 8
    return exponent != INFINITE


@step
def read_bytes(d: Desk, end: int) -> int:
    """Read the head of bytes at ``at`` that end at ``end``, which moves behind it; return 0 when it is none."""
    if d.at + 3 > end:
        return 0
    kind = d.packets[d.at]
    size = d.packets[d.at + 1]
    d.at += 2
    if kind == BYTES_16:
        size = (size << 8) | d.packets[d.at]
        d.at += 1
    elif kind != BYTES_8:
        return 0
    return size == end - d.at


@step
def read_write(d: Desk, end: int) -> int:
    """Read a packet at ``at``, up to ``end``, as a write; return 0 when it is something else, or written otherwise."""
    if end - d.at < 8 or d.packets[d.at] != PARTS or d.packets[d.at + 1] != WRITE:
        return 0
    d.at += 2
    d.number = take_number(d, end)
    if d.number < 1 or d.number >= MOST_NUMBER or d.at >= end or d.packets[d.at] >= FIX:
        return 0
    d.replace = d.packets[d.at] & REPLACE
    d.at += 1
    if not pass_seconds(d, end) or not read_bytes(d, end):
        return 0
    d.records = end - d.at
    return 1


@step
def read_heard(d: Desk, end: int) -> int:
    """Read a packet at ``at``, up to ``end``, as a Heard; return the instant that it tells, 0: it is something else."""
    if end - d.at < 4 or d.packets[d.at] != NOTICE or d.packets[d.at + 1] != HEARD or d.packets[d.at + 2]:
        return 0
    d.at += 3
    at_ns = take_number(d, end)
    return at_ns if at_ns > 0 and d.at == end else 0


@step
def read_passed(d: Desk, end: int) -> int:
    """Read a packet at ``at``, up to ``end``, as a Passed, whose own packet is at ``at`` then; return the instant that
    it tells, 0: it is something else.
    """
    if end - d.at < 4 or d.packets[d.at] != LONG_NOTICE or d.packets[d.at + 1] != PASSED or d.packets[d.at + 2]:
        return 0
    d.at += 3
    at_ns = take_number(d, end)
    return at_ns if at_ns > 0 and read_bytes(d, end) else 0


@step
def put_number(d: Desk, at: int, value: int) -> int:
    """Write a number from 0 into the reply; return where it ends."""
    if value < FIX:
        d.reply[at] = value
        return at + 1
    kind = UINT_64
    size = 8
    if value < 1 << 8:
        kind = UINT_8
        size = 1
    elif value < 1 << 16:
        kind = UINT_8 + 1
        size = 2
    elif value < 1 << 32:
        kind = UINT_8 + 2
        size = 4
    d.reply[at] = kind
    for i in range(size):
        d.reply[at + 1 + i] = (value >> (8 * (size - 1 - i))) & 255
    return at + 1 + size


@step
def put_reply(d: Desk, tick: int, effect_ns: int) -> int:
    """Make the reply, as ``messages.reply`` does; return its size."""
    d.reply[0] = ANSWER
    d.reply[1] = 0
    at = put_number(d, 2, d.number)
    d.reply[at] = 0
    at = put_number(d, at + 1, tick)
    d.reply[at] = FALSE
    return put_number(d, at + 1, effect_ns)


@step
def writer_of(d: Desk, fd: int) -> int:
    """Return which writer has a socket; -1: none whose writes may be served by steps."""
    for i in range(d.count):
        if d.fds[i] == fd:
            return i
    return -1


@step
def is_unread(d: Desk) -> int:
    """Return whether a client has yet to read the answer to a packet that is kept."""
    for k in range(d.kept):
        if unread(d.fds[d.writer[k]]):
            return 1
    return 0


@step
def counted(d: Desk) -> int:
    """Return how many records there are in what has been read; 0: they are not whole."""
    count = 0
    left = d.records
    while left >= SIZE:
        left -= SIZE
        count += 1
    return 0 if left else count


@step
def note_word(d: Desk, who: int, heard_ns: int, came_ns: int) -> int:
    """Note when a client said something, as a gateway tells; 0: it does not."""
    d.heard[who] = max(d.heard[who], min(heard_ns, came_ns))
    return 0


@step
def serve_packet(d: Desk, who: int, tick: int) -> int:
    """Serve the next packet of a writer; return 0 when all is done, 1 when it, or its answer, is the loop's."""
    if d.kept >= MOST_KEPT:
        return 1
    came_ns = clock_ns()
    if is_requested(d.request):
        return 1
    begin = d.kept * ROOM
    size = look_at_packet(d.fds[who], d.packets, begin, ROOM)
    if size <= 0 or size > ROOM:
        return 1
    d.at = begin
    heard_ns = read_heard(d, begin + size)
    if heard_ns:
        if heard_ns < d.reset[who]:
            return 1
        drop_packet(d.fds[who])
        note_word(d, who, heard_ns, came_ns)
        return 0
    if not d.kept and d.busy[0] >= MOST_BUSY:
        return 1
    d.at = begin
    heard_ns = read_passed(d, begin + size)
    if not heard_ns:
        d.at = begin
    elif heard_ns < d.reset[who]:
        return 1
    start = d.at
    if not read_write(d, begin + size):
        return 1
    count = counted(d)
    if not admits(d.plain, d.packets, d.at, count, d.axes, d.first[who], d.known[who], d.waiting, d.replace):
        return 1
    drop_packet(d.fds[who])
    kept = d.kept
    d.effect[kept] = clock_ns()
    sent = send_packet(d.fds[who], d.reply, put_reply(d, tick, d.effect[kept]))
    note_word(d, who, heard_ns, came_ns)
    d.start[kept] = start
    d.size[kept] = begin + size - start
    d.writer[kept] = who
    d.came[kept] = came_ns
    d.sent[kept] = sent >= 0
    d.waiting += count
    d.busy[0] += not d.kept
    d.kept += 1
    d.took[kept] = clock_ns() - came_ns
    if d.gives_way:
        give_way()
    return sent < 0
