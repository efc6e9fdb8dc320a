"""What remote clients hold, many at a time: clients are killed and hang, gateways are killed and hang, and the link
between them is cut, stalls, is late, loses pieces and doubles them.

Sixteen clients of one cell move an axis each and ask at random for what does not change that. What is looked at: how
soon each axis halts, whether anything moves again by itself when clients have connected anew, whether an output has two
owners, and what the sessions that have ended leave in the gateway. A trial is a client that loses its axis.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import random
import signal
import struct
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from sioms.check.daemon import Daemon, descriptors, wait_for
from sioms.check.remote import Gateway, ZenohGateway
from sioms.client.command import command
from sioms.client.workcell import Workcell
from sioms.protocol.link import DEFAULT_LEASE_S

from .badlink import KINDS as BAD
from .badlink import BadLink
from .figures import Bar, Report
from .options import Options
from .workcells import axes, workcell

DEVICES = ("mod0", "mod1")
AXES = 8
SPEED = 0.05
HISTORY = 4096
BAR_MS = 1e3 * DEFAULT_LEASE_S + 20
ROUNDS: Mapping[str, int] = {"client killed": 4, "client hung": 1} | {f"link {kind}": 1 for kind in BAD}
"""Rounds of one gateway's life; it ends by being killed, or every fourth time by hanging."""
ENDS = ("gateway killed", "gateway killed", "gateway killed", "gateway hung")
SETTLED_S = 0.1
"""From the first slower snapshot to rest, with much to spare [s]."""
WRONG = ("axes that never halted", "motions that began again", "second owners", "clients that did not come back",
         "descriptors and threads left in gateways")  # fmt: skip


class Tally:
    """What has been seen.

    Attributes:
        halts: by what had happened: from then to each axis halting [ns].
        wrong: what must not be, by name.
        again: connections of clients after they had lost one.
    """

    def __init__(self) -> None:
        self.halts: dict[str, list[int]] = {}
        self.wrong = Counter(dict.fromkeys(WRONG, 0))
        self.again = 0
        self.notes: list[str] = []

    @property
    def trials(self) -> int:
        """Axes that have halted, or should have."""
        return sum(map(len, self.halts.values())) + self.wrong["axes that never halted"]

    def is_wrong(self, what: str, detail: str, count: int = 1) -> None:
        """Count what must not be."""
        self.wrong[what] += count
        self.notes.append(f"{what}: {detail}")


def bench_links(options: Options, report: Report, kind: type[Gateway] = Gateway) -> None:
    """Lose clients, links and gateways until there have been as many losses as asked for."""
    wanted, chance, tally = options.kills(100, 10_000), random.Random(options.seed), Tally()
    with contextlib.suppress(OSError):  # clients and gateways that get no processor lose their axes by their leases
        os.nice(-10)
    config = workcell([axes(name, AXES, history=HISTORY, limits=False) for name in DEVICES])
    with Daemon(config) as daemon, kind(daemon.socket) as gateway, BadLink(daemon, gateway.port) as link:
        intruder = Intruder(daemon)
        try:
            while tally.trials < wanted:
                _life(_Scene(daemon, gateway, link, chance, tally), chance.choice(ENDS), options.quick)
                report.progress(f"links: {tally.trials} of {wanted}")
        finally:
            _tell(tally, intruder, report)


def bench_zenohlinks(options: Options, report: Report) -> None:
    """The same over Zenoh."""
    bench_links(options, report, ZenohGateway)


def _tell(tally: Tally, intruder: Intruder, report: Report) -> None:
    for note in tally.notes[:20]:
        report.note(note[:300])
    for what, halts in tally.halts.items():
        late = sum(halt > BAR_MS * 1e6 for halt in halts)
        report.samples(f"{what} to its axis halting", halts, "ms", bars=[Bar("max", BAR_MS)],
                       notes=f"{late} later than the bar")  # fmt: skip
    tried, taken, double = intruder.seen()
    tally.wrong["second owners"] += double
    zero = [Bar("value", 0)]
    for what in WRONG:
        notes = f"{tried} tries of another client, {taken} of a free axis" if what == "second owners" else ""
        report.value(what, tally.wrong[what], bars=zero, notes=notes)
    report.value("connections after a lost one", tally.again)


# --- who tries to become a second owner ----------------------------------------------------------


