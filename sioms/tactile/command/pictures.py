"""Draw the mechanics of a finger: the pictures that design and reproduction share."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sioms.tactile import closedform, contact, emap, halfplane
from sioms.tactile.contact import Contact
from sioms.tactile.cylinder import Cylinder, respond
from sioms.tactile.design import (
    class_difference,
    conditioning,
    cutoff,
    exact_equivalent_wedge,
    predicted_errors,
)
from sioms.tactile.finger import Finger
from sioms.tactile.indenter import FLAT, Round
from sioms.tactile.width import rigid_core_table

Floats = NDArray[np.float64]
Tick = Callable[[str], None]


def _axes(width: float = 8.0, height: float = 3.4) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots()


def _pair(width: float = 11.0, height: float = 3.6) -> tuple[Figure, Axes, Axes]:
    figure = Figure(figsize=(width, height), layout="constrained")
    left, right = figure.subplots(1, 2)
    return figure, left, right


def displacement_field(body: Cylinder, load: float = 200.0) -> Figure:
    """Draw the displacements under an edge pressed at 45 degrees (figure 2.3)."""
    figure, axes = _axes(7.0, 7.0)
    component = load / np.sqrt(2.0)
    highest = 80
    smooth = np.sinc(np.arange(highest + 1) / (highest + 1))  # a line load's own point has no finite displacement
    k = np.arange(highest + 1)
    even, odd = (total / (np.pi * body.outer_m) * smooth for total in (-component, component))
    theta = np.linspace(-0.25, 0.25, 41)
    for r in np.linspace(body.core_m, body.outer_m, 8):
        h = respond(body, k, r)
        weight = np.where(k == 0, 0.5, 1.0)
        cosine, sine = np.cos(k * theta[:, None]), np.sin(k * theta[:, None])
        p, q = even * weight, odd * weight
        u = cosine @ (h.u_r[:, 0, 0] * p) + sine @ (h.u_r[:, 0, 1] * q)
        v = -sine @ (h.u_t[:, 0, 0] * p) + cosine @ (h.u_t[:, 0, 1] * q)
        x, y = r * np.cos(theta), r * np.sin(theta)
        dx, dy = u * np.cos(theta) - v * np.sin(theta), u * np.sin(theta) + v * np.cos(theta)
        axes.plot(1e3 * np.stack([x, x + dx]), 1e3 * np.stack([y, y + dy]), "-", color="0.6", lw=0.6)
        axes.plot(1e3 * (x + dx), 1e3 * (y + dy), lw=1, color="tab:blue")
    axes.set(xlabel="mm", ylabel="mm", aspect="equal")
    return figure


def frequency_response(body: Cylinder, radius_m: float) -> Figure:
    """Draw strain coefficients over k and strain and displacement as a Bode plot (figures 2.4, 2.6)."""
    figure, left, right = _pair()
    k = np.arange(0, 200)
    inside, surface = respond(body, k, radius_m), respond(body, k, body.outer_m)
    names = (
        ("e_rr", 0, "e_rr from p"),
        ("e_rr", 1, "e_rr from q"),
        ("e_rt", 0, "e_rt from p"),
        ("e_rt", 1, "e_rt from q"),
    )
    for field, which, label in names:
        value = getattr(inside, field)[:, 0, which]
        left.plot(k[:41], value[:41], ".-", label=label)
        right.loglog(k[1:] / (2 * np.pi), np.maximum(np.abs(value[1:]) / np.abs(value).max(), 1e-12), label=label)
    shift = np.abs(surface.u_r[1:, 0, 0])
    right.loglog(k[1:] / (2 * np.pi), shift / shift.max(), "k--", label="surface displacement from p")
    left.set(xlabel="k", ylabel="1/Pa")
    right.set(xlabel="cycles/rad", ylabel="relative to maximum", ylim=(1e-5, 2))
    left.legend(fontsize=7)
    right.legend(fontsize=7)
    return figure


def impulse_response(body: Cylinder, radius_m: float, load: float = 200.0) -> Figure:
    """Draw the strains around an edge: cylinder and half plane (figure 2.5)."""
    figure, left, right = _pair()
    theta, highest = np.linspace(-1.2, 1.2, 601), 200
    k = np.arange(highest + 1)
    h = respond(body, k, radius_m)
    weight = np.where(k == 0, 0.5, 1.0) / (np.pi * body.outer_m)
    cosine, sine = np.cos(k * theta[:, None]), np.sin(k * theta[:, None])
    normal = -100 * load * cosine @ (weight * h.e_rr[:, 0, 0])
    left.plot(theta, normal, label="normal load")
    left.plot(theta, 100 * load * sine @ (weight * h.e_rr[:, 0, 1]), label="tangential load")
    plane = 100 * halfplane.normal_strain(
        body.outer_m * theta, body.outer_m - radius_m, load, body.poisson, body.shear_pa
    )
    left.plot(theta, plane, "--", label="half plane, normal load")
    right.plot(theta, -100 * load * -sine @ (weight * h.e_rt[:, 0, 0]), label="normal load")
    right.plot(theta, 100 * load * cosine @ (weight * h.e_rt[:, 0, 1]), label="tangential load")
    left.set(xlabel="rad", ylabel="e_rr, %", title=f"{load:g} N/m")
    right.set(xlabel="rad", ylabel="e_rt, %")
    left.legend(fontsize=7)
    right.legend(fontsize=7)
    return figure


def cutoffs(poisson: float, outer_m: float, depth: Callable[[Cylinder], float]) -> Figure:
    """Draw the -20 dB frequency over ra/rb with the published fit (figure 2.7)."""
    figure, axes = _axes()
    alpha = np.linspace(0.5, 0.94, 23)
    found = []
    for ratio in alpha:
        body = Cylinder(ratio * outer_m, outer_m, poisson)
        found.append(cutoff(body, depth(body)))
    axes.plot(alpha, found, ".-", label="computed")
    axes.plot(alpha, 0.90 / ((1 - alpha) - 0.0274), "--", label="0.90/((1 - alpha) - 0.0274)")
    axes.set(xlabel="alpha = ra/rb", ylabel="cycles/rad", ylim=(0, 25))
    axes.legend()
    return figure


def pressures(body: Cylinder) -> Figure:
    """Draw the pressure under flats of 2 and 4 mm contact, over Hertz's peak (figure 2.12)."""
    figure, axes = _axes()
    for width, colour in ((2e-3, "tab:blue"), (4e-3, "tab:red")):
        half = 0.5 * width / body.outer_m
        solved = contact.frictionless(body, FLAT, half)
        hertz = float(closedform.hertz_product(body, half)) / body.outer_m
        t = np.linspace(-1.3, 1.3, 521) * half
        peak = 2.0 * hertz / (np.pi * body.outer_m * half)
        axes.plot(
            1e3 * body.outer_m * t,
            solved.pressure(t) / peak,
            color=colour,
            label=f"{1e3 * width:g} mm, rigid core",
        )
        shape = np.sqrt(np.maximum(1 - (t / half) ** 2, 0.0))
        axes.plot(1e3 * body.outer_m * t, shape, "--", color=colour, label="Hertz")
    axes.set(xlabel="mm", ylabel="pressure over Hertz's peak")
    axes.legend(fontsize=8)
    return figure


