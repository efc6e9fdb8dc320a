"""Calibrate a finger from a folder of recordings: write its file and a report with pictures."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sioms.report_page import Page
from sioms.tactile.calibrate import NEAR, strain_of
from sioms.tactile.calibration import Calibration, Options
from sioms.tactile.calibration import calibrate as fit
from sioms.tactile.characterize import creep_of, noise_of, proximity_of, relaxation_of, shares_of, thermal_of
from sioms.tactile.closedform import equivalent_radius, indenter_radius
from sioms.tactile.command.pictures import poisson_responses
from sioms.tactile.command.progress import Progress
from sioms.tactile.estimator import Estimator
from sioms.tactile.files import Data, read_folder
from sioms.tactile.finger import Finger, from_toml, to_toml
from sioms.tactile.identify import series_of
from sioms.tactile.linearity import linearise
from sioms.tactile.quality import Load, ShapeEstimate
from sioms.tactile.touches import Recording, Touches, join, ramps_of
from sioms.whole_file import write_whole

Floats = NDArray[np.float64]


def calibrate(args: argparse.Namespace) -> int:
    """Read, calibrate, write, report."""
    progress = Progress()
    data = read_folder(args.data)
    progress(f"read {len(data.recordings)} recordings, {sum(map(len, data.touches.values()))} touches")
    options = Options(math.radians(args.edge_deg), not args.no_map, args.contact)
    ramp = data.recordings.get("ramp")
    ramps = [] if ramp is None else ramps_of(ramp, data.nominal.signal.scale)
    result = fit(data.nominal, join(list(data.touches.values())), options, progress, ramps)
    report = args.report or args.output.with_suffix(".html")
    finger = _warmed(result.finger, data.recordings.get("thermal"))
    if result.doubts:
        if not args.doubtful:
            write_report(data, result, report, progress)
            progress.close()
            raise ValueError(
                f"calibrate {args.data}: not to be believed, no finger was written: {'; '.join(result.doubts)}. See "
                f"{report}; record again, or write it all the same with --doubtful"
            )
        finger = msgspec.structs.replace(finger, notes={**finger.notes, "doubts": "; ".join(result.doubts)})
    write_whole(args.output, to_toml(finger))
    from_toml(args.output.read_text(encoding="utf-8"))  # what was written can be read
    write_report(data, result, report, progress)
    progress.close()
    for warning in (*result.doubts, *result.warnings):
        print(f"warning: {warning}")
    print(f"wrote {args.output} ({result.finger.contact.model}, map: {result.finger.notes['map']}) and {report}")
    return 0


def _warmed(finger: Finger, recording: Recording | None) -> Finger:
    """Return the finger with what temperature does to each of its elements, if that was recorded."""
    thermal = None if recording is None else thermal_of(recording)
    if thermal is None:
        return finger
    return msgspec.structs.replace(
        finger, signal=msgspec.structs.replace(finger.signal, thermal=shares_of(thermal))
    )  # fmt: skip


def write_report(data: Data, result: Calibration, path: Path, progress: Callable[[str], None]) -> None:
    """Write the report: what was found, how well it predicts, and what the finger can tell."""
    page = Page(f"Calibration of finger {result.finger.name}")
    for warning in (*result.doubts, *result.warnings):
        page.warn(warning)
    _summary(page, result)
    _elements(page, result)
    progress("pictures of the fit")
    _pictures(page, result)
    progress("fits to the indenters")
    _indenters(page, data, result)
    progress("other effects")
    _characters(page, data.recordings, result)
    page.write(path)


def _summary(page: Page, result: Calibration) -> None:
    page.head("Result")
    finger = result.finger
    rows = [(name, f"{100 * np.nanmin(r):.2f}", f"{100 * np.nanmean(r):.2f}", f"{100 * np.nanmax(r):.2f}")
            for name, r in result.residuals.items()]  # fmt: skip
    page.text(
        f"Contact model {finger.contact.model}, share of adhesion {finger.contact.adhesion:.2f}; Poisson's ratio "
        f"{finger.geometry.poisson:.3f}; an element averages over +-{math.degrees(finger.geometry.extent_rad):.2f} "
        f"deg; map in use: {finger.notes['map']}. Residuals are root mean squares over touches that were left out of "
        f"the fit, in per cent of the peak strain of a 200 N/m edge ({100 * result.peak:.2f} %); those of the model "
        "within 25 degrees of the element, those of identified maps over all touches."
    )
    page.table(("method", "least", "mean", "most"), rows)
    page.table(
        ("contact model tried", "residual, % of output"),
        [(name, f"{100 * value:.4f}") for name, value in result.contacts.items()],
    )


def _elements(page: Page, result: Calibration) -> None:
    page.head("Elements")
    e, quadratic = result.finger.elements, result.quadratic
    rows = []
    for number in range(len(e.angle_rad)):
        deviation = "" if quadratic is None else _deviation(quadratic.deviation[number])
        rows.append(
            (
                number,
                f"{math.degrees(e.angle_rad[number]):.2f}",
                f"{1e3 * e.radius_m[number]:.2f}",
                f"{e.gain[number]:.3f}",
                f"{e.quadratic[number] / 100:.4f}",
                deviation,
                f"{100 * e.noise[number]:.3f}",
                f"{100 * e.gain[number] * e.noise[number] / result.peak:.2f}",
                *(f"{100 * r[number]:.2f}" for r in result.residuals.values()),
            )
        )
    head = ("element", "angle, deg", "depth radius, mm", "gain, % strain / % output", "quadratic, 1/%", "its deviation",
            "noise, % output", "noise, % of peak")  # fmt: skip
    page.table((*head, *(f"{name}, % of peak" for name in result.residuals)), rows)
    page.figure(
        poisson_responses(result.finger.cylinder, float(np.mean(e.radius_m))),
        "Frequency response at the mean depth "
        "for several Poisson's ratios: what it takes to tell the ratio from the depth (figure 3.18)",
    )


def _deviation(value: float) -> str:
    return f"{value / 100:.4f}" if math.isfinite(value) else "no load series"


def _grid(count: int, height: float = 2.0) -> tuple[Figure, list[Axes]]:
    rows = math.ceil(count / 4)
    figure = Figure(figsize=(12, height * rows), layout="constrained")
    axes = figure.subplots(rows, 4, sharex=True, sharey=True, squeeze=False)
    return figure, list(axes.ravel())


def _pictures(page: Page, result: Calibration) -> None:
    page.head("Edge touches")
    edge = (result.touches.radius_m == 0.0) & (np.abs(result.touches.load / 200.0 - 1.0) < 0.2)
    if not edge.any():
        page.text("No edge touches near 200 N/m in the data: no pictures of impulse responses.")
        return
    chosen = np.flatnonzero(edge)
    chosen = chosen[np.argsort(result.touches.angle_rad[chosen], kind="stable")]
    touches = result.touches.pick(chosen)
    gain = np.array(result.finger.elements.gain)
    figure = Figure(figsize=(11, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot(np.degrees(touches.angle_rad), 100 * touches.output * gain, lw=1)
    axes.set(xlabel="edge at, deg", ylabel="compression, % strain")
    page.figure(figure, "Overlapping impulse responses of all elements, calibrated (in the manner of figure 3.3)")
    _array_response(page, result, touches)
    figure, axes_list = _grid(gain.size)
    predicted = _predictions(result, chosen)
    for element, ax in enumerate(axes_list[: gain.size]):
        near = np.abs(touches.angle_rad - result.finger.elements.angle_rad[element]) < 2 * NEAR
        x = np.degrees(touches.angle_rad[near])
        measured = 100 * touches.output[near, element] * gain[element]
        ax.plot(x, measured, ".", ms=3, color="black")
        for (name, strain), colour in zip(predicted.items(), ("tab:red", "tab:blue"), strict=False):
            ax.plot(x, -100 * strain[near, element], lw=1, color=colour, label=name)
            ax.plot(x, measured + 100 * strain[near, element], lw=0.8, ls=":", color=colour)
        ax.set_title(f"element {element}", fontsize=8)
    axes_list[0].legend(fontsize=7)
    page.figure(
        figure,
        "Touches (dots), predictions (lines) and errors (dotted), % strain over the edge's place in degrees "
        "(figures 3.16, 3.17, 3.22)",
    )
    _flat_and_edge(page, result)


def _array_response(page: Page, result: Calibration, touches: Touches) -> None:
    gain = np.array(result.finger.elements.gain)
    angle = np.degrees(result.finger.elements.angle_rad)
    middle = int(np.abs(np.degrees(touches.angle_rad) - angle.mean()).argmin())
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    axes = figure.subplots()
    axes.plot(angle, 100 * touches.output[middle], "s--", ms=4, label="output, %")
    axes.plot(angle, 100 * touches.output[middle] * gain, "o-", ms=4, label="strain, %")
    axes.set(xlabel="element at, deg", title=f"edge at {np.degrees(touches.angle_rad[middle]):.1f} deg")
    axes.legend()
    page.figure(figure, "Response of the array to one edge, before and after the gains (figure 3.15)")


def _predictions(result: Calibration, which: NDArray[np.bool_] | NDArray[np.intp]) -> dict[str, Floats]:
    """Return model and identified strains of some touches, shape (nt, ns) each."""
    touches = result.touches.pick(which)
    loads = type(result.loads)(result.loads.normal[which], result.loads.shear[which])
    e, body, share = result.finger.elements, result.finger.cylinder, result.finger.contact.adhesion
    columns = [
        strain_of(body, t, r, nu, touches, loads, share, result.finger.geometry.extent_rad)
        for t, r, nu in zip(e.angle_rad, e.radius_m, e.poisson, strict=True)
    ]
    out = {"model": np.stack(columns, axis=1)}
    if result.finger.identified is not None:
        normal, shear = series_of(touches, loads)
        matrix = np.split(result.finger.e_map(), 2, axis=1)[1]
        out["identified map"] = normal @ np.array(result.finger.identified.rows).T + share * shear @ matrix.T
    return out


def _flat_and_edge(page: Page, result: Calibration) -> None:
    usual = np.abs(result.touches.load / 200.0 - 1.0) < 0.2
    flat = usual & np.isinf(result.touches.radius_m)
    if not flat.any():
        return
    angles = np.array(result.finger.elements.angle_rad)
    places = result.touches.angle_rad[flat]
    element = int(np.abs(angles - np.median(places)).argmin())
    figure = Figure(figsize=(10, 3.4), layout="constrained")
    for ax, (name, which) in zip(
        figure.subplots(1, 2, sharey=True),
        (("edge", usual & (result.touches.radius_m == 0.0)), ("flat", flat)),
        strict=True,
    ):
        near = which & (np.abs(result.touches.angle_rad - angles[element]) < 2 * NEAR)
        order = np.argsort(result.touches.angle_rad[near])
        x = np.degrees(result.touches.angle_rad[near])[order]
        gain, load = result.finger.elements.gain[element], result.touches.load[near][order]
        measured = 100 * result.touches.output[near, element][order] * gain * 200 / load
        ax.plot(x, measured, ".", color="black", label="touches")
        for label, strain in _predictions(result, near).items():
            model = -100 * strain[order, element] * 200 / load
            ax.plot(x, model, lw=1, label=label)
            ax.plot(x, measured - model, ":", lw=1)
        ax.set(title=f"{name}, element {element}", xlabel="deg", ylabel="% strain at 200 N/m")
        ax.legend(fontsize=7)
    page.figure(figure, "One element under edge and flat (figures 3.19, 3.20, 3.23)")


def _fit_all(finger: Finger, touches: Touches, with_load: bool) -> list[ShapeEstimate]:
    estimator = Estimator(finger, averaged=max(touches.averaged, 1.0))
    strains = -np.array(finger.elements.gain) * touches.output
    return [
        estimator.frame(y, Load(float(p), 4.0) if with_load else None)
        for y, p in zip(strains, touches.load, strict=True)
    ]


def _indenters(page: Page, data: Data, result: Calibration) -> None:
    """Fit the touches of every indenter and tabulate means and deviations as tables 3.10 to 3.12 do."""
    finger = result.finger
    parts = [t for t in data.touches.values() if np.unique(t.radius_m).size > 1]
    if not parts:
        return
    page.head("Shape from strain on the recorded indenters")
    touches = join(parts)
    touches = touches.with_output(linearise(touches.output, np.array(finger.elements.quadratic)))
    touches = touches.pick(np.abs(touches.load / 200.0 - 1.0) < 0.25)
    if len(touches) == 0:
        return
    if np.isfinite(touches.force).all() and np.all(touches.force > 0.0):
        # what was applied: the cell's variation at the commanded level
        applied = touches.force * float(np.median(touches.load / touches.force))
        touches = replace(touches, load=applied)
    free = _fit_all(finger, touches, False)
    loaded = _fit_all(finger, touches, True) if np.isfinite(touches.force).all() else None
    rows, radii = [], np.unique(touches.radius_m)
    for rc in radii:
        mine = np.flatnonzero(touches.radius_m == rc)
        rows.append(_row(finger, float(rc), touches, mine, free, loaded))
    page.table(
        ("rc, mm", "R, mm", "mean R", "deviation of R", "rc from mean R", "place: mean error, deg", "deviation, deg",
         "load: mean error, N/m", "deviation, N/m", "mean R with load cell", "deviation"), rows)  # fmt: skip
    page.text(
        "The touches took part in the calibration; deviations are over places. The published finger: place 0.043 deg, "
        "load 6.4 N/m, R 0.60 mm by place."
    )
    figure = Figure(figsize=(11, 4), layout="constrained")
    axes = figure.subplots()
    for rc in radii:
        mine = np.flatnonzero(touches.radius_m == rc)
        x = np.degrees(touches.angle_rad[mine])
        order = np.argsort(x)
        line = axes.plot(x[order], [1e3 * free[m].equivalent_radius_m for m in mine[order]], ".-", ms=3, lw=0.7)
        axes.axhline(1e3 * equivalent_radius(finger.cylinder, float(rc)), color=line[0].get_color(), lw=0.5, ls="--")
    axes.set(xlabel="place, deg", ylabel="R, mm")
    page.figure(figure, "Fitted equivalent radius over the place, true values dashed (figures 3.32, 3.33)")


def _row(
    finger: Finger, rc: float, touches: Touches, mine: NDArray[np.intp], free: list[ShapeEstimate],
    loaded: list[ShapeEstimate] | None,
) -> tuple[str, ...]:  # fmt: skip
    radius = np.array([1e3 * free[m].equivalent_radius_m for m in mine])
    place = np.degrees([free[m].angle_rad for m in mine]) - np.degrees(touches.angle_rad[mine])
    load = np.array([free[m].load_n_per_m for m in mine]) - touches.load[mine]
    cells = [
        "flat" if math.isinf(rc) else f"{1e3 * rc:.2f}", f"{1e3 * equivalent_radius(finger.cylinder, rc):.2f}",
        *_spread(radius, ".2f"), "none" if np.isnan(radius).all() else
        f"{1e3 * indenter_radius(finger.cylinder, 1e-3 * float(np.nanmean(radius))):.2f}",
        *_spread(place, "+.3f"), *_spread(load, "+.1f"),
    ]  # fmt: skip
    if loaded is not None:
        other = np.array([1e3 * loaded[m].equivalent_radius_m for m in mine])
        cells += _spread(other, ".2f")
    return tuple(cells)


def _spread(values: Floats, form: str) -> list[str]:
    """Return mean and deviation of the values that there are."""
    if np.isnan(values).all():
        return ["none", "none"]
    return [f"{np.nanmean(values):{form}}", f"{np.nanstd(values):{form.lstrip('+')}}"]


def _characters(page: Page, recordings: dict[str, Recording], result: Calibration) -> None:
    page.head("Other effects")
    rows: list[tuple[str, str]] = []
    if "noise" in recordings:
        noise = noise_of(recordings["noise"])
        lines = ", ".join(f"{a:.3g} at {f:.4g} Hz" for f, a in noise.lines[:5]) or "none"
        rows += [
            ("noise of one frame, raw units", f"{noise.deviation.mean():.4f}"),
            ("converter step", f"{noise.step:.3g}"),
            ("lines in the spectrum", lines),
        ]
        figure = Figure(figsize=(8, 3), layout="constrained")
        axes = figure.subplots()
        axes.semilogy(noise.frequency_hz, noise.density)
        axes.set(xlabel="Hz", ylabel="raw² / Hz")
        page.figure(figure, "Power spectrum of the untouched output, mean over elements (figure 3.6)")
    if "thermal" in recordings:
        _thermal(page, recordings["thermal"], rows)
    held = next((r for name, r in recordings.items() if name not in ("noise", "thermal", "ramp")), None)
    if held is not None:
        for what, late in (
            ("creep within the touches", creep_of(held)),
            ("left after release", relaxation_of(held)),
        ):
            if late is not None:
                time = "" if math.isnan(late.time_s) else f", time constant {late.time_s:.2f} s"
                rows.append((what, f"{100 * late.share:+.1f} +- {100 * late.deviation:.1f} %{time}"))
        rows.append(("far elements under a touch (proximity), raw units", _spread(proximity_of(held), "+.4f")[0]))
    ramp = recordings.get("ramp")
    if ramp is not None:
        _ramp(page, ramp, result)
    page.table(("effect", "value"), rows)


def _thermal(page: Page, recording: Recording, rows: list[tuple[str, str]]) -> None:
    thermal = thermal_of(recording)
    if thermal is None:
        rows.append(("temperature", "the recording spans less than half a degree"))
        return
    mean = float(thermal.slope.mean())
    rows.append(("temperature slope, raw units per K", f"{mean:+.3f} +- {thermal.deviation.mean():.3f}"))
    figure = Figure(figsize=(6, 3), layout="constrained")
    axes = figure.subplots()
    axes.plot(recording.temperature_c, recording.raw.mean(1), ".")
    axes.set(xlabel="°C", ylabel="raw, mean of elements")
    page.figure(figure, "Untouched output against temperature (figure 3.11)")


def _ramp(page: Page, ramp: Recording, result: Calibration) -> None:
    """Show linear and quadratic fits to the load ramps (figure 3.12, table 3.2)."""
    scale = 100 * result.finger.signal.scale
    figure, axes = _grid(min(len(result.finger.angles_rad), 16), 1.8)
    for number, ax in enumerate(axes):
        mine = ramp.touch == number
        rise = mine & (ramp.phase == 1)
        if rise.sum() < 10:
            continue
        before = mine & (ramp.phase == 0)
        d = ramp.raw[rise, number] - (ramp.raw[before, number].mean() if before.any() else 0.0)
        force = ramp.force[rise]
        order = np.argsort(force)
        for degree, style in ((1, "-"), (2, "--")):
            base = np.stack([force**n for n in range(1, degree + 1)], axis=1)
            answer = np.linalg.lstsq(base, d, rcond=None)[0]
            ax.plot(force[order], scale * (base @ answer)[order], style, lw=1)
        ax.plot(force, scale * d, "+", ms=3, color="black")
        ax.set_title(f"element {number}", fontsize=8)
    page.figure(
        figure,
        "Output, %, against load, N/m: linear (solid) and quadratic fit (dashed) (figure 3.12). The curvature "
        "mixes the electronics' quadratic with the growth of the contact and creep; the table above does not",
    )
