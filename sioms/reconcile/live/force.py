"""``sioms reconcile force NODE``: design the loads, ask, apply and record them through the daemon, decide, put the
model to work.

A *stand* says how the sensor can be loaded (``--stand``): axes that press, each with a force that tells how hard, and
weights that somebody hangs on::

    [[push]]
    name = "z"
    axis = "mod0.zaxis"                     # m, larger presses harder
    reference = "mod0.plant.zaxis_contact"  # N, what it presses with
    wrench = [0, 0, -1, 0.05, 0, 0]         # on the sensor, per newton: fx, fy, fz, tx, ty, tz (1, m)
    most = 40.0                             # N
    [[hang]]
    name = "x"
    wrench = [1, 0, 0, 0, 0, 0]
    loads = [5.0, 10.0, 20.0]               # N at hand

The workflow sees what any client sees. It knows nothing of what the sensor hides.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

import sioms
from sioms.documents import read_bytes, toml_of
from sioms.lab.loading_axis import LoadingAxis
from sioms.lab.stopping import ExperimentStopped
from sioms.protocol.flags import AnalogStatus, NodeClass
from sioms.protocol.nodeinfo import NodeInfo
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.force import read_model, reconcile_force
from sioms.reconcile.force.plan import LAPS, UP_AND_DOWN, Push, rest
from sioms.reconcile.force.records import unit_of
from sioms.reconcile.live.experiments import ROUNDS, Say, agree, decide, have_done, kept
from sioms.reconcile.live.experiments import able as choose
from sioms.reconcile.sensors.verdict import Proposal, SensorVerdict

LEASE_S = 1.0
#: Rows of a hold, and the samples that each is the mean of; what a hold takes with its motion [s].
ROWS, SAMPLES, HOLD_S = 4, 40, 0.6
PRESS, REST = "push_", "rest"


class PushTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An axis that presses on the sensor."""

    name: str
    axis: str
    reference: str
    wrench: tuple[float, ...]
    most: float
    clear_m: float = 2e-3


class HangTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Weights that somebody hangs on the sensor."""

    name: str
    wrench: tuple[float, ...]
    loads: tuple[float, ...]


class Stand(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a sensor can be loaded."""

    push: tuple[PushTable, ...] = ()
    hang: tuple[HangTable, ...] = ()


@dataclass(frozen=True, slots=True)
class Load:
    """What a user asks of a live run.

    Attributes:
        node: the sensor; stand: how it can be loaded.
        first: "full" for all loads of the stand, "one" for the first only.
        rest_s: time without a load, where that decides.
        yes: move without asking.
        socket: of the daemon, None for the usual one.
    """

    node: str
    stand: Path
    first: str = "full"
    rest_s: float = 120.0
    yes: bool = False
    socket: str | None = None
    seed: int = 1


def live(model: Path, asked: Load, folder: Path, say: Say) -> tuple[SensorVerdict, float]:
    """Reconcile a force/torque sensor behind a daemon.

    Args:
        model: the nominal sensor.
        folder: where the records go, readable as DATA; they replace those of an earlier run at the end.

    Returns:
        The verdict and the seconds of analysis.

    Raises:
        BadInputError: the nodes are no such stand, or the user did not agree.
        ExperimentStopped: the experiment was stopped; the axes are halted.
        OSError: the daemon or a node cannot be reached.
    """
    nominal, names = read_model(model)
    stand = read_stand(asked.stand, len(names))
    pushes = {p.name: p for p in _pushes(stand)}
    full = nominal.base.full
    able = [*(p.plan(full) for p in pushes.values()), rest(len(names), asked.rest_s)]
    plans = {plan[0]: plan for plan in able}
    with sioms.Workcell(asked.socket, "reconcile") as cell:
        _check_nodes(cell, asked.node, names, full, stand)
        first = list(pushes.values())[: None if asked.first == "full" else 1]
        _agree(asked, stand, first)
        with kept(folder) as fresh:
            bench = Bench(cell, asked, stand, names, fresh, say)
            for push in first:
                bench.apply(push)

            def separate(best: Proposal) -> None:
                if best.name == REST:
                    bench.rest()
                else:
                    bench.apply(pushes[best.name.removeprefix(PRESS)])

            return decide(
                lambda: reconcile_force(fresh, model, None, asked.seed, say, able),
                separate,
                choose(plans, lambda name: float(len(plans[name][2].load))),
                ROUNDS,
                say,
            )


