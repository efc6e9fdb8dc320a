"""Prepare recorded touches for calibration: loads from the load cell; proximity, quadratic and strips off the
outputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sioms.tactile.calibrate import ElementFit, Freedom, fit_elements, starts, strain_of
from sioms.tactile.cylinder import Cylinder
from sioms.tactile.emap import highest_needed
from sioms.tactile.finger import Finger
from sioms.tactile.linearity import Quadratic, find_quadratic, linearise, ramp_quadratic, with_ramps
from sioms.tactile.proximity import Proximity, find_proximity
from sioms.tactile.strips import Strips, find_strips
from sioms.tactile.touches import Ramp, Touches, TouchLoads, touch_loads
from sioms.tactile.width import WidthTable, rigid_core_table

Floats = NDArray[np.float64]
Fits = list[ElementFit | None]

_WAVES, _MOST_WAVES = 60, 250  # of calibration: the least, and the most for elements just below the surface
_MISSED = 1e-3  # of a line load's peak
_WIDER = 0.02  # of the half width, for a difference quotient
_EVIDENT = 2.5  # standard deviations of the share of the cell's variation that the touches follow


@dataclass(frozen=True, slots=True)
class Faults:
    """Hold what was taken off the outputs; None where there was nothing of the kind.

    Args:
        quadratic, proximity, strips: what was found.
        recorded: the touches with the loads that are believed.
        undrawn: without a conductor's pull.
        ramped: the load ramps.
    """

    quadratic: Quadratic | None
    proximity: Proximity | None
    strips: Strips | None
    recorded: Touches
    undrawn: Touches
    ramped: _Ramps

    def straightened(self, body: Cylinder, fits: Fits, loads: TouchLoads, adhesion: float) -> tuple[Touches, Faults]:
        """Return touches and faults with the quadratic found anew, by what is known of elements and contact by now."""
        drawn = self.proximity is not None
        source = self.recorded if drawn else self.undrawn
        series = find_quadratic(source, _model(body, fits, source, loads, adhesion), drawn)
        found = self.ramped.join(fits, series, drawn, adhesion)
        output = self.undrawn.output if found is None else linearise(self.undrawn.output, found.value)
        return self.evened(self.undrawn.with_output(output)), replace(self, quadratic=found)

    def wider(self, touches: Touches) -> Floats | float:
        """Return by what the strips make each contact wider."""
        return 1.0 if self.strips is None else self.strips.width_factor(touches.angle_rad)

    def evened(self, touches: Touches) -> Touches:
        """Return the touches as an even layer would have given them."""
        if self.strips is None:
            return touches
        return touches.with_output(touches.output / self.strips.strain_factor(touches.angle_rad)[:, None])


def waves_needed(nominal: Finger) -> int:
    """Return how many wave numbers calibration keeps: enough for the shallowest element."""
    needed = highest_needed(nominal.cylinder, max(nominal.elements.radius_m), _MISSED)
    return min(max(needed, _WAVES), _MOST_WAVES)


def begin_at(nominal: Finger, touches: Touches) -> Fits:
    """Return where to start each element, as `starts`."""
    e, extent = nominal.elements, nominal.geometry.extent_rad
    return starts(nominal.cylinder, np.array(e.angle_rad), np.array(e.radius_m), touches, extent)


def clean_outputs(
    nominal: Finger,
    touches: Touches,
    widths: WidthTable,
    ramps: list[Ramp],
    edge_half_angle: float,
    warnings: list[str],
    tick: Callable[[str], None],
) -> tuple[Touches, TouchLoads, Faults]:
    """Take proximity, quadratic and strips off the outputs; all the model needs for that is each element's depth.

    In rounds: how strain grows with load and falls with distance depends on the depth, which the first round
    finds; with a conductor's pull beside the quadratic there is a third.
    """
    body, recorded = nominal.cylinder, touches
    highest = waves_needed(nominal)
    loads = touch_loads(body, widths, touches, highest, edge_half_angle)
    fits = begin_at(nominal, touches)
    distance = np.array(nominal.angles_rad) - touches.angle_rad[:, None]
    ramped, quadratic, proximity = _Ramps(body, ramps, highest, edge_half_angle), None, None
    known = np.array([fit is not None for fit in fits])
    for number in range(3):
        expected = _expected(body, fits, recorded, loads, quadratic)
        proximity = find_proximity(recorded.output[:, known], expected[:, known], distance[:, known])
        pull = 0.0 if proximity is None else proximity.output(distance)
        touches = undrawn = recorded.with_output(recorded.output - pull)
        drawn = proximity is not None
        last = number == (2 if drawn else 1)
        if number == 0 and (share := _cell_share(nominal, touches, loads)) > 0.0:
            recorded = _cell_loads(recorded, share)
            touches = undrawn = recorded.with_output(touches.output)
            loads = touch_loads(body, widths, recorded, highest, edge_half_angle)
            warnings.append(
                "the outputs follow the load cell from touch to touch: its variation was used"
                f"{'' if share == 1.0 else f' by {100 * share:.0f} %, the rest is its noise,'} at the commanded level"
            )
        source = recorded if drawn else touches
        quadratic = ramped.join(fits, find_quadratic(source, _model(body, fits, touches, loads), drawn), drawn)
        if quadratic is not None:
            touches = touches.with_output(linearise(touches.output, quadratic.value))
        if last:
            break
        fits = fit_elements(body, fits, touches, loads, 0.0, Freedom(True, True), lambda: tick("first fit"))
    _tell(quadratic, proximity, bool(ramps), warnings)
    wider = touch_loads(body, widths, touches, highest, edge_half_angle, 1.0 + _WIDER)
    strips = _strips(body, fits, touches, loads, wider)
    faults, uneven = Faults(quadratic, proximity, strips, recorded, undrawn, ramped), touches
    if faults.strips is not None:
        # once more with depths and gains that the strips have not bent
        even = faults.evened(uneven)
        bent = touch_loads(body, widths, even, highest, edge_half_angle, faults.wider(even))
        fits = fit_elements(body, fits, even, bent, 0.0, Freedom(True, True), lambda: tick("strips"))
        faults = replace(faults, strips=_strips(body, fits, uneven, loads, wider))
    if (strips := faults.strips) is not None:
        touches = faults.evened(uneven)
        loads = touch_loads(body, widths, touches, highest, edge_half_angle, faults.wider(touches))
        warnings.append(
            f"the finger answers unevenly along the arc, as over strips {math.degrees(strips.period_rad):.2f} deg "
            "apart: "
            f"strains +-{100 * strips.gain:.1f} %, width +-{100 * strips.width:.1f} %; the finger's file undoes it"
        )
    return touches, loads, faults


def _strips(body: Cylinder, fits: Fits, touches: Touches, loads: TouchLoads, wider: TouchLoads) -> Strips | None:
    """Look for strips in all touches, else in the edges alone: what round indenters leave besides does not hide them
    then.
    """
    found = _strips_in(body, fits, touches, loads, wider)
    edge = touches.radius_m == 0.0
    if found is not None or edge.all() or not edge.any():
        return found
    some, broad = (TouchLoads(p.normal[edge], p.shear[edge]) for p in (loads, wider))
    return _strips_in(body, fits, touches.pick(edge), some, broad)


def _strips_in(body: Cylinder, fits: Fits, touches: Touches, loads: TouchLoads, wider: TouchLoads) -> Strips | None:
    """Look for strips in what the elements' fits leave of touches over the elements."""
    known = [element for element, fit in enumerate(fits) if fit is not None]
    gain = np.array([fit.gain for fit in fits if fit is not None])
    angles = [fit.angle_rad for fit in fits if fit is not None]
    inside = (touches.angle_rad > min(angles)) & (touches.angle_rad < max(angles))
    even, broad = (-_model(body, fits, touches, p)[inside][:, known] / gain for p in (loads, wider))
    broad = (broad - even) / _WIDER
    # one scale and one width for loads within a quarter and each indenter: how the contact model errs over them is no
    # matter of place, though touches on an even grid make it look like one
    output, load, radius = touches.output[inside][:, known], touches.load[inside], touches.radius_m[inside]
    kinds = np.stack([np.round(4.0 * np.log(load)), np.minimum(radius, 1e3)], axis=1)
    rest = np.empty_like(output)
    for kind in np.unique(kinds, axis=0):
        mine = np.all(kinds == kind, axis=1)
        basis = np.stack([even[mine].ravel(), broad[mine].ravel()], axis=1)
        scale, wide = np.linalg.lstsq(basis, output[mine].ravel(), rcond=1e-6)[0]
        rest[mine] = output[mine] - scale * even[mine] - wide * broad[mine]
        even[mine] *= scale
        broad[mine] *= scale
    return find_strips(rest, even, broad, touches.angle_rad[inside])


