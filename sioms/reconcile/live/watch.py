"""The watch beside a running cell, or over a recording: the same core, fed from rings or from a file.

It opens nodes for reading only. What it tells goes to the list of alarms (``Workcell.tell_alarm``); without the right
to that, to the log and the terminal. A daemon or driver that goes is waited for.
"""

from __future__ import annotations

import errno
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import sioms
from sioms.documents import json_of, json_text, read_text
from sioms.protocol.flags import READONLY, AxisStatus, NodeClass, Severity
from sioms.protocol.nodeinfo import NodeInfo
from sioms.protocol.records import READ
from sioms.reconcile.effect import Slot
from sioms.reconcile.effects import known
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.model import AxisModel
from sioms.reconcile.watch.axis import About, AxisWatch, Settings
from sioms.reconcile.watch.keep import packed, restore
from sioms.reconcile.watch.moves import Array, Samples
from sioms.reconcile.watch.rows import Known
from sioms.recording.live.taps import NodeTap
from sioms.recording.live.times import CellTime
from sioms.recording.reader import Recording
from sioms.whole_file import write_whole

#: How often rings are looked at [s], the state is kept, and what is gone is looked for.
LOOK_S, KEEP_S, RETRY_S = (0.02, 0.25), 60.0, 0.5
#: Bytes of a file of state.
LARGEST = 64 << 20
#: In these states an axis does not follow a position with its own force alone.
UNUSABLE = int(
    AxisStatus.FORCE_MODE | AxisStatus.FOLLOWING_ERROR | AxisStatus.FAULT | AxisStatus.EMERGENCY_STOP
    | AxisStatus.SATURATED | AxisStatus.HOMING | AxisStatus.STOPPING | AxisStatus.STALLED | AxisStatus.LIMIT_MINUS
    | AxisStatus.LIMIT_PLUS | AxisStatus.SWITCH_MINUS | AxisStatus.SWITCH_PLUS
)  # fmt: skip
#: Effects of a model file that are no numbers of the watch.
BESIDE = ("cogging", "gravity", "spring", "quadratic_drag", "torque_ripple")
_AXIS, _PORT = list(READ[NodeClass.AXIS]), list(READ[NodeClass.BINARY])


@dataclass(slots=True)
class Watched:
    """One axis that is watched.

    Attributes:
        reference: binary node of one bit on the load's side, '' for none.
        gains: k, kz, kp, kb as they were read last.
        told: what has been told last: severity and sentence.
    """

    watch: AxisWatch
    model: AxisModel | None
    reference: str = ""
    gains: tuple[float, ...] = ()
    told: tuple[int, str] = (0, "")
    bit: int = 0
    _level: int = -1

    def feed(self, slots: NDArray[np.uint64] | None, edges: NDArray[np.uint64] | None) -> bool:
        """Take snapshots of the axis and of its reference, as they are in the ring; return whether it was judged."""
        found = [] if edges is None else self._edges(edges)
        if slots is None or not len(slots):
            self.watch.feed(_none(), found)
            return False
        samples, gains = decoded(slots)
        self.gains = gains
        return self.watch.feed(samples, found)

    def _edges(self, slots: NDArray[np.uint64]) -> list[float]:
        """Return the instants at which the reference changed [s]."""
        level = slots[:, 4 + _PORT.index("data")].view(np.int64) >> self.bit & 1
        changed = slots[:, 4 + _PORT.index("changed_ns")].view(np.int64)
        before = np.concatenate([[self._level if self._level >= 0 else level[0]], level[:-1]])
        self._level = int(level[-1])
        return [float(at) * 1e-9 for at in changed[level != before].tolist()]


def _none() -> Samples:
    nothing, no = np.empty(0), np.empty(0, dtype=np.bool_)
    return Samples(nothing, nothing, nothing, nothing, nothing, no, no)


