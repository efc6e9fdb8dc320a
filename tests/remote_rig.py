"""What may fail of a client on another machine, its gateway, and the link between them."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable

import pytest
from daemon_rig import Client, Daemon, jog

import sioms
from sioms.bench.watching import Watch, halting_ns
from sioms.check.remote import Gateway, Relay
from sioms.protocol.link import DEFAULT_LEASE_S

LATE_NS = int((DEFAULT_LEASE_S + 0.020) * 1e9) + 100_000_000
"""Within which whatever fails halts what it held; more than 20 ms on a machine that runs other tests at the same time:
`sioms bench reach` has the figures.
"""


def keeping(lease: float = 0.0) -> str:
    """Return the script of a client that lets an axis run, and keeps its lease."""
    return jog("mod0.xaxis", 0.2, lease) + "while True:\n    node.keepalive(); time.sleep(0.01)\n"


def halts_within_the_lease(
    what: str, gateway: type[Gateway], daemon: Daemon, cell: sioms.Workcell, client: Callable[..., Client]
) -> None:
    """Let one thing fail while a remote client moves an axis: that halts, nothing resumes, and the axis is free.

    Args:
        what: fails: "client killed", "client hung", "gateway killed", "gateway hung", "cut" or "stalled".
        gateway: the kind of gateway.
        daemon: behind it.
        cell: a session on its own machine.
        client: starts a client.
    """
    with gateway(daemon.socket) as gate, Relay(gate.port) as relay, cell.open("mod0.xaxis.readonly") as seen:
        gate.socket = gate.trusted(relay.port)
        victim = client(gate, keeping())
        watch = Watch(seen)
        time.sleep(0.3)
        assert seen.read().commanded_velocity[0] == pytest.approx(0.2), "who is alive keeps its motion"
        begin = time.monotonic_ns()
        hung = {"client hung": victim.pid, "gateway hung": gate.process.pid}.get(what, 0)
        if hung:
            os.kill(hung, signal.SIGSTOP)
        elif what == "client killed":
            victim.kill()
        elif what == "gateway killed":
            gate.process.kill()
        elif what == "cut":
            relay.cut()
        else:
            relay.stalled = True
        try:
            assert halting_ns(watch, begin) - begin < LATE_NS
            if what == "stalled":
                relay.stalled = False  # what was held back comes now, in a burst
            if hung:
                os.kill(hung, signal.SIGCONT)
            time.sleep(0.3)
            assert not seen.read().in_motion[0], "nothing resumes"
            with cell.open("mod0.xaxis", "rw", timeout=2.0):
                pass
            if what != "client killed":
                victim.wait_line("Error")
        finally:
            if hung:
                os.kill(hung, signal.SIGCONT)
