"""The workcell through a gateway, beside a bare ZeroMQ CURVE round trip of the same run. All on one machine, so that
the clocks of both ends are the same and stamps can be compared.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import cycle
from typing import Any, Self

import zmq

from sioms.check import other_clock, other_host
from sioms.check.daemon import Daemon, wait_for
from sioms.check.remote import Gateway, Relay
from sioms.children import ends_with_us
from sioms.client.command import command
from sioms.client.workcell import Workcell
from sioms.protocol.link import DEFAULT_LEASE_S

from .again import connect_again
from .figures import Bar, Report
from .options import Options
from .watching import HISTORY, Watch, halting_ns
from .workcells import axes, workcell

CHUNK = 100
PACE_S = 0.01
"""Between two requests of a program that does something else, too [s]."""
SPEED = 0.05
_ECHO = """
import sys, zmq
sock = zmq.Context().socket(zmq.ROUTER)
sock.curve_server, sock.curve_secretkey = True, sys.argv[1].encode()
print(sock.bind_to_random_port("tcp://127.0.0.1"), flush=True)
while True:
    sock.send_multipart(sock.recv_multipart())
"""
_CRUISE = """
import sys, time, sioms
node = sioms.Workcell(sys.argv[1], "cruiser").open("mod0", "rw", 10.0, lease=float(sys.argv[3]))
node.write([sioms.command(axis, velocity=float(sys.argv[2])) for axis in range(len(node.info.channels))])
print("ready", flush=True)
while True:
    node.keepalive()
    time.sleep(0.02)
