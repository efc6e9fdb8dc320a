"""Report what a finger will be able to tell before it is moulded."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sioms.report_page import Page
from sioms.tactile.closedform import ellipse_spectrum, equivalent_radius
from sioms.tactile.command import pictures as draw
from sioms.tactile.command.progress import Progress
from sioms.tactile.cylinder import Cylinder, respond
from sioms.tactile.design import class_difference, conditioning, cutoff, predicted_errors, spacing_needed
from sioms.tactile.emap import highest_needed
from sioms.tactile.finger import Finger, nominal_finger
from sioms.tactile.width import rigid_core_table

LOADS = (25.0, 50.0, 100.0, 200.0, 400.0)
RADII = (0.5e-3, 1.6e-3, 3.9e-3, 6.0e-3, 12.3e-3, 25.3e-3, math.inf)


def design(args: argparse.Namespace) -> int:
    """Compute, print the main figures, write the report."""
    body = Cylinder(1e-3 * args.core_mm, 1e-3 * args.outer_mm, args.poisson, args.shear_pa)
    radius = body.outer_m - 1e-3 * args.depth_mm
    if not body.core_m < radius < body.outer_m:
        raise ValueError(
            f"design finger: elements {args.depth_mm} mm deep are at radius {1e3 * radius:.4g} mm; "
            f"need between {args.core_mm} and {args.outer_mm} mm"
        )
    if args.elements < 4:
        raise ValueError(f"design finger: {args.elements} elements; need at least 4")
    if not 0.0 < args.pitch_deg * (args.elements - 1) < 360.0:
        raise ValueError(
            f"design finger: {args.elements} elements {args.pitch_deg:g} deg apart; need a positive pitch and less "
            "than a turn"
        )
    if not 0.0 < args.noise_percent < math.inf:
        raise ValueError(f"design finger: noise of {args.noise_percent:g} %; need a positive number")
    progress = Progress()
    angles = np.radians(args.pitch_deg) * (np.arange(args.elements) - 0.5 * (args.elements - 1)) + np.pi / 2
    finger = nominal_finger(body, angles, radius, 1.0, 0.01 * args.noise_percent, "design")
    page = Page(
        f"Finger design: {args.core_mm:g}/{args.outer_mm:g} mm, {args.elements} elements at {args.pitch_deg:g} deg"
    )
    rows = _figures(body, radius, finger, args)
    limit = math.degrees(spacing_needed(body, radius))
    coarse = (
        f"elements {args.pitch_deg:g} deg apart are too coarse: {limit:.2f} deg are needed, half a wavelength of the "
        "cut-off; between two of them touches are told less well, and two touches pass for one"
    )
    if args.pitch_deg > limit:
        page.warn(coarse)
    page.table(("quantity", "value", "meaning"), rows)
    progress("errors")
    _errors(page, finger)
    _classes(page, body, radius, 0.01 * args.noise_percent, progress)
    _pictures(page, body, radius, finger, progress)
    page.write(args.output)
    progress.close()
    for name, value, _ in rows:
        print(f"{name:38s} {value}")
    if args.pitch_deg > limit:
        print(f"warning: {coarse}")
    print(f"wrote {args.output}")
    return 0


def _figures(body: Cylinder, radius: float, finger: Finger, args: Any) -> list[tuple[str, str, str]]:
    limit, pitch = spacing_needed(body, radius), math.radians(args.pitch_deg)
    verdict = "ok: fine enough" if pitch <= limit else f"no: too coarse by {100 * (pitch / limit - 1):.0f} %"
    nu = np.array([0.40, body.poisson, 0.49])
    condition = conditioning(body, np.array(finger.angles_rad), radius, nu)
    peak = float(np.abs(finger.strain_table().nodes[0, :, 0]).max())
    return [
        ("cut-off of normal strain (-20 dB)", f"{cutoff(body, radius):.2f} cycles/rad", "finer detail is filtered out"),
        (
            "cut-off of shear strain, tangential",
            f"{cutoff(body, radius, field='e_rt', traction=1):.2f} cycles/rad",
            "shear sensing tells the tangential load, not the shape",
        ),
        (
            "element spacing needed",
            f"{math.degrees(limit):.2f} deg = {1e3 * body.outer_m * limit:.2f} mm",
            "half a wavelength",
        ),
        ("element spacing given", f"{args.pitch_deg:.2f} deg = {1e3 * body.outer_m * pitch:.2f} mm", verdict),
        ("wave numbers needed", f"{highest_needed(body, radius)}", "for 0.2 % of a line load's peak"),
        ("peak strain per load", f"{100 * peak * 100:.2f} % at 100 N/m", "of an edge"),
        (
            "condition of E",
            ", ".join(f"{c:.2f} at nu {n:g}" for n, c in zip(nu, condition, strict=True)),
            "noise amplification when pressures are asked for",
        ),
        ("covered arc", f"{math.degrees(np.ptp(finger.angles_rad)):.0f} deg", ""),
    ]


def _errors(page: Page, finger: Finger) -> None:
    page.head("Standard deviations of one frame's estimate, in the middle of the arc")
    page.text("From the curvature of the squares (Cramér-Rao); the estimator reaches them to a few per cent. R is the "
              "equivalent radius, 1/R = 1/rb + 1/rc; sd(rc) = (1 + rc/rb)² sd(R).")  # fmt: skip
    found = predicted_errors(finger, LOADS, RADII)
    names = ["flat" if math.isinf(rc) else f"rc {1e3 * rc:g} mm" for rc in RADII]
    for title, value in (
        ("place, deg", np.degrees(found.angle)),
        ("load, N/m", found.load),
        ("R, mm", 1e3 * found.radius),
    ):
        page.table(
            (f"{title} at", *names),
            [(f"{p:g} N/m", *(f"{x:.3g}" for x in row)) for p, row in zip(LOADS, value, strict=True)],
        )


def _classes(page: Page, body: Cylinder, radius: float, noise: float, progress: Progress) -> None:
    page.head("Which indenters can be told apart")
    widths = rigid_core_table(body)
    rows = []
    peak = 0.0
    for rc in RADII[1:-1]:
        share = class_difference(body, radius, 200.0, rc, widths)
        table = widths.half_width(200.0 * equivalent_radius(body, rc))
        peak = _peak(body, radius, table)
        seen = share * peak / noise
        verdict = "ok: from one frame" if seen > 2.0 else f"no: {math.ceil((2.0 / seen) ** 2)} frames averaged"
        rows.append((f"{1e3 * rc:g}", f"{100 * share:.2f}", f"{seen:.2f}", verdict))
        progress(f"classes, rc {1e3 * rc:g} mm")
    page.text(
        "Round indenter against the wedge of the same width and load, 200 N/m: root mean square difference of the "
        "strain, and the same in standard deviations of the noise (two are called distinguishable)."
    )
    page.table(("rc, mm", "difference, % of peak", "over noise", "class told"), rows)


def _peak(body: Cylinder, radius: float, half_width: float) -> float:
    highest = highest_needed(body, radius, 1e-3)
    k = np.arange(highest + 1)
    spectrum = ellipse_spectrum(k * half_width) * np.where(k == 0, 0.5, 1.0)
    return float(abs(200.0 / (np.pi * body.outer_m) * respond(body, k, radius).e_rr[:, 0, 0] @ spectrum))


def _pictures(page: Page, body: Cylinder, radius: float, finger: Finger, progress: Progress) -> None:
    page.head("Pictures")
    share = (radius - body.core_m) / (body.outer_m - body.core_m)

    def depth(other: Cylinder) -> float:
        return other.core_m + share * (other.outer_m - other.core_m)

    peak = _peak(body, radius, 1e-6)
    noise = float(np.median(finger.strain_noise)) / peak
    angles = np.array(finger.angles_rad)
    pictures: list[tuple[str, Callable[[], Figure]]] = [
        (
            "Displacements under an edge of 200 N/m pressed at 45 degrees (as figure 2.3)",
            lambda: draw.displacement_field(body),
        ),
        (
            "Frequency response of strain and displacement (as figures 2.4, 2.6)",
            lambda: draw.frequency_response(body, radius),
        ),
        (
            "Strain around an edge; half plane for comparison (as figure 2.5)",
            lambda: draw.impulse_response(body, radius),
        ),
        ("Cut-off over the core's size (as figure 2.7)", lambda: draw.cutoffs(body.poisson, body.outer_m, depth)),
        ("Pressure under flats (as figure 2.12)", lambda: draw.pressures(body)),
        ("Full adhesion against no friction (as figure 2.13)", lambda: draw.adhesion(body, radius)),
        ("Spectra of indenter classes of one width and load (as figure 2.20)", lambda: draw.class_spectra(body)),
        ("Radii at one load (as figures 2.21, 2.22)", lambda: draw.radius_study(body, radius)),
        ("Sliding", lambda: draw.sliding(body, radius)),
        ("Equivalent wedge (as figure 2.24)", lambda: draw.equivalent_wedges(body)),
        (
            "Difference of classes over depth and radius (as figure 2.25)",
            lambda: draw.class_differences(body.outer_m, body.poisson, depth, noise, tick=progress),
        ),
        ("Conditioning (as figure 3.24)", lambda: draw.conditions(body, angles, radius)),
        ("Theoretical deviations (as figures 3.27 to 3.29)", lambda: draw.error_maps(finger)),
    ]
    for caption, make in pictures:
        page.figure(make(), caption)
        progress(caption)
