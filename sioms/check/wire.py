"""The wire as a process: ``python -m sioms.check.wire --kind serial --device PORT --link PATH``.

Stands between a driver and its device, carries characters at the line's speed in both directions, bends the
device's messages, and keeps what went over it. It says ``ready PORT``, the port for the driver, and obeys lines on
standard input, each answered by ``ok``, ``ok JSON`` or ``error`` with a sentence:

    fault {"flip":0.1}      bend from now on (keys of Faults); fault {} stops bending
    babble RATE SECONDS     random bytes to the driver, so many a second
    unplug, plug            pull the cable, put it back
    log [COUNT]             the last messages: [time ns, direction, hex, what was done to it]
    totals                  messages and bytes of both directions, messages bent, time that the device took to answer
    [ns]
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import json
import os
import signal
import sys
import time
from collections import deque
from pathlib import Path
from typing import Any

from sioms.descriptors import readable
from sioms.simulation.control import obey

from .bending import Bender, Faults, Piece, Way
from .ends import DATAGRAMS, KINDS, TcpHost, make_ends

KEPT = 4000
"""Messages that the log holds."""
BABBLE_NS = 5_000_000
LONGEST_S = 0.05
_PR_SET_TIMERSLACK = 29


class Wire:
    """Both ends, both ways and the log.

    Args:
        kind: one of KINDS.
        device_port: of the device.
        link: path of the driver's serial port.
        character_ns: time a character takes on the line [ns], 0 for none.
        seed: of the random numbers.

    Attributes:
        device_ns: time between requests that reached the device and what it said next, in all [ns].
    """

    def __init__(self, kind: str, device_port: str, link: Path, character_ns: float, seed: int) -> None:
        self.host, self.device = make_ends(kind, device_port, link)
        self._whole = kind in DATAGRAMS
        self.to_device = Way(character_ns, not self._whole)
        self.to_host = Way(character_ns, not self._whole)
        self.bender = Bender(seed)
        self.log: deque[tuple[int, str, bytes, str]] = deque(maxlen=KEPT)
        self.device_ns = 0
        self._asked_ns = 0
        self._babble = (0, 0, 0.0)  # until [ns], next [ns], bytes a turn

    def handlers(self) -> dict[str, Any]:
        """Return the commands on standard input."""
        return {
            "fault": self.fault, "babble": self.babble, "unplug": self.unplug, "plug": self.host.plug,
            "log": self.last, "totals": self.totals,
        }  # fmt: skip

    def fault(self, keys: str = "{}") -> None:
        """Bend by these faults; datagrams are not chopped."""
        wanted = json.loads(keys)
        self.bender.set(Faults(**({**wanted, "chop": ""} if self._whole else wanted)))

    def babble(self, rate: str, seconds: str) -> None:
        """Say random bytes to the driver."""
        now_ns = time.monotonic_ns()
        self._babble = (now_ns + int(float(seconds) * 1e9), now_ns, float(rate) * BABBLE_NS / 1e9)

    def unplug(self) -> None:
        """Pull the cable; what is under way is lost."""
        self.host.unplug()
        self.to_host.clear()
        self.to_device.clear()

    def last(self, count: str = "20") -> list[list[Any]]:
        """Return the last messages."""
        entries = list(self.log)[-int(count) :]
        return [[t_ns, way, data.hex(), note] for t_ns, way, data, note in entries]

    def totals(self) -> dict[str, int]:
        """Return what was carried."""
        return {
            "requests": self.to_device.messages,
            "request_bytes": self.to_device.characters,
            "replies": self.to_host.messages,
            "reply_bytes": self.to_host.characters,
            "bent": self.bender.hits,
            "device_ns": self.device_ns,
        }

    def turn(self) -> None:
        """Carry what is due, then wait for the next thing and take it."""
        now_ns = time.monotonic_ns()
        self._babble_on(now_ns)
        for data in self.to_device.due(now_ns):
            self.device.write(data)
        for data in self.to_host.due(now_ns):
            self.host.write(data)
        until_ns = [t for t in (self.to_device.next_ns, self.to_host.next_ns, self._babble[1] or None) if t]
        wait_s = min([LONGEST_S, *(max(0, t - now_ns) / 1e9 for t in until_ns)])
        hosts, devices = self.host.fds(), self.device.fds()
        for fd in readable([0, *hosts, *devices], wait_s):
            if fd in hosts:
                self._from_host(fd)
            elif fd in devices:
                self._from_device(fd)
            elif fd == 0:
                self._obey()

    def _from_host(self, fd: int) -> None:
        data = self.host.read(fd)
        if data is None and isinstance(self.host, TcpHost):
            self.host.hang_up()
        if not data:
            return
        now_ns = time.monotonic_ns()
        reaches, note = self.bender.requested(data)
        self.log.append((now_ns, ">", data, note))
        if reaches:  # with its last character: in how many pieces a request comes says nothing of who sent it
            self._asked_ns = self.to_device.send([Piece(reaches, at_once=True)], now_ns)

    def _from_device(self, fd: int) -> None:
        data = self.device.read(fd)
        if data is None and isinstance(self.host, TcpHost):
            self.host.hang_up()
        if not data:
            return
        now_ns = time.monotonic_ns()
        if self._asked_ns:
            self.device_ns, self._asked_ns = self.device_ns + max(0, now_ns - self._asked_ns), 0
        pieces, note = self.bender.bend(data)
        at_ns = self.to_host.send(pieces, now_ns)
        if note and pieces:
            note += f"; the device sent {data.hex(' ')}"
        self.log.append((at_ns, "<", b"".join(piece.data for piece in pieces) if pieces else data, note))

    def _babble_on(self, now_ns: int) -> None:
        until_ns, next_ns, size = self._babble
        if not next_ns or now_ns < next_ns:
            return
        if now_ns >= until_ns:
            self._babble = (0, 0, 0.0)
            return
        data = self.bender.chance.randbytes(max(1, round(size)))
        self._babble = (until_ns, next_ns + BABBLE_NS, size)
        self.log.append((self.to_host.send([Piece(data)], now_ns), "<", data, "random bytes"))

    def _obey(self) -> None:
        line = sys.stdin.readline()
        if not line:
            raise KeyboardInterrupt
        print(obey(line, self.handlers()), flush=True)


def main() -> int:
    """Serve until standard input ends."""
    parser = argparse.ArgumentParser(description="wire between a driver and its device")
    parser.add_argument("--kind", choices=KINDS, required=True)
    parser.add_argument("--device", required=True, metavar="PORT")
    parser.add_argument("--link", type=Path, default=Path("/nonexistent"), help="path of the driver's serial port")
    parser.add_argument("--baud", type=float, default=0.0, help="speed of the line; 0 takes no time")
    parser.add_argument("--bits", type=int, default=10, help="bits of a character")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    ctypes.CDLL(None).prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    with contextlib.suppress(OSError):  # a real line waits for nobody
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(20))
    character_ns = options.bits / options.baud * 1e9 if options.baud else 0.0
    wire = Wire(options.kind, options.device, options.link, character_ns, options.seed)
    print(f"ready {wire.host.name}", flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            wire.turn()
    wire.unplug()
    return 0


if __name__ == "__main__":
    sys.exit(main())
