"""Eight cells over Zenoh as one fleet: stops beside bare rounds of Zenoh, starts, reconnections, strangers. All on one
machine, so that stamps of different cells can be compared.
"""

from __future__ import annotations

import contextlib
import os
import random
import socket
import ssl
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, Self

import zenoh
from zenoh.handlers import Callback

from sioms.check import other_clock
from sioms.check.daemon import Daemon, wait_for
from sioms.check.remote import Gateway, Relay, ZenohGateway
from sioms.children import ends_with_us
from sioms.client.command import command
from sioms.client.fleet import Fleet
from sioms.client.keys import VARIABLE
from sioms.client.workcell import Workcell
from sioms.client.zenoh_keys import config, endpoint, open_session
from sioms.protocol.flags import AxisStatus

from .again import connect_again
from .figures import Bar, Report
from .options import Options
from .reach import fail
from .watching import HISTORY, Counted, Watch, halting_ns
from .workcells import axes, workcell

CELLS, AXES = 8, 2
SPEED = 0.02
SETTLED_S = 0.1
"""How long cells have been let alone before a stop [s]."""
_ECHO = """
import sys, time, zenoh
from zenoh.handlers import Callback
from sioms.client.keys import Folder
from sioms.client.zenoh_keys import config, endpoint, open_session
session = open_session(config(Folder(sys.argv[1]), "listen", mode="router", listen={"endpoints": [sys.argv[2]]}))
options = dict(congestion_control=zenoh.CongestionControl.BLOCK, priority=zenoh.Priority.REAL_TIME, express=True)
back = session.declare_publisher("bare/back", **options)
there = session.declare_subscriber("bare/there", Callback(lambda sample: back.put(sample.payload), indirect=False))
print("ready", flush=True)
time.sleep(1e6)
"""


class BareRound:
    """A put and a put back over Zenoh under TLS between two Python processes."""

    def __init__(self, gateway: ZenohGateway, port: int) -> None:
        place = endpoint("127.0.0.1", port)
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", _ECHO, gateway.keys.path, place], stdout=subprocess.PIPE, text=True,
            preexec_fn=ends_with_us(),
        )  # fmt: skip
        assert self._process.stdout is not None
        self._process.stdout.readline()
        connect = {"endpoints": [place], "timeout_ms": 5000, "exit_on_failure": True}
        self._session = open_session(config(gateway.own, "connect", mode="client", connect=connect))
        self._came = threading.Semaphore(0)
        self._subscriber = self._session.declare_subscriber("bare/back", Callback(self._back, indirect=False))
        self._publisher = self._session.declare_publisher(
            "bare/there",
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        )
        for _ in range(50):  # until each end knows of the other's
            self._publisher.put(b"")
            if self._came.acquire(timeout=0.2):
                break
        time.sleep(0.3)
        while self._came.acquire(blocking=False):
            pass

    def _back(self, _: zenoh.Sample) -> None:
        self._came.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._session.close()  # type: ignore[no-untyped-call]
        self._process.kill()
        self._process.wait()

    def time_ns(self) -> int:
        """Return how long one takes [ns]."""
        begin = time.perf_counter_ns()
        self._publisher.put(bytes(100))
        if not self._came.acquire(timeout=5.0):
            raise TimeoutError("a bare round of Zenoh was lost")
        return time.perf_counter_ns() - begin


def bench_fleet(options: Options, report: Report) -> None:
    """Stop, start and connect to eight cells over Zenoh; strangers at a gateway."""
    with contextlib.ExitStack() as stack:
        gateways: list[ZenohGateway] = []
        daemons: list[Daemon] = []
        for i in range(CELLS):
            text = workcell([axes("mod0", AXES, history=8192, limits=False)])
            text = text.replace('name = "bench"', f'name = "cell{i}"').replace("realtime_priority = 50\n", "")
            daemon = stack.enter_context(Daemon(text))
            daemons.append(daemon)
            authority = gateways[0].authority if gateways else None
            gateways.append(stack.enter_context(ZenohGateway(daemon.socket, authority=authority)))
            report.progress(f"fleet: cell {i + 1} of {CELLS}")
        own = gateways[0].own  # one certificate for all cells
        for gateway in gateways[1:]:
            gateway.keys.revoke(gateway.name)
            gateway.keys.allow(gateway.name, gateways[0].number)
        os.environ[VARIABLE] = own.path
        time.sleep(0.3)
        cells = {f"cell{i}": gateway.socket for i, gateway in enumerate(gateways)}
        with Fleet(cells, "bench") as fleet:
            _stops(options, report, fleet, gateways, daemons)
            _starts(options, report, fleet)
        connect_again(options, report, gateways[0])
        _strangers(options, report, gateways[0])
        _clocks(options, report, gateways[0])
    with Daemon(workcell([axes("mod0", history=HISTORY, limits=False)])) as daemon:
        fail(options, report, daemon, ZenohGateway)