def _tell(quadratic: Quadratic | None, proximity: Proximity | None, ramps: bool, warnings: list[str]) -> None:
    if proximity is not None:
        warnings.append(
            f"the indenter draws {100 * proximity.amplitude:+.2f} % of output without strain, over "
            f"{np.degrees(proximity.range_rad):.0f} deg: shield the elements; the finger's file undoes it for "
            "conductors"
        )
    if quadratic is None:
        warnings.append("no place was touched with three loads or more over a factor of two: quadratic not fitted")
    elif not quadratic.groups.any():
        warnings.append("the quadratic comes from load ramps alone: creep during the ramp is in it")
    elif not ramps and not np.isfinite(quadratic.deviation).all():
        few = int(np.count_nonzero(~np.isfinite(quadratic.deviation)))
        warnings.append(
            f"{few} of {quadratic.value.size} elements have too few load series for a quadratic of their own: theirs "
            f"is the common {quadratic.common / 100.0:.3g} per per cent"
        )


def _model(body: Cylinder, fits: Fits, touches: Touches, loads: TouchLoads, adhesion: float = 0.0) -> Floats:
    """Return the strain of every touch and element [1], zero for elements without touches."""
    silent = np.zeros(len(touches))
    columns = [
        silent
        if fit is None
        else strain_of(body, fit.angle_rad, fit.radius_m, fit.poisson, touches, loads, adhesion, fit.extent_rad)
        for fit in fits
    ]
    return np.stack(columns, axis=1)


