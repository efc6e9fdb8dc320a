"""Calibrate a finger from recorded touches: the whole procedure, from outputs to a finger's file.

In order: quadratic, contact model, uniform fit (one depth and Poisson's ratio), fit per element, direct
identification; each step kept only if the touches left out of it are predicted better.  What the data cannot
support stays at its nominal value and is said so in `warnings`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from sioms.tactile import held_out
from sioms.tactile.calibrate import (
    DEEP,
    FEWEST,
    LARGEST,
    NEAR,
    REFERENCE_LOAD,
    SHALLOW,
    SMALLEST,
    TURN,
    Freedom,
    fit_elements,
    strain_of,
)
from sioms.tactile.contact import width_for_load
from sioms.tactile.cylinder import Cylinder, respond
from sioms.tactile.emap import MOST_EXTENT, e_map, felt, highest_needed
from sioms.tactile.finger import ContactKind, ContactModel, Elements, Finger, Geometry, IdentifiedMap
from sioms.tactile.identify import Identified, corrected, series_of, truncated
from sioms.tactile.indenter import Wedge
from sioms.tactile.linearity import Quadratic
from sioms.tactile.preparation import Faults, Fits, begin_at, clean_outputs
from sioms.tactile.proximity import LONGEST, SHORTEST
from sioms.tactile.together import Common, fit_together
from sioms.tactile.touches import Ramp, Touches, TouchLoads, touch_loads
from sioms.tactile.width import WidthTable, hertz_table, rigid_core_table

Floats = NDArray[np.float64]

FEWEST_TOUCHES = 30
SHARES = (
    0.0,
    0.4,
    0.8,
    1.2,
)  # of full adhesion, tried in turn; what is full has no sharp meaning, see `adhere`
_BETTER = 0.97  # a richer model must bring the left-out residual below this share of the simpler one's
_POISSON_DEVIATION = 0.03
_STANDS_OUT = 5.0  # standard deviations of the square of the elements' extent
_ROUNDS = 3
_PEAK_WAVES = 60
_POISSON_MATTERS = 4e-3
_QUADRATIC_MATTERS = 0.15  # 1/output
MOST_MISFIT = 2.0  # per cent of the peak that a good finger leaves unexplained
_CLOSE = 0.005  # of a range, to its end
_MOST_QUADRATIC = 15.0  # 1/output
_FAR_CELL = 2.0
_MOST_BENT = 0.9  # 4 q A, at 1 of which a pull A is the lowest output of a quadratic q
_FAR_GAIN = 5.0  # from nominal, either way: rather a wrong unit than scatter


@dataclass(frozen=True, slots=True)
class Options:
    """Say what calibration may do.

    Args:
        edge_half_angle_rad: of the indenters with radius zero.
        identify: allow an identified map.
        contact: fix the contact model; None lets the data choose.
    """

    edge_half_angle_rad: float = np.pi / 4
    identify: bool = True
    contact: ContactKind | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Hold the finger and everything a report wants to show; strains and residuals as fractions.

    Args:
        finger: the result.
        touches: with linear outputs.
        loads: their tractions.
        quadratic: or None if the loads did not support it.
        uniform: elements with common depth and Poisson's ratio.
        elements: elements with their own depth.
        peak: model strain of a 200 N/m edge, the unit of residuals.
        contacts: left-out residual (of peak) of each contact model tried, by name.
        truncated: E by the source's way.
        corrected: E by the smallest change of the model.
        residuals: root mean square over left-out touches per element, of peak, by method.
        warnings: what the data could not support.
        doubts: why the finger is not to be believed; none of a good one.
    """

    finger: Finger
    touches: Touches
    loads: TouchLoads
    quadratic: Quadratic | None
    uniform: Fits
    elements: Fits
    peak: float
    contacts: dict[str, float]
    truncated: Identified | None
    corrected: Identified | None
    residuals: dict[str, Floats]
    warnings: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)


