"""Attacks: what floods by one user cost another.

The victims and the attackers share the machine: attackers take processor time of their own. What is compared are phases
of one run, with and without attackers. Run by root, attackers are another user, which is what shares are counted by.
"""

from __future__ import annotations

import contextlib
import os
import pwd
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

from sioms.check.daemon import CpuTimes, Daemon, wait_for
from sioms.client.command import command
from sioms.protocol.flags import Request
from sioms.protocol.messages import ClientVerb, encode

from .figures import Bar, Figure, Report
from .options import Options
from .watching import HISTORY, Watch, halting_ns
from .workcells import axes, workcell

VICTIMS = ("mod0", "mod1")
LATER_US = {"p50": 100.0, "p99.9": 1000.0}
"""How much later than without attackers ticks may be."""
REQUEST_MS = 20.0
PACE_S = 0.01


def bench_attack(options: Options, report: Report) -> None:
    """Floods beside victims."""
    _floods(options.count(2, 20), report)


# --- floods --------------------------------------------------------------------------------------


def _floods(seconds: int, report: Report) -> None:
    devices = [axes(name, history=HISTORY, limits=False) for name in VICTIMS]
    with Daemon(workcell(devices, socket_mode='"0666"')) as daemon:
        os.chmod(daemon.folder, 0o755)
        report.note(f"load before: {os.getloadavg()[0]:.1f}; attackers are user {_attacker()[0]}")
        calm: dict[str, Figure] = {}
        for name, flood in {"none": None, **FLOODS}.items():
            attackers = [] if flood is None else [daemon.fork(_as_attacker(daemon, flood)) for _ in range(2)]
            time.sleep(0.3)
            _phase(daemon, name, seconds, calm, report)
            for pid in attackers:
                daemon.kill(pid)
                daemon.reap(pid)
            time.sleep(0.3)


def _phase(daemon: Daemon, name: str, seconds: int, calm: dict[str, Figure], report: Report) -> None:
    """Measure what the victims notice of one flood; that of none is what others are compared with."""
    writes: list[int] = []
    reads: list[int] = []
    asks: list[int] = []
    with daemon.cell("victim") as cell, cell.open("mod0.a0", "rw", 10.0) as axis:
        pids = {"daemon": daemon.pid, **daemon.device_pids()}
        cpu = CpuTimes(pids)
        begin = next_s = time.monotonic()
        for i in range(int(seconds / PACE_S)):
            next_s += PACE_S
            time.sleep(max(0.0, next_s - time.monotonic()))
            record = command(0, velocity=0.01 * (i % 2))
            writes.append(_took_ns(partial(axis.write, record, replace=True)))
            reads.append(_took_ns(axis.read))
            if i % 10 == 0:
                asks.append(_took_ns(cell.status))
        shares = cpu.shares()
        ticks = {}
        for device in VICTIMS:
            with cell.open(f"{device}.readonly") as node:
                ticks[device] = node.statistics(min(8192, int((time.monotonic() - begin) * 1000)))["late_ns"]
        stops = [_stop_ns(cell, axis) for _ in range(3)]
    told = "without attackers" if name == "none" else name
    bar = [] if name == "none" else [Bar("p99.9", REQUEST_MS)]
    for what, samples in (("write", writes), ("read", reads), ("status", asks)):
        unit = "us" if what == "read" else "ms"
        figure = report.samples(
            f"{told}: {what}", samples, unit, baseline=calm.get(what), cpu=shares, bars=bar if unit == "ms" else []
        )  # fmt: skip
        calm.setdefault(what, figure)
    report.samples(f"{told}: stop to the axis braking", stops, "ms", bars=[Bar("max", 20.0)])
    for device, late in ticks.items():
        for percentile, key in (("p50", "50.0"), ("p99", "99.0"), ("p99.9", "99.9"), ("max", "100.0")):
            what = f"{device} tick late, {percentile}"
            found, before = late[key] * 1e-3, calm.get(what)
            base = before.value if before is not None and before.value is not None else found
            bars = [Bar("value", base + LATER_US[percentile])] if before and percentile in LATER_US else []
            notes = f"{found / base:.2f} of that without attackers" if before and base else ""
            calm.setdefault(what, report.value(f"{told}: {what}", found, "us", bars=bars, notes=notes))