class Intruder:
    """A local client that opens axes for writing whenever it can, and sees that none is driven by another meanwhile."""

    _COUNTS = struct.Struct("<QQQ")

    def __init__(self, daemon: Daemon) -> None:
        self._memory = mmap.mmap(-1, mmap.PAGESIZE)
        daemon.fork(lambda: self._run(daemon))

    def seen(self) -> tuple[int, int, int]:
        """Return tries, opens, and axes that were driven while it had them."""
        tried, taken, double = self._COUNTS.unpack_from(self._memory)
        return tried, taken, double

    def _run(self, daemon: Daemon) -> None:
        tried = taken = double = 0
        chance = random.Random(0)
        with daemon.cell("intruder") as cell:
            while True:
                tried += 1
                name = f"{chance.choice(DEVICES)}.a{chance.randrange(AXES)}"
                with contextlib.suppress(OSError), cell.open(name, "rw", 0.001) as axis:
                    before = abs(axis.read().commanded_velocity[0])
                    time.sleep(0.003)
                    double += abs(axis.read().commanded_velocity[0]) > before + 1e-9
                    taken += 1
                self._COUNTS.pack_into(self._memory, 0, tried, taken, double)
                time.sleep(0.005)


# --- owners --------------------------------------------------------------------------------------


def _owner(address: str, name: str, seed: int, begun: mmap.mmap) -> None:
    """Move an axis until it is lost; then connect and open again, and move nothing.

    A client that a busy machine keeps waiting for longer than its lease loses its axis before anything has been done to
    it: until then it tries again.
    """
    chance = random.Random(seed)
    while True:
        with (
            contextlib.suppress(OSError),
            Workcell(address, f"owner {name}") as cell,
            cell.open(name, "rw", 20.0) as axis,
        ):
            if not begun[0]:
                axis.write(command(0, velocity=SPEED))
            while True:
                chance.choices((axis.keepalive, axis.read, cell.nodes), (8, 8, 1))[0]()
                axis.keepalive()
                time.sleep(0.01 + 0.04 * chance.random())
        time.sleep(0.1)


# --- a gateway's life ----------------------------------------------------------------------------


class _Scene:
    """What a round happens in."""

    def __init__(
        self, daemon: Daemon, gateway: Gateway, link: BadLink, chance: random.Random, tally: Tally
    ) -> None:  # fmt: skip
        self.daemon, self.gateway, self.link, self.chance, self.tally = daemon, gateway, link, chance, tally
        self.through = gateway.trusted(link.port)
        self.begun = mmap.mmap(-1, mmap.PAGESIZE)
        """Whether what a round is about has happened; owners see it."""


def _life(scene: _Scene, end: str, short: bool) -> None:
    """Rounds with one gateway, whose end is the last one; then the next gateway is started."""
    kinds = [kind for kind, count in ROUNDS.items() for _ in range(1 if short else count)]
    scene.chance.shuffle(kinds)
    with scene.daemon.cell("judge") as cell:
        _round(scene, cell, "client killed")  # warm, so that sizes can be compared
        before = _weight(scene, cell)
        for kind in kinds:
            _round(scene, cell, kind)
        _compare(before, _weight(scene, cell), scene.tally)
        _round(scene, cell, end)


def _round(scene: _Scene, cell: Any, kind: str) -> None:
    """Have owners on all axes, lose them, and look."""
    who, what = kind.split()
    nodes = {name: cell.open(f"{name}.readonly") for name in DEVICES}
    owners = _set_going(scene, nodes, scene.through if who == "link" else scene.gateway.socket)
    time.sleep(0.05 * scene.chance.random())
    after = {name: node.read().number for name, node in nodes.items()}
    scene.begun[0] = 1
    begins = dict.fromkeys(owners, 0)
    if who == "client":
        for axis, pid in owners.items():
            begins[axis] = scene.daemon.kill(pid, signal.SIGKILL if what == "killed" else signal.SIGSTOP)
            time.sleep(0.05 * scene.chance.random() / len(owners))
    elif who == "link":
        begins = dict.fromkeys(owners, scene.link.be(what))
    else:
        begins = dict.fromkeys(owners, time.monotonic_ns())
        os.kill(scene.gateway.process.pid, signal.SIGKILL if what == "killed" else signal.SIGSTOP)
    for name, node in nodes.items():
        _take_halts(node, name, after[name], begins, kind, scene.tally)
    _come_back(scene, cell, who, owners)
    for name, node in nodes.items():
        _look_for_motion(node, after[name], max(begins.values()), kind, scene.tally)
        node.close()
    for pid in owners.values():
        scene.daemon.kill(pid)
        scene.daemon.reap(pid)


