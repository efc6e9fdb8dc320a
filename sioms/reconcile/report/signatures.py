"""Pictures of what each effect of a sensor leaves, for the page of the libraries: drawn from the effects themselves."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile.finger.belief import Belief, late, outputs, scene_of
from sioms.reconcile.finger.effects import library as of_fingers
from sioms.reconcile.force.belief import ForceBelief, Loads, readings
from sioms.reconcile.force.effects import library as of_force_sensors
from sioms.reconcile.sensors.effect import SensorEffect, SensorModel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
#: One panel: what it is drawn against, values shape (n,), curves shape (n, k), and what they are.
Panel = tuple[str, Array, Array, str]
COMPONENTS = ("fx", "fy")
#: A finger of 16 elements, 19 mm wide under 1.6 mm of elastomer; the element that is shown, and loads [N/m].
ELEMENTS, SHOWN, LOAD, MOST = 16, 8, 150.0, 400.0
FINGER = Belief(
    0.0096,
    0.0127,
    83e3,
    0.46,
    np.radians(np.linspace(-70.0, 70.0, ELEMENTS)),
    np.full(ELEMENTS, 0.0103),
    np.full(ELEMENTS, 3.0),
    np.zeros(ELEMENTS),
    np.zeros(ELEMENTS),
)
#: Radius of an indenter [m], and the effects that change widths of contact, which an edge has not.
ROUND, OF_WIDTH = 6e-3, ("hertz", "adhesion")
#: Values that show better than the typical ones.
STATED = {
    "mains_line": {"a": 1e-3, "f": 50.0}, "dead_element": {"index": float(SHOWN)}, "creep": {"c": 0.05, "tau": 3.0},
    "sliding_friction": {"apex": 0.0}, "angle_offset": {"off": 0.02}, "gain_scatter": {"g": 0.05},
    "hysteresis": {"b": 0.02, "r": 0.5, "a": 0.0, "m": 0.0}, "offset_drift": {"d": 3e-5}, "poisson": {"dnu": -0.02},
}  # fmt: skip


def pictures() -> dict[str, Figure]:
    """Draw every effect of both libraries, by the stem of its file."""
    drawn = {f"finger_{name}": _figure(panels_of_finger(effect)) for name, effect in of_fingers().items()}
    force = {n: e for n, e in of_force_sensors(COMPONENTS).items() if not n.startswith("term_")}
    return drawn | {f"force_{name}": _figure(_of_force(effect)) for name, effect in force.items()}


def _values(effect: SensorEffect, count: int) -> dict[str, Array]:
    """Return a typical effect; where every element has a number of its own, they differ."""
    uneven = np.cos(2.4 * np.arange(count) + 1.0)
    out = {}
    for i, q in enumerate(effect.parameters):
        plain = q.size if i == 0 or not q.starts else q.starts[0]
        value = STATED.get(effect.name, {}).get(q.symbol, plain)
        differ = q.each and i == 0 and q.lower < 0.0
        out[q.symbol] = value * (uneven if differ else np.ones(count if q.each else 1))
    return out


def panels_of_finger(effect: SensorEffect) -> list[Panel]:
    """Return what an effect changes on a finger: over places, loads and the time of a touch that warms."""
    model = SensorModel(FINGER, ELEMENTS, of_fingers())
    after = model.with_effect(effect.name, _values(effect, ELEMENTS)).belief()
    radius, said_of = (ROUND, "a rounding of 6 mm") if effect.name in OF_WIDTH else (0.0, "an edge")
    middle = float(FINGER.angle[SHOWN])
    place = np.linspace(middle - 0.6, middle + 0.6, 121)
    load = np.linspace(20.0, MOST, 60)
    time = np.linspace(0.0, 30.0, 200)

    def change(where: Array, strength: Array, clock: Array) -> Array:
        """Change of every output in per cent under an indenter, held, while it warms by 2 K in 30 s."""
        scene = replace(scene_of(where, strength, np.full(len(where), radius)), time=clock, temperature=clock / 15.0)
        warm = scene.temperature[:, None]
        said = [outputs(b, scene) * late(b, clock)[:, None] + b.temperature * warm for b in (FINGER, after)]
        return np.asarray(100.0 * (said[1] - said[0]))

    still = np.zeros(len(place))
    panels = [
        (f"place of {said_of}, deg", np.degrees(place), change(place, still + LOAD, still), "outputs, %"),
        (f"load of {said_of}, N/m", load, change(np.full(60, middle), load, np.zeros(60)), "outputs, %"),
        (
            "time of a touch (warming by 2 K), s",
            time,
            change(np.full(200, middle), np.full(200, LOAD), time),
            "outputs, %",
        ),
    ]
    match effect.name:
        case "mains_line":
            clock = np.linspace(0.0, 0.1, 500)
            line = STATED["mains_line"]
            wave = 100.0 * line["a"] * np.sin(2.0 * np.pi * line["f"] * clock)
            return [("time, s", clock, wave[:, None], "untouched outputs, %")]
        case "dead_element":
            own = outputs(FINGER, scene_of(place, still + LOAD, still))[:, [SHOWN]]
            return [("place of an edge, deg", np.degrees(place), -100.0 * own, "output, %")]
        case "force_gain":
            return [("load, N/m", load, (after.cell * load)[:, None], "load cell, N/m")]
    return panels


def _of_force(effect: SensorEffect) -> list[Panel]:
    count = len(COMPONENTS)
    base = ForceBelief(COMPONENTS, np.ones(count), np.eye(count))
    after = (
        SensorModel(base, count, of_force_sensors(COMPONENTS)).with_effect(effect.name, _values(effect, count)).belief()
    )
    turn = np.concatenate([np.linspace(a, b, 40) for a, b in ((0.0, 0.9), (0.9, -0.9), (-0.9, 0.9), (0.9, 0.0))])
    load = np.concatenate([np.outer(turn, own) for own in np.eye(count)])
    time = 2.0 * np.arange(float(len(load)))
    loads = Loads(load, time, 4.0 * time / time[-1] - 2.0, np.zeros(len(load), dtype=np.int64))
    change = 100.0 * (readings(after, loads) - readings(base, loads))
    first = slice(0, len(turn))
    return [
        ("load of fx, % of full range", 100.0 * load[first, 0], change[first], "readings, % of full range"),
        ("time (fx, then fy up and down; warming by 4 K), s", time, change, "readings, % of full range"),
    ]


def _figure(panels: list[Panel]) -> Figure:
    """Draw the change that the effect makes; the element shown, or the first component, is dark."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 2.3), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for ax, (label, at, curves, what) in zip(axes, panels, strict=True):
        dark = SHOWN if curves.shape[1] == ELEMENTS else 0
        ax.plot(at, curves, lw=0.6, color="#c3ced8")
        ax.plot(at, curves[:, dark], lw=1.2, color="#1f5f8b")
        top = 1.2 * float(np.abs(curves).max())
        ax.set_ylim(-top - 1e-9, top + 1e-9)
        ax.set_xlabel(label)
        ax.set_ylabel(f"change of {what}", fontsize=8)
        ax.grid(visible=True, lw=0.3)
    return figure
