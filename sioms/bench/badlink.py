"""A relay in a process of its own: its sockets are in no client that is forked meanwhile, so that a cut is one."""

from __future__ import annotations

import os
from typing import Self

from sioms.check.daemon import Daemon
from sioms.check.remote import Relay

LATE_S = 0.4
"""Delay of a late link [s]: longer than any lease of the bench."""
KINDS = ("cut", "stalled", "late", "losing", "doubling")
"""What may be wrong with a link: all connections end; nothing comes; everything comes late; pieces are lost; pieces
come twice.
"""


class BadLink:
    """Passes connections on to a gateway until it is told to do it badly. Use it in a ``with`` block.

    Args:
        daemon: whose clients use it; it ends with it.
        to_port: of the gateway.

    Attributes:
        port: where clients connect.
    """

    def __init__(self, daemon: Daemon, to_port: int) -> None:
        self._daemon = daemon
        mine, said = os.pipe()
        told, self._tell = os.pipe()
        self._pid = daemon.fork(lambda: _relay(to_port, told, said))
        os.close(said)
        os.close(told)
        self._said = os.fdopen(mine)
        self.port = int(self._said.readline())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._daemon.kill(self._pid)
        self._daemon.reap(self._pid)
        os.close(self._tell)
        self._said.close()

    def be(self, kind: str) -> int:
        """Be of a kind, '' for a good link; return since when it is so [ns, CLOCK_MONOTONIC]."""
        os.write(self._tell, f"{kind}\n".encode())
        return int(self._said.readline())


def _relay(to_port: int, told: int, said: int) -> None:
    """Be the process."""
    with Relay(to_port) as relay, os.fdopen(told) as orders:
        os.write(said, f"{relay.port}\n".encode())
        for order in orders:
            kind = order.strip()
            if kind == "cut":
                now_ns = relay.cut()
            else:
                late_s = LATE_S if kind == "late" else 0.0
                now_ns = relay.treat(
                    stalled=kind == "stalled", doubled=kind == "doubling", losing=kind == "losing", delay_s=late_s
                )
            os.write(said, f"{now_ns}\n".encode())
