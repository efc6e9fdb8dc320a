"""Recompute the checkable claims of the published work on fingers A (nu 0.5, ra 8.9 mm) and B (nu 0.46, ra 9.6 mm).

Every function computes its numbers and judges them by a stated tolerance; no verdict is written down.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from sioms.tactile import closedform, contact, emap, halfplane, series
from sioms.tactile.cylinder import FINGER_A, FINGER_B, Cylinder, respond
from sioms.tactile.design import (
    class_difference,
    conditioning,
    cutoff,
    exact_equivalent_wedge,
    spacing_needed,
)
from sioms.tactile.estimator import Estimator
from sioms.tactile.finger import ContactModel, Finger, nominal_finger
from sioms.tactile.indenter import FLAT, Round
from sioms.tactile.quality import Load
from sioms.tactile.width import hertz_table, rigid_core_table

Floats = NDArray[np.float64]
ANGLES = np.radians(143.0 - 9.22 * np.arange(16))
RS_A, RS_B = 9.4e-3, 10.3e-3
CLASS_NOISE = 0.017  # of the peak, in the abstract
PUBLISHED_RC = {0.5: (0.41, 0.95), 1.59: (1.34, 2.39), 3.90: (2.09, 3.37), 6.01: (3.71, 5.84), 7.55: (5.22, 8.17),
                9.30: (5.85, 9.41), 12.30: (7.60, 12.94), 18.71: (8.58, 15.51), 25.25: (9.90, 19.36)}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Claim:
    """One published statement beside what was computed; `holds` is the verdict."""

    where: str
    statement: str
    computed: str
    holds: bool


def _near(value: float, published: float, tolerance: float) -> bool:
    return abs(value / published - 1.0) <= tolerance


def chapter_2() -> Iterator[Claim]:
    """Recompute the claims of chapter 2."""
    k = np.arange(200)
    inside, surface = respond(FINGER_A, k, RS_A), respond(FINGER_A, k, FINGER_A.outer_m)
    ratio = [float(abs(f[20]) / np.abs(f).max()) for f in (inside.e_rr[:, 0, 0], inside.e_rt[:, 0, 0])]
    yield Claim("fig 2.4", "e_rr and e_rt below 10 % of their maximum by the 20th coefficient",
                f"{100 * ratio[0]:.1f} % and {100 * ratio[1]:.1f} %", max(ratio) < 0.10)  # fmt: skip
    fall = [20 * math.log10(abs(f[20] / f[60])) / math.log10(3.0) for f in (inside.e_rr[:, 0, 0], surface.u_r[:, 0, 0])]
    yield Claim("fig 2.6", "strain falls by more than 100 dB/decade, displacement by about 20",
                f"{fall[0]:.0f} and {fall[1]:.0f} dB/decade", fall[0] > 100 and _near(fall[1], 20, 0.15))  # fmt: skip
    theta = np.array([0.0])
    line = series.line_load(FINGER_A, -200.0, 0.0, 200)
    mine = float((emap.e_map(FINGER_A, theta, RS_A, 200)[:, :401] @ line)[0])
    plane = float(halfplane.normal_strain(0.0, FINGER_A.outer_m - RS_A, 200.0, 0.5, FINGER_A.shear_pa))
    yield Claim("2.2", "the half plane's peak strain is 1.25 times the cylinder's", f"{plane / mine:.2f}",
                _near(plane / mine, 1.25, 0.03))  # fmt: skip
    shear = np.abs(inside.e_rt[1:, 0, 1]).max() / np.abs(inside.e_rt[1:, 0, 0]).max()
    normal = np.abs(inside.e_rr[:, 0, 0]).max() / np.abs(inside.e_rr[:, 0, 1]).max()
    yield Claim(
        "fig 2.4",
        "shear strain is affected a factor 3 more by the tangential load; normal strain differs by 2",
        f"{shear:.1f}; {normal:.1f}",
        _near(shear, 3, 0.1) and _near(normal, 2, 0.25),
    )
    alpha = np.linspace(0.6, 0.9, 13)
    bodies = [Cylinder(a * 12.7e-3, 12.7e-3, 0.5) for a in alpha]
    found = np.array([cutoff(b, b.core_m + 0.5e-3) for b in bodies])
    off = float(np.max(np.abs(found * ((1 - alpha) - 0.0274) / 0.90 - 1.0)))
    yield Claim(
        "(2.18)",
        "cut-off 0.90/((1 - alpha) - 0.0274) cycles/rad for alpha < 0.9",
        f"to {100 * off:.0f} %",
        off < 0.13,
    )
    bench = Cylinder(0.756 * 12.7e-3, 12.7e-3, 0.5)
    pitch = spacing_needed(bench, bench.core_m + 0.5e-3)
    yield Claim(
        "3.1.1",
        "spacing at most 0.13 rad = 1.6 mm at alpha = 0.75",
        f"{pitch:.3f} rad = {12.7 * pitch:.2f} mm",
        _near(pitch, 0.13, 0.05),
    )
    thin = Cylinder(0.85 * 12.7e-3, 12.7e-3, 0.5)
    drag = cutoff(thin, thin.core_m + 0.5e-3, field="e_rt", traction=1)
    yield Claim(
        "2.2",
        "shear strain under tangential load is filtered to 1.6 cycles/rad at alpha = 0.85",
        f"{drag:.2f}",
        _near(drag, 1.6, 0.15),
    )
    shallow = Cylinder(0.90 * 12.7e-3, 12.7e-3, 0.5)
    forty, twenty = cutoff(shallow, shallow.core_m + 0.5e-3, 0.01), cutoff(shallow, shallow.core_m + 0.5e-3)
    yield Claim(
        "2.5.2",
        "the -40 dB frequency at alpha = 0.90 is 12 cycles/rad",
        f"{forty:.1f}; the -20 dB value is {twenty:.1f}",
        _near(forty, 12.0, 0.05),
    )
    yield from _contacts()
    yield from _classes()


def _contacts() -> Iterator[Claim]:
    half = 2e-3 / FINGER_A.outer_m
    free, stuck = contact.frictionless(FINGER_A, FLAT, half), contact.adhere(FINGER_A, FLAT, half)
    hertz = float(closedform.hertz_product(FINGER_A, half)) / FINGER_A.outer_m
    yield Claim("fig 2.12", "a rigid core gives more load and peak pressure than Hertz for one width (flat, 4 mm)",
                f"{free.load / hertz:.2f} times the load", free.load > 1.05 * hertz)  # fmt: skip
    x = np.linspace(-0.95, 0.95, 39)
    shape = free.pressure(half * x) / free.pressure(0.0)
    bend = float(np.max(np.abs(shape - np.sqrt(1 - x**2))))
    yield Claim(
        "fig 2.12",
        "the pressure is still near the ellipse",
        f"within {100 * bend:.1f} % of the peak",
        bend < 0.05,
    )
    theta = np.linspace(-0.5, 0.5, 2001)
    matrix = emap.e_map(FINGER_A, theta, RS_A, 120)
    wide = []
    for solved in (free, stuck):
        strain = matrix @ solved.series(0.0, 120)
        wide.append(float(np.ptp(theta[strain < 0.5 * strain.min()])))
    yield Claim(
        "fig 2.13",
        "adhesion narrows the strain profile",
        f"half-value width {wide[1]:.4f} against {wide[0]:.4f} rad",
        wide[1] < wide[0],
    )
    cut = {c: _odd_over_even(c) for c in (0.3, 0.1, 0.03, 0.01)}
    yield Claim("2.5.1", "the odd shape has 0.11 of the even shape's singular value",
                "; ".join(f"{v:.2f} with cut {c:g}" for c, v in cut.items()),
                all(_near(v, 0.11, 0.3) for v in cut.values()))  # fmt: skip


def _odd_over_even(cut: float, half: float = 2e-3 / 12.7e-3, highest: int = 150) -> float:
    """Return the ratio of the largest odd to the largest even singular value of E C (S C)^+ with a cut SVD."""
    points = np.linspace(-half, half, 101)
    k = np.arange(1, highest + 1)
    slope = np.zeros((points.size, 2 * highest + 1))
    steep = k * respond(FINGER_A, k, FINGER_A.outer_m).u_r[:, 0, 0]
    slope[:, 1::2] = steep * np.cos(k * points[:, None])
    slope[:, 2::2] = -steep * np.sin(k * points[:, None])
    strip = series.restriction(half, 0.0, highest)
    inverse = np.linalg.pinv(slope @ strip, rcond=cut)
    theta = np.linspace(-1.2, 1.2, 25)
    chain = emap.e_map(FINGER_A, theta, RS_A, highest)[:, : 2 * highest + 1] @ strip @ inverse
    _, values, rows = np.linalg.svd(chain)
    # an even shape has an odd slope
    even_shape = [v for v, row in zip(values, rows, strict=False) if np.dot(row, row[::-1]) < 0]
    odd_shape = [v for v, row in zip(values, rows, strict=False) if np.dot(row, row[::-1]) > 0]
    return float(max(odd_shape) / max(even_shape))


def _classes() -> Iterator[Claim]:
    sharp = math.degrees(exact_equivalent_wedge(FINGER_A, 200.0, 0.5e-3)[0])
    larger = math.degrees(exact_equivalent_wedge(FINGER_A, 200.0, 2.7e-3)[0])
    yield Claim(
        "fig 2.24",
        "rc = 0.5 mm has an equivalent wedge of 70 deg half angle at 200 N/m",
        f"{sharp:.0f} deg; 70 deg belongs to rc = 2.7 mm ({larger:.0f} deg)",
        _near(sharp, 70, 0.1),
    )
    ratios = (0.70, 0.75, 0.80, 0.85, 0.90)
    share = [_class_share(ratio) for ratio in ratios]
    needed = float(np.interp(CLASS_NOISE, share, ratios))
    yield Claim("2.6", "telling round from wedge needs alpha above 0.85 with noise of 1.7 % of peak",
                ", ".join(f"{100 * v:.2f} % of peak at {a:g}" for a, v in zip(ratios, share, strict=True))
                + f": 1.7 % are passed at alpha = {needed:.2f}", abs(needed - 0.85) < 0.03)  # fmt: skip
    k = np.arange(1, 80)
    spectra = np.array([
        contact.width_for_load(FINGER_A, Round(rc), 200.0).series(0.0, 80)[2:160:2] for rc in (1.6e-3, 12.3e-3, 25.3e-3)
    ])  # fmt: skip
    spread = np.ptp(np.abs(spectra), axis=0) / np.abs(spectra).max(0)
    slow, fast = (
        float(spread[k / (2 * np.pi) < 1.0].max()),
        float(spread[(k / (2 * np.pi) > 2.7) & (k < 21)].min()),
    )
    yield Claim("fig 2.22", "radii at one load differ little below 1 cycle/rad and clearly at 3",
                f"by at most {100 * slow:.0f} % and at least {100 * fast:.0f} %", slow < 0.3 < fast)  # fmt: skip


def _class_share(ratio: float) -> float:
    """Return the difference of rc = rb from its wedge at 200 N/m as a share of the peak (figure 2.25)."""
    body = Cylinder(ratio * 12.7e-3, 12.7e-3, 0.5)
    return class_difference(body, body.core_m + 0.5e-3, 200.0, 12.7e-3)


def chapter_3(frames: int, tick: Callable[[str], None]) -> Iterator[Claim]:
    """Recompute the claims of chapter 3; `frames` of Monte Carlo for each figure."""
    condition = conditioning(FINGER_B, ANGLES, RS_B, [0.46, 0.48, 0.489])
    yield Claim("3.4.3", "condition number of E 2.7; below 5 for nu < 0.49",
                ", ".join(f"{c:.2f}" for c in condition) + " at nu 0.46, 0.48, 0.489",
                _near(float(condition[0]), 2.7, 0.05) and float(condition.max()) < 5.0)  # fmt: skip
    yield Claim("3.3.1", "quantisation of 0.05 % is a third of the noise of 0.05 %", f"{math.sqrt(12):.1f} times",
                _near(math.sqrt(12), 3, 0.2))  # fmt: skip
    yield Claim(
        "3.3.3",
        "0.81 %/K is 27 times the rubber's 0.03 %/K",
        f"{0.81 / 0.03:.0f} times",
        _near(0.81 / 0.03, 27, 0.01),
    )
    turned = np.radians(np.arange(180.0))
    touches = np.array([series.line_load(FINGER_B, -200.0, float(t), 60) for t in turned])
    values = np.linalg.svd(touches, compute_uv=False)
    rank = int(np.count_nonzero(values > 0.02 * values[0]))
    yield Claim(
        "3.4.2",
        "touches round half the finger give half the rank of P",
        f"{rank} of 121",
        _near(rank, 60.5, 0.15),
    )
    finger = nominal_finger(FINGER_B, ANGLES, RS_B, 1.0, 1e-3)
    yield from _bias(finger)
    tick("bias of the contact models")
    yield from _deviations(finger, frames, tick)


def _hertz_finger(finger: Finger) -> Finger:
    table = hertz_table(finger.cylinder)
    model = ContactModel("hertz", 0.0, tuple(table.half_widths.tolist()), tuple(table.ratio.tolist()))
    return msgspec.structs.replace(finger, contact=model)


def _elliptic(finger: Finger) -> Finger:
    """Return the finger with the published model: the exact width, under an elliptic pressure."""
    contact_model = msgspec.structs.replace(finger.contact, pressure="elliptic")
    return msgspec.structs.replace(finger, contact=contact_model)


def radii_fitted(finger: Finger, adhesion: float) -> dict[float, tuple[float, float]]:
    """Return rc [mm] fitted with Hertz's and the approximate frictionless model to exact touches at 200 N/m, by rc
    [mm].

    Touches: the bounded solution, with `adhesion` of the tangential traction of full adhesion, mean over
        places in one pitch.
    """
    estimators = Estimator(_hertz_finger(finger)), Estimator(_elliptic(finger))
    matrix = emap.e_map(FINGER_B, ANGLES, RS_B, 100)
    out = {}
    for rc in PUBLISHED_RC:
        radius = closedform.equivalent_radius(FINGER_B, 1e-3 * rc)
        solved = contact.width_for_load(FINGER_B, Round(1e-3 * rc), 200.0)
        stuck = contact.adhere(FINGER_B, FLAT, solved.half_width)
        fitted: list[list[float]] = [[], []]
        for place in np.linspace(ANGLES[8], ANGLES[7], 7):
            loads = solved.series(float(place), 100)
            loads[201:] += adhesion * 200.0 / stuck.load * stuck.series(float(place), 100)[201:]
            for column, estimator in zip(fitted, estimators, strict=True):
                column.append(estimator.frame(matrix @ loads).equivalent_radius_m)
        del radius
        found = [1e3 * closedform.indenter_radius(FINGER_B, float(np.mean(column))) for column in fitted]
        out[rc] = found[0], found[1]
    return out


def _bias(finger: Finger) -> Iterator[Claim]:
    free = radii_fitted(finger, 0.0)
    low = {rc: free[rc][0] for rc in (12.30, 18.71, 25.25)}
    yield Claim("table 3.10", "Hertz fits underestimate rc: 12.3 -> 7.6, 18.7 -> 8.6, 25.25 -> 9.9 mm",
                ", ".join(f"{rc} -> {v:.1f}" for rc, v in low.items()),
                all(abs(v - PUBLISHED_RC[rc][0]) < 0.25 * PUBLISHED_RC[rc][0] for rc, v in low.items()))  # fmt: skip
    small = {rc: free[rc][1] for rc in (6.01, 9.30, 12.30)}
    yield Claim("table 3.10", "the approximate frictionless model is unbiased up to 13 mm",
                ", ".join(f"{rc} -> {v:.2f}" for rc, v in small.items()),
                all(_near(v, rc, 0.08) for rc, v in small.items()))  # fmt: skip
    sticky = radii_fitted(finger, 0.5)
    large = {rc: sticky[rc][1] for rc in (18.71, 25.25)}
    yield Claim(
        "table 3.10",
        "above 13 mm rc is underestimated, probably by friction (18.7 -> 15.5, 25.25 -> 19.4)",
        ", ".join(f"{rc} -> {v:.1f}, {free[rc][1]:.1f}" for rc, v in large.items())
        + " with half of full adhesion, without",
        all(_near(v, PUBLISHED_RC[rc][1], 0.1) and v < 0.95 * free[rc][1] for rc, v in large.items()),
    )


def _touch(finger: Finger, load: float, rc: float, place: float) -> Floats:
    highest = 60
    half = rigid_core_table(FINGER_B).half_width(load * closedform.equivalent_radius(FINGER_B, rc))
    spectrum = closedform.ellipse_spectrum(half * np.arange(highest + 1))
    matrix = emap.e_map(FINGER_B, finger.angles_rad, RS_B, highest)[:, : 2 * highest + 1]
    strain: Floats = matrix @ series.spread(FINGER_B, -load, spectrum, place)
    return strain


def _scatter(
    finger: Finger, load: float, rc: float, frames: int, known: Load | None = None, miss: float = 0.0
) -> Floats:
    """Return place [deg], load [N/m], R [mm] and rc [mm] of noisy frames; the known load may err by `miss` N/m."""
    random = np.random.default_rng(7)
    estimator, clean = Estimator(finger), _touch(finger, load, rc, math.radians(75.0))
    rows = []
    for _ in range(frames):
        told = None if known is None else Load(max(known.value + miss * random.normal(), 1.0), known.deviation)
        e = estimator.frame(clean + 1e-3 * random.normal(size=clean.size), told)
        rows.append(
            (
                math.degrees(e.angle_rad),
                e.load_n_per_m,
                1e3 * e.equivalent_radius_m,
                1e3 * min(e.radius_m, 10.0),
            )
        )
    return np.array(rows)


def _deviations(finger: Finger, frames: int, tick: Callable[[str], None]) -> Iterator[Claim]:
    found = {(p, rc): _scatter(finger, p, rc, frames).std(0) for p in (50.0, 200.0) for rc in (3.9e-3, 12.3e-3)}
    tick("Monte Carlo")
    at, weak = found[200.0, 3.9e-3], found[50.0, 3.9e-3]
    yield Claim("fig 3.27", "location improves with load and hardly depends on curvature",
                f"{weak[0]:.3f} deg at 50, {at[0]:.3f} at 200 N/m; rc 12.3 mm: {found[200.0, 12.3e-3][0]:.3f}",
                at[0] < 0.5 * weak[0] and _near(found[200.0, 12.3e-3][0], at[0], 0.3))  # fmt: skip
    yield Claim(
        "fig 3.28",
        "standard deviation of R in the tenths of a millimetre at 200 N/m",
        f"{at[2]:.2f} mm (rc 3.9), {found[200.0, 12.3e-3][2]:.2f} mm (rc 12.3)",
        0.1 <= at[2] <= 1.0,
    )
    yield Claim(
        "fig 3.29",
        "load deviation about 3 N/m, the same over load and radius",
        f"{at[1]:.2f} N/m at 200, {weak[1]:.2f} at 50 N/m",
        1.5 < at[1] < 4.5 and _near(weak[1], at[1], 0.2),
    )
    pitch = 9.22
    yield Claim(
        "3.6",
        "location to 1/25 of the element spacing or better",
        f"1/{pitch / at[0]:.0f} by noise alone",
        pitch / at[0] > 25,
    )
    many = _scatter(finger, 200.0, 5e-3, frames).std(0)
    growth = (1 + 5.0 / 12.7) ** 2
    flat_growth = 4.0
    yield Claim(
        "3.5.2",
        "for rc = rb the deviation of rc is twice that of R",
        f"(1 + rc/rb)² = {flat_growth:g}; Monte Carlo at rc = 5 mm: {many[3] / many[2]:.2f}, formula {growth:.2f}, "
        f"linear law {1 + 5 / 12.7:.2f}",
        not _near(many[3] / many[2], growth, 0.1),
    )
    exact = _scatter(finger, 200.0, 3.9e-3, frames, Load(200.0, 0.0)).std(0)
    noisy = _scatter(finger, 200.0, 3.9e-3, frames, Load(200.0, 0.0), 10.0).std(0)
    honest = _scatter(finger, 200.0, 3.9e-3, frames, Load(200.0, 10.0), 10.0).std(0)
    yield Claim("3.5.2", "a noisy load taken as exact makes R worse, an exact one slightly better",
                f"R {at[2]:.3f} mm without, {exact[2]:.3f} with exact, {noisy[2]:.3f} with 10 N/m taken as exact, "
                f"{honest[2]:.3f} with 10 N/m weighted as such", exact[2] < at[2] < noisy[2])  # fmt: skip
    tick("load information")
