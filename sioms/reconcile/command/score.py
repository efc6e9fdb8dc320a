"""``sioms reconcile score``: diagnose a folder of fingers with known answers, and tabulate the results.

``PUBLIC/NAME/`` holds one finger as ``sioms reconcile tactile`` reads it, ``TRUTH/NAME.json`` its hidden effects
(``effects``, and ``parameters`` and ``elements`` to compare sizes with). The truth is read after the verdict.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.finger import reconcile_tactile
from sioms.reconcile.sensors.verdict import SensorVerdict

#: How a truth's number is found in a verdict: its key, and the effect's parameter in the truth's unit.
SIZES: dict[str, tuple[str, Callable[[Mapping[str, float]], float]]] = {
    "angle_offset": ("pos_off", lambda p: np.degrees(p["off"])), "adhesion": ("adhesion", lambda p: p["share"]),
    "proximity": ("proximity", lambda p: 100.0 * p["A"]), "force_gain": ("force_gain", lambda p: p["g"]),
    "creep": ("creep", lambda p: p["c"]), "sliding_friction": ("friction", lambda p: p["f"]),
    "temperature_drift": ("temp_coef", lambda p: 100.0 * p["k"]), "mains_line": ("line_amp", lambda p: 100.0 * p["a"]),
    "strip_inhomogeneity": ("strip_gain", lambda p: p["G"]),
    "quadratic": ("quad", lambda p: 0.01 * float(np.mean([v for k, v in p.items() if k.startswith("q[")]))),
}  # fmt: skip
EACH = {
    "gain_scatter": ("gain", "g", "gain_percent_strain_per_percent_output", True),
    "depth_scatter": ("rs_mm", "dr", "element_radius_mm", False),
    "angle_scatter": ("theta_deg", "dt", "element_angle_deg", False),
}


@dataclass(frozen=True, slots=True)
class Row:
    """One finger, scored; ``errors`` are relative errors of the leading numbers by effect."""

    name: str
    hidden: tuple[str, ...]
    named: tuple[str, ...]
    verdict: str
    errors: dict[str, float]
    closed: float
    seconds: float

    @property
    def right(self) -> bool:
        """Say whether exactly the hidden effects were named."""
        return set(self.hidden) == set(self.named) and self.verdict == ("named" if self.hidden else "none")


def score(public: Path, truth: Path) -> int:
    """Solve and score every finger; print a row for each and the table.

    Returns:
        0 when at least nine tenths were judged right, else 1.
    """
    rows = []
    for folder in sorted(p for p in public.iterdir() if p.is_dir()):
        try:
            began = time.monotonic()
            verdict = reconcile_tactile(folder, None)
            seconds = time.monotonic() - began
        except BadInputError as e:
            print(f"{folder.name}: bad input: {e}")
            continue
        row = compare(folder, json.loads((truth / f"{folder.name}.json").read_text()), verdict, seconds)
        rows.append(row)
        errors = ", ".join(f"{k} {100 * v:.1f} %" for k, v in row.errors.items())
        print(
            f"{row.name}  {'right' if row.right else 'WRONG'}  hidden {', '.join(row.hidden) or 'nothing'} | "
            f"{row.verdict}: {', '.join(row.named) or '-'} | errors {errors or '-'} | gap closed {row.closed:.3f} "
            f"({row.seconds:.0f} s)",
            flush=True,
        )
    print(table(rows))
    return 0 if rows and sum(r.right for r in rows) >= 0.9 * len(rows) else 1


def compare(folder: Path, truth: Mapping[str, Any], verdict: SensorVerdict, seconds: float) -> Row:
    """Score one verdict."""
    nominal = json.loads((folder / "nominal.json").read_text())
    found = {e.name: {p.symbol: p.value for p in e.parameters} for e in verdict.effects}
    errors: dict[str, float] = {}
    for name in set(truth["effects"]) & set(found):
        if name in SIZES:
            key, size = SIZES[name]
            errors[name] = abs(size(found[name]) - truth["parameters"][key]) / abs(truth["parameters"][key])
        elif name in EACH:
            key, symbol, stated, relative = EACH[name]
            errors[name] = _spread(truth["elements"][key], nominal[stated], found[name], symbol, relative)
        elif name == "poisson":
            true = truth["parameters"]["nu"] - nominal["poisson"]
            errors[name] = abs(found[name]["dnu"] - true) / abs(true)
    gaps = [g for g in verdict.gaps if g.before > 1.5 * g.floor]
    return Row(folder.name, tuple(truth["effects"]), tuple(found), verdict.outcome.value, errors,
               min((g.closed for g in gaps), default=1.0), seconds)  # fmt: skip


def _spread(true: Any, stated: Any, found: Mapping[str, float], symbol: str, relative: bool) -> float:
    """Root mean square error of the elements over the root mean square of what was hidden."""
    base, want = np.array(stated), np.array(true)
    got = np.array([found[f"{symbol}[{i}]"] for i in range(len(base))])
    unit = {"dr": 1e3, "dt": 180.0 / np.pi}.get(symbol, 1.0)
    hidden = want / base - 1.0 if relative else want - base
    return float(np.sqrt(np.mean((got * unit - hidden) ** 2) / np.mean(hidden**2)))


def table(rows: list[Row]) -> str:
    """Lay the figures out with their counts."""

    def share(low: int, high: int) -> str:
        mine = [r for r in rows if low <= len(r.hidden) <= high]
        return f"{sum(r.right for r in mine)}/{len(mine)}"

    errors = sorted(e for r in rows for n, e in r.errors.items() if n != "adhesion")
    closed = sorted(r.closed for r in rows if r.hidden)
    named, hidden = sum(len(r.named) for r in rows), sum(len(r.hidden) for r in rows)
    hits = sum(len(set(r.named) & set(r.hidden)) for r in rows)
    seconds = sorted(r.seconds for r in rows)
    lines = [
        ("nothing hidden: silent", share(0, 0)),
        ("one hidden effect: named exactly", share(1, 1)),
        ("two or three: named exactly", share(2, 99)),
        ("precision, recall over effects", f"{hits}/{named}, {hits}/{hidden}"),
        ("gap closed: median, tenth percentile", _quantiles(closed, 0.5, 0.1)),
        ("parameter error: median, ninetieth percentile", _quantiles(errors, 0.5, 0.9)),
        ("seconds a finger, median", _quantiles(seconds, 0.5)),
    ]
    return "\n".join(f"{a:50s} {b}" for a, b in lines)


def _quantiles(values: list[float], *shares: float) -> str:
    return ", ".join(f"{values[min(int(s * len(values)), len(values) - 1)]:.3f}" for s in shares) if values else "-"