def read_stand(path: Path, count: int) -> Stand:
    """Read a stand for a sensor of so many components.

    Raises:
        BadInputError: it is missing or makes no sense.
    """
    try:
        stand = msgspec.convert(toml_of(read_bytes(path)), Stand)
    except (OSError, ValueError, msgspec.ValidationError) as error:
        raise BadInputError(f"read stand {path}: {getattr(error, 'strerror', None) or error}") from None
    items = [(p.name, p.wrench, p.most) for p in stand.push]
    items += [(h.name, h.wrench, min(h.loads, default=0.0)) for h in stand.hang]
    names = [name for name, *_ in items]
    if not items or len(set(names)) != len(names):
        raise BadInputError(f"read stand {path}: names are {names}; needs one push or hang, each of its own name")
    for name, wrench, load_n in items:
        if len(wrench) != count or not any(wrench) or load_n <= 0.0:
            raise BadInputError(
                f"read stand {path}: {name} has a wrench of {len(wrench)} numbers and {load_n:g} N; needs {count} "
                "(not all 0) and more than 0 N"
            )
    return stand


def _pushes(stand: Stand) -> Iterator[Push]:
    for p in stand.push:
        text = f"{p.axis} presses with up to {p.most:g} N in steps up and down, {LAPS} times"
        yield Push(p.name, text, p.wrench, tuple(p.most * np.tile(UP_AND_DOWN, LAPS)))
    for h in stand.hang:
        up = (0.0, *sorted(h.loads), *sorted(h.loads)[-2::-1], 0.0)
        yield Push(h.name, f"weights of {', '.join(f'{v:g}' for v in h.loads)} N hung on and off", h.wrench, up)


def _check_nodes(cell: sioms.Workcell, node: str, names: Sequence[str], full: Any, stand: Stand) -> None:
    info = cell.info(node)
    have = tuple(c.name for c in info.channels)
    if info.node_class is not NodeClass.ANALOG or have != tuple(names):
        raise BadInputError(f"reconcile {node}: its channels are {', '.join(have)}; the model has {', '.join(names)}")
    for channel in info.channels:
        if channel.unit.replace("*", " ") != unit_of(channel.name):
            raise BadInputError(f"reconcile {node}: {channel.name} is in {channel.unit}; needs {unit_of(channel.name)}")
    for p in stand.push:
        _check_axis(cell.info(p.axis), p)
        told = cell.info(p.reference).channels
        if len(told) != 1 or told[0].unit != "N":
            raise BadInputError(f"load {node}: {p.reference} is no single force in N")
        _within(node, p.name, p.most, p.wrench, full)
    for h in stand.hang:
        _within(node, h.name, max(h.loads), h.wrench, full)


def _check_axis(info: NodeInfo, p: PushTable) -> None:
    single = info.node_class is NodeClass.AXIS and len(info.channels) == 1 and info.channels[0].unit == "m"
    if not single or info.channels[0].maximum is None:
        raise BadInputError(f"press with {p.axis}: it is no single axis in m with an upper end that the sensor bears")


def _within(node: str, name: str, most: float, wrench: Sequence[float], full: Any) -> None:
    share = float(np.max(most * np.abs(wrench) / full))
    if share > 1.0:
        raise BadInputError(f"load {node}: {name} goes to {share:.2f} of full range; needs 1 or less")


def _agree(asked: Load, stand: Stand, first: Sequence[Push]) -> None:
    seconds = HOLD_S * sum(len(p.levels) for p in first)
    told = [
        f"{asked.node} will be loaded for some {seconds:.0f} s:",
        *(f"  {p.name}: {p.text}" for p in first),
    ]
    question = "every axis is clear of what it presses, nothing hangs on the sensor; begin?"
    by_hand = {h.name for h in stand.hang}
    # nothing moves by itself where all is done by hand
    agree(f"load {asked.node}", told, question, asked.yes or all(p.name in by_hand for p in first))