def adhesion(body: Cylinder, radius_m: float) -> Figure:
    """Draw tractions and strains of a flat on 4 mm with and without adhesion (figure 2.13)."""
    figure, left, right = _pair()
    half = 2e-3 / body.outer_m
    free, stuck = contact.frictionless(body, FLAT, half), contact.adhere(body, FLAT, half)
    t = np.linspace(-0.995, 0.995, 401) * half
    left.plot(t, 1e-3 * free.pressure(t), label=f"p, frictionless, {free.load:.1f} N/m")
    left.plot(t, 1e-3 * stuck.pressure(t), label=f"p, adhesion, {stuck.load:.1f} N/m")
    left.plot(t, 1e-3 * stuck.shear(t), label="q, adhesion")
    theta = np.linspace(-0.6, 0.6, 301)
    matrix = emap.e_map(body, theta, radius_m, 100)
    for name, solved in (("frictionless", free), ("adhesion", stuck)):
        strain = matrix @ solved.series(0.0, 100)
        right.plot(theta, strain / np.abs(strain).max(), label=name)
    top = 1.25e-3 * float(np.max(free.pressure(t)))  # q is singular at the edges
    left.set(xlabel="rad", ylabel="kPa", ylim=(-top, top))
    right.set(xlabel="rad", ylabel="e_rr over its peak")
    left.legend(fontsize=7)
    right.legend(fontsize=7)
    return figure


