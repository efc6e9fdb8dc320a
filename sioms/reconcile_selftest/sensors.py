"""Score verdicts on hidden fingers, force sensors and hands against the truth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sioms.reconcile_selftest.finger_draw import HiddenFinger
from sioms.reconcile_selftest.force_world import COMPONENTS, HiddenSensor
from sioms.reconcile_selftest.hand_world import PRIMARY as OF_HANDS
from sioms.reconcile_selftest.hand_world import HiddenHand
from sioms.reconcile_selftest.score import Scored, is_right

#: The parameter that says how large an effect is.
PRIMARY = {
    "gain_scatter": "g",
    "depth_scatter": "dr",
    "angle_scatter": "dt",
    "angle_offset": "off",
    "poisson": "dnu",
    "quadratic": "q",
    "temperature_drift": "k",
    "creep": "c",
    "proximity": "A",
    "strip_inhomogeneity": "G",
    "adhesion": "share",
    "sliding_friction": "f",
    "mains_line": "a",
    "cross_talk": "x",
    "force_gain": "g",
    "gain": "g",
    "offset_drift": "d",
    "hysteresis": "b",
    "temperature": "k",
    **OF_HANDS,
}


def score_sensor(hidden: HiddenFinger | HiddenSensor | HiddenHand, answer: Mapping[str, Any]) -> Scored:
    """Score one verdict (the parsed verdict.json)."""
    got, truth = tuple(answer["effects"]), set(hidden.named)
    verdict = str(answer["verdict"])
    errors: list[float] = []
    inside: list[bool] = []
    for detail in answer["details"]:
        name = detail["name"]
        # what "full adhesion" means depends on how fine its edge is resolved; a dead element has no size
        if name in truth and name not in ("adhesion", "dead_element") and hidden.kind != "confounded":
            _compare(name, detail["parameters"], hidden.named[name], errors, inside)
    gaps = [g for g in answer["gaps"] if g["before"] > 1.5 * g["floor"]]
    closed = min((float(g["closed"]) for g in gaps), default=1.0)
    return Scored(
        hidden,
        verdict,
        got,
        is_right(hidden, answer),
        bool(got) and got[0] in truth,
        tuple(errors),
        tuple(inside),
        closed,
        None,
        float(answer["seconds"]),
    )


def _compare(
    name: str, found: Mapping[str, Any], true: Mapping[str, Any], errors: list[float], inside: list[bool]
) -> None:
    symbol = PRIMARY[name]
    pairs = []
    if name == "cross_talk" and symbol not in found:
        for j, source in enumerate(COMPONENTS):
            pairs += [(found[f"from_{source}[{i}]"], float(true["x"][i, j])) for i in range(6) if i != j]
    elif symbol in found:
        pairs = [(found[symbol], float(np.mean(true[symbol])))]
    else:
        pairs = [(found[f"{symbol}[{i}]"], float(v)) for i, v in enumerate(true[symbol])]
    value, want = np.array([p["value"] for p, _ in pairs]), np.array([t for _, t in pairs])
    errors.append(float(np.sqrt(np.sum((value - want) ** 2) / np.sum(want**2))))
    inside += [bool(p["low"] <= t <= p["high"]) for p, t in pairs]
