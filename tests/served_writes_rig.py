"""Packets of a writer, ordinary and hostile, served by steps: what became of each, one line a packet.

Run as a program it does so with a seed, so that both forms of the steps can be compared.
"""

from __future__ import annotations

import os
import random
import socket
import struct
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

from sioms.motion import AxisSettings, plain_step
from sioms.motion.commands import RULES
from sioms.motion.plain_step import plain_of
from sioms.motion.queue import CommandQueue
from sioms.native.system import changed_ns
from sioms.protocol.flags import AxisStatus, ControlMode, NodeClass
from sioms.protocol.messages import encode
from sioms.protocol.records import AXIS_WRITE, WRITE
from sioms.sdk.serve_step import MOST_KEPT, MOST_WRITERS, REPLY, ROOM, Desk, StopFile, serve_packet

AXES = [2, 0, 3]
"""Bank axes of the node; axis 1 is another client's."""
TICK = 70_000
COLUMNS = list(WRITE[NodeClass.AXIS].values())
QUANTITIES = [int(m) for m in (ControlMode.POSITION, ControlMode.VELOCITY, ControlMode.FORCE, ControlMode.JERK)]


def queue_of(chance: random.Random) -> CommandQueue:
    """Return the buffers of four axes with limits, one of which may be latched, require a reference, or be full."""
    whole = sum(ControlMode)
    settings = [
        AxisSettings(
            f"a{i}", velocity_max=0.5, acceleration_max=5.0, force_max=60.0, jerk_max=None if i else 100.0,
            position_min=None if i == 3 else -0.4, position_max=None if i == 3 else 0.4,
            modes=ControlMode(whole & ~int(ControlMode.JERK)) if i == 2 else ControlMode(whole),
        )
        for i in range(4)
    ]  # fmt: skip
    queue = CommandQueue(settings, _NoMarkers(), 8)
    if chance.random() < 0.2:
        bits = (AxisStatus.FAULT, AxisStatus.EMERGENCY_STOP, AxisStatus.HOMING, AxisStatus.POSITION_LOST)
        queue.latched[chance.randrange(4)] = int(chance.choice(bits))
    if chance.random() < 0.1:
        queue.home_required[chance.randrange(4)] = True
        queue.latched[chance.randrange(4)] |= int(AxisStatus.HOMED)
    if chance.random() < 0.3:
        queue.waiting[chance.randrange(4)] = chance.randrange(4, 9)
    return queue


class _NoMarkers:
    def __getattr__(self, name: str) -> Any:
        raise AssertionError("no plain record has a marker")


def record(chance: random.Random) -> bytes:
    """Return a record that is often plain and good, and often by a hair not."""
    odds = chance.choice([0.0, 0.0, 0.3])
    mode = chance.choice(QUANTITIES)
    for rule in RULES:
        if chance.random() < 0.1 * odds:
            mode |= rule.flag
    if chance.random() < 0.2 * odds:
        mode ^= 1 << chance.randrange(32)
    values: list[Any] = []
    for column in COLUMNS:
        if column.code in "iIq":
            bits = {"i": 31, "I": 32, "q": 63}[column.code]
            values.append(chance.randrange(1 << bits) if chance.random() < 0.1 else 0)
        else:
            near = chance.choice([0.0, 0.1, 0.4, 0.5, 5.0, 60.0, 100.0]) * chance.choice([1.0, -1.0])
            odd = [near, np.nextafter(near, 9e9), np.nextafter(near, -9e9), np.inf, -np.inf, np.nan, 1.7e308]
            values.append(float(chance.choice(odd)) if chance.random() < odds else min(abs(near), 0.1))
    values[0] = chance.choice([0, 1, 2, 3, -1, 2**31 - 1]) if chance.random() < odds else chance.randrange(3)
    values[1] = mode
    return AXIS_WRITE.pack(*values)


