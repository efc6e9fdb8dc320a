"""Deaths at random points: clients, drivers, fork server and daemon are killed or stopped, alone and within a
millisecond of each other.

Clients move an axis each, at one speed, and ask at random for everything that does not change it, so that a death meets
any request half done. What is looked at: how soon axes halt, whether what was stopped stays stopped, whether an output
has two owners, and what is left of the dead.
"""

from __future__ import annotations

import contextlib
import errno
import os
import random
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from sioms.check.daemon import Daemon, descriptors, wait_for
from sioms.client.command import command
from sioms.protocol.flags import Request

from .figures import Bar, Report
from .observer import Observer, Seen
from .options import Options
from .watching import HISTORY, Watch
from .workcells import axes, workcell

DEVICES = ("mod0", "mod1", "mod2")
AXES = 3
SPEED = 0.05
LEASE_S = 0.25
DAEMON_LEASE_S = 0.5
ROUNDS = 25
"""Rounds that one daemon lives at most; then it is killed, or stopped, itself."""
BAR_MS = 20.0
OURS_MS = 10.0
"""How much later than an observer in the class of its driver hears of the death an axis may halt; else it is we."""
LIMITS = {"client stopped": LEASE_S * 1e3 + BAR_MS, "daemon stopped": DAEMON_LEASE_S * 1e3 + BAR_MS}
"""How soon an axis halts [ms], by what has happened; BAR_MS after all others."""
KINDS: Mapping[str, int] = {
    "clients": 20, "clients stopped": 3, "driver": 3, "driver stopped": 1, "fork server": 2, "client and driver": 5,
    "client and fork server": 4, "driver and fork server": 3, "two drivers": 1,
}  # fmt: skip
"""How often each kind of round is, among all of a daemon's life."""
ENDS: Mapping[str, int] = {"daemon": 3, "daemon and client": 3, "daemon and driver": 3, "daemon and fork server": 2,
                           "daemon stopped": 1}  # fmt: skip
"""How a daemon's life ends."""


def bench_deaths(options: Options, report: Report) -> None:
    """Kill and stop processes until there have been as many signals as asked for."""
    wanted = options.kills(60, 10_000)
    chance, tally = random.Random(options.seed), Tally()
    try:
        while tally.signals[signal.SIGKILL] < wanted:
            _life(chance, tally, partial(_progress, report, tally, wanted))
    finally:
        _tell(tally, report)


class Tally:
    """What has been seen.

    Attributes:
        signals: how many of each were sent to a process that lived.
        kinds: how many rounds and ends of each kind there were.
        halts: by what had happened: from the signal to the axis halting [ns].
        heard: from the same signals to an observer hearing of the death [ns].
        late: of each late halt, how much later than the observer it was [ns].
        wrong: what must not be, by name, and how often it was.
    """

    def __init__(self) -> None:
        self.signals: Counter[int] = Counter()
        self.kinds: Counter[str] = Counter()
        self.halts: dict[str, list[int]] = {}
        self.heard: list[int] = []
        self.late: list[int] = []
        self.wrong = Counter(dict.fromkeys(WRONG, 0))
        self.notes: list[str] = []

    def is_wrong(self, what: str, detail: str) -> None:
        """Count what must not be."""
        self.wrong[what] += 1
        self.notes.append(f"{what}: {detail}")


WRONG = ("stops lost", "second owners", "axes that never halted", "nodes never free again", "descriptors left",
         "processes left", "lives that ended in an error")  # fmt: skip


def _progress(report: Report, tally: Tally, wanted: int) -> None:
    report.progress(f"{tally.signals[signal.SIGKILL]} of {wanted} kills, {tally.signals[signal.SIGSTOP]} stops")


def _tell(tally: Tally, report: Report) -> None:
    report.note("rounds: " + ", ".join(f"{count} {kind}" for kind, count in sorted(tally.kinds.items())))
    for note in tally.notes[:20]:
        report.note(note[:300])
    report.value("processes killed", tally.signals[signal.SIGKILL])
    report.value("processes stopped", tally.signals[signal.SIGSTOP])
    for what, halts in tally.halts.items():
        late = sum(halt > LIMITS.get(what, BAR_MS) * 1e6 for halt in halts)
        report.samples(f"{what} to its axis halting", halts, "ms", bars=[Bar("max", LIMITS.get(what, BAR_MS))],
                       notes=f"{late} later than that")  # fmt: skip
    if tally.heard:
        report.samples("client killed to an observer hearing of it", tally.heard, "ms", notes="what the machine takes")
        ours = sum(late > OURS_MS * 1e6 for late in tally.late)
        report.value(f"late halts, {OURS_MS:g} ms and more behind the observer", ours, bars=[Bar("value", 0)],
                     notes=f"of {len(tally.late)}; worst {max(tally.late, default=0) / 1e6:.1f} ms")  # fmt: skip
    for what in WRONG:
        report.value(what, tally.wrong[what], bars=[Bar("value", 0)])


