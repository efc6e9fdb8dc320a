"""The workcell of etc/hand.toml on one thread and a clock of its own: its drivers as they are, ticked in turn.

Nothing waits and nothing is late unless a test says so; what the daemon does (handles, leases, deaths) is not here.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar

import msgspec
import numpy as np
from motion_rig import Markers

from sioms.drivers.compound.hand import HandDriver
from sioms.drivers.sim.axes import SimAxes
from sioms.drivers.sim.force import SimForce
from sioms.drivers.sim.tactile import SimTactile
from sioms.drivers.sim.world import SimWorld
from sioms.hand.contacts import FINGER_M, Grasp, grasp_of
from sioms.hand.control import Gains
from sioms.hand.felt import felt, internal_force, lightly
from sioms.hand.follow import D, Follower, Order, standing
from sioms.hand.kinematics import Hand
from sioms.hand.touch import Felt, Reading, Setpoint
from sioms.motion.commands import WIRE_DTYPE
from sioms.protocol.flags import AxisStatus, ControlMode
from sioms.protocol.records import VALUE, read_rows
from sioms.sdk.exchange import LinkError
from sioms.sdk.inputs import NotMeasuredError

T = TypeVar("T")
ETC = Path(__file__).resolve().parents[1] / "etc"
DRIVERS: dict[str, Any] = {
    "hand": HandDriver, "sim-axes": SimAxes, "sim-force": SimForce, "sim-tactile": SimTactile, "sim-world": SimWorld,
}  # fmt: skip
_COMMON = ("driver", "description", "lease_s", "realtime_priority", "hang_s", "process")
_LATCHED = int(AxisStatus.EMERGENCY_STOP | AxisStatus.FAULT)


class Node:
    """A node as another driver sees it: read, and driven where it is held."""

    def __init__(self, cell: HandCell, name: str) -> None:
        self._cell, self.name = cell, name
        self.stamp_ns = self.as_of_ns = self.shows_reset_ns = 0
        self.is_there = True
        self.dead = False

    @property
    def channels(self) -> Any:
        return self._block()[0].spec.channels

    def _block(self) -> tuple[Any, int | None]:
        device, _, rest = self.name.partition(".")
        blocks = {block.spec.name: block for block in self._cell.drivers[device].blocks}
        if rest in blocks:
            return blocks[rest], None
        head, _, channel = rest.rpartition(".")
        block = blocks[head]
        return block, [one.name for one in block.spec.channels].index(channel)

    def read(self, now_ns: int) -> Any:
        device = self.name.partition(".")[0]
        if self.dead or device not in self._cell.shown_ns:
            return None
        block, channel = self._block()
        fields = np.frombuffer(bytes(block.payload())).reshape(-1, block.n)
        rows = read_rows(block.spec.node_class, fields if channel is None else fields[:, [channel]])
        rows["value"] = rows[VALUE[block.spec.node_class]]
        self.stamp_ns = block.stamp_ns or self._cell.shown_ns[device]
        self.as_of_ns = self._cell.shown_ns[device]
        return rows

    def measured(self, now_ns: int, since_ns: int = 0) -> Any:
        rows = self.read(now_ns)
        if rows is None or self.stamp_ns < since_ns:
            raise NotMeasuredError(f"{self.name}: not there, or old")
        return rows["value"]

    def drive(self, velocities: Sequence[float]) -> None:
        self._write([(axis, False, velocity) for axis, velocity in enumerate(velocities)])

    def _write(self, orders: Sequence[Order]) -> None:
        write(self._cell.drivers[self.name].bank, orders, self._cell.now_ns)

    def stop(self) -> None:
        bank = self._cell.drivers[self.name].bank
        bank.stop(np.arange(bank.n), self._cell.now_ns)

    def reset(self, until_ns: int) -> None:
        bank = self._cell.drivers[self.name].bank
        bank.reset(np.arange(bank.n))

    def trouble(self) -> OSError | None:
        bank = self._cell.drivers[self.name].bank
        latched = np.flatnonzero(bank.rows["status"] & _LATCHED)
        return OSError(5, bank.fault_text(int(latched[0])) or "emergency stop") if latched.size else None


def write(bank: Any, orders: Sequence[Order], now_ns: int, most_n: float = math.inf) -> None:
    """Write velocities and forces to a bank, replacing what it does; with a greatest force of d, if it is finite."""
    records = np.zeros(len(orders), WIRE_DTYPE)
    for record, (axis, presses, value) in zip(records, orders, strict=True):
        record["axis"] = axis
        record["control_mode"] = int(ControlMode.FORCE if presses else ControlMode.VELOCITY)
        record["force" if presses else "velocity"] = value
        if axis == D and most_n < math.inf:
            record["control_mode"] |= int(ControlMode.SPECIFIED_MAX_FORCE)
            record["max_force"] = most_n
    bank.append(records, np.arange(bank.n), now_ns, replace=True)


class Nodes(dict[str, Node]):
    """Nodes by name, made when they are asked for."""

    def __init__(self, cell: HandCell) -> None:
        self._cell = cell

    def __missing__(self, name: str) -> Node:
        self[name] = Node(self._cell, name)
        return self[name]


class HandCell:
    """The cell; ``run`` carries out a skill.

    Args:
        change: changes the tables of etc/hand.toml.
        compiled: the estimator; the plain one is slower and needs no numba.
    """

    def __init__(self, change: Callable[[dict[str, Any]], None] = lambda tables: None, compiled: bool = True) -> None:
        self.now_ns = 1_000_000_000
        self.nodes = Nodes(self)
        self.shown_ns: dict[str, int] = {}
        kit: Any = SimpleNamespace(
            markers=Markers(), inputs=self.nodes, held=self.nodes, now_ns=lambda: self.now_ns, log=print
        )
        tables = tomllib.loads(
            (ETC / "hand.toml").read_text(encoding="utf-8").replace("hand-finger.toml", f"{ETC}/hand-finger.toml")
        )
        change(tables["device"])
        self.drivers: dict[str, Any] = {}
        self._period_ns: dict[str, int] = {}
        self._next_ns: dict[str, int] = {}
        for index, (name, table) in enumerate(tables["device"].items()):
            kind = DRIVERS[table["driver"]]
            if "shape" in table:
                table["shape"]["compiled"] = compiled
            keys = {key: value for key, value in table.items() if key not in _COMMON}
            self.drivers[name] = kind(name, msgspec.convert(keys, kind.Settings), kit)
            period_ns = self._period_ns[name] = round(1e9 / self.drivers[name].settings.tick_hz)
            self._next_ns[name] = self.now_ns + round(period_ns * ((index * 0.6180339887) % 1.0))
        self._open: set[str] = set()
        self.halted: set[str] = set()
        self.lost: dict[str, str] = {}
        self.hand = Hand()
        self._yields = "touch" in tables["device"]["hand"]
        self._follower = Follower(Gains())
        self.seen: Callable[[HandCell, Setpoint], None] | None = None
        self._begin_ns, self._was_s = self.now_ns, 0.0
        self.advance(0.5 if self._yields else 0.2)  # means of frames have to come, too
        self.reading = self._read()

    @property
    def bank(self) -> Any:
        """Of the hand."""
        return self.drivers["hand"].bank

    @property
    def world(self) -> Any:
        """The truth."""
        return self.drivers["world"]._world

    def advance(self, time_s: float) -> None:
        """Let all devices tick for a time."""
        end_ns = self.now_ns + round(time_s * 1e9)
        while (name := min(self._next_ns, key=self._next_ns.__getitem__)) and self._next_ns[name] <= end_ns:
            self._tick(name)
        self.now_ns = end_ns

    def _tick(self, name: str) -> None:
        self.now_ns = self._next_ns[name]
        self._next_ns[name] += self._period_ns[name]
        if name in self.halted:
            return
        driver = self.drivers[name]
        try:
            if name not in self._open:
                driver.open()
                self._open.add(name)
            driver.tick(self.now_ns)
        except LinkError as error:
            self.lost[name] = str(error)
            self._open.discard(name)
            return
        self.lost.pop(name, None)
        self.shown_ns[name] = self.now_ns

    def run(self, ticks: Generator[Setpoint, Reading, T], most_s: float = 60.0) -> T:
        """Carry out a skill to its end; return what it found."""
        end = self.reading.time_s + most_s
        try:
            setpoint = next(ticks)
            while self.reading.time_s < end:
                setpoint = ticks.send(self.tick(setpoint))
        except StopIteration as done:
            write(self.bank, standing(), self.now_ns)
            found: T = done.value
            return found
        raise TimeoutError(f"not done in {most_s:g} s")

    def tick(self, setpoint: Setpoint) -> Reading:
        """Go on by a tick of the hand."""
        if setpoint.frozen:
            self.bank.stop(np.arange(6), self.now_ns)
        else:
            force = internal_force(*self.reading.fingers) or 0.0
            orders = self._follower.orders(setpoint, self.coordinates, force, max(self._sample_s, 1e-4))
            most = self.drivers["hand"].settings.axis[D].force_max if self._yields else math.inf
            write(self.bank, orders, self.now_ns, min(setpoint.most_n, most))
        self.advance(2.5e-3)
        self.reading = self._read()
        if self.seen is not None:
            self.seen(self, setpoint)
        return self.reading

    @property
    def coordinates(self) -> list[float]:
        """As the hand's node shows them."""
        return [float(value) for value in self.bank.rows["position"]]

    def _read(self) -> Reading:
        time_s = (self.now_ns - self._begin_ns) * 1e-9
        self._sample_s, self._was_s = time_s - self._was_s, time_s
        feels, ages = [], []
        for name in ("touch1.shape", "touch2.shape"):
            row = self.nodes[name].read(self.now_ns)
            feels.append(felt(row["value"].tolist(), 20e-3))
            ages.append((self.now_ns - self.nodes[name].stamp_ns) * 1e-9)
        joints: Any = self.hand.inverse(self.coordinates)
        light = self._lightly() if self._yields else None
        return Reading(time_s, joints, (feels[0], feels[1]), (ages[0], ages[1]), light=light)

    def _lightly(self) -> tuple[Felt, Felt]:
        touch = self.nodes["hand.touch"].read(self.now_ns)["value"].tolist()
        one, two = (felt(self.nodes[f"touch{i}.mean"].read(self.now_ns)["value"].tolist(), 20e-3) for i in (1, 2))
        return lightly(touch[0], touch[2], one), lightly(touch[1], touch[3], two)

    def truth(self) -> Grasp:
        """Return the true grasp."""
        one, two = self.world.fingers
        return grasp_of(one.centre, two.centre, one.phi + one.place[2], two.phi + two.place[2], FINGER_M)