def calibrate(
    nominal: Finger,
    touches: Touches,
    options: Options = Options(),
    tick: Callable[[str], None] = lambda what: None,
    ramps: list[Ramp] | None = None,
) -> Calibration:
    """Calibrate a finger.

    Args:
        nominal: the finger as built; angles within 8 degrees, depth and gain roughly.
        touches: averaged touches with raw outputs.
        options: what is allowed.
        tick: called with a few words at every step of progress.
        ramps: load ramps over elements, for the differences of their quadratics.

    Raises:
        ValueError: too few touches, wrong number of elements, or outputs of the wrong sign.
    """
    warnings: list[str] = []
    recorded = touches
    _check(nominal, touches, warnings)
    body = nominal.cylinder
    widths = rigid_core_table(body)
    tick("loads of the touches")
    touches, loads, faults = clean_outputs(
        nominal, touches, widths, ramps or [], options.edge_half_angle_rad, warnings, tick
    )
    begin = begin_at(nominal, touches)
    for element, fit in enumerate(begin):
        if fit is None:
            warnings.append(
                f"element {element}: too few touches within 25 degrees, or no answer to them; left out of the finger"
            )
    if sum(fit is not None for fit in begin) < 4:
        raise ValueError("calibrate finger: fewer than 4 elements have touches near them; probe more of the finger")
    begin = _with_extent(body, begin, touches, loads)
    tick("width of the elements")
    for _ in range(_ROUNDS):
        kind, adhesion, contacts, tractions, table = _contact(
            body, begin, touches, loads, widths, options, faults, tick
        )
        own, nu, sought = _together(body, begin, touches, tractions, adhesion, warnings)
        tick("element fit")
        straight, again = faults.straightened(body, own, tractions, adhesion)
        if abs(nu - body.poisson) < _POISSON_MATTERS and not _bent(again.quadratic, faults.quadratic):
            break
        # the contact's width goes with Poisson's ratio, and with both how the outputs grow with the load
        touches, faults = straight, again
        body = Cylinder(body.core_m, body.outer_m, nu, body.shear_pa)
        widths, begin = rigid_core_table(body), own
        loads = touch_loads(body, widths, touches, loads.highest, options.edge_half_angle_rad, faults.wider(touches))
        tick("loads of the touches")
    loads, widths = tractions, table
    body = Cylinder(body.core_m, body.outer_m, nu, body.shear_pa)
    uniform, _ = fit_together(body, own, touches, loads, adhesion, Common(True, False, False))
    _check_gains(nominal, own, warnings)
    peak = edge_peak(body, own, options.edge_half_angle_rad)
    residuals = {
        "uniform": _left_out(body, uniform, touches, loads, adhesion, Freedom(False, False), peak),
        "elements": _left_out(body, own, touches, loads, adhesion, Freedom(True, False), peak),
    }
    tick("left-out residuals")
    best = own if np.nanmean(residuals["elements"]) < _BETTER * np.nanmean(residuals["uniform"]) else uniform
    cut, direct = _identify(body, best, touches, loads, adhesion, options, warnings)
    tick("identification")
    known = np.array([fit is not None for fit in best])
    for name, found in (("truncated", cut), ("corrected", direct)):
        if found is not None:
            residuals[name] = np.full(known.size, np.nan)
            residuals[name][known] = found.left_out / peak
    finger = _finger(nominal, body, best, kind, adhesion, widths, faults, touches, residuals, direct, peak)
    doubts = _doubts(nominal, finger, best, sought, faults, touches.force / touches.load)
    halves = [
        _half(finger, body, best, touches, loads, adhesion, np.arange(len(touches)) % 2 == parity) for parity in (0, 1)
    ]
    tick("estimates of left-out touches")
    worth = held_out.joined(
        [held_out.estimates(half, recorded.pick(~train), faults.recorded.load[~train]) for half, train in halves]
    )
    finger = msgspec.structs.replace(finger, systematic=held_out.systematic(worth))
    doubts += held_out.doubts(worth, finger.systematic)
    return Calibration(
        finger,
        touches,
        loads,
        faults.quadratic,
        uniform,
        own,
        peak,
        contacts,
        cut,
        direct,
        residuals,
        warnings,
        doubts,
    )