def class_spectra(body: Cylinder, load: float = 200.0, indenter_m: float = 10e-3) -> Figure:
    """Draw the pressure spectra of cylinder, wedge and punch of one width and load (figure 2.20)."""
    figure, axes = _axes()
    _, ball, wedge = exact_equivalent_wedge(body, load, indenter_m)
    k = np.arange(0, 200)
    for name, solved, style in (("round", ball, "-"), ("wedge", wedge, "--")):
        p = np.abs(solved.series(0.0, 199)[: 2 * 199 + 1 : 2])
        axes.semilogx(k[1:] / (2 * np.pi), 20 * np.log10(p[1:] / (2 * p[0])), style, label=name)
    punch = np.abs(closedform.punch_spectrum(k * ball.half_width))
    axes.semilogx(k[1:] / (2 * np.pi), 20 * np.log10(punch[1:]), ":", label="flat-ended punch")
    axes.set(xlabel="cycles/rad", ylabel="20 log10 |p(k)|", ylim=(-50, 3))
    axes.legend()
    return figure


def equivalent_wedges(body: Cylinder, load: float = 200.0) -> Figure:
    """Draw the equivalent wedge angle over the radius, exact and in closed form (figure 2.24)."""
    figure, axes = _axes()
    radii, widths = 1e-3 * np.geomspace(0.2, 40, 18), rigid_core_table(body)
    exact = [np.degrees(exact_equivalent_wedge(body, load, float(rc), widths)[0]) for rc in radii]
    closed = [
        np.degrees(closedform.equivalent_wedge(body, load, closedform.equivalent_radius(body, float(rc))))
        for rc in radii
    ]
    axes.plot(1e3 * radii, exact, ".-", label="rigid core, finger's curvature")
    axes.plot(1e3 * radii, closed, "--", label="closed form (2.58)")
    axes.set(xlabel="rc, mm", ylabel="half angle, deg")
    axes.legend()
    return figure


def class_differences(
    outer_m: float, poisson: float, depth: Callable[[Cylinder], float], noise: float, load: float = 200.0,
    tick: Tick = lambda what: None,
) -> Figure:  # fmt: skip
    """Draw the difference of round and wedge over depth and radius beside the noise (figure 2.25)."""
    figure, axes = _axes()
    radii = outer_m * np.array([0.04, 0.1, 0.25, 0.5, 1.0, 2.0])
    for ratio in (0.7, 0.8, 0.85, 0.9):
        body = Cylinder(ratio * outer_m, outer_m, poisson)
        widths = rigid_core_table(body)
        value = [100 * class_difference(body, depth(body), load, float(rc), widths) for rc in radii]
        axes.semilogx(radii / outer_m, value, ".-", label=f"alpha = {ratio:g}")
        tick(f"indenter classes, alpha {ratio:g}")
    axes.axhline(200 * noise, color="black", ls=":", label="two deviations of the noise")
    axes.set(xlabel="rc/rb", ylabel="difference, % of peak")
    axes.legend(fontsize=8)
    return figure