# --- a daemon's life -----------------------------------------------------------------------------


def _life(chance: random.Random, tally: Tally, progress: Callable[[], None]) -> None:
    """Start a daemon, kill round it, at last kill it, and see that its successor is stopped as it was."""
    devices = [axes(name, AXES, history=HISTORY, limits=False) for name in DEVICES]
    with Daemon(workcell(devices, daemon_lease_s=DAEMON_LEASE_S)) as daemon:
        try:
            before = _weight(daemon)
            with contextlib.closing(Observer(daemon)) as observer:
                for _ in range(ROUNDS):
                    kind = chance.choices(list(KINDS), list(KINDS.values()))[0]
                    tally.kinds[kind] += 1
                    _round(daemon, observer, kind, chance, tally)
                    progress()
            _look_for_leaks(daemon, before, tally)
            _end(daemon, chance, tally)
            progress()
        except (OSError, RuntimeError) as error:
            tally.is_wrong("lives that ended in an error", f"{error}; the log ends: {daemon.log()[-600:]}")


def _round(daemon: Daemon, observer: Observer, kind: str, chance: random.Random, tally: Tally) -> None:
    """Have clients on all axes, kill and stop as the kind says, and look."""
    stops = kind.endswith("clients stopped")
    with daemon.cell("judge") as cell:
        nodes, clients = _set_going(daemon, cell, chance, LEASE_S if stops else 0.0)
        watches = {name: Watch(node) for name, node in nodes.items()}
        pids = daemon.device_pids()
        stopped = chance.choice((*DEVICES, "", ""))  # a node of it is stopped within a millisecond of the deaths
        if stopped:
            nodes[stopped].emergency_stop()
        time.sleep(chance.random() * 0.001)
        victims = chance.sample(sorted(clients), len(clients) if "clients" in kind else kind.count("client"))
        drivers = chance.sample(DEVICES, 2 if "two" in kind else kind.count("driver"))
        servers = fork_servers(daemon, set(pids.values())) if "fork server" in kind else []
        driver_signal = signal.SIGSTOP if kind == "driver stopped" else signal.SIGKILL
        acts = [(clients[axis], signal.SIGSTOP if stops else signal.SIGKILL, axis) for axis in victims]
        acts += [(pids[name], driver_signal, "") for name in drivers] + [(pid, signal.SIGKILL, "") for pid in servers]
        chance.shuffle(acts)
        observer.watch([clients[axis] for axis in victims], pids[DEVICES[0]])
        begins = send([(pid, how) for pid, how, _ in acts], chance, tally)
        begin_of = {axis: begin for (_, _, axis), begin in zip(acts, begins, strict=True)}
        halts: dict[str, int] = {}
        for axis in victims:
            device, _, number = axis.partition(".a")
            if device not in drivers and device != stopped:
                what = "client stopped" if stops else "client killed"
                halts[axis] = _take_halt(watches[device], int(number), begin_of[axis], what, pids[device], tally)
        _compare(observer.seen(), halts, {axis: (clients[axis], begin_of[axis]) for axis in halts}, tally, stops)
        for pid in clients.values():
            daemon.kill(pid)
            daemon.reap(pid)
        for name in drivers:
            wait_for(Back(cell, name, pids[name]), 60.0, f"{name} to be back")
        _judge(cell, stopped, tally)


def _set_going(
    daemon: Daemon, cell: Any, chance: random.Random, lease_s: float = 0.0
) -> tuple[dict[str, Any], dict[str, int]]:
    """Return read-only nodes by device, and clients by axis, each of which goes at its speed."""
    nodes = {name: cell.open(f"{name}.readonly", timeout=20.0) for name in DEVICES}
    clients = {}
    for name in DEVICES:
        for axis in range(AXES):
            work = _restless(daemon, f"{name}.a{axis}", chance.getrandbits(32), lease_s)
            clients[f"{name}.a{axis}"] = daemon.fork(work)
    for name, node in nodes.items():
        wait_for(partial(_all_go, node), 30.0, f"{name} to cruise")
    return nodes, clients


def _all_go(node: Any) -> bool:
    return all(abs(v - SPEED) < 1e-6 for v in node.read().commanded_velocity)