def _doubts(nominal: Finger, finger: Finger, fits: Fits, poisson: float, faults: Faults, cell: Floats) -> list[str]:
    """Return why the finger is not to be believed: parameters at the end of what they may be, residuals,
    contradictions.
    """
    doubts, body = [], finger.cylinder
    known = [(element, fit) for element, fit in enumerate(fits) if fit is not None]
    off = 100.0 * float(np.mean([finger.elements.misfit[element] for element, _ in known]))
    if off > MOST_MISFIT:
        doubts.append(
            f"the touches leave {off:.1f} % of the peak strain unexplained beside their noise; a sound finger leaves "
            "less than "
            f"{MOST_MISFIT:g} %: something acts that no model here knows, or the recordings contradict each other"
        )
    thick = body.outer_m - body.core_m
    low, high = body.core_m + SHALLOW * thick, body.core_m + DEEP * thick
    for element, fit in known:
        if not low + _CLOSE * thick < fit.radius_m < high - _CLOSE * thick:
            doubts.append(
                f"element {element}: its effective radius runs to the end of what it can be, {1e3 * fit.radius_m:.2f} "
                f"mm between a core of {1e3 * body.core_m:.2f} and a surface of {1e3 * body.outer_m:.2f} mm"
            )
        turned = abs(fit.angle_rad - nominal.elements.angle_rad[element])
        if turned > (1.0 - _CLOSE) * TURN:
            doubts.append(
                f"element {element}: its place runs to the end of what was searched, {np.degrees(turned):.1f} degrees "
                "from the nominal one"
            )
    if min(finger.geometry.extent_rad, MOST_EXTENT) > (1.0 - _CLOSE) * MOST_EXTENT:
        doubts.append(
            f"the arc of an element runs to the widest that was searched, {np.degrees(MOST_EXTENT):.1f} degrees"
        )
    if poisson < SMALLEST + _CLOSE * (LARGEST - SMALLEST):
        doubts.append(f"Poisson's ratio runs to the least that was searched, {SMALLEST:g}")
    gains = [fit.gain / nominal.elements.gain[element] for element, fit in known]
    ratio = float(np.median(gains))
    if not 1.0 / _FAR_GAIN < ratio < _FAR_GAIN:
        doubts.append(f"the gains come out {ratio:.3g} times the nominal ones: a wrong unit, or a wrong nominal finger")
    quadratic, pull = faults.quadratic, faults.proximity
    if quadratic is not None and float(np.max(np.abs(quadratic.value))) > _MOST_QUADRATIC:
        doubts.append(
            f"the quadratic comes out as {float(np.max(np.abs(quadratic.value))) / 100.0:.2f} per per cent: at "
            f"{_MOST_QUADRATIC / 100.0:.2f} and more an output of a few per cent is at the end of its range"
        )
    if pull is not None and quadratic is not None:
        bent = 4.0 * float(np.max(quadratic.value)) * abs(pull.amplitude)
        if bent > _MOST_BENT:
            doubts.append(
                f"the pull of the conductor, {100.0 * pull.amplitude:.1f} % of output, lies "
                f"{'beyond' if bent > 1.0 else 'near'} the lowest "
                "output that a quadratic of this size can give: what is below cannot be undone; shield the elements"
            )
    if pull is not None and not SHORTEST < pull.range_rad < LONGEST:
        doubts.append(
            f"the pull of the conductor reaches {np.degrees(pull.range_rad):.0f} degrees, the end of what was searched"
        )
    if np.isfinite(cell).all() and not 1.0 / _FAR_CELL < float(np.median(cell)) < _FAR_CELL:
        doubts.append(
            f"the load cell reads {float(np.median(cell)):.2f} times the commanded load: strains and loads contradict "
            "each other in scale"
        )
    return doubts


def _check(nominal: Finger, touches: Touches, warnings: list[str]) -> None:
    count = len(nominal.angles_rad)
    if touches.output.shape[1] != count:
        raise ValueError(f"calibrate finger: touches have {touches.output.shape[1]} elements; the finger has {count}")
    if len(touches) < FEWEST_TOUCHES:
        raise ValueError(f"calibrate finger: {len(touches)} touches; need at least {FEWEST_TOUCHES} over all elements")
    if not np.all(touches.load > 0.0):
        raise ValueError(f"calibrate finger: a touch has load {touches.load.min()} N/m; pressing loads are positive")
    # about each touch's own mean: a conductor lowers all outputs, but the pressed ones stand out
    own = touches.output - touches.output.mean(axis=1, keepdims=True)
    nearest = np.abs(np.array(nominal.angles_rad) - touches.angle_rad[:, None]).argmin(axis=1)
    angles = np.array(nominal.angles_rad)
    arc, inside = (
        float(np.ptp(angles)),
        (touches.angle_rad - angles.min()) * (touches.angle_rad - angles.max()) < 0.0,
    )
    away = np.abs(angles[np.abs(own).argmax(axis=1)] - touches.angle_rad)[inside]
    span = float(np.ptp(touches.angle_rad))
    if span < 0.1 * arc:
        raise ValueError(
            f"calibrate finger: touches lie within {np.degrees(span):.3g} of {np.degrees(arc):.0f} degrees; places "
            "must be in degrees and spread over the elements"
        )
    if away.size and np.median(away) > max(arc / 6.0, 1.5 * arc / (count - 1)):
        raise ValueError(
            f"calibrate finger: the element that answers most lies {np.degrees(np.median(away)):.0f} degrees from the "
            "touch, as a rule; places must be in degrees, in direction and order of the elements' angles"
        )
    if np.median(own[np.arange(len(touches)), nearest]) < 0.0:
        raise ValueError("calibrate finger: pressing lowers the output; compression must be positive: change its sign")
    ratio = float(np.median(touches.force / touches.load)) if np.isfinite(touches.force).all() else 1.0
    if ratio < 0.0:
        warnings.append(
            "the load cell reads less under load than before: its sign is wrong; the commanded load was used"
        )
    elif abs(ratio - 1.0) > 0.02:
        warnings.append(
            f"the load cell reads {100 * (ratio - 1):+.1f} % of the commanded load: one of them is out of scale; "
            "the commanded load was used"
        )


