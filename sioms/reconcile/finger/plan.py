"""The experiment that would decide between beliefs about a finger: a small catalogue, and where two differ most."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sioms.reconcile.finger.belief import Belief, Scene, late, outputs, scene_of
from sioms.reconcile.finger.effects import pulled
from sioms.reconcile.finger.pressures import Floats
from sioms.reconcile.sensors.verdict import Proposal

LOAD_KNOWN = 6e-3  # relative standard deviation to which a load cell tells the load of a touch
FRAMES = 20  # averaged in a touch
_STEP_K = 2.0
_HELD_S = np.geomspace(0.1, 30.0, 12)

#: Name, description and touches.
Plan = tuple[str, str, Scene]


@dataclass(frozen=True, slots=True)
class Bench:
    """What touches can be made.

    Attributes:
        radii: of the indenters at hand [m], 0 an edge, infinite a flat; the first is the one for places.
        load, most: usual and largest load [N/m].
        low, high: places within reach [rad].
    """

    radii: tuple[float, ...] = (0.0, np.inf)
    load: float = 200.0
    most: float = 300.0
    low: float = -np.inf
    high: float = np.inf

    def within(self, scene: Scene) -> Scene:
        """Return the touches whose places are within reach."""
        near = (scene.place >= self.low) & (scene.place <= self.high)
        return scene_of(scene.place[near], scene.load[near], scene.radius[near])


def indenter(radius: float) -> str:
    """Return what an indenter is called."""
    return "edge" if radius == 0.0 else "flat" if np.isinf(radius) else f"indenter of {1e3 * radius:.3g} mm"


def _at(places: Floats, loads: Floats | float, radii: Floats | float) -> Scene:
    p, q, r = np.broadcast_arrays(places, np.asarray(loads), np.asarray(radii))
    return scene_of(np.array(p, dtype=np.float64), np.array(q, dtype=np.float64), np.array(r, dtype=np.float64))


def first(b: Belief, bench: Bench, step: float = np.radians(2.0)) -> Iterator[Plan]:
    """Yield name, description and touches of what is recorded before anything is decided.

    Args:
        step: from place to place [rad].
    """
    low, high = float(b.angle.min()), float(b.angle.max())
    beyond, name = np.radians(4.0), indenter(bench.radii[0])
    places = np.arange(low - beyond, high + beyond, step)
    yield (
        "places",
        f"{name} every {np.degrees(step):.3g} degrees at {bench.load:g} N/m",
        bench.within(_at(places, bench.load, bench.radii[0])),
    )
    yield loads_at(b, bench, (0.25, 0.5, 0.75), np.geomspace(0.25 * bench.load, bench.most, 4))
    for radius in bench.radii[1:]:
        few = np.linspace(low, high, 12)
        text = f"{indenter(radius)} at 12 places at {bench.load:g} N/m"
        yield f"indenter_{1e3 * radius:g}mm", text, bench.within(_at(few, bench.load, radius))


def loads_at(b: Belief, bench: Bench, shares: tuple[float, ...], loads: Floats, repeats: int = 1) -> Plan:
    """Return touches at some shares of the arc, each with some loads [N/m], so many times over."""
    order = np.sort(b.angle)
    at = [float(order[int(share * (len(order) - 1))]) for share in shares]
    full = np.tile(loads, repeats)
    text = f"loads from {loads[0]:.0f} to {loads[-1]:.0f} N/m" if len(loads) > 1 else f"{loads[0]:.0f} N/m"
    text += f" at {len(at)} place{'s' if len(at) > 1 else ''}"
    return "loads", text, bench.within(_at(np.repeat(at, len(full)), np.tile(full, len(at)), bench.radii[0]))


def one_place(b: Belief, bench: Bench, touches: int = 24) -> Iterator[Plan]:
    """Yield the least that can be recorded: some loads at one place."""
    yield loads_at(b, bench, (0.5,), np.geomspace(0.25 * bench.load, bench.most, 4), touches // 4)


def catalogue(b: Belief, bench: Bench | None = None) -> Iterator[Plan]:
    """Yield name, description and touches of the experiments that consist of touches and can be made."""
    bench = bench or Bench()
    low, high = float(b.angle.min()), float(b.angle.max())
    middle = float(np.sort(b.angle)[len(b.angle) // 2])
    name, usual = indenter(bench.radii[0]), f"{bench.load:g} N/m"
    dense = np.arange(low, high, np.radians(1.0))
    found = [
        (
            "profile",
            f"{name} touches every degree across each element at {usual}",
            _at(dense, bench.load, bench.radii[0]),
        )
    ]
    both = (min(bench.radii), max(bench.radii)) if len(bench.radii) > 1 else bench.radii
    kinds = " and ".join(f"with {_a(radius)}" for radius in both)
    least = bench.most / 12.0
    decade = np.geomspace(least, bench.most, 8)
    found.append(
        (
            "loads_here",
            f"a decade of loads, {least:.0f} to {bench.most:.0f} N/m, at one place {kinds}",
            _at(np.full(8 * len(both), middle), np.tile(decade, len(both)), np.repeat(both, 8)),
        )
    )
    if len(both) > 1:
        few = np.linspace(low, high, 12)
        found.append(
            (
                "widths",
                f"the same places {kinds} at {usual}",
                _at(np.tile(few, 2), bench.load, np.repeat(both, 12)),
            )
        )
    fine = np.arange(middle - 0.35, middle + 0.35, np.radians(0.5))
    found.append(
        (
            "steps",
            "touches every half degree over 40 degrees, less than half a period of the strips",
            _at(fine, bench.load, bench.radii[0]),
        )
    )
    for label, text, scene in found:
        near = bench.within(scene)
        if len(near.place):
            yield label, text, near


def _a(radius: float) -> str:
    text = indenter(radius)
    return f"{'an' if text[0] in 'aei' else 'a'} {text}"


def propose(beliefs: Sequence[Belief], noise: float, bench: Bench | None = None) -> tuple[Proposal, ...]:
    """Rank the experiments by how far the beliefs differ on them, each pair counted by its worst; best first.

    Args:
        noise: standard deviation of one frame's output.
        bench: what touches can be made.
    """
    if len(beliefs) < 2:
        return ()
    sigma, b0 = noise * np.sqrt(2.0 / FRAMES), beliefs[0]
    found = []
    for name, text, scene in catalogue(b0, bench):
        found.append(Proposal(name, text, _apart([outputs(b, scene) for b in beliefs], sigma)))
    dense = next(catalogue(b0))[2]
    turned = [outputs(replace(b, friction=-b.friction), dense) for b in beliefs]
    text = "the same edge touches while the indenter drags the other way"
    found.append(Proposal("reverse", text, _apart(turned, sigma)))
    step = [(_STEP_K * b.temperature)[None] for b in beliefs]
    text = f"a temperature step of {_STEP_K:g} K at zero load"
    found.append(Proposal("warm", text, _apart(step, sigma, 0.0)))
    peak = float(np.max(outputs(b0, dense)))
    held = [peak * late(b, _HELD_S)[None] for b in beliefs]
    text = "one touch held for 30 s at constant temperature"
    found.append(Proposal("hold", text, _apart([h - h[:, -1:] for h in held], sigma, 0.0)))
    text = "a grounded and an insulating indenter brought near before the touch"
    found.append(Proposal("near", text, _apart([_pull(b) for b in beliefs], sigma, 0.0)))
    return tuple(sorted(found, key=lambda p: -p.separation))


def _pull(b: Belief) -> Floats:
    """Return what a conductor near each element draws, without contact."""
    nothing = np.zeros((len(b.angle), len(b.angle)))
    scene = scene_of(b.angle, np.ones(len(b.angle)), np.zeros(len(b.angle)))
    scene = replace(scene, distance=b.angle - b.angle[:, None])
    return sum((r(nothing, scene, p) for r, p in b.responses if r is pulled), nothing)


def _apart(said: Sequence[Floats], sigma: float, load: float = LOAD_KNOWN) -> float:
    """Return by how many times the noise the closest pair differs in a touch (rms), its load free within ``load``."""
    least = np.inf
    for i, a in enumerate(said):
        for b in said[i + 1 :]:
            d, u = (a - b) / sigma, a / sigma
            n = np.sum(u * u, axis=1)
            factor = (1.0 - 1.0 / np.sqrt(1.0 + n * load**2)) / np.maximum(n, 1e-12)
            d = d - (factor * np.sum(d * u, axis=1))[:, None] * u
            least = min(least, float(np.sqrt(np.mean(np.sum(d**2, axis=1)))))
    return least
