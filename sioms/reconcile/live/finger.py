"""``sioms reconcile tactile NODE``: design the touches, ask, probe the finger through the daemon, decide, put the model
to work.

The workflow sees what any client sees: readings of the finger and of a force sensor, and axes that it moves by their
own commands. It knows nothing of what the finger hides.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import sioms
from sioms.protocol.flags import NodeClass, Request
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.finger import read_model, reconcile_tactile
from sioms.reconcile.finger.belief import Belief, Scene
from sioms.reconcile.finger.plan import Bench, Plan, catalogue, first, indenter, one_place
from sioms.reconcile.live.experiments import ROUNDS, Say, agree, decide, have_done, kept
from sioms.reconcile.live.experiments import able as choose
from sioms.reconcile.sensors.verdict import Proposal, SensorVerdict
from sioms.tactile.live.prober import Prober, Recorder, Rig, Touch

#: Frames of the untouched finger, and what a touch takes [s].
QUIET, TOUCH_S = 1200, 0.4
#: Distance kept from the ends of the axis round the finger [rad].
MARGIN_RAD = 0.01


@dataclass(frozen=True, slots=True)
class Probe:
    """What a user asks of a live run.

    Attributes:
        rig: nodes of the prober, and the largest load.
        radii: of the indenters at hand [m]; the first one is mounted.
        load: usual load [N/m].
        step: from place to place [rad].
        full: places, loads and indenters at first; else loads at one place only.
        yes: move without asking.
        socket: of the daemon, None for the usual one.
    """

    rig: Rig
    radii: tuple[float, ...] = (0.0,)
    load: float = 200.0
    step: float = np.radians(2.0)
    full: bool = True
    yes: bool = False
    socket: str | None = None
    seed: int = 1


def live(model: Path, asked: Probe, folder: Path, say: Say) -> tuple[SensorVerdict, float]:
    """Reconcile a finger behind a daemon.

    Args:
        model: the nominal finger.
        folder: where the records go, readable as DATA; they replace those of an earlier run at the end.

    Returns:
        The verdict and the seconds of analysis.

    Raises:
        BadInputError: the nodes are no such prober, or the user did not agree.
        ExperimentStopped: the experiment was stopped; the axes are halted.
        OSError: the daemon or a node cannot be reached.
    """
    nominal, _, _ = read_model(model, model)
    with sioms.Workcell(asked.socket, "reconcile") as cell:
        bench = bench_of(cell, nominal, asked)
        plan = list(first(nominal, bench, asked.step) if asked.full else one_place(nominal, bench))
        _agree(asked, bench, plan)
        with kept(folder) as fresh:
            hand = Hand(cell, asked.rig, bench.radii[0], fresh, say)
            hand.untouched()
            hand.run(plan)
            able = {name: (name, text, scene) for name, text, scene in catalogue(nominal, bench)}

            def separate(best: Proposal) -> None:
                name, text, scene = able[best.name]
                hand.run([(f"separate_{name}", text, scene)])

            return decide(
                lambda: reconcile_tactile(fresh, model, asked.seed, say, bench),
                separate,
                choose(able, lambda name: len(able[name][2].place)),
                ROUNDS,
                say,
            )


class Hand:
    """Carries plans out with the indenter that they need and keeps the records. One thread.

    The nodes are open while touches are made, and free while somebody changes the indenter or the program decides.
    """

    def __init__(self, cell: sioms.Workcell, rig: Rig, mounted: float, folder: Path, say: Say) -> None:
        self._cell, self._rig, self._mounted, self.folder, self._say = cell, rig, mounted, folder, say

    def untouched(self) -> None:
        """Record the finger at rest."""
        self._say("untouched frames")
        with self._prober() as prober:
            prober.quiet(QUIET).save(self.folder / "noise.npz")

    def run(self, plan: Iterable[Plan]) -> None:
        """Make the touches of a plan, indenter by indenter, and keep them by the plan's names."""
        work = [(radius, name, scene) for name, _, scene in plan for radius in dict.fromkeys(scene.radius.tolist())]
        order = list(dict.fromkeys(radius for radius, _, _ in work))
        for radius in sorted(order, key=lambda r: r != self._mounted):
            self._mount(radius)
            with self._prober() as prober:
                for _, name, scene in [w for w in work if w[0] == radius]:
                    self._say(f"{name}: {int(np.sum(scene.radius == radius))} touches with {indenter(radius)}")
                    kept = _recorded(prober, scene, radius, name)
                    kept.take_felt_loads()
                    kept.save(self.folder / f"{name}_{1e3 * radius:g}mm.npz")

    def _prober(self) -> Prober:
        return Prober(self._cell, lambda radius: None, self._rig)

    def _mount(self, radius: float) -> None:
        if radius == self._mounted:
            return
        have_done(f"mount the {indenter(radius)}, clear of the finger", "give --indenters only what is mounted")
        self._mounted = radius