def _check_gains(nominal: Finger, fits: Fits, warnings: list[str]) -> None:
    found = [fit.gain / gain for fit, gain in zip(fits, nominal.elements.gain, strict=True) if fit is not None]
    ratio = float(np.median(found))
    if not 1.0 / _FAR_GAIN < ratio < _FAR_GAIN:
        warnings.append(
            f"the gains come out {ratio:.3g} times the nominal ones: outputs must be in the finger's raw unit (per "
            "cent of the untouched output), loads in N/m"
        )


def _contact(
    body: Cylinder, begin: Fits, touches: Touches, loads: TouchLoads, widths: WidthTable, options: Options,
    faults: Faults, tick: Callable[[str], None],
) -> tuple[ContactKind, float, dict[str, float], TouchLoads, WidthTable]:  # fmt: skip
    """Choose the contact model by the residual of a fit with free depths."""
    half = hertz_table(body)
    other = touch_loads(body, half, touches, loads.highest, options.edge_half_angle_rad, faults.wider(touches))
    tried: dict[str, tuple[ContactKind, float, TouchLoads, WidthTable]] = {"hertz": ("hertz", 0.0, other, half)}
    for share in SHARES:
        name = "frictionless" if share == 0.0 else f"adhesion {share:g}"
        tried[name] = ("frictionless" if share == 0.0 else "adhering", share, loads, widths)
    if options.contact is not None:
        tried = {name: entry for name, entry in tried.items() if entry[0] == options.contact}
    score: dict[str, float] = {}
    for name, (_, share, tractions, _) in tried.items():
        fits = fit_elements(body, begin, touches, tractions, share, Freedom(True, False))
        score[name] = float(np.sqrt(np.mean([fit.residual**2 for fit in fits if fit is not None])))
        tick(f"contact model {name}")
    best = min(score, key=lambda name: score[name])
    if "frictionless" in score and score[best] > _BETTER * score["frictionless"]:
        best = "frictionless"
    kind, share, tractions, table = tried[best]
    if kind == "adhering" and options.contact is None:
        share = _between({entry[1]: score[name] for name, entry in tried.items() if entry[0] != "hertz"}, share)
    return kind, share, score, tractions, table


def _between(score: dict[float, float], best: float) -> float:
    """Return the share at the vertex of the parabola through the squares about the best one tried, within 0 to 1."""
    shares = sorted(score)
    place = min(max(shares.index(best), 1), len(shares) - 2)
    near = shares[place - 1 : place + 2]
    bend, tilt, _ = np.polyfit(near, [score[share] ** 2 for share in near], 2)
    return float(np.clip(-tilt / (2.0 * bend), near[0], near[-1])) if bend > 0.0 else best


def edge_peak(body: Cylinder, fits: Fits, half_angle: float) -> float:
    """Return the mean over elements of the model strain right under a 200 N/m edge, positive."""
    known = [fit for fit in fits if fit is not None]
    highest = max(highest_needed(body, max(fit.radius_m for fit in known), 1e-3), _PEAK_WAVES)
    series = width_for_load(body, Wedge(half_angle), REFERENCE_LOAD).series(0.0, highest)[: 2 * highest + 1 : 2]
    factors = respond(body, np.arange(highest + 1), [fit.radius_m for fit in known]).e_rr[:, :, 0].T
    return float(-np.mean(factors @ (series * felt(highest, known[0].extent_rad))))