def _stops(
    options: Options, report: Report, fleet: Fleet, gateways: list[ZenohGateway], daemons: list[Daemon]
) -> None:  # fmt: skip
    """Stop all cells while their axes move, and one; each stop follows as many bare rounds."""
    from sioms.check.remote import free_ports

    braking, everywhere, one, bare, counted = [], [], [], [], Counted()
    pids = {"client": os.getpid()}
    for i, (daemon, gateway) in enumerate(zip(daemons, gateways, strict=True)):
        drivers = {f"driver {i}": pid for pid in daemon.device_pids().values()}
        pids |= {f"daemon {i}": daemon.pid, f"gateway {i}": gateway.process.pid} | drivers
    worked_ns = 0
    with contextlib.ExitStack() as stack, BareRound(gateways[0], free_ports()) as rounds:
        cells = [stack.enter_context(daemon.cell("judge")) for daemon in daemons]
        nodes = [stack.enter_context(cell.open("mod0", "rw")) for cell in cells]
        trials = options.kills(30, 1000)
        for trial in range(trials):
            bare += [rounds.time_ns() for _ in range(4)]
            for node in nodes:
                node.write([command(axis, velocity=SPEED) for axis in range(AXES)], replace=True)
            for node in nodes:
                wait_for(partial(_cruises, node), 10.0, f"{node.name} to cruise")
            time.sleep(SETTLED_S)
            watches, before_ns = [Watch(node) for node in nodes], _worked_ns(pids)
            begin = time.monotonic_ns()
            fleet.emergency_stop("bench")
            everywhere.append(time.monotonic_ns() - begin)
            worked_ns += _worked_ns(pids) - before_ns
            braking.append(max(counted.look(partial(halting_ns, watch, begin)) for watch in watches) - begin)
            fleet.reset()
            begin = time.monotonic_ns()
            fleet["cell0"].emergency_stop_workcell("bench")
            one.append(time.monotonic_ns() - begin)
            fleet.reset()
            report.progress(f"fleet: stop {trial}")
    base = report.samples("bare round of Zenoh under TLS", bare)
    report.samples("stop of one cell to acknowledgement", one, baseline=base)
    report.samples(
        f"stop of {CELLS} cells to the tick in which the last of {CELLS} drivers brakes", braking, "ms", baseline=base,
        bars=[Bar("p50", 5.0), Bar("p99", 10.0)],
    )  # fmt: skip
    counted.tell(report, "brakings")
    report.samples(f"stop of {CELLS} cells to the last acknowledgement", everywhere, "ms")
    report.value("processor time of all of them for it [ms]", worked_ns / trials * 1e-6)


def _cruises(node: Any) -> bool:
    return all(abs(speed - SPEED) < 1e-9 for speed in node.read().commanded_velocity)


def _worked_ns(pids: Mapping[str, int]) -> int:
    """Return how long all threads of some processes have run [ns];."""
    return sum(
        int(task.joinpath("schedstat").read_text().split()[0])
        for pid in pids.values()
        for task in Path(f"/proc/{pid}/task").iterdir()
    )