def decoded(slots: NDArray[np.uint64]) -> tuple[Samples, tuple[float, ...]]:
    """Return the samples of snapshots of one axis, and its gains in the last one."""

    def column(name: str) -> Array:
        return np.ascontiguousarray(slots[:, 4 + _AXIS.index(name)]).view(np.float64)

    def whole(name: str) -> NDArray[np.int64]:
        return np.ascontiguousarray(slots[:, 4 + _AXIS.index(name)]).view(np.int64)

    time_s: Array = slots[:, 1].astype(np.float64) * 1e-9
    samples = Samples(
        time_s, column("position"), column("force"), column("commanded_position"),
        column("commanded_velocity"), whole("in_motion") != 0, (whole("status") & UNUSABLE) == 0,
    )  # fmt: skip
    return samples, tuple(float(column(gain)[-1]) for gain in ("k", "kz", "kp", "kb"))


def about(info: NodeInfo, step: float = 0.0) -> About:
    """Return what a node says of its axis.

    Raises:
        BadInputError: it is no single axis with a force, a range and a speed.
    """
    where = f"watch {info.name}"
    if info.node_class is not NodeClass.AXIS or len(info.channels) != 1:
        raise BadInputError(f"{where}: it is no single axis; give the node of one axis")
    channel = info.channels[0]
    low, high, limits = channel.minimum, channel.maximum, channel.limits
    if "force" not in limits or "velocity" not in limits:
        raise BadInputError(f"{where}: it tells no force; the watch judges by the force of the drive")
    if low is None or high is None or not np.isfinite(high - low) or not high > low:
        raise BadInputError(f"{where}: its range has no ends; the watch needs position_min and position_max")
    return About(
        info.name.removesuffix(READONLY), channel.unit == "rad", 1.0 / info.tick_hz, float(limits["force"]),
        float(high - low), step, float(limits["velocity"]),
    )  # fmt: skip


def beside(model: AxisModel | None) -> Known | None:
    """Return the force that a model file explains beside the numbers of the watch, None for none."""
    if model is None:
        return None
    effects = [(known()[name], v) for name, v in model.effects.items() if name in BESIDE]
    effects = [(e, v) for e, v in effects if e.slot in (Slot.FORCE, Slot.GAIN)]
    if not effects:
        return None
    rows = [(e, e.row(e.values(v), model.pitch)) for e, v in effects]

    def force(x: Array, v: Array, u: Array) -> Array:
        cold = np.zeros_like(x)
        return np.asarray(-np.sum([e.force(x, v, u, cold, np.sign(v), row) for e, row in rows], axis=0))

    return force


def watched(info: NodeInfo, model: AxisModel | None, reference: str, settings: Settings) -> Watched:
    """Return the watch of a node."""
    of = about(info, model.resolution if model is not None else 0.0)
    if model is not None and model.rotary != of.rotary:
        raise BadInputError(f"watch {info.name}: it is {'rotary' if of.rotary else 'linear'}, its model is not")
    return Watched(AxisWatch(of, settings, beside(model)), model, reference)


# --- state ---------------------------------------------------------------------------------------


def load(path: Path | None, axes: Mapping[str, Watched], offset_s: float, say: Callable[[str], None]) -> None:
    """Let watches go on with what was kept; what is damaged is told and left out, and its file is kept beside.

    Raises:
        OSError: it cannot be read, or not be renamed.
    """
    if path is None:
        return
    try:
        kept = json_of(read_text(path, LARGEST))
        table = kept["axes"]
        if not isinstance(table, dict):
            raise ValueError("it is no state of a watch")
    except FileNotFoundError:
        return
    except (ValueError, KeyError, TypeError) as error:
        beside = path.with_name(f"{path.name}.damaged")
        path.replace(beside)  # it may be another file, whose name was given by mistake
        say(f"read the state {path}: {error}; it is now {beside.name}, and the axes are learnt anew")
        return
    for name, axis in axes.items():
        if name not in table:
            continue
        if why := restore(axis.watch, table[name], offset_s):
            say(f"{name}: {why}; it is learnt anew")
        gains = table[name].get("gains") if isinstance(table[name], dict) else None
        if isinstance(gains, list) and len(gains) == 4 and all(isinstance(g, float | int) for g in gains):
            axis.gains = tuple(map(float, gains))


