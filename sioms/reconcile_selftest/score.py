"""Score verdicts against the truth and lay the table out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sioms.reconcile_selftest.draw import Axis

#: The parameter that says how large an effect is.
PRIMARY = {"viscous": "b_extra", "coulomb": "Fc", "stribeck": "Fc", "backlash": "gap", "cogging": "amp", "torque_ripple": "depth",
           "gravity": "amp", "offset": "off", "delay": "delay", "saturation": "limit", "elastic": "f_res", "encoder_scale": "gain",
           "encoder_quantisation": "factor", "thermal_gain": "loss", "payload": "J_extra"}


@dataclass(frozen=True, slots=True)
class Scored:
    """One axis, scored. ``errors`` are relative errors of the leading parameters, ``inside`` whether the interval covers."""

    axis: Axis
    verdict: str
    got: tuple[str, ...]
    right: bool
    leading: bool
    errors: tuple[float, ...]
    inside: tuple[bool, ...]
    closed: float
    seconds: float


def score(axis: Axis, answer: Mapping[str, Any]) -> Scored:
    """Score one verdict (the parsed verdict.json)."""
    got, truth = tuple(answer["effects"]), set(axis.named)
    verdict = str(answer["verdict"])
    sets = [set(got), *(set(a) for a in answer["alternatives"])]
    match axis.kind:
        case "null":
            right = verdict == "none" and not got
        case "confounded":
            right = verdict == "ambiguous" and truth in sets and {axis.rival} in sets and bool(answer["separating_experiment"])
        case "unknown":
            right = verdict == "unexplained" and set(got) == truth
        case _:
            right = verdict == "named" and set(got) == truth
    errors, inside = [], []
    for detail in answer["details"]:
        name = detail["name"]
        if name in truth:
            p, true = detail["parameters"][PRIMARY[name]], axis.named[name][PRIMARY[name]]
            size = abs(true - 1.0) if name == "encoder_scale" else abs(true)
            errors.append(abs(p["value"] - true) / size)
            inside.append(bool(p["low"] <= true <= p["high"]))
    closed = next((float(g["closed"]) for g in answer["gaps"] if g["channel"].startswith("force")), 0.0)
    return Scored(axis, verdict, got, right, bool(got) and got[0] in truth, tuple(errors), tuple(inside), closed, float(answer["seconds"]))


def table(rows: Sequence[Scored]) -> str:
    """Lay the figures out with their counts."""
    def share(kind: str, key: str = "right") -> str:
        chosen = [r for r in rows if r.axis.kind == kind]
        return f"{sum(getattr(r, key) for r in chosen)}/{len(chosen)}"

    def quantile(values: list[float], q: float) -> str:
        return f"{sorted(values)[min(int(q * len(values)), len(values) - 1)]:.3f}" if values else "-"

    errors = [e for r in rows for e in r.errors]
    inside = [i for r in rows for i in r.inside]
    closed = [r.closed for r in rows if r.axis.kind in ("single", "multi")]
    hits = sum(len(set(r.got) & set(r.axis.named)) for r in rows if r.axis.kind != "confounded")
    named = sum(len(r.got) for r in rows if r.axis.kind != "confounded")
    hidden = sum(len(r.axis.named) for r in rows if r.axis.kind != "confounded")
    lines = [
        ("nothing hidden: silent", share("null")), ("one hidden: named exactly", share("single")),
        ("one hidden: leading effect", share("single", "leading")), ("two or three: named exactly", share("multi")),
        ("precision over effects", f"{hits}/{named}"), ("recall over effects", f"{hits}/{hidden}"),
        ("outside the library: refused, known part right", share("unknown")), ("confounded: both named", share("confounded")),
        ("gap closed, median", quantile(closed, 0.5)), ("gap closed, tenth percentile", quantile(closed, 0.1)),
        ("parameter error, median", quantile(errors, 0.5)), ("parameter error, ninetieth percentile", quantile(errors, 0.9)),
        ("95 % intervals that cover", f"{sum(inside)}/{len(inside)}"),
        ("seconds an axis, median", quantile([r.seconds for r in rows], 0.5)),
    ]
    return "\n".join(f"{a:50s} {b}" for a, b in lines)