def _expected(body: Cylinder, fits: Fits, touches: Touches, loads: TouchLoads, quadratic: Quadratic | None) -> Floats:
    """Return the outputs that strain alone gives, up to each element's scale."""
    strain = _model(body, fits, touches, loads)
    if quadratic is None:
        return strain
    gain = np.array([np.inf if fit is None else fit.gain for fit in fits])
    linear = -strain / gain
    output: Floats = linear + quadratic.value * linear**2
    return output


def _cell_share(nominal: Finger, touches: Touches, loads: TouchLoads) -> float:
    """Return the share of the load cell's variation that the strength of the touches follows, beyond the commanded
    load.

    It is the best guess of the load from a noisy reading, 0 where it is not evident. More touches make it more evident,
    whatever else varies in them.
    """
    if not np.isfinite(touches.force).all() or np.any(touches.force <= 0.0):
        return 0.0
    e = nominal.elements
    begin = begin_at(nominal, touches)
    model = _model(nominal.cylinder, begin, touches, loads)
    # each element at its own gain first, or the gains' scatter hides the loads'
    model = -model * (np.sum(touches.output * -model, axis=0) / (np.sum(model**2, axis=0) + 1e-30))
    strength = np.einsum("ji,ji->j", touches.output, model) / (np.einsum("ji,ji->j", model, model) + 1e-30)
    inside = (touches.angle_rad > min(e.angle_rad)) & (touches.angle_rad < max(e.angle_rad))
    told, heard = [], []
    for load, radius in {(p, r) for p, r in zip(touches.load[inside], touches.radius_m[inside], strict=True)}:
        mine = inside & (touches.load == load) & (touches.radius_m == radius)
        if mine.sum() >= 10:
            heard.append(strength[mine] / strength[mine].mean() - 1.0)
            told.append(touches.force[mine] / touches.force[mine].mean() - 1.0)
    if not told:
        return 0.0
    x, y = np.concatenate(told), np.concatenate(heard)
    share = float(x @ y) / max(float(x @ x), 1e-300)
    left = y - share * x
    deviation = math.sqrt(float(left @ left) / (max(x.size - 2, 1) * max(float(x @ x), 1e-300)))
    return min(share, 1.0) if share > _EVIDENT * deviation else 0.0


def _cell_loads(touches: Touches, share: float) -> Touches:
    """Return the touches with loads that follow the cell's by a share, at the commanded level."""
    told = touches.force * float(np.median(touches.load / touches.force))
    return replace(touches, load=touches.load + share * (told - touches.load))


class _Ramps:
    """Hold the tractions of an edge over the range of the ramps' loads, to ask the model again with other depths."""

    _LOADS = 9

    def __init__(self, body: Cylinder, ramps: list[Ramp], highest: int, edge_half_angle: float) -> None:
        self._body, self._ramps = body, ramps
        if not ramps:
            return
        top = max(float(ramp.load.max()) for ramp in ramps)
        self._load = np.linspace(0.02 * top, top, self._LOADS)
        none = np.zeros(self._LOADS)
        self._touches = Touches(none[:, None], none, self._load, none, self._load, np.zeros(1))
        widths = rigid_core_table(body)
        self._loads = touch_loads(body, widths, self._touches, highest, edge_half_angle)

    def join(self, fits: Fits, series: Quadratic | None, drawn: bool, adhesion: float = 0.0) -> Quadratic | None:
        """Return the quadratic of load series and ramps together; drawn: by a conductor."""
        found = np.full(len(fits), np.nan)
        for ramp in self._ramps:
            fit = fits[ramp.element]
            if fit is not None:
                strain = strain_of(
                    self._body,
                    0.0,
                    fit.radius_m,
                    fit.poisson,
                    self._touches,
                    self._loads,
                    adhesion,
                    fit.extent_rad,
                )
                # strain per load is nearly constant: interpolate that
                found[ramp.element] = ramp_quadratic(
                    ramp.output, ramp.load * np.interp(ramp.load, self._load, strain / self._load), drawn
                )
        return with_ramps(found, series) if np.isfinite(found).any() else series
