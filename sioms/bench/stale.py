"""Readings that are older than what the same program has been acknowledged: there must be none.

Real daemons and drivers, with compiled ticks and without, the blocking face and that of asyncio: requests of axes,
outputs, sensors and of the daemon in random order, each followed by readings through the same node, its read-only
companion, or the node of the whole device. The same on a clock of its own, with skipped ticks, lost polls and drives on
lines, is tests/properties/test_own_writes.py.
"""

from __future__ import annotations

import asyncio
import os
import random
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from sioms import aio
from sioms.check.daemon import Daemon
from sioms.client.command import command
from sioms.protocol.flags import AxisStatus

from .figures import Bar, Report
from .options import Options
from .workcells import axes, force, workcell

QUICK, FULL = 400, 20_000
STOPPED, STOPPING = int(AxisStatus.EMERGENCY_STOP), int(AxisStatus.STOPPING)
WAITING_SYNCH = int(AxisStatus.WAITING_SYNCH)
RATE_HZ = 1000.0
IO = f'[device.io0]\ndriver = "sim-io"\noutputs = 8\nsafe = 0\ntick_hz = {RATE_HZ}\n'

Do = Callable[[Any], Any]
Shows = Callable[[Any], bool]
Act = Callable[[], Shows]


def bench_stale(options: Options, report: Report) -> None:
    """Play interleavings on both faces, with compiled ticks and without; tell how many readings were stale."""
    count = options.kills(QUICK, FULL)
    played = read = 0
    stale: list[str] = []
    for compiled in (True, False):
        config = workcell([axes("mod0", 2, tick_hz=RATE_HZ), force("force0", tick_hz=RATE_HZ), IO])
        with _steps(compiled), Daemon(config) as daemon:
            for face in (_blocking, _asyncio):
                with face(daemon) as (cell, do):
                    game = Game(cell, do, random.Random(options.seed))
                    what = f"{'compiled' if compiled else 'plain'} ticks, {face.__name__.strip('_')}"
                    begin = time.monotonic()
                    for i in range(count // 4):
                        game.play()
                        if not i % 64:
                            report.progress(f"stale: {what}: {i} of {count // 4}")
                    game.close()
                    rate = (count // 4) / (time.monotonic() - begin)
                    report.value(what, game.read, "readings", notes=f"{count // 4} requests, {rate:.0f} a second")
                    played, read = played + count // 4, read + game.read
                    stale += [f"{what}: {text}" for text in game.stale]
    report.value("interleavings in all", played)
    report.value("readings in all", read)
    report.value("stale readings", len(stale), bars=[Bar("value", 0)], notes="; ".join(stale[:5]))


@contextmanager
def _steps(compiled: bool) -> Iterator[None]:
    """Have what is started run its steps compiled, or as Python."""
    before = os.environ.pop("SIOMS_UNCOMPILED", None)
    if not compiled:
        os.environ["SIOMS_UNCOMPILED"] = "1"
    try:
        yield
    finally:
        os.environ.pop("SIOMS_UNCOMPILED", None)
        if before is not None:
            os.environ["SIOMS_UNCOMPILED"] = before


@contextmanager
def _blocking(daemon: Daemon) -> Iterator[tuple[Any, Do]]:
    with daemon.cell() as cell:
        yield cell, lambda answer: answer


@contextmanager
def _asyncio(daemon: Daemon) -> Iterator[tuple[Any, Do]]:
    with asyncio.Runner() as runner:
        cell = runner.run(aio.connect(daemon.socket))
        try:
            yield cell, runner.run
        finally:
            runner.run(cell.close())


class Game:
    """Requests in random order, and what must show after each.

    Args:
        cell: a session.
        do: carries out what a verb of it returns.
        chance: of the order.

    Attributes:
        read: readings that were looked at.
        stale: a sentence for each that did not show what was acknowledged.
    """

    def __init__(self, cell: Any, do: Do, chance: random.Random) -> None:
        self._cell, self._do, self._chance = cell, do, chance
        self.read = 0
        self.stale: list[str] = []
        self._axis, self._out = (do(cell.open(name, "rw", timeout=10.0)) for name in ("mod0.a0", "io0"))
        self._force = do(cell.open("force0"))
        names = {self._axis: ("mod0.readonly", "mod0.a0.readonly"), self._out: ("io0.readonly",), self._force: ()}
        self._eyes = {node: [node, *[do(cell.open(name)) for name in eyes]] for node, eyes in names.items()}
        self._stopped = False
        self._count = 0
        on_axis: Sequence[Act] = (
            self._jog, self._stop, self._queue, self._calibrate, self._zero, self._emergency, self._gate, self._idle,
        )  # fmt: skip
        self._acts: list[tuple[Any, Act]] = [(self._axis, act) for act in on_axis]
        self._acts += [(self._out, self._set)] * 3 + [(self._force, self._gains), (self._force, self._tare)]

    def play(self) -> None:
        """Ask for something, and read."""
        node, act = self._chance.choice(self._acts)
        if self._stopped and node is self._axis:
            act = self._reset
        self._count += 1
        shows = act()
        if self._chance.random() < 0.2:  # else the reading comes as soon as it can
            time.sleep(self._chance.uniform(0.0, 2.0 / RATE_HZ))
        for _ in range(self._chance.randint(1, 2)):
            eye = self._chance.choice(self._eyes[node])
            seen = self._do(eye.fresh()) if self._chance.random() < 0.3 else eye.read()
            self.read += 1
            if not shows(seen):
                self.stale.append(f"{act.__name__.strip('_')} does not show on {eye.name}: {seen}"[:300])

    def close(self) -> None:
        """Leave the workcell as it was."""
        self._do(self._cell.reset())
        self._do(self._force.set_gains([1.0] * 6))
        for eyes in self._eyes.values():
            for node in eyes:
                self._do(node.close())

    # --- an axis ---------------------------------------------------------------------------------

    def _jog(self) -> Shows:
        speed = self._chance.choice((-1e-3, 1e-3))
        self._do(self._axis.jog(speed))
        return lambda seen: bool(seen.in_motion[0] or seen.buffered[0])

    def _stop(self) -> Shows:
        self._do(self._axis.stop())
        return lambda seen: bool(seen.status[0] & STOPPING) or not seen.in_motion[0]

    def _queue(self) -> Shows:
        count = self._chance.randint(1, 8)
        self._do(self._axis.stop())
        self._do(self._axis.write([command(velocity=1e-3, synch=True)] * count))
        return lambda seen: bool(seen.buffered[0] == count)

    def _gate(self) -> Shows:
        """Flush, or start what waits."""
        self._do(self._axis.stop())
        self._do(self._axis.wait_until_idle(5.0))
        self._do(self._axis.command(velocity=1e-3, synch=True))
        if self._chance.random() < 0.5:
            self._do(self._axis.flush())
            return lambda seen: not seen.buffered[0] and not seen.status[0] & WAITING_SYNCH
        self._do(self._axis.synch(time.monotonic_ns() + 50_000_000))
        return lambda seen: not seen.status[0] & WAITING_SYNCH

    def _idle(self) -> Shows:
        self._do(self._axis.stop())
        self._do(self._axis.wait_until_idle(5.0))
        return lambda seen: not seen.in_motion[0]

    def _calibrate(self) -> Shows:
        self._idle()
        place = self._chance.uniform(-0.1, 0.1)
        self._do(self._axis.calibrate(place))
        return lambda seen: abs(seen.position[0] - place) < 5e-4

    def _zero(self) -> Shows:
        self._calibrate()
        self._do(self._axis.zero())
        return lambda seen: abs(seen.position[0]) < 5e-4

    def _emergency(self) -> Shows:
        by_daemon = self._chance.random() < 0.5
        self._do(self._cell.emergency_stop("mod0.a0") if by_daemon else self._axis.emergency_stop())
        self._stopped = True
        return lambda seen: bool(seen.status[0] & STOPPED)

    def _reset(self) -> Shows:
        self._do(self._cell.reset("mod0.a0") if self._chance.random() < 0.5 else self._axis.reset())
        self._stopped = False
        return lambda seen: not seen.status[0] & STOPPED

    # --- outputs and a sensor --------------------------------------------------------------------

    def _set(self) -> Shows:
        value = self._chance.randrange(256)
        self._do(self._out.set(value))
        return lambda seen: bool(seen.data[0] == value)

    def _gains(self) -> Shows:
        """A gain of 0 makes all readings 0, whatever the noise; one of 1 makes them noise again."""
        self._do(self._force.set_gains([0.0] * 6))
        return lambda seen: not any(seen.data)

    def _tare(self) -> Shows:
        self._do(self._force.set_gains([1.0] * 6))
        return lambda seen: any(seen.data)