"""


class CurveRoundTrip:
    """A bare request and reply over TCP with CURVE between two Python processes."""

    def __init__(self) -> None:
        server, secret = zmq.curve_keypair()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", _ECHO, secret.decode()], stdout=subprocess.PIPE, text=True,
            preexec_fn=ends_with_us(),
        )  # fmt: skip
        assert self._process.stdout is not None
        port = int(self._process.stdout.readline())
        self._context = zmq.Context()
        self._sock = self._context.socket(zmq.DEALER)
        self._sock.curve_publickey, self._sock.curve_secretkey = zmq.curve_keypair()
        self._sock.curve_serverkey, self._sock.linger = server, 0
        self._sock.connect(f"tcp://127.0.0.1:{port}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        self._sock.close()
        self._context.term()

    def samples(self, count: int, size: int, pause_s: float = 0.0) -> list[int]:
        """Return the durations of round trips of packets of a size, with a pause before each [ns]."""

        def trip() -> None:
            self._sock.send(bytes(size))
            self._sock.recv()

        return _times(trip, count, pause_s)


def _times(act: Callable[[], object], count: int, pause_s: float = 0.0) -> list[int]:
    """Return how long each of some acts took, with a pause before each [ns]."""
    clock, result = time.perf_counter_ns, []
    for _ in range(count):
        if pause_s:
            time.sleep(pause_s)
        begin = clock()
        act()
        result.append(clock() - begin)
    return result


def _writes(node: Any, records: list[bytes], pause_s: float) -> list[int]:
    """Return how long each of some writes took, with a pause before each [ns]."""
    turn = cycle(records)
    return _times(lambda: node.write(next(turn), replace=True), CHUNK, pause_s)


def bench_reach(options: Options, report: Report) -> None:
    """Requests, readings and stops through a gateway; then owners, gateways and links that fail."""
    config = workcell([axes("mod0", history=HISTORY, limits=False), axes("mod1", 24, history=HISTORY)])
    with Daemon(config) as daemon, Gateway(daemon.socket) as gateway:
        with Workcell(gateway.socket, "bench") as far, daemon.cell() as near:
            _requests(options, report, far, near)
            _readings(options, report, far)
            _stops(options, report, far)
            _clocks(options, report, gateway)
        connect_again(options, report, gateway)
        fail(options, report, daemon)


def _requests(options: Options, report: Report, far: Workcell, near: Workcell) -> None:
    """Requests one after the other, and one in PACE_S, each in turn with bare round trips at the same pace."""
    records = [command(0, position=p) for p in (1e-4, 0.0)]
    for pause_s, how in ((0.0, ", in a row"), (PACE_S, ", one in 10 ms")):
        count = options.slow(300, 3_000) if pause_s else options.count(1_000, 20_000)
        trips, asked, written, local = list[int](), list[int](), list[int](), list[int]()
        with CurveRoundTrip() as bare:
            while len(trips) < count:
                trips += bare.samples(CHUNK, len(records[0]), pause_s)
                asked += _times(lambda: far.info("mod0"), CHUNK, pause_s)
                for cell, samples, least_s in ((far, written, 0.0), (near, local, 3e-4)):
                    with cell.open("mod0", "rw", 1.0) as node:
                        samples += _writes(node, records, max(pause_s, least_s))
                report.progress(f"reach: {len(trips)} of {count}{how}")
        base = report.samples(f"bare CURVE round trip{how}", trips)
        report.samples(f"remote request to the daemon{how}", asked, baseline=base, bars=[Bar("ratio", 2.5)])
        report.samples(f"remote write to acknowledgement{how}", written, baseline=base, bars=[Bar("ratio", 2.5)])
        report.samples(f"local write{how}" if pause_s else "local write, 0.3 ms after the one before", local)


def _readings(options: Options, report: Report, far: Workcell) -> None:
    with far.open("mod1.readonly") as node:
        report.samples("remote read of 24 axes", _times(node.read, 10_000), bars=[Bar("p50", 2.0)])
        late, missed, number = [], 0, 0
        seconds = options.count(2, 30)
        for snapshot in node.snapshots(10):
            late.append(time.monotonic_ns() - snapshot.cell_stamp_ns)
            if len(late) >= 100 * seconds:
                break
        report.samples("stamp to remote subscriber awake, 100 Hz", late, "ms", notes="bar: bare round trip + 0.3 ms")
        end_s = time.monotonic() + seconds
        number = node.read().number
        got = 0
        while time.monotonic() < end_s:
            for each in node.history(number):
                missed += each.number - number - 1
                number, got = each.number, got + 1
            time.sleep(0.005)
        report.value(
            "24 axes at 1 kHz: snapshots missed", missed, bars=[Bar("value", 0)], notes=f"{got} came"
        )  # fmt: skip


def _stops(options: Options, report: Report, far: Workcell) -> None:
    samples = []
    for _ in range(options.kills(20, 500)):
        samples += _times(lambda: far.emergency_stop_workcell("bench"), 1)
        far.reset()
    report.samples("remote stop of the workcell to acknowledgement", samples, "ms", bars=[Bar("p50", 2.0)])


def _clocks(options: Options, report: Report, gateway: Gateway) -> None:
    """The clock of a client in a time namespace is off by what is known; without the right to make one both ends have
    one clock, and the true offset is 0.
    """
    if other_clock.available():
        with Relay(gateway.port) as relay:
            relay.jitter_s = 0.002
            found = other_clock.seen(gateway.trusted(relay.port), options.count(20, 2_000), 3600.0)
        outside = sum(abs(off) > error for off, error in zip(found["off"], found["error"], strict=True))
        report.samples("stated error of a stamp over a link of 0 to 2 ms each way", found["error"])
        report.samples("UTC of a stamp beside that of this machine", [abs(off) for off in found["utc_off"]])
        report.value(
            "stamps whose stated error did not hold the truth", outside, bars=[Bar("value", 0)],
            notes=f"of {len(found['off'])}, clocks {other_clock.OFFSET_S} s apart",
        )  # fmt: skip
        return
    trials, wrong, errors = options.count(20, 500), 0, []
    for _ in range(trials):
        with Workcell(gateway.socket) as cell:
            clock: Any = cell._channel.clock
            errors.append(clock.error_ns)
            wrong += abs(clock.offset_ns) > clock.error_ns
    report.samples("stated error of the clocks' offset, at once", errors)
    report.value("trials in which it did not hold the truth", wrong, bars=[Bar("value", 0)], notes=f"of {trials}")


def fail(options: Options, report: Report, daemon: Daemon, kind: type[Gateway] = Gateway) -> None:
    """Let each end of a link fail, and the link itself, while a remote client moves four axes."""
    bar = Bar("max", 1e3 * DEFAULT_LEASE_S + 20)
    for what in ("client killed", "client hung", "gateway killed", "gateway hung", "link cut", "link stalled"):
        samples = []
        trials = options.slow(3, 100)
        for trial in range(trials):
            samples.append(_fail_once(what, daemon, kind))
            report.progress(f"reach: {what}, {trial} of {trials}")
        report.samples(f"{what} to its 4 axes halting", samples, "ms", bars=[bar], notes="none missed")
    if not other_host.available():
        report.notes.append("no right to make a network namespace: pulled cables were not tried")
        return
    samples = [_pull_once(daemon, kind) for _ in range(options.slow(3, 100))]
    report.samples("cable pulled to its 4 axes halting", samples, "ms", bars=[bar], notes="none missed")


def _pull_once(daemon: Daemon, kind: type[Gateway]) -> int:
    """Pull the cable between a client that moves axes and their gateway; return how long they went on [ns]."""
    with other_host.Hosts() as hosts, daemon.cell() as cell:
        with hosts.on(other_host.CELL):
            gateway = kind(daemon.socket, host=other_host.CELL)
        with gateway:
            with hosts.on(other_host.CLIENT):
                victim = cruiser(gateway.socket)
            try:
                with cruising(victim, cell) as node:
                    watch, begin = Watch(node), time.monotonic_ns()
                    hosts.pull()
                    return halting_ns(watch, begin) - begin
            finally:
                victim.kill()
                victim.wait()


def cruiser(address: str, lease_s: float = 0.0) -> subprocess.Popen[str]:
    """Start a client that moves axes; a lease of 0 is the usual one."""
    return subprocess.Popen(
        [sys.executable, "-P", "-c", _CRUISE, address, str(SPEED), str(lease_s)], stdout=subprocess.PIPE, text=True,
        stderr=subprocess.DEVNULL, preexec_fn=ends_with_us(),
    )  # fmt: skip


@contextmanager
def cruising(victim: subprocess.Popen[str], cell: Workcell) -> Iterator[Any]:
    """Wait until its axes cruise; give their node."""
    assert victim.stdout is not None
    victim.stdout.readline()
    with cell.open("mod0.readonly") as node:
        wait_for(lambda: all(abs(v - SPEED) < 1e-6 for v in node.read().commanded_velocity), 10.0, "axes to cruise")
        time.sleep(0.1)
        yield node


def _fail_once(what: str, daemon: Daemon, kind: type[Gateway]) -> int:
    """Let something fail while a remote client moves axes; return how long they went on [ns]."""
    with kind(daemon.socket) as gateway, Relay(gateway.port) as relay, daemon.cell() as cell:
        victim = cruiser(gateway.trusted(relay.port))
        stopped = 0
        try:
            with cruising(victim, cell) as node:
                watch, begin = Watch(node), time.monotonic_ns()
                match what:
                    case "client killed":
                        victim.kill()
                    case "gateway killed":
                        gateway.process.kill()
                    case "client hung" | "gateway hung":
                        stopped = victim.pid if what == "client hung" else gateway.process.pid
                        os.kill(stopped, signal.SIGSTOP)
                    case "link cut":
                        relay.cut()
                    case _:
                        relay.stalled = True
                return halting_ns(watch, begin) - begin
        finally:
            if stopped:
                os.kill(stopped, signal.SIGCONT)
            victim.kill()
            victim.wait()
