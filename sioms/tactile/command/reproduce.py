"""Write the report of the published figures and tables, recomputed, each beside its published value."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from matplotlib.figure import Figure

from sioms.report_page import Page
from sioms.tactile.command import pictures as draw
from sioms.tactile.command.claims import (
    ANGLES,
    PUBLISHED_RC,
    RS_A,
    RS_B,
    Claim,
    chapter_2,
    chapter_3,
    radii_fitted,
)
from sioms.tactile.command.progress import Progress
from sioms.tactile.cylinder import FINGER_A, FINGER_B, Cylinder
from sioms.tactile.finger import nominal_finger


def reproduce(args: argparse.Namespace) -> int:
    """Recompute, print the verdicts, write the report."""
    progress = Progress()
    claims: list[Claim] = []
    for claim in chapter_2():
        claims.append(claim)
        progress(claim.where)
    for claim in chapter_3(50 if args.quick else 500, progress):
        claims.append(claim)
        progress(claim.where)
    page = Page("Elastic tactile fingers: published results, recomputed")
    page.text(
        "Finger A: core 8.9, outer 12.7, elements at 9.4 mm, nu 0.5. Finger B: core 9.6, elements at 10.3 mm, nu 0.46, "
        "16 elements at 9.22 degrees. Each verdict is computed from the numbers beside it."
    )
    page.table(
        ("where", "published", "computed", "verdict"),
        [(c.where, c.statement, c.computed, "ok: reproduces" if c.holds else "no: does not") for c in claims],
    )
    _table_3_10(page)
    progress("table 3.10")
    _pictures(page, progress)
    page.write(args.output)
    progress.close()
    for claim in claims:
        print(f"{'reproduces' if claim.holds else 'DOES NOT  '}  {claim.where:10s} {claim.statement}: {claim.computed}")
    print(f"wrote {args.output}")
    return 0


def _table_3_10(page: Page) -> None:
    page.head("Table 3.10: mean estimates of rc at 200 N/m, mm")
    finger = nominal_finger(FINGER_B, ANGLES, RS_B, 1.0, 1e-3)
    free, half = radii_fitted(finger, 0.0), radii_fitted(finger, 0.5)
    page.table(
        (
            "rc",
            "Hertz, published",
            "Hertz, frictionless touches",
            "Hertz, half adhesion",
            "approx. frictionless, published",
            "on frictionless touches",
            "on half adhesion",
        ),
        [
            (rc, h, f"{free[rc][0]:.2f}", f"{half[rc][0]:.2f}", a, f"{free[rc][1]:.2f}", f"{half[rc][1]:.2f}")
            for rc, (h, a) in PUBLISHED_RC.items()
        ],
    )


def _shallow(body: Cylinder) -> float:
    return body.core_m + 0.5e-3


def _pictures(page: Page, progress: Progress) -> None:
    page.head("Figures")
    finger = nominal_finger(FINGER_B, ANGLES, RS_B, 1.0, 1e-3)
    pictures: list[tuple[str, Callable[[], Figure]]] = [
        ("2.3: displacements under an edge at 45 degrees", lambda: draw.displacement_field(FINGER_A)),
        ("2.4, 2.6: frequency response", lambda: draw.frequency_response(FINGER_A, RS_A)),
        ("2.5: strains around an edge", lambda: draw.impulse_response(FINGER_A, RS_A)),
        ("2.7: cut-off over alpha", lambda: draw.cutoffs(0.5, 12.7e-3, _shallow)),
        ("2.12: pressures under flats", lambda: draw.pressures(FINGER_A)),
        ("2.13: adhesion", lambda: draw.adhesion(FINGER_A, RS_A)),
        ("2.20: spectra of indenter classes", lambda: draw.class_spectra(FINGER_A)),
        ("2.21: radii at one load", lambda: draw.radius_study(FINGER_A, RS_A)),
        ("2.24: equivalent wedge", lambda: draw.equivalent_wedges(FINGER_A)),
        (
            "2.25: telling classes",
            lambda: draw.class_differences(12.7e-3, 0.5, _shallow, 0.005, tick=progress),
        ),
        ("3.18: frequency response over Poisson's ratio", lambda: draw.poisson_responses(FINGER_B, RS_B)),
        ("3.24: conditioning of E", lambda: draw.conditions(FINGER_B, ANGLES, RS_B)),
        ("3.25: singular values of E", lambda: draw.singular_values(FINGER_B, ANGLES, RS_B)),
        ("3.27 to 3.29: standard deviations at 0.1 % noise", lambda: draw.error_maps(finger)),
    ]
    for caption, make in pictures:
        page.figure(make(), f"Figure {caption}")
        progress(f"figure {caption}")