def packets(chance: random.Random) -> Iterator[tuple[bytes, bool]]:
    """Yield packets for ever, and whether each is packed as clients do."""
    while True:
        count = chance.choice([1, 1, 1, 2, 3, 8, 9, 16, 17, 0])
        data = b"".join(record(chance) for _ in range(count))
        number = chance.choice([1, 127, 128, 255, 256, 65535, 65536, 2**32 - 1, 2**32, 2**53 - 1])
        number = chance.choice([number] * 8 + [2**53, 0])
        seconds = chance.choice([*[0.0] * 12, *[None, 0, 3, 2.5] * 2, float("nan"), float("inf"), -1.0, 300, -1])  # type: ignore[list-item]
        flags = chance.choice([*[0, 1] * 6, 2, 3, 127, 128, -1])
        packet = encode(chance.choice([*[1] * 12, 2, 4]), number, flags, seconds, data)
        if chance.random() < 0.1:
            packet = encode(chance.choice([7, 7, 7, 3]), chance.choice([0, 0, 1]), chance.choice([0, 1, number, -1]))
        if chance.random() < 0.2:
            at_ns = chance.choice([1, 127, 128, number, 2**40, 2**62, 0, -1])
            packet = encode(chance.choice([8, 8, 8, 8, 7]), chance.choice([0, 0, 0, 0, 1]), at_ns, packet)
        usual = seconds != float("inf") and (type(seconds) is not int or 0 <= seconds < 128)
        match chance.randrange(12):
            case 0:
                packet = packet[: chance.randrange(len(packet))]
            case 1:
                packet += chance.randbytes(chance.randrange(1, 9))
            case 2:
                at = chance.randrange(min(len(packet), 24))
                packet = packet[:at] + chance.randbytes(1) + packet[at + 1 :]
            case 3:
                packet = chance.randbytes(chance.randrange(200))
            case 4:  # the same number, longer than it has to be
                packet = packet[:2] + struct.pack(">BQ", 0xCF, number) + encode(flags, seconds, data)[1:]
            case _:
                yield packet, usual and 0 <= flags < 128
                continue
        yield packet, False


class Served:
    """A desk with one writer, on a real socket.

    Args:
        queue: the buffers of its axes.
        request: a file that nobody writes to.
        busy: of how many devices of the process writes are kept; None: of this one only.
    """

    def __init__(self, queue: CommandQueue, request: int, busy: Any = None) -> None:
        self.ours, self.theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for end in (self.ours, self.theirs):
            end.setblocking(False)

        def row(*values: int, count: int = MOST_KEPT) -> Any:
            return np.array([*values, *[0] * (count - len(values))], dtype=np.int64)

        self.desk = Desk(
            plain=plain_of(queue), count=1, fds=row(self.theirs.fileno(), count=MOST_WRITERS),
            first=row(1, count=MOST_WRITERS), known=row(len(AXES), count=MOST_WRITERS), axes=row(1, *AXES, count=4),
            heard=row(count=MOST_WRITERS), reset=row(count=MOST_WRITERS),
            request=StopFile(there=1, file=request, word=0, changed=changed_ns(request)), gives_way=0,
            packets=np.zeros(MOST_KEPT * ROOM, dtype=np.uint8), busy=row(count=1) if busy is None else busy,
            kept=0, start=row(), size=row(), writer=row(),
            came=row(), effect=row(), took=row(), sent=row(), waiting=0, number=0, replace=0, at=0, records=0,
            grace_ns=0, patience_ns=0,
            reply=np.zeros(REPLY, dtype=np.uint8),
        )  # fmt: skip

    def serve(self, packet: bytes) -> bool:
        """Have steps serve a packet; return whether they have."""
        self.ours.send(packet)
        return serve_packet(self.desk, 0, TICK) == 0

    def left(self) -> bytes:
        """Return what is still there to be read."""
        try:
            return self.theirs.recv(1 << 17)
        except BlockingIOError:
            return b""

    def answer(self) -> bytes:
        """Return what the client has got."""
        try:
            return self.ours.recv(1 << 17)
        except BlockingIOError:
            return b""

    def close(self) -> None:
        """Close the sockets."""
        self.ours.close()
        self.theirs.close()


def main(seed: int, count: int) -> None:
    """Print what became of so many packets, the instants left out."""

    chance, request = random.Random(seed), os.memfd_create("request")
    print("python" if plain_step.admits.__module__ == plain_step.__name__ else "compiled")
    made = packets(chance)
    for _ in range(count):
        served = Served(queue_of(chance), request)
        for _ in range(chance.randrange(1, 7)):
            packet, _ = next(made)
            if packet:
                done = served.serve(packet)
                print(done, served.left().hex(), served.answer()[:-9].hex(), served.desk.kept, served.desk.waiting)
        served.close()


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