def _bent(new: Quadratic | None, old: Quadratic | None) -> bool:
    if new is None or old is None:
        return False
    return bool(np.max(np.abs(new.value - old.value)) > _QUADRATIC_MATTERS)


def _with_extent(body: Cylinder, begin: Fits, touches: Touches, loads: TouchLoads) -> Fits:
    """Return the elements with the arc over which they average, zero if that does not stand out.

    Edges tell it whatever the friction; where there are few of them all touches must.
    """
    edge = touches.radius_m == 0.0
    near = np.abs(touches.angle_rad[edge, None] - [fit.angle_rad for fit in begin if fit is not None]) <= NEAR
    if np.any(near.sum(axis=0) < FEWEST):
        edge[:] = True
    found, shared = fit_together(
        body, begin, touches.pick(edge), TouchLoads(loads.normal[edge], loads.shear[edge]), 0.0, Common()
    )
    return found if shared.extent_square > _STANDS_OUT * shared.extent_deviation else begin


def _together(
    body: Cylinder, begin: Fits, touches: Touches, loads: TouchLoads, adhesion: float, warnings: list[str]
) -> tuple[Fits, float, float]:
    """Fit depths of all elements with one Poisson's ratio, the body's if the data do not support another, and the one
    sought.
    """
    wide = any(fit is not None and fit.extent_rad > 0.0 for fit in begin)
    found, shared = fit_together(body, begin, touches, loads, adhesion, Common(extent=wide))
    nu, deviation = shared.poisson, shared.poisson_deviation
    if deviation < _POISSON_DEVIATION and 0.36 < nu < 0.4995:
        return found, nu, nu
    warnings.append(
        f"Poisson's ratio is not supported by the data ({nu:.3f} +- {deviation:.3f}): kept at {body.poisson:.3g}"
    )
    held = [None if fit is None else replace(fit, poisson=body.poisson) for fit in begin]
    found, _ = fit_together(body, held, touches, loads, adhesion, Common(poisson=False, extent=wide))
    return found, body.poisson, nu


def _left_out(
    body: Cylinder,
    fits: Fits,
    touches: Touches,
    loads: TouchLoads,
    adhesion: float,
    freedom: Freedom,
    peak: float,
) -> Floats:
    """Return each element's residual, of peak, on every other touch when fitted to the rest, both ways round."""
    square, count = np.zeros(len(fits)), np.zeros(len(fits))
    for parity in (0, 1):
        train = np.arange(len(touches)) % 2 == parity
        trained = fit_elements(
            body,
            fits,
            touches.pick(train),
            TouchLoads(loads.normal[train], loads.shear[train]),
            adhesion,
            freedom,
        )
        test, tractions = touches.pick(~train), TouchLoads(loads.normal[~train], loads.shear[~train])
        for element, fit in enumerate(trained):
            if fit is None:
                continue
            strain = strain_of(
                body, fit.angle_rad, fit.radius_m, fit.poisson, test, tractions, adhesion, fit.extent_rad
            )
            near = np.abs(test.angle_rad - fit.angle_rad) <= NEAR
            miss = (fit.gain * test.output[:, element] + strain)[near]
            square[element] += float(miss @ miss)
            count[element] += miss.size
    return np.asarray(np.sqrt(square / np.where(count > 0, count, np.nan)) / peak)


def _half(
    finger: Finger,
    body: Cylinder,
    fits: Fits,
    touches: Touches,
    loads: TouchLoads,
    adhesion: float,
    train: NDArray[np.bool_],
) -> tuple[Finger, NDArray[np.bool_]]:
    """Return the finger with elements and map from some of the touches alone, and which."""
    part, tractions = touches.pick(train), TouchLoads(loads.normal[train], loads.shear[train])
    depth = finger.notes["map"] != "uniform"
    own = fit_elements(body, fits, part, tractions, adhesion, Freedom(depth, False))
    rows = None
    if finger.identified is not None:
        direct = _identify(body, own, part, tractions, adhesion, Options(), [])[1]
        if direct is not None:
            rows = np.array(finger.identified.rows)
            rows[[e for e, fit in enumerate(own) if fit is not None]] = direct.rows
    return msgspec.structs.replace(
        finger,
        elements=msgspec.structs.replace(
            finger.elements,
            **{
                name: tuple(
                    kept if fit is None else float(getattr(fit, name))
                    for kept, fit in zip(getattr(finger.elements, name), own, strict=True)
                )
                for name in ("angle_rad", "radius_m", "gain")
            },
        ),
        identified=None if rows is None else IdentifiedMap(tuple(map(tuple, rows.tolist()))),
    ), train


