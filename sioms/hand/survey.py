"""A survey: a known object grasped in many ways and under several loads, recorded for ``sioms reconcile hand``.

    survey = Survey(hand, first_reading, Thing(DISK, 0.02), manner)
    plane.run(survey.carry_out(settings(20), plane.beside))
    write(path, survey.rows)

Between grasps the object is turned while it is held, and the fingers are rolled while they are free, so that links and
fingers are seen from all sides (what decides between confounders: docs/reconcile-hand.md). A grasp that fails is left
out and said in `events`; the object is then sought where it was last.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from sioms.hand.contacts import FINGER_M
from sioms.hand.kinematics import Hand
from sioms.hand.motions import STILL
from sioms.hand.regrasp import NEUTRAL
from sioms.hand.skills import Skills
from sioms.hand.touch import Failed, Manner, Reading, Setpoint, State

OTHER, DISK, BAR = 0, 1, 2
MOST_M = 0.5  # of an object
LOADS_N = (0.5, 1.0, 1.8)
SLIPS_N = (0.4, 0.8, 1.2, 1.8)
COLUMNS = (
    "time", "grasp", "kind", "thing", "size", *(f"{joint}{i}" for i in (1, 2) for joint in ("x", "y", "th")), "place1",
    "place2", "load1", "load2", *(f"cmd_{joint}{i}" for i in (1, 2) for joint in ("x", "y", "th")), "fx1", "fy1", "fx2",
    "fy2", "slip",
)  # fmt: skip
"""Of a recording, as ``sioms reconcile hand`` reads them."""
PSI, PHI = 1.0, (1.0, 2.1)
"""Directions of the line of contacts from minus to plus [rad], and angles of the fingers [rad], of a survey."""
SETTLED_S = 1.2  # under each force: while the damper still moves, the joints' damping bears a part of it
MEAN_S, DRAGGED_S = 1.0, 0.3
"""How long what is told is averaged in a hold, and while fingers slide [s]: forces and commands swing by some per cent
about once a second, and a drive that moves bears by its damping what its stiffness does not."""
DRAG, DRAG_S = 5e-3, 0.6  # speed at which fingers are dragged along a clamped bar [m/s], and for how long first
EVEN = 0.01  # velocity along the line of centres for a difference of both loads [m/(s N)]
LEAST_ROWS, LEAST_GRASPS = 30, 10
"""Rows and grasps below which ``sioms reconcile hand`` judges no records."""
TRIES = 3  # grasps that fail one after the other
#: What a hand's devices tell by themselves: x1, y1, th1, x2, y2, th2 as the encoders read them, places, loads, the same
#: joints as commanded, and the wrists' forces fx1, fy1, fx2, fy2 [m, rad, N]; nan where not known.
Told = Callable[[], Sequence[float]]


@dataclass(frozen=True, slots=True)
class Thing:
    """A known object; immutable.

    Args:
        kind: DISK, BAR or OTHER.
        size_m: radius of a disk, width of a bar [m], within 0 and MOST_M.
        number: that records tell it by.
    """

    kind: int
    size_m: float
    number: int = 1

    def __post_init__(self) -> None:
        if self.kind not in (DISK, BAR):
            raise ValueError(f"survey object: kind {self.kind}; want {DISK}, a disk, or {BAR}, a bar")
        if not 0.0 < self.size_m < MOST_M:
            what = "radius of the disk" if self.kind == DISK else "width of the bar"
            raise ValueError(f"survey object: the {what} is {self.size_m:g} m; want less than {MOST_M:g}, above 0")

    @property
    def apart_m(self) -> float:
        """Distance of the contacts of a parallel grasp."""
        return self.size_m * (2.0 if self.kind == DISK else 1.0)


@dataclass(frozen=True, slots=True)
class Setting:
    """One grasp: direction of the line of centres and angles of the fingers [rad], and forces [N], rising."""

    psi: float
    phi1: float
    phi2: float
    loads: tuple[float, ...] = LOADS_N


def settings(count: int, loads: Sequence[float] = LOADS_N, start: float = 0.0, seed: int = 1) -> list[Setting]:
    """Return grasps that cover directions and angles evenly, in an order of small turns.

    Args:
        count: of grasps.
        loads: forces of each [N], above 0.
        start: direction about which they lie [rad].
        seed: of the angles of the fingers.
    """
    most = Manner().most_n
    if not loads or not all(0.0 < load < most for load in loads):
        raise ValueError(f"survey object: forces {list(loads)} N; want some above 0 and below {most:g} N, an overload")
    random, (low, high) = np.random.default_rng(seed), PHI
    turns = start + PSI * np.sin(np.linspace(0.0, 2.0 * math.pi, count, endpoint=False))
    ranks = [random.permutation(count) for _ in range(2)]
    phi = [low + (high - low) * (rank + 0.5) / count for rank in ranks]
    return [Setting(float(t), float(a), float(b), tuple(sorted(loads))) for t, a, b in zip(turns, *phi, strict=True)]


class Survey(Skills):
    """Survey a known object with one hand.  One at a time.

    Args:
        hand: as the model has it.
        first: what is read of it at the start.
        thing: what it is to grasp.
        manner: how it does it.

    Attributes:
        rows: recorded so far, by `COLUMNS`.
        progress: told of every grasp that has been made, while the hand is open.
    """

    def __init__(self, hand: Hand, first: Reading, thing: Thing, manner: Manner | None = None) -> None:
        super().__init__(hand, first, manner)
        self.thing, self.rows = thing, list[list[float]]()
        self.progress: Callable[[str], None] = lambda text: None
        self._number = 0

    def carry_out(self, plan: Sequence[Setting], told: Told, first: int = 0) -> Generator[Setpoint, Reading, int]:
        """Make grasps; return how many were recorded.

        Args:
            plan: the grasps; the object lies between the fingers as they are, a bar with its sides across the line.
            told: asked with every frame.
            first: number of the first grasp.

        Raises:
            Failed: several grasps one after the other; the hand has opened or is frozen.
        """
        return self._guarded("survey", self._all(plan, told, first, self._one))

    def slide(self, plan: Sequence[Setting], told: Told, first: int = 0) -> Generator[Setpoint, Reading, int]:
        """Close on a bar that is clamped to the platen, drag both fingers along it, and record how they slide.

        The links are across the line of centres, so that their stiff axes bear the friction. Directions and angles of
        the plan do not count, its forces do. Args, Returns and Raises as of ``carry_out``.
        """
        return self._guarded("survey", self._all(plan, told, first, self._dragged))

    def _all(
        self, plan: Sequence[Setting], told: Told, first: int, one: Callable[..., Generator[Setpoint, Reading, Any]]
    ) -> Generator[Setpoint, Reading, int]:
        middle, failed = self._goal[:2], 0
        for setting in plan:
            try:
                before = len(self.rows)
                middle = yield from one(setting, middle, told, first + self._number)
                failed = 0
                self._number += 1
                self.progress(f"grasp {self._number} of {len(plan)}, {len(self.rows)} rows")
            except Failed as fault:
                del self.rows[before:]  # half a grasp
                failed += 1
                if failed == TRIES:
                    raise
                self.say(str(fault), fault.fault)
                yield from self._recover()
        self.state = State.IDLE
        return self._number

    def _one(
        self, setting: Setting, middle: Sequence[float], told: Told, number: int
    ) -> Generator[Setpoint, Reading, list[float]]:
        """Roll the fingers, close, feel under each force, turn the object towards what comes; return where it is."""
        yield from self._take(middle, (setting.phi1, setting.phi2))
        yield from self._turn(setting.psi, setting.loads[0])
        for force in setting.loads:
            yield from self._settle(force, SETTLED_S)
            self.rows.append((yield from self._record(force, told, number)))
        seen = self._seen()
        yield from self._open()
        return [0.5 * (a + b) for a, b in zip(seen.contact1, seen.contact2, strict=True)]

    def _dragged(
        self, setting: Setting, middle: Sequence[float], told: Told, number: int
    ) -> Generator[Setpoint, Reading, list[float]]:
        """Drag the closed fingers along the object, to and fro with the grasps; return where the hand closes next."""
        yield from self._take(middle, (NEUTRAL, NEUTRAL))
        psi, sign = self._goal[2], 1.0 if number % 2 else -1.0
        along = (-sign * DRAG * math.sin(psi), sign * DRAG * math.cos(psi), 0.0, 0.0, 0.0, 0.0)
        for force in setting.loads:
            yield from self._even(STILL, force, SETTLED_S)
            yield from self._even(along, force, DRAG_S)
            for finger in (1.0, 2.0):
                row = yield from self._record(force, told, number, partial(self._evenly, along, force), DRAGGED_S)
                self.rows.append([*row[:-1], finger])
        yield from self._open()
        return list(middle)

    def _even(self, along: Sequence[float], force: float, time_s: float) -> Generator[Setpoint, Reading, None]:
        """Move for a time [s], both fingers bearing alike."""
        begun_s = self.now.time_s
        while self.now.time_s - begun_s < time_s:
            yield from self._evenly(along, force)

    def _evenly(self, along: Sequence[float], force: float) -> Generator[Setpoint, Reading, None]:
        """Move for a tick, the hand being put, along the line of centres, where both fingers bear alike.

        What is clamped gives way to neither finger: a hand that would be elsewhere presses ever more with one.
        """
        one, two = self.now.fingers
        at, u, v = self.hand.forward(self.now.joints), math.cos(self._goal[2]), math.sin(self._goal[2])
        off = (at[0] - self._goal[0]) * u + (at[1] - self._goal[1]) * v
        self._goal[0] += off * u
        self._goal[1] += off * v
        shift = EVEN * (two.force - one.force)
        yield from self._follow((along[0] + shift * u, along[1] + shift * v, *along[2:]), force)

    def _take(self, middle: Sequence[float], phi: tuple[float, float]) -> Generator[Setpoint, Reading, None]:
        """Roll the fingers, and close lightly about a place."""
        opened = self.thing.apart_m + 2.0 * FINGER_M + 2.0 * self.manner.clearance_m
        target = (middle[0], middle[1], self._goal[2], opened, *phi)
        self._check_sensors("survey object")
        self._check_reach("survey object", target)
        yield from self._move(target)
        yield from self._close()
        yield from self._settle(self.manner.light_n, 0.25)

    def _turn(self, psi: float, force: float) -> Generator[Setpoint, Reading, None]:
        """Turn the hand with what it holds."""
        rate = 0.3 * self.manner.turning
        while abs(left := math.remainder(psi - self._goal[2], math.tau)) > 5e-3:
            yield from self._follow((0.0, 0.0, math.copysign(min(rate, 3.0 * abs(left)), left), 0.0, 0.0, 0.0), force)

    def _record(
        self, force: float, told: Told, number: int,
        move: Callable[[], Generator[Setpoint, Reading, None]] | None = None, time_s: float = MEAN_S,
    ) -> Generator[Setpoint, Reading, list[float]]:  # fmt: skip
        """Average what is told for a time [s] while the hand keeps still, or moves by ticks of its own; return a row.

        Raises:
            Failed: a finger is doubtful in more than half of the frames.
        """
        self.state, begun_s, count = State.SENSE, self.now.time_s, 0
        frames = []
        while self.now.time_s - begun_s < time_s or count < self.manner.frames:
            yield from self._follow(STILL, force) if move is None else move()
            count += 1
            one, two = self.now.fingers
            if one.touched and two.touched and not one.doubt and not two.doubt:
                frames.append(list(told()))
        if len(frames) < count // 2:
            yield from self._sense(force)  # says which finger, and why
        mean = np.mean(frames or [[math.nan] * 20], axis=0)
        thing = float(self.thing.kind), float(self.thing.number), self.thing.size_m
        return [self.now.time_s, float(number), *thing, *(float(v) for v in mean), 0.0]

    def _recover(self) -> Generator[Setpoint, Reading, None]:
        """Let go and open."""
        self.state, self._held = State.FAULT, False
        yield from self._let_go()
        yield from self._open()


def continued(past: Sequence[Sequence[float]], rows: Sequence[Sequence[float]]) -> list[list[float]]:
    """Return rows after those of the same session before; their time goes on."""
    began = past[-1][0] if past else 0.0
    return [*(list(row) for row in past), *([row[0] + began, *row[1:]] for row in rows)]


def missing(rows: int, grasps: int) -> str:
    """Say what is missing for records that can be judged; empty when nothing is."""
    more = [
        f"{least - there} more {what}{'s' if least - there > 1 else ''}"
        for what, there, least in (("row", rows, LEAST_ROWS), ("grasp", grasps, LEAST_GRASPS))
        if there < least
    ]
    return " and ".join(more)


def next_grasp(past: Sequence[Sequence[float]]) -> int:
    """Return the number of the first grasp after those of a session."""
    return int(past[-1][1]) + 1 if past else 0


def text_of(rows: Sequence[Sequence[float]]) -> str:
    """Return a recording as CSV; a column that is nowhere known is left out."""
    table = np.array(rows, dtype=np.float64).reshape(-1, len(COLUMNS))
    kept = [i for i, name in enumerate(COLUMNS) if name == "size" or not np.isnan(table[:, i]).all()]
    lines = [",".join(COLUMNS[i] for i in kept)]
    lines += [",".join(repr(float(row[i])) for i in kept) for row in table]
    return "\n".join(lines) + "\n"


def rows_of(text: str) -> list[list[float]]:
    """Return the rows of a recording that `text_of` wrote.

    Raises:
        ValueError: it has other columns, or no numbers.
    """
    head, *lines = text.splitlines() or [""]
    names = head.split(",")
    odd = [name for name in names if name not in COLUMNS]
    if odd or not {"time", "grasp"} <= set(names):
        raise ValueError(f"its columns are {head[:60]!r}")
    out = []
    for line in lines:
        known = dict(zip(names, map(float, line.split(",")), strict=True))
        out.append([known.get(name, math.nan) for name in COLUMNS])
    return out