def _restless(daemon: Daemon, name: str, seed: int, lease_s: float) -> Callable[[], None]:
    """Return a client that keeps an axis going and asks for something at random, again and again."""

    def client() -> None:
        chance = random.Random(seed)
        with daemon.cell(f"restless {name}") as cell, cell.open(name, "rw", 20.0, lease=lease_s) as axis:
            go = command(0, velocity=SPEED)
            axis.write(go)
            while True:
                with contextlib.suppress(
                    OSError
                ):  # a device may be gone, a wait may time out: neither is ours to judge
                    chance.choice(list(_requests(cell, axis, go)))()
                axis.keepalive()
                time.sleep(chance.random() * 0.002)

    return client


def _requests(cell: Any, axis: Any, go: bytes) -> Iterator[Callable[[], object]]:
    """What a client asks for that leaves its axis going as it goes."""
    device = axis.name.partition(".")[0]
    yield axis.read
    yield axis.keepalive
    yield partial(axis.write, go, replace=True)
    yield partial(axis.write, go * 200, replace=True)
    yield partial(axis.ioctl, Request.GET_LIMITS)
    yield partial(axis.ioctl, Request.WAIT_UNTIL_IDLE, timeout=0.001)
    yield partial(axis.statistics, 10)
    yield cell.status
    yield cell.nodes
    yield partial(_opened, cell, f"{device}.readonly")
    yield partial(_opened, cell, f"{device}.a0", "rw")
    yield partial(_marked, cell)


def _opened(cell: Any, name: str, mode: str = "r") -> None:
    with cell.open(name, mode, 0.001) as node:
        node.read()


def _marked(cell: Any) -> None:
    marker = cell.reserve_marker()
    marker.signal()
    marker.wait(0.001)
    marker.free()


def _take_halt(watch: Watch, axis: int, begin: int, what: str, pid: int, tally: Tally) -> int:
    """Take how long an axis took from a signal to its first slower snapshot; return that [ns], 0 when it did not."""
    try:
        snapshot = watch.first(lambda s: abs(s.commanded_velocity[axis]) < SPEED - 1e-6, begin, 5.0, "an axis halting")
    except (TimeoutError, OSError) as error:
        tally.is_wrong("axes that never halted", f"{what}: {error}")
        return 0
    halt = int(snapshot.stamp_ns) - begin
    tally.halts.setdefault(what, []).append(halt)
    if halt > LIMITS.get(what, BAR_MS) * 1e6:
        tally.notes.append(f"{what}: {halt / 1e6:.0f} ms; {_circumstances(pid)}")
    return halt


def _compare(
    seen: Seen, halts: Mapping[str, int], of: Mapping[str, tuple[int, int]], tally: Tally, stops: bool
) -> None:
    """Compare what drivers took for the deaths of clients with what an observer took."""
    if stops:
        return  # a client that is stopped does not end: it is its lease that does
    if seen.unlike:
        tally.notes.append(f"a round is not compared with its observer: {seen.unlike}")
        return
    for axis, halt in halts.items():
        pid, begin = of[axis]
        if not halt or pid not in seen.ended_ns:
            continue
        heard = seen.ended_ns[pid] - begin
        tally.heard.append(heard)
        if halt > BAR_MS * 1e6:
            tally.late.append(halt - heard)
            tally.notes.append(
                f"{axis} halted after {halt / 1e6:.1f} ms; an observer heard of it after {heard / 1e6:.1f}, and "
                f"woke up to {seen.late_ns / 1e6:.1f} ms late"
            )


def _circumstances(pid: int) -> str:
    """Return what explains that a driver was late: its class of scheduling, and the load."""
    try:
        real = os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
    except OSError:
        return "its driver has ended"
    return f"its driver is {'in a real-time class' if real else 'an ordinary process'}, load {os.getloadavg()[0]:.1f}"


def _judge(cell: Any, stopped: str, tally: Tally) -> None:
    """See that no output has two owners, all nodes are free again, and what was stopped is stopped; reset it."""
    holders = [row[0] for row in cell.status()["holders"]]
    if len(holders) != len(set(holders)):
        tally.is_wrong("second owners", str(holders))
    for name in DEVICES:
        try:
            with cell.open(name, "rw", 20.0) as node:
                if name == stopped and not _refuses(node):
                    tally.is_wrong("stops lost", f"{name} takes motion")
        except OSError as error:
            tally.is_wrong("nodes never free again", f"{name}: {error}")
    if stopped:
        cell.reset(stopped)


def _refuses(node: Any) -> bool:
    try:
        node.write(command(0, velocity=0.01), replace=True)
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.ECANCELED, errno.ESHUTDOWN, errno.EIO):
            raise
        return True
    return False