class Bench:
    """Applies loads and keeps the rows. One thread. Axes are held only while they press."""

    def __init__(
        self, cell: sioms.Workcell, asked: Load, stand: Stand, names: Sequence[str], folder: Path, say: Say
    ) -> None:
        self._cell, self._asked, self._names, self._folder, self._say = cell, asked, names, folder, say
        self._push = {p.name: p for p in stand.push}
        self._rows: list[np.ndarray[Any, np.dtype[np.float64]]] = []
        self._began = time.monotonic()

    def apply(self, push: Push) -> None:
        """Apply the loads of a push and keep what the sensor says."""
        self._say(f"loading {push.name}: {push.text}")
        with self._cell.open(self._asked.node) as sensor:
            table = self._push.get(push.name)
            if table is None:
                for level in push.levels:
                    what = f"hang {level:g} N on {push.name}" if level else f"take everything off {push.name}"
                    have_done(what, "loads by hand need somebody at the terminal")
                    self._hold(sensor, push, partial(float, level), lambda: None)
            else:
                self._pressed(sensor, push, table)
        self._save()

    def rest(self) -> None:
        """Record the sensor without a load."""
        self._say(f"{self._asked.rest_s:.0f} s without a load")
        end = time.monotonic() + self._asked.rest_s
        nothing = Push(REST, "", (0.0,) * len(self._names), ())
        with self._cell.open(self._asked.node) as sensor:
            while time.monotonic() < end:
                self._hold(sensor, nothing, lambda: 0.0, lambda: None)
                time.sleep(self._asked.rest_s / 40.0)
        self._save()

    def _pressed(self, sensor: Any, push: Push, table: PushTable) -> None:
        with (
            self._cell.open(table.axis, "rw", lease=LEASE_S) as axis,
            self._cell.open(table.reference) as reference,
        ):
            loading = LoadingAxis(axis, reference, table.most, table.clear_m)
            try:
                loading.tare()
                loading.take(push.name)
                loading.learn()
                for level in push.levels:
                    if level > 0.0:
                        loading.press(level)
                    else:
                        loading.clear()
                    self._hold(sensor, push, _told(loading), loading.check)
            finally:
                with suppress(OSError, ExperimentStopped):  # stopped: it stays where it is
                    loading.clear()

    def _hold(self, sensor: Any, push: Push, load: Callable[[], float], check: Callable[[], None]) -> None:
        """Keep the rows of one load."""
        wrench = np.array(push.wrench)
        for _ in range(ROWS):
            begin_ns, last = time.monotonic_ns(), sensor.read().number
            seen: list[Any] = []
            load()
            while len(seen) < SAMPLES:
                sensor.wait_new(last, 2.0)
                new = sensor.history(last)
                last = new[-1].number
                seen += [one for one in new if one.stamp_ns >= begin_ns]  # what comes late was felt before
                check()
            if any(flag & (AnalogStatus.SATURATED | AnalogStatus.INVALID) for s in seen for flag in s.flags):
                raise ExperimentStopped(f"load {sensor.name}: it is saturated, or reads nothing, during {push.name}")
            reading = np.mean([s.data for s in seen], axis=0)
            self._rows.append(np.concatenate([[time.monotonic() - self._began], load() * wrench, reading]))

    def _save(self) -> None:
        names = self._names
        columns = ["time", *(f"load_{n}" for n in names), *names]
        np.savetxt(
            self._folder / "loads.csv",
            np.array(self._rows),
            "%.9g",
            ",",
            header=",".join(columns),
            comments="",
        )
        lines = ["[columns]", 'time = { name = "time", unit = "s" }', "[load]"]
        lines += [f'{n} = {{ name = "load_{n}", unit = "{unit_of(n)}" }}' for n in names]
        lines += ["[reading]", *(f'{n} = {{ name = "{n}", unit = "{unit_of(n)}" }}' for n in names)]
        (self._folder / "columns.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _told(loading: LoadingAxis) -> Callable[[], float]:
    """Return what tells the mean force [N] since it was asked last."""
    asked_ns, last = time.monotonic_ns(), loading.force.read()

    def told() -> float:
        nonlocal asked_ns, last
        seen = loading.force.history(last.number) or [last]  # a slow one may have nothing new
        since = [one for one in seen if one.stamp_ns >= asked_ns] or seen[-1:]
        asked_ns, last = time.monotonic_ns(), seen[-1]
        return loading.net(since)

    return told
