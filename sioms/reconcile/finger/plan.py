"""The experiment that would decide between beliefs about a finger: a small catalogue, and where two differ most."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from sioms.reconcile.finger.belief import Belief, Scene, late, outputs, scene_of
from sioms.reconcile.finger.effects import pulled
from sioms.reconcile.finger.pressures import Floats
from sioms.reconcile.sensors.verdict import Proposal

LOAD_KNOWN = 6e-3  # relative standard deviation to which a load cell tells the load of a touch
FRAMES = 20  # averaged in a touch
_STEP_K = 2.0
_HELD_S = np.geomspace(0.1, 30.0, 12)


def catalogue(b: Belief) -> Iterator[tuple[str, str, Scene]]:
    """Yield name, description and touches of the experiments that consist of touches."""
    low, high = float(b.angle.min()), float(b.angle.max())
    middle = float(np.sort(b.angle)[len(b.angle) // 2])

    def at(places: Floats, loads: Floats, radii: Floats) -> Scene:
        p, q, r = np.broadcast_arrays(places, loads, radii)
        return scene_of(np.array(p), np.array(q), np.array(r))

    dense = np.arange(low, high, np.radians(1.0))
    yield (
        "profile",
        "edge touches every degree across each element at 200 N/m",
        at(dense, np.array(200.0), np.array(0.0)),
    )
    decade = np.geomspace(25.0, 300.0, 8)
    both = scene_of(np.full(16, middle), np.tile(decade, 2), np.repeat([0.0, np.inf], 8))
    yield "loads", "a decade of loads, 25 to 300 N/m, at one place with an edge and with a flat", both
    few = np.linspace(low, high, 12)
    widths = scene_of(np.tile(few, 2), np.full(24, 200.0), np.repeat([0.0, np.inf], 12))
    yield "widths", "the same places with an edge and with a flat at 200 N/m", widths
    fine = np.arange(middle - 0.35, middle + 0.35, np.radians(0.5))
    yield (
        "steps",
        "touches every half degree over 40 degrees, less than half a period of the strips",
        at(fine, np.array(200.0), np.array(0.0)),
    )


def propose(beliefs: Sequence[Belief], noise: float) -> Proposal | None:
    """Choose the experiment on which the beliefs differ most, each pair counted by its worst.

    Args:
        noise: standard deviation of one frame's output.
    """
    if len(beliefs) < 2:
        return None
    sigma = noise * np.sqrt(2.0 / FRAMES)
    found = []
    for name, text, scene in catalogue(beliefs[0]):
        said = [outputs(b, scene) for b in beliefs]
        found.append(Proposal(name, text, _apart(said, sigma)))
    turned = [outputs(replace(b, friction=-b.friction), next(catalogue(b))[2]) for b in beliefs]
    found.append(
        Proposal(
            "reverse", "the same edge touches while the indenter drags the other way", _apart(turned, sigma)
        )
    )
    step = [(_STEP_K * b.temperature)[None] for b in beliefs]
    found.append(
        Proposal("warm", f"a temperature step of {_STEP_K:g} K at zero load", _apart(step, sigma, 0.0))
    )
    peak = float(np.max(outputs(beliefs[0], next(catalogue(beliefs[0]))[2])))
    held = [peak * late(b, _HELD_S)[None] for b in beliefs]
    found.append(
        Proposal(
            "hold",
            "one touch held for 30 s at constant temperature",
            _apart([h - h[:, -1:] for h in held], sigma, 0.0),
        )
    )
    nothing = np.zeros((len(beliefs[0].angle), len(beliefs[0].angle)))
    near = []
    for b in beliefs:
        scene = replace(
            scene_of(b.angle, np.ones(len(b.angle)), np.zeros(len(b.angle))),
            distance=b.angle - b.angle[:, None],
        )
        near.append(sum((r(nothing, scene, p) for r, p in b.responses if r is pulled), nothing))
    found.append(
        Proposal(
            "near",
            "a grounded and an insulating indenter brought near before the touch",
            _apart(near, sigma, 0.0),
        )
    )
    return max(found, key=lambda p: p.separation)


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
