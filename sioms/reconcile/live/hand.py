"""``sioms reconcile hand NODE``: grasp known objects with the hand of a workcell, decide, correct its model.

The first object lies between the fingers; somebody lays the others there when asked. The workflow sees what any client
sees: encoders, commands, what the fingers and the wrists tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import sioms
from sioms.hand.live.surveying import Nodes, surveying
from sioms.hand.survey import (
    BAR,
    DISK,
    LEAST_GRASPS,
    LOADS_N,
    SLIPS_N,
    Setting,
    Thing,
    continued,
    next_grasp,
    settings,
    text_of,
)  # fmt: skip
from sioms.hand.touch import Failed
from sioms.lab.stopping import ExperimentStopped
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.hand import read_model, reconcile_hand
from sioms.reconcile.live.experiments import ROUNDS, Say, agree, decide, have_done, kept
from sioms.reconcile.live.experiments import able as choose
from sioms.reconcile.sensors.verdict import SensorVerdict
from sioms.whole_file import write_whole

HEAVY = (0.5, 1.0, 1.8, 2.8)
GRASP_S, DRAG_S = 16.0, 12.0
"""What a grasp under three loads takes, and one in which the fingers are dragged [s]."""


@dataclass(frozen=True, slots=True)
class Grasping:
    """What a user asks of a live run.

    Attributes:
        nodes: of the hand.
        disks, bars: radii and widths of the objects at hand [m].
        clamped: width of a bar that can be clamped to the platen [m]; 0 without one, and friction is not judged.
        grasps: of each object; in each the fingers slide in a third of so many.
        full: all objects at first; else only the first.
        yes: move without asking.
        socket: of the daemon, None for the usual one.
    """

    nodes: Nodes
    disks: tuple[float, ...] = ()
    bars: tuple[float, ...] = ()
    clamped: float = 0.0
    grasps: int = 12
    full: bool = True
    yes: bool = False
    socket: str | None = None
    seed: int = 1

    @property
    def things(self) -> list[Thing]:
        """The objects, in the order in which they are grasped."""
        sizes = [*((DISK, radius) for radius in self.disks), *((BAR, width) for width in self.bars)]
        return [Thing(kind, size, number) for number, (kind, size) in enumerate(sizes, 1)]

    @property
    def bar(self) -> Thing | None:
        """The bar that can be clamped, if there is one."""
        return Thing(BAR, self.clamped, len(self.disks) + len(self.bars) + 1) if self.clamped else None


def live(model: Path, asked: Grasping, folder: Path, say: Say) -> tuple[SensorVerdict, float]:
    """Reconcile a hand behind a daemon.

    Args:
        model: the nominal hand.
        folder: where the records go, readable as DATA; they replace those of an earlier run at the end.

    Returns:
        The verdict and the seconds of analysis.

    Raises:
        BadInputError: no object, the nodes are no such hand, or the user did not agree.
        ExperimentStopped: the hand failed or was stopped; it stands.
        OSError: the daemon or a node cannot be reached.
    """
    read_model(model)
    first = _chosen(asked)
    _check(asked, first)
    _agree(asked, first)
    with sioms.Workcell(asked.socket, "reconcile") as cell, kept(folder) as fresh:
        bench = Bench(cell, asked, fresh, say)
        for thing in first:
            bench.grasp(thing)
        if asked.full:
            bench.slide()
        return decide(
            lambda: reconcile_hand(fresh, model, asked.seed, say),
            lambda best: bench.separate(best.name),
            choose(bench.able(), bench.effort),
            ROUNDS,
            say,
        )


def _chosen(asked: Grasping) -> list[Thing]:
    """Return the objects of the first round; none of those at hand may be one that no hand takes."""
    try:
        things, _ = asked.things, asked.bar
    except ValueError as error:
        raise BadInputError(f"grasp with {asked.nodes.hand}: {error}") from None
    return things if asked.full else things[:1]


def _check(asked: Grasping, first: Sequence[Thing]) -> None:
    if not first:
        raise BadInputError(f"grasp with {asked.nodes.hand}: no object; give --disks RADIUS or --bars WIDTH in m")
    if len(asked.nodes.wrists) not in (0, 2) or (asked.clamped and not asked.nodes.wrists):
        raise BadInputError(
            f"grasp with {asked.nodes.hand}: {len(asked.nodes.wrists)} wrists; needs two, or --wrists without a name "
            "and no --clamped bar"
        )
    if asked.grasps * len(first) < LEAST_GRASPS:
        raise BadInputError(
            f"grasp with {asked.nodes.hand}: {asked.grasps} grasps of {len(first)} objects; needs {LEAST_GRASPS} in all"
        )


def _agree(asked: Grasping, first: Sequence[Thing]) -> None:
    seconds = GRASP_S * asked.grasps * len(first) + DRAG_S * _drags(asked) * bool(asked.clamped and asked.full)
    told = [
        f"{asked.nodes.hand} will grasp for some {seconds:.0f} s, with up to {max(LOADS_N):g} N"
        + (f" ({max(SLIPS_N):g} N where it slides)" if asked.clamped else "")
        + ", and turn by a radian to either side:",
        *(f"  {described(thing)}" for thing in first),
    ]
    agree(
        f"grasp with {asked.nodes.hand}",
        told,
        f"{described(first[0])} lies between the open fingers; begin?",
        asked.yes,
    )


def described(thing: Thing) -> str:
    """Return what an object is, for a person."""
    if thing.kind == DISK:
        return f"a disk of {1e3 * thing.size_m:g} mm radius"
    return f"a bar of {1e3 * thing.size_m:g} mm, its sides across the line of the fingers"


def _drags(asked: Grasping) -> int:
    return max(asked.grasps // 3, 3)


class Bench:
    """Grasps objects and keeps the rows. One thread. The hand is held only while it grasps."""

    def __init__(self, cell: sioms.Workcell, asked: Grasping, folder: Path, say: Say) -> None:
        self._cell, self._asked, self._folder, self._say = cell, asked, folder, say
        self._rows: list[list[float]] = []
        self._lies: Thing | None = asked.things[0]
        self._grasped: list[Thing] = []

    def grasp(self, thing: Thing, loads: Sequence[float] = LOADS_N) -> None:
        """Grasp an object in many ways and under several loads; keep what is told."""
        if thing != self._lies:
            have_done(f"lay {described(thing)}, between the open fingers", "give one object only to work unattended")
            self._lies = thing
        self._grasped.append(thing)
        seed = self._asked.seed + len(self._grasped)
        self._carry(thing, settings(self._asked.grasps, loads, seed=seed), False)

    def slide(self) -> None:
        """Drag the fingers along the clamped bar, if there is one."""
        bar = self._asked.bar
        if bar is None:
            return
        have_done(f"clamp {described(bar)}, to the platen", "leave out --clamped to work unattended")
        self._lies = None
        self._carry(bar, settings(_drags(self._asked), SLIPS_N), True)

    def able(self) -> set[str]:
        """Return the programmes of `sioms.reconcile.hand.plan` that can be made."""
        new = len(self._asked.things) > len(self._grasped)
        return {"loads", *(["sizes"] if new else []), *(["slips"] if self._asked.clamped else [])}

    def effort(self, name: str) -> float:
        """Return how many grasps a programme takes."""
        count = {"sizes": len(self._asked.things) - len(self._grasped), "loads": 1}
        return float(self._asked.grasps * count[name] if name in count else _drags(self._asked))

    def separate(self, name: str) -> None:
        """Make what would decide."""
        if name == "slips":
            self.slide()
        elif name == "sizes":
            for thing in self._asked.things[len(self._grasped) :]:
                self.grasp(thing)
        else:
            self.grasp(self._lies or self._asked.things[0], HEAVY)

    def _carry(self, thing: Thing, plan: Sequence[Setting], slips: bool) -> None:
        self._say(f"{len(plan)} grasps of {described(thing)}" + (", fingers dragged along it" if slips else ""))
        try:
            with surveying(self._cell, self._asked.nodes, thing, slips) as (survey, carry):
                survey.progress = self._say
                try:
                    carry(plan, next_grasp(self._rows))
                finally:
                    for event in survey.events:
                        self._say(event.text)
        except Failed as failed:
            raise ExperimentStopped(f"{failed}; the hand stands") from None
        self._rows = continued(self._rows, survey.rows)
        write_whole(self._folder / "grasps.csv", text_of(self._rows))