class Back:
    """Tells whether a device has another process than before; resets it once where it has died too often.

    Once: the status may be a moment old, and a second reset would come when the device is up, and clear its stop.
    """

    def __init__(self, cell: Any, name: str, before: int) -> None:
        self._cell, self._name, self._before, self._is_reset = cell, name, before, False

    def __call__(self) -> bool:
        device = next(d for d in self._cell.status()["devices"] if d["name"] == self._name)
        if device["state"] == "fault" and not self._is_reset:
            self._is_reset = True
            self._cell.reset(self._name)
        return device["state"] == "up" and device["pid"] not in (0, self._before)


# --- its end -------------------------------------------------------------------------------------


def _end(daemon: Daemon, chance: random.Random, tally: Tally) -> None:
    """Kill or stop the daemon while axes move and a stop has just been acknowledged; nothing of it may be left but the
    stop.
    """
    kind = chance.choices(list(ENDS), list(ENDS.values()))[0]
    tally.kinds[kind] += 1
    cell = daemon.cell("judge")
    nodes, clients = _set_going(daemon, cell, chance)
    watches = {name: Watch(node) for name, node in nodes.items()}
    pids = daemon.device_pids()
    servers = fork_servers(daemon, set(pids.values()))
    others = {"client": [clients["mod0.a0"]], "driver": [pids["mod0"]], "server": servers}.get(kind.split()[-1], [])
    nodes["mod2"].emergency_stop()
    how = signal.SIGSTOP if kind == "daemon stopped" else signal.SIGKILL
    acts = [(daemon.pid, how), *((pid, signal.SIGKILL) for pid in others)]
    chance.shuffle(acts)
    begin = send(acts, chance, tally)[acts.index((daemon.pid, how))]
    what = "daemon stopped" if how is signal.SIGSTOP else "daemon killed"
    for name in ("mod1",) if "driver" in kind else ("mod0", "mod1"):
        for axis in range(AXES):
            if not ("client" in kind and (name, axis) == ("mod0", 0)):
                _take_halt(watches[name], axis, begin, what, pids[name], tally)
    if how is signal.SIGSTOP:
        os.kill(daemon.pid, signal.SIGKILL)
        tally.signals[signal.SIGKILL] += 1
    for pid in clients.values():
        daemon.kill(pid)
        daemon.reap(pid)
    with contextlib.suppress(OSError):
        cell.close()
    daemon.process.wait(10.0)
    try:
        wait_for(lambda: not any(lives(pid) for pid in (*pids.values(), *servers)), 10.0, "its processes to end")
    except TimeoutError:
        tally.is_wrong("processes left", kind)
    daemon.start()
    with daemon.cell("judge") as cell:
        _judge(cell, "mod2", tally)


def _look_for_leaks(daemon: Daemon, before: dict[str, int], tally: Tally) -> None:
    """Compare the daemon, and the processes it has, with what they were at the beginning."""

    def grown() -> dict[str, int]:
        return {what: now - before[what] for what, now in _weight(daemon).items() if now > before[what]}

    with contextlib.suppress(TimeoutError):  # what is on its way out may go
        wait_for(lambda: not grown(), 3.0, "all to be gone")
    for what, count in grown().items():
        tally.is_wrong("processes left" if what == "processes" else "descriptors left", f"{count} {what}")


def _weight(daemon: Daemon) -> dict[str, int]:
    """Return how many processes the daemon has, fork server among them, and descriptors of each of ours."""
    drivers = daemon.device_pids()
    children = Path(f"/proc/{daemon.pid}/task/{daemon.pid}/children").read_text().split()
    weight = {
        "processes": max(len(children), len(drivers) + 1),
        "descriptors of the daemon": descriptors(daemon.pid),
    }
    return weight | {f"descriptors of {name}": descriptors(pid) for name, pid in drivers.items()}


def fork_servers(daemon: Daemon, drivers: set[int]) -> list[int]:
    """Return the fork server, if there is one: after its death one is started when it is needed."""
    children = Path(f"/proc/{daemon.pid}/task/{daemon.pid}/children").read_text().split()
    return [int(pid) for pid in children if int(pid) not in drivers]


def send(acts: Sequence[tuple[int, signal.Signals]], chance: random.Random, tally: Tally) -> list[int]:
    """Send signals within a millisecond; return when each was sent [ns].

    If we may, we and the victims go before other work on the machine: who dies needs a processor to end on.
    """
    begins = []
    for pid in (0, *(pid for pid, _ in acts)):
        with contextlib.suppress(OSError):
            os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(1))
    for pid, how in acts:
        begins.append(time.monotonic_ns())
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, how)
            tally.signals[how] += 1
        time.sleep(chance.random() * 0.001 / len(acts))
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return begins


def lives(pid: int) -> bool:
    """Tell whether a process is there and has not ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False