def keep(path: Path | None, axes: Mapping[str, Watched], offset_s: float) -> None:
    """Keep the state of all watches, and of axes that are not watched this time.

    Raises:
        OSError: it cannot be written.
    """
    if path is None:
        return
    try:
        table = json_of(read_text(path, LARGEST))["axes"]
    except (OSError, ValueError, KeyError, TypeError):
        table = {}
    table = table if isinstance(table, dict) else {}
    for name, axis in axes.items():
        table[name] = packed(axis.watch, offset_s) | {"gains": list(axis.gains)}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json_text({"axes": table}))


def kept_axes(path: Path, nodes: Sequence[str], models: Mapping[str, AxisModel]) -> dict[str, Watched]:
    """Return the watches that are kept in a file, as they were.

    Raises:
        BadInputError: it cannot be read, is damaged, or has no such axis.
    """
    where = f"read the state {path}"
    try:
        table = json_of(read_text(path, LARGEST))["axes"]
        abouts = {str(name): About(**each["about"]) for name, each in table.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise BadInputError(f"{where}: {error}") from None
    axes: dict[str, Watched] = {}
    for name in nodes or list(abouts):
        if name not in abouts:
            raise BadInputError(f"{where}: no axis {name}; there are: {', '.join(abouts) or 'none'}")
        axes[name] = Watched(AxisWatch(abouts[name]), models.get(name))
        if why := restore(axes[name].watch, table[name], 0.0):
            raise BadInputError(f"{where}: {name}: {why}")
        gains = table[name].get("gains")
        if isinstance(gains, list) and len(gains) == 4 and all(isinstance(g, float | int) for g in gains):
            axes[name].gains = tuple(map(float, gains))
    return axes


# --- from a recording ----------------------------------------------------------------------------


def from_recording(
    path: Path, nodes: Sequence[str], make: Callable[[NodeInfo], Watched], judged: Callable[[Watched], None]
) -> tuple[dict[str, Watched], tuple[str, ...]]:
    """Watch over a recording.

    Returns:
        The axes by name, and what of the recording is lost, a sentence each.

    Raises:
        OSError: it cannot be read, or has no such node.
    """
    found: dict[str, Watched] = {}
    with Recording(path) as recording:
        for name in nodes or [n for n, r in recording.nodes.items() if r.info.node_class is NodeClass.AXIS]:
            axis = found[name] = make(recording.node(name).info)
            if axis.reference:
                axis.bit = max(recording.node(axis.reference).bit, 0)
                for slots in recording.slots(axis.reference):
                    axis.feed(None, slots)
            for slots in recording.slots(name):
                if axis.feed(slots, None):
                    judged(axis)
        lost = tuple(dict.fromkeys(recording.damage))
    return found, lost


# --- beside a cell -------------------------------------------------------------------------------


@dataclass(slots=True)
class Beside:
    """Watches nodes of a running cell. Use from one thread.

    Attributes:
        connect: makes a session.
        make: makes the watch of a node.
        say: told sentences for the user.
        changed: called when something new is told of an axis.
    """

    connect: Callable[[], sioms.Workcell]
    nodes: Sequence[str]
    make: Callable[[NodeInfo], Watched]
    say: Callable[[str], None]
    changed: Callable[[Watched], None]
    state: Path | None = None
    learns_anew: bool = False
    offset_s: float = 0.0
    axes: dict[str, Watched] = field(default_factory=dict)
    _taps: dict[str, NodeTap] = field(default_factory=dict)
    _cell: sioms.Workcell | None = None
    _may_tell: bool = True

    def open(self) -> None:
        """Connect and open all nodes for reading.

        Raises:
            OSError: the cell or a node is not there.
            BadInputError: a node is not an axis that can be watched.
        """
        cell = self._cell = self.connect()
        self.offset_s = CellTime(cell.clock).offset_ns * 1e-9
        for name in self.nodes:
            if name not in self.axes:
                self.axes[name] = self.make(cell.info(name))
            for each in (name, self.axes[name].reference):
                if each and each not in self._taps:
                    opened = each if cell.info(each).read_only else each + READONLY
                    self._taps[each] = NodeTap(cell, each, opened)
            if self.axes[name].reference:
                self.axes[name].bit = max(self._taps[self.axes[name].reference].bit, 0)

    def run(self, until: Callable[[], bool]) -> None:
        """Watch until told to end."""
        if self._cell is None:
            self.open()
        if not self.learns_anew:
            load(self.state, self.axes, self.offset_s, self.say)
        for axis in self.axes.values():
            self._tell(axis)
        kept_s = time.monotonic()
        while not until():
            try:
                self.look()
            except OSError as error:
                self._lost(error)
                continue
            if time.monotonic() - kept_s > KEEP_S:
                kept_s = time.monotonic()
                self._keep()
            rings = [tap.ring_s for tap in self._taps.values() if not tap.is_over]
            time.sleep(min(max(min(rings, default=1.0) / 3.0, LOOK_S[0]), LOOK_S[1]))
        self._keep()

    def look(self) -> None:
        """Take what is new, and tell what follows from it.

        Raises:
            OSError: a node is gone.
        """
        over = [name for name, tap in self._taps.items() if tap.is_over]
        taken = {name: tap.take()[0] for name, tap in self._taps.items()}
        for axis in self.axes.values():
            name = axis.watch.about.name
            edges = taken.get(axis.reference) if axis.reference else None
            if axis.feed(taken[name], edges):
                self._tell(axis)
        if over and self._cell is not None:
            time.sleep(RETRY_S)
            for name in over:
                self._taps[name].open(self._cell)

    def _tell(self, axis: Watched) -> None:
        """Tell the cell what is the matter with an axis, if that is something else than before."""
        drift = axis.watch.drift
        severity, text = Severity.NONE, ""
        if drift is not None:
            since = time.strftime("%Y-%m-%d %H:%M", time.localtime(drift.since_s + self.offset_s))
            severity = Severity.MAJOR if drift.serious else Severity.MINOR
            text = f"{drift.text(axis.watch.about)}, since {since}"
        state = (int(severity), "" if drift is None else f"{drift.names}")
        if state == axis.told or (not severity and not axis.told[0]):
            return
        axis.told = state
        self.say(f"{axis.watch.about.name}: {text or 'as it was'}")
        self.changed(axis)
        if self._cell is None or not self._may_tell:
            return
        try:
            self._cell.tell_alarm(axis.watch.about.name, "drift", int(severity), text)
        except OSError as error:
            if error.errno not in (errno.EPERM, errno.EROFS):
                raise
            self._may_tell = False
            self.say(f"alarms are not told, but lines of the log: {error.strerror}")
            self._cell.report("warning" if severity else "info", f"{axis.watch.about.name}: {text or 'as it was'}")

    def _lost(self, error: OSError) -> None:
        """Begin a session anew after the cell, or a driver, has gone."""
        self.say(f"waiting for the cell: {error.strerror or error}")
        while True:
            time.sleep(RETRY_S)
            self.release()
            try:
                self.open()
                return
            except OSError:
                continue

    def _keep(self) -> None:
        try:
            keep(self.state, self.axes, self.offset_s)
        except OSError as error:
            self.say(f"the state is not kept: {error.strerror or error}")

    def release(self) -> None:
        """Let go of nodes and session."""
        for tap in self._taps.values():
            tap.release()
        self._taps = {}
        if self._cell is not None:
            self._cell.close()
        self._cell = None


def names_of(values: Iterable[str], what: str) -> dict[str, str]:
    """Take NODE=VALUE apart.

    Raises:
        BadInputError: one is no such pair.
    """
    out: dict[str, str] = {}
    for value in values:
        node, _, other = value.partition("=")
        if not node or not other:
            raise BadInputError(f"{what} {value}: want NODE=VALUE")
        out[node] = other
    return out


def as_json(axes: Mapping[str, Watched], offset_s: float) -> dict[str, Any]:
    """Return what is told of all axes, as plain values."""
    out: dict[str, Any] = {}
    for name, axis in axes.items():
        drift = axis.watch.drift
        out[name] = {
            "state": "learning" if axis.watch.normal is None else "drift" if drift else "normal",
            "motion_s": axis.watch.motion_s,
        }
        if drift is not None:
            f = drift.finding
            out[name] |= {
                "cause": drift.name, "candidates": list(drift.names), "size": f.size, "low": f.low, "high": f.high,
                "ordered_by": f.ordered, "since": drift.since_s + offset_s, "serious": drift.serious,
                "text": drift.text(axis.watch.about),
            }  # fmt: skip
    return out