def _starts(options: Options, report: Report, fleet: Fleet) -> None:
    """Let an axis of two cells begin to cruise at one instant; where they are afterwards says when they began."""
    skews, stated, told, lost = [], [], 0, 0
    with fleet.open("cell0:mod0", "rw", lease=5.0) as one, fleet.open("cell1:mod0", "rw", lease=5.0) as two:
        nodes = (one, two)
        for trial in range(options.count(10, 300)):
            begun = [node.read().commanded_position[0] for node in nodes]
            for node in nodes:
                node.write(command(0, velocity=SPEED, synch=True))
            start_ns = fleet.synch(*nodes, lead=0.5, within=1.0)
            clocks: list[Any] = [fleet[name]._channel.clock for name in ("cell0", "cell1")]
            bound = sum(clock.error_ns for clock in clocks)
            began = [_began_ns(node, place, start_ns) for node, place in zip(nodes, begun, strict=True)]
            if None in began:
                faults = [bool(node.read().status[0] & AxisStatus.FAULT) for node in nodes]
                told, lost = told + any(faults), lost + (not any(faults))
            else:
                stated.append(bound)
                skews.append(abs(int(began[0] - began[1])))  # type: ignore[operator]
            for node in nodes:
                node.stop()
            for node in nodes:
                node.wait_until_idle(10.0)
            fleet.reset()
            report.progress(f"fleet: start {trial}")
    report.samples("skew of a start of two cells", skews, bars=[Bar("p99", 100.0)])
    report.samples("stated: how far apart they may be", stated)
    outside = sum(skew > bound for skew, bound in zip(skews, stated, strict=True))
    report.value("starts further apart than stated", outside, bars=[Bar("value", 0)], notes=f"of {len(skews)}")
    report.value("starts missed without a fault", lost, bars=[Bar("value", 0)], notes=f"{told} were told as faults")


def _began_ns(node: Any, place: float, start_ns: int) -> float | None:
    """Return when an axis began [ns, clock of its cell], by a reading in which it cruises; None: it does not.

    A reading of before it cruises tells nothing of when it began, and the copy of a remote page may be that old on a
    busy machine.
    """
    deadline_ns = start_ns + 10_000_000_000
    while time.monotonic_ns() < deadline_ns:
        seen = node.read()
        if abs(seen.commanded_velocity[0] - SPEED) < 1e-9:
            return float(seen.cell_stamp_ns - (seen.commanded_position[0] - place) / SPEED * 1e9)
        if seen.status[0] & AxisStatus.FAULT:
            return None
        time.sleep(0.02)
    return None


def _strangers(options: Options, report: Report, gateway: ZenohGateway) -> None:
    """Send what is no TLS, broken TLS, and good TLS without a certificate."""
    dice, sent, passed = random.Random(options.seed), 0, 0
    context = ssl.create_default_context(cafile=gateway.own.file("authority.pem"))
    connections = options.frames or options.count(300, 20_000)
    for trial in range(connections):
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", gateway.port), 2.0) as plain:
            plain.settimeout(0.3)
            if trial % 3 == 2:
                with context.wrap_socket(plain, server_hostname="127.0.0.1") as sock:
                    sock.sendall(b"\x0a\x00\x01" + dice.randbytes(40))
                    sent += 1
                    passed += bool(sock.recv(1))
                continue
            for _ in range(dice.randint(1, 8)):
                head = b"\x16\x03\x01" if trial % 3 else dice.randbytes(2)
                plain.sendall(head + dice.randbytes(dice.randint(1, 600)))
                sent += 1
            plain.recv(100)  # an alert of TLS, or nothing
        report.progress(f"fleet: stranger {trial} of {connections}")
    with Workcell(gateway.socket, "afterwards") as cell:
        served = bool(cell.nodes())
    report.value(
        "frames of strangers that were answered by more than an alert", passed, bars=[Bar("value", 0)],
        notes=f"of {sent} in {connections} connections; the gateway {'serves' if served else 'does not serve'} others",
    )  # fmt: skip


def _clocks(options: Options, report: Report, gateway: Gateway) -> None:
    if not other_clock.available():
        report.notes.append("no right to make a time namespace: clocks of two machines were not tried")
        return
    with Relay(gateway.port) as relay:
        relay.jitter_s = 0.002
        found: Any = other_clock.seen(gateway.trusted(relay.port), options.count(10, 1_000), 3600.0)
    outside = sum(abs(off) > error for off, error in zip(found["off"], found["error"], strict=True))
    report.samples("stated error of a stamp over a link of 0 to 2 ms each way", found["error"])
    report.value("stamps outside of it", outside, bars=[Bar("value", 0)], notes=f"of {len(found['off'])}")