def _recorded(prober: Prober, scene: Scene, radius: float, name: str) -> Recorder:
    mine = np.flatnonzero(scene.radius == radius)
    touches = [Touch(float(scene.place[i]), float(scene.load[i]), radius) for i in mine]
    return prober.run(touches, lambda what: None, name)


def bench_of(cell: sioms.Workcell, nominal: Belief, asked: Probe) -> Bench:
    """Check the nodes against the finger, and say what touches their limits allow.

    Raises:
        BadInputError: a node is not what the prober needs, or the loads make no sense.
    """
    rig = asked.rig
    channels = cell.info(rig.finger).channels
    if len(channels) != len(nominal.angle) or channels[0].unit != "%":
        raise BadInputError(
            f"reconcile {rig.finger}: it has {len(channels)} channels in {channels[0].unit or '1'}; the model has "
            f"{len(nominal.angle)} elements, in % of the untouched output"
        )
    force = cell.info(rig.force).channels
    if len(force) != 1 or force[0].unit != "N":
        raise BadInputError(f"reconcile {rig.finger}: {rig.force} is no single force in N; give --force NODE")
    press, place = _axis(cell, rig.press, "m"), _axis(cell, rig.place, "rad")
    if press.maximum is None:
        raise BadInputError(
            f"reconcile {rig.finger}: {rig.press} has no upper end; give it a position_max that the finger bears"
        )
    if not 0.0 < asked.load <= rig.most_load:
        raise BadInputError(
            f"reconcile {rig.finger}: load {asked.load:g} N/m; needs 0 to the largest, {rig.most_load:g} N/m"
        )
    low = -np.inf if place.minimum is None else place.minimum + MARGIN_RAD
    high = np.inf if place.maximum is None else place.maximum - MARGIN_RAD
    within = np.mean((nominal.angle > low) & (nominal.angle < high))
    if within < 0.5:
        raise BadInputError(
            f"reconcile {rig.finger}: {rig.place} goes from {low:.3g} to {high:.3g} rad and reaches "
            f"{100 * within:.0f} % of the elements; needs half of them"
        )
    return Bench(asked.radii, asked.load, rig.most_load, float(low), float(high))


def _axis(cell: sioms.Workcell, node: str, unit: str) -> ChannelInfo:
    info = cell.info(node)
    if info.node_class is not NodeClass.AXIS or len(info.channels) != 1 or info.channels[0].unit != unit:
        raise BadInputError(f"probe with {node}: it is no single axis in {unit}")
    return info.channels[0]


def _agree(asked: Probe, bench: Bench, plan: list[Plan]) -> None:
    """Say what will be done and ask."""
    rig, places = asked.rig, np.concatenate([scene.place for _, _, scene in plan])
    most_n = bench.most * rig.length_m
    told = [
        f"{rig.place} will go from {places.min():.3g} to {places.max():.3g} rad and {rig.press} press the "
        f"{indenter(bench.radii[0])} on {rig.finger} with up to {bench.most:g} N/m ({most_n:.3g} N on {rig.force}), "
        f"for some {TOUCH_S * len(places):.0f} s:",
        *(f"  {name}: {text}, {len(scene.place)} touches" for name, text, scene in plan),
    ]
    agree(f"probe {rig.finger}", told, "the indenter is clear of the finger; move?", asked.yes)


def loads(node: str, text: str) -> Callable[[sioms.Workcell], str]:
    """Return what has the driver of a finger load a corrected one now, and says so."""

    def take_up(cell: sioms.Workcell) -> str:
        with cell.open(f"{node}.shape") as shape:
            return f" and loaded by {node}.shape ({shape.ioctl(Request.CALIBRATE_DEVICE, text)})"

    return take_up