def _identify(
    body: Cylinder, fits: Fits, touches: Touches, loads: TouchLoads, adhesion: float, options: Options,
    warnings: list[str],
) -> tuple[Identified | None, Identified | None]:  # fmt: skip
    if not options.identify:
        return None, None
    known = [(element, fit) for element, fit in enumerate(fits) if fit is not None]
    gain = np.array([fit.gain for _, fit in known])
    strain = -touches.output[:, [element for element, _ in known]] * gain
    pressure, shear = series_of(touches, loads)
    full = e_map(
        body, [fit.angle_rad for _, fit in known], [fit.radius_m for _, fit in known], loads.highest,
        body.poisson,
        known[0][1].extent_rad,
    )  # fmt: skip
    normal, tangential = np.split(full, 2, axis=1)
    covered = float(np.ptp(touches.angle_rad)) / np.ptp([fit.angle_rad for _, fit in known])
    if covered < 0.8:
        warnings.append(
            f"touches cover {100 * covered:.0f} % of the elements' arc: no map identified, the model is used"
        )
        return None, None
    # the source's way leaves the tangential part in E; the corrected map takes it from the model
    by_shear = adhesion * shear @ tangential.T
    return truncated(pressure, strain), corrected(pressure, strain - by_shear, normal)


def _finger(
    nominal: Finger, body: Cylinder, fits: Fits, kind: ContactKind, adhesion: float, widths: WidthTable,
    faults: Faults, touches: Touches, residuals: dict[str, Floats], direct: Identified | None, peak: float,
) -> Finger:  # fmt: skip
    count = len(fits)
    base, quadratic, proximity = nominal.elements, faults.quadratic, faults.proximity

    def column(name: str, fallback: tuple[float, ...]) -> tuple[float, ...]:
        return tuple(fallback[e] if fit is None else float(getattr(fit, name)) for e, fit in enumerate(fits))

    method = (
        "uniform" if np.nanmean(residuals["uniform"]) <= np.nanmean(residuals["elements"]) / _BETTER else "elements"
    )
    misfit, rows = residuals[method], None
    if direct is not None and np.nanmean(residuals["corrected"]) < _BETTER * np.nanmean(misfit):
        misfit, method, rows = residuals["corrected"], "corrected", np.zeros((count, direct.rows.shape[1]))
        rows[[e for e, fit in enumerate(fits) if fit is not None]] = direct.rows
    # what averaging left of the noise is no misfit
    own = np.array(column("gain", base.gain)) * touches.noise / np.sqrt(touches.averaged) / peak
    misfit = np.sqrt(np.maximum(misfit**2 - np.where(np.isfinite(own), own, 0.0) ** 2, (0.2 * misfit) ** 2))
    noise = np.where(np.isfinite(touches.noise) & (touches.noise > 0.0), touches.noise, np.array(base.noise))
    elements = Elements(
        angle_rad=column("angle_rad", base.angle_rad),
        radius_m=column("radius_m", base.radius_m),
        poisson=(body.poisson,) * count,
        gain=column("gain", base.gain),
        quadratic=tuple((quadratic.value if quadratic is not None else np.zeros(count)).tolist()),
        noise=tuple(noise.tolist()),
        misfit=tuple(np.where(np.isfinite(misfit), misfit, 0.0).tolist()),
        used=tuple(fit is not None for fit in fits),
    )
    table = rigid_core_table(body) if kind != "hertz" else widths
    return msgspec.structs.replace(
        nominal,
        geometry=Geometry(
            body.core_m, body.outer_m, body.poisson, body.shear_pa, max(f.extent_rad for f in fits if f is not None)
        ),
        elements=elements,
        contact=ContactModel(
            kind, adhesion, tuple(table.half_widths.tolist()), tuple(table.ratio.tolist()),
            nominal.contact.most_load_n_per_m, "elliptic" if kind == "hertz" else "exact", 1.0,
        ),
        signal=nominal.signal if proximity is None else msgspec.structs.replace(
            nominal.signal, proximity=proximity.amplitude, proximity_range_rad=proximity.range_rad
        ),
        strips=faults.strips,
        identified=None if rows is None else IdentifiedMap(tuple(tuple(row) for row in rows.tolist())),
        notes={**nominal.notes, "map": method},
    )  # fmt: skip
