"""Score verdicts against the truth and lay the table out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from sioms.reconcile_selftest.axis import Axis

#: The parameter that says how large an effect is.
PRIMARY = {
    "viscous": "b_extra",
    "viscous_direction": "b_dir",
    "quadratic_drag": "c",
    "coulomb": "Fc",
    "coulomb_position": "Fm",
    "stribeck": "Fc",
    "presliding": "Fc",
    "lugre": "Fc",
    "friction_variation": "depth",
    "load_friction": "mu",
    "backlash": "gap",
    "cogging": "amp",
    "torque_ripple": "depth",
    "gravity": "amp",
    "spring": "k",
    "offset": "off",
    "delay": "delay",
    "lag": "tau",
    "saturation": "limit",
    "slew_limit": "rate",
    "supply_limit": "F0",
    "elastic": "f_res",
    "encoder_scale": "gain",
    "encoder_quantisation": "factor",
    "eccentricity": "amp",
    "interpolation_error": "amp",
    "thermal_gain": "loss",
    "payload": "J_extra",
    "hardening_spring": "k3",
    "asymmetric_spring": "d",
    "dead_band": "w",
    "gain_asymmetry": "d",
    "power_drag": "n",
    "quadratic_direction": "c",
    "load_square_friction": "g",
    "warming_friction": "g",
    "swinging_load": "f_res",
}


class Hidden(Protocol):
    """What is scored: its kind, and the effects it hides."""

    @property
    def name(self) -> str: ...
    @property
    def kind(self) -> str: ...
    @property
    def rival(self) -> str: ...
    @property
    def named(self) -> Mapping[str, Any]: ...
    @property
    def nameless(self) -> Mapping[str, Any]: ...


@dataclass(frozen=True, slots=True)
class Scored:
    """One axis or sensor, scored.

    Attributes:
        errors: relative errors of the leading parameters; inside: whether the interval covers.
        closed: share of the gap that the model closes on a held-out command, None where there is none.
        stable: shares of resampled analyses with the same verdict, None where there were none.
    """

    axis: Hidden
    verdict: str
    got: tuple[str, ...]
    right: bool
    leading: bool
    errors: tuple[float, ...]
    inside: tuple[bool, ...]
    closed: float | None
    stable: float | None
    seconds: float


def is_right(hidden: Hidden, answer: Mapping[str, Any]) -> bool:
    """Tell whether a verdict (the parsed verdict.json) is the one that this kind of case demands."""
    got, truth = set(answer["effects"]), set(hidden.named)
    verdict = str(answer["verdict"])
    match hidden.kind:
        case "null":
            return verdict == "none" and not got
        case "confounded":
            sets = [got, *(set(a) for a in answer["alternatives"])]
            both = truth in sets and set(hidden.rival.split(" + ")) in sets
            return verdict == "ambiguous" and both and bool(answer["separating_experiment"])
        case "unknown" | "near":
            return verdict == "unexplained" and got == truth
        case _:
            return verdict == "named" and got == truth


def score(
    axis: Axis,
    answer: Mapping[str, Any],
    closed: float | None = None,
    again: Sequence[Mapping[str, Any]] = (),
) -> Scored:
    """Score one verdict (the parsed verdict.json).

    Args:
        closed: share of the gap closed on a held-out command.
        again: verdicts of the same records with their blocks of time drawn anew.
    """
    got, truth = tuple(answer["effects"]), set(axis.named)
    verdict = str(answer["verdict"])
    errors, inside = [], []
    for detail in answer["details"]:
        name = detail["name"]
        if name in truth:
            p, true = detail["parameters"][PRIMARY[name]], axis.named[name][PRIMARY[name]]
            size = abs(true - 1.0) if name == "encoder_scale" else abs(true)
            errors.append(abs(p["value"] - true) / size)
            inside.append(bool(p["low"] <= true <= p["high"]))
    same = [str(a["verdict"]) == verdict and set(a["effects"]) == set(got) for a in again]
    stable = sum(same) / len(same) if same else None
    return Scored(
        axis,
        verdict,
        got,
        is_right(axis, answer),
        bool(got) and got[0] in truth,
        tuple(errors),
        tuple(inside),
        closed,
        stable,
        float(answer["seconds"]),
    )


def table(rows: Sequence[Scored]) -> str:
    """Lay the figures out with their counts."""

    def share(kind: str, key: str = "right") -> str:
        chosen = [r for r in rows if r.axis.kind == kind]
        return f"{sum(getattr(r, key) for r in chosen)}/{len(chosen)}"

    def quantile(values: list[float], q: float) -> str:
        return f"{sorted(values)[min(int(q * len(values)), len(values) - 1)]:.3f}" if values else "-"

    errors = [e for r in rows for e in r.errors]
    inside = [i for r in rows for i in r.inside]
    closed = [r.closed for r in rows if r.axis.kind in ("single", "multi") and r.closed is not None]
    stable = [r.stable for r in rows if r.stable is not None]
    hits = sum(len(set(r.got) & set(r.axis.named)) for r in rows if r.axis.kind != "confounded")
    named = sum(len(r.got) for r in rows if r.axis.kind != "confounded")
    hidden = sum(len(r.axis.named) for r in rows if r.axis.kind != "confounded")
    lines = [
        ("nothing hidden: silent", share("null")),
        ("one hidden: named exactly", share("single")),
        ("one hidden: leading effect", share("single", "leading")),
        ("two or three: named exactly", share("multi")),
        ("precision over effects", f"{hits}/{named}"),
        ("recall over effects", f"{hits}/{hidden}"),
        ("outside the library: refused, known part right", share("unknown")),
        ("near a form of the library: refused, known part right", share("near")),
        ("confounded: both named", share("confounded")),
        ("gap closed, median", quantile(closed, 0.5)),
        ("gap closed, tenth percentile", quantile(closed, 0.1)),
        ("parameter error, median", quantile(errors, 0.5)),
        ("parameter error, ninetieth percentile", quantile(errors, 0.9)),
        ("95 % intervals that cover", f"{sum(inside)}/{len(inside)}"),
        ("same verdict with the blocks drawn anew", f"{sum(stable) / len(stable):.3f}" if stable else "-"),
        ("seconds an axis, largest", quantile([r.seconds for r in rows], 1.0)),
        ("seconds each, median", quantile([r.seconds for r in rows], 0.5)),
    ]
    return "\n".join(f"{a:50s} {b}" for a, b in lines)