def _took_ns(call: Callable[[], object]) -> int:
    begin = time.monotonic_ns()
    call()
    return time.monotonic_ns() - begin


def _stop_ns(cell: Any, axis: Any) -> int:
    """Stop the workcell while an axis moves; return how long it took to brake, and reset."""
    axis.command(velocity=0.02, replace=True)
    wait_for(lambda: axis.read().commanded_velocity[0] > 0.019, 5.0, "the axis to move")
    watch = Watch(axis)
    begin = time.monotonic_ns()
    cell.emergency_stop(why="bench")
    found = halting_ns(watch, begin) - begin
    wait_for(lambda: not axis.read().in_motion[0], 5.0, "rest")
    cell.reset()
    return found


def _attacker() -> tuple[str, int]:
    """Return whom attackers are: another user, if we may become one."""
    if os.getuid() == 0:
        with contextlib.suppress(KeyError):
            return "nobody", pwd.getpwnam("nobody").pw_uid
    return pwd.getpwuid(os.getuid()).pw_name, os.getuid()


def _as_attacker(daemon: Daemon, flood: Callable[[Daemon], Iterator[object]]) -> Callable[[], None]:
    def attack() -> None:
        uid = _attacker()[1]
        if uid != os.getuid():
            os.setgroups([])
            os.setgid(uid)
            os.setuid(uid)
        while True:
            with contextlib.suppress(OSError):  # it may be refused, or thrown out: that is what is asked for
                for _ in flood(daemon):
                    pass
            time.sleep(0.001)

    return attack


def _raw(daemon: Daemon) -> socket.socket:
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    sock.setblocking(False)
    sock.connect(daemon.socket)
    return sock


def _statuses(daemon: Daemon) -> Iterator[object]:
    socks = []
    for _ in range(100):
        with contextlib.suppress(OSError):
            socks.append(_raw(daemon))
    number = 0
    while True:
        number += 1
        for sock in socks:
            with contextlib.suppress(BlockingIOError):
                sock.send(encode(ClientVerb.STATUS, number))
            with contextlib.suppress(BlockingIOError):
                sock.recv(1 << 16)
        yield number


def _many_waits(daemon: Daemon) -> Iterator[object]:
    with daemon.cell("attacker") as cell:
        nodes = [cell.open("mod0.readonly") for _ in range(16)]
        while True:
            for node in nodes:
                for _ in range(64):
                    node._channel.send(node._ioctl(Request.WAIT_UNTIL_IDLE, None, 0.5))
                while node._channel.take() is not None:
                    pass
            yield None


def _statistics(daemon: Daemon) -> Iterator[object]:
    with daemon.cell("attacker") as cell:
        nodes = [cell.open(f"{device}.readonly") for device in VICTIMS for _ in range(8)]
        last = 0
        while True:
            last = last % 8000 + 1
            for node in nodes:
                node._channel.send(node._ioctl(Request.GET_STATISTICS, last, None))
                while node._channel.take() is not None:
                    pass
            yield None


def _nonsense(daemon: Daemon) -> Iterator[object]:
    with daemon.cell("attacker") as cell:
        for _ in range(50):
            node = cell.open("mod0.readonly")
            with contextlib.suppress(OSError):
                node._channel.notice(os.urandom(200))
            with contextlib.suppress(OSError):
                node.close()
            yield None


def _connections(daemon: Daemon) -> Iterator[object]:
    while True:
        with contextlib.suppress(OSError), _raw(daemon):
            yield None
        yield None


def _no_ops(daemon: Daemon) -> Iterator[object]:
    with daemon.cell("attacker") as cell, cell.open(f"mod0.a{1 + os.getpid() % 3}", "rw") as axis:
        here = axis.read().commanded_position[0]
        records = b"".join([command(0, position=here)] * 8000)
        while True:
            axis.write(records, timeout=0.0, replace=True)
            yield None


FLOODS: Mapping[str, Callable[[Daemon], Iterator[object]]] = {
    "STATUS over 100 sessions": _statuses,
    "1,024 waits of a reader": _many_waits,
    "statistics": _statistics,
    "malformed packets": _nonsense,
    "connections": _connections,
    "writes of 8,000 no-ops": _no_ops,
}