def poisson_responses(body: Cylinder, radius_m: float) -> Figure:
    """Draw the frequency response of the strain for several Poisson's ratios, the body's own among them (figure
    3.18).
    """
    figure, axes = _axes()
    k = np.arange(41)
    for nu in sorted({0.40, 0.45, 0.48, 0.5, body.poisson}):
        other = Cylinder(body.core_m, body.outer_m, nu, body.shear_pa)
        axes.plot(k, 1e6 * respond(other, k, radius_m).e_rr[:, 0, 0], ".-", label=f"nu = {nu:.3g}")
    axes.set(xlabel="k", ylabel="e_rr from p, 1/MPa")
    axes.legend(fontsize=8)
    return figure


def conditions(body: Cylinder, angles: Floats, radius_m: float) -> Figure:
    """Draw the condition number of E over Poisson's ratio (figure 3.24)."""
    figure, axes = _axes()
    nu = np.array([0.30, 0.34, 0.38, 0.42, 0.44, 0.46, 0.47, 0.48, 0.485, 0.49, 0.495, 0.499, 0.5])
    axes.plot(nu, conditioning(body, angles, radius_m, nu), ".-")
    axes.set(xlabel="Poisson's ratio", ylabel="condition number of E")
    return figure


def error_maps(finger: Finger) -> Figure:
    """Draw the deviations of place, load and R over load for several radii (figures 3.27 to 3.29)."""
    figure = Figure(figsize=(13, 3.6), layout="constrained")
    axes = figure.subplots(1, 3)
    loads, radii = np.array([25.0, 50.0, 100.0, 150.0, 200.0, 300.0]), np.array([1.6, 6.0, 12.3, 25.0, 40.0])
    found = predicted_errors(finger, loads, 1e-3 * radii)
    parts = (
        (np.degrees(found.angle), "place, deg"),
        (found.load, "load, N/m"),
        (1e3 * found.radius, "R, mm"),
    )
    for ax, (value, label) in zip(axes, parts, strict=True):
        for column, rc in enumerate(radii):
            ax.plot(loads, value[:, column], ".-", label=f"rc {rc:g} mm")
        ax.set(xlabel="load, N/m", ylabel=f"standard deviation of {label}", yscale="log")
    axes[0].legend(fontsize=7)
    return figure


def radius_study(body: Cylinder, radius_m: float, load: float = 200.0) -> Figure:
    """Draw pressures and strains under five radii at one load (figures 2.21, 2.22)."""
    figure, left, right = _pair()
    theta = np.linspace(-0.6, 0.6, 301)
    matrix = emap.e_map(body, theta, radius_m, 100)
    for rc in (0.5e-3, 1.6e-3, 3.9e-3, 12.3e-3, 25.3e-3):
        solved: Contact = contact.width_for_load(body, Round(rc), load)
        left.plot(theta, 1e-3 * solved.pressure(theta), label=f"rc {1e3 * rc:g} mm")
        right.plot(theta, 100 * matrix @ solved.series(0.0, 100))
    left.set(xlabel="rad", ylabel="pressure, kPa")
    right.set(xlabel="rad", ylabel="e_rr, %")
    left.legend(fontsize=7)
    return figure


def sliding(body: Cylinder, radius_m: float, load: float = 200.0, friction: float = 0.5) -> Figure:
    """Draw the strains of a round indenter at rest and sliding both ways."""
    figure, axes = _axes()
    theta = np.linspace(-0.8, 0.8, 401)
    matrix = emap.e_map(body, theta, radius_m, 100)
    for value in (0.0, friction, -friction):
        solved = contact.width_for_load(body, Round(6e-3), load, value)
        axes.plot(theta, 100 * matrix @ solved.series(0.0, 100), label=f"friction {value:+g}")
    axes.set(xlabel="rad", ylabel="e_rr, %")
    axes.legend()
    return figure


def singular_values(body: Cylinder, angles: Floats, radius_m: float) -> Figure:
    """Draw the singular values of E's pressure columns."""
    figure, axes = _axes(6, 3)
    matrix = emap.e_map(body, angles, radius_m, 40)[:, :81]
    axes.semilogy(np.linalg.svd(matrix, compute_uv=False), ".-")
    axes.set(xlabel="number", ylabel="singular value, 1/Pa")
    return figure