def _set_going(scene: _Scene, nodes: Mapping[str, Any], address: str) -> dict[str, int]:
    """Return owners by axis, all of which move it."""
    owners = {}
    scene.begun[0] = 0
    for name in [f"{device}.a{number}" for device in DEVICES for number in range(AXES)]:
        owners[name] = scene.daemon.fork(partial(_owner, address, name, scene.chance.getrandbits(32), scene.begun))
    for node in nodes.values():
        wait_for(partial(_all_go, node), 120.0, f"{node.name} to cruise")
    return owners


def _all_go(node: Any) -> bool:
    return all(abs(v - SPEED) < 1e-6 for v in node.read().commanded_velocity)


def _take_halts(
    node: Any, device: str, after: int, begins: Mapping[str, int], kind: str, tally: Tally
) -> None:  # fmt: skip
    """Take how long each axis of a device took from what happened to its first slower snapshot."""
    left = {number: begins[f"{device}.a{number}"] for number in range(AXES)}
    deadline = time.monotonic() + 3.0
    while left and time.monotonic() < deadline:
        for snapshot in node.history(after, gone=True):
            after = snapshot.number
            for number, speed in enumerate(snapshot.commanded_velocity):
                if speed < SPEED - 1e-6 and snapshot.stamp_ns >= left.get(number, 1 << 63):
                    tally.halts.setdefault(kind, []).append(snapshot.stamp_ns - left.pop(number))
        time.sleep(0.005)
    for number in left:
        tally.is_wrong("axes that never halted", f"{kind}: {device}.a{number}")


def _come_back(scene: _Scene, cell: Any, who: str, owners: Mapping[str, int]) -> None:
    """Mend what was broken and wait until the clients that live hold their axes again."""
    if who == "client":
        return
    if who == "gateway":
        with contextlib.suppress(ProcessLookupError):
            os.kill(scene.gateway.process.pid, signal.SIGKILL)
        scene.gateway.process.end()
        scene.gateway.start()
    else:
        scene.link.be("")
    tally = scene.tally
    seen: set[str] = set()

    def all_have_been_back() -> bool:  # the intruder may have one of them at any time
        seen.update(row[0] for row in cell.status()["holders"] if "owner" in str(row) and row[0] in owners)
        return len(seen) == len(owners)

    try:
        wait_for(all_have_been_back, 60.0, "clients to come back")
    except TimeoutError:
        tally.is_wrong("clients that did not come back", f"{len(owners) - len(seen)}", len(owners) - len(seen))
    tally.again += len(seen)


def _look_for_motion(node: Any, after: int, begin_ns: int, kind: str, tally: Tally) -> None:
    """See that nothing has moved since it halted."""
    rest_ns = begin_ns + int((DEFAULT_LEASE_S + SETTLED_S) * 1e9)
    for snapshot in _history(node, after):
        if snapshot.stamp_ns > rest_ns and any(abs(v) > 1e-9 for v in snapshot.commanded_velocity):
            tally.is_wrong("motions that began again", f"{kind}: {node.name} at {snapshot.stamp_ns - begin_ns} ns")
            return


def _history(node: Any, after: int) -> Iterator[Any]:
    newest = node.read().number
    yield from node.history(max(after, newest - HISTORY + 8), gone=True)


# --- what is left --------------------------------------------------------------------------------


def _weight(scene: _Scene, cell: Any) -> dict[str, int]:
    """Return descriptors and threads of the gateway, when all sessions have ended."""
    wait_for(lambda: not any("owner" in str(row) for row in cell.status()["holders"]), 30.0, "sessions to end")
    time.sleep(0.3)
    pid = scene.gateway.process.pid
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return {"descriptors": descriptors(pid), "threads": int(status["Threads"])}


def _compare(before: Mapping[str, int], after: Mapping[str, int], tally: Tally) -> None:
    for what in before:
        if after[what] > before[what]:
            count = after[what] - before[what]
            tally.is_wrong("descriptors and threads left in gateways", f"{count} {what}", count)
