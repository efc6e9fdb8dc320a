"""Tables 3.4 to 3.12 of the published finger, computed for another one beside the published numbers."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from sioms.tactile.calibrate import ElementFit, Freedom, fit_elements, starts
from sioms.tactile.calibration import Calibration, Options
from sioms.tactile.calibration import calibrate as fit
from sioms.tactile.closedform import equivalent_radius, indenter_radius
from sioms.tactile.cylinder import Cylinder
from sioms.tactile.emap import e_map
from sioms.tactile.estimator import Estimator
from sioms.tactile.files import Data, read_folder
from sioms.tactile.finger import ContactModel, Finger, IdentifiedMap
from sioms.tactile.identify import series_of, truncated
from sioms.tactile.linearity import linearise
from sioms.tactile.quality import Load
from sioms.tactile.together import Common, fit_together
from sioms.tactile.touches import LOADED, Touches, TouchLoads, join, ramps_of, touch_loads
from sioms.tactile.width import hertz_table

Floats = NDArray[np.float64]
Tell = Callable[[str], None]

NOISY = 6  # indenters of table 3.11
PUBLISHED_3_10 = {  # rc: Hertz by model and map, approximate frictionless by model and map, mm
    0.5: (0.41, 0.52, 0.95, 0.99), 1.59: (1.34, 1.77, 2.39, 2.53), 3.9: (2.09, 2.46, 3.37, 3.33),
    6.01: (3.71, 4.28, 5.84, 6.01), 7.55: (5.22, 5.58, 8.17, 7.92), 9.3: (5.85, 6.23, 9.41, 9.03),
    12.3: (7.60, 7.81, 12.94, 11.89), 18.71: (8.58, 8.64, 15.51, 13.77), 25.25: (9.90, 9.91, 19.36, 16.50),
}  # fmt: skip
PUBLISHED_3_11 = {  # model, map: place deg, load N/m, R mm
    ("model", "total"): (0.24, 13.1, 1.26),
    ("model", "by place"): (0.20, 9.1, 1.00),
    ("model", "noise"): (0.14, 9.6, 0.79),
    ("map", "total"): (0.24, 11.7, 0.96),
    ("map", "by place"): (0.19, 6.4, 0.60),
    ("map", "noise"): (0.14, 9.8, 0.77),
}
PUBLISHED_3_12 = {  # rc: mean without and with load, deviation without and with load, mm
    0.5: (0.99, 0.36, 0.60, 0.14), 1.59: (2.53, 2.29, 0.77, 1.04), 3.9: (3.33, 6.17, 0.58, 1.52),
    6.01: (6.01, 6.69, 0.98, 1.49), 7.55: (7.92, 6.30, 1.32, 1.18), 9.3: (9.03, 9.09, 1.73, 1.64),
    12.3: (11.89, 10.43, 2.64, 1.78), 18.71: (13.77, 15.95, 2.23, 3.45), 25.25: (16.50, 19.24, 3.60, 5.26),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Table:
    """Hold one table as text."""

    title: str
    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def calibrated(folder: Path, tell: Tell) -> tuple[Data, Calibration]:
    """Read and calibrate the recordings of a folder."""
    data = read_folder(folder)
    ramp = data.recordings.get("ramp")
    ramps = [] if ramp is None else ramps_of(ramp, data.nominal.signal.scale)
    return data, fit(data.nominal, join(list(data.touches.values())), Options(), tell, ramps)


def tables(data: Data, result: Calibration, tell: Tell) -> Iterator[Table]:
    """Compute the tables in order."""
    work = Tables(data, result)
    for number, make in enumerate(
        (
            work.table_3_4,
            work.table_3_5,
            work.table_3_6,
            work.table_3_7,
            work.table_3_8,
            work.table_3_9,
            work.table_3_10,
            work.table_3_11,
            work.table_3_12,
        ),
        4,
    ):
        yield make()
        tell(f"table 3.{number}")


class Tables:
    """The tables of one finger.  One caller at a time."""

    def __init__(self, data: Data, result: Calibration) -> None:
        self.data, self.result, self.peak = data, result, result.peak
        self.body: Cylinder = result.finger.cylinder
        usual = np.abs(result.touches.load / 200.0 - 1.0) < 0.2
        self.edge = usual & (result.touches.radius_m == 0.0)
        self.both = self.edge | (usual & np.isinf(result.touches.radius_m))
        e = result.finger.elements
        self.extent = result.finger.geometry.extent_rad
        self.begin = starts(self.body, np.array(e.angle_rad), np.array(e.radius_m), result.touches, self.extent)

    def part(self, which: NDArray[np.bool_], loads: TouchLoads | None = None) -> tuple[Touches, TouchLoads]:
        """Return some touches with their tractions."""
        loads = loads or self.result.loads
        return self.result.touches.pick(which), TouchLoads(loads.normal[which], loads.shear[which])

    def fits(self, which: NDArray[np.bool_], share: float, loads: TouchLoads | None = None) -> dict[int, ElementFit]:
        """Fit place, depth, Poisson's ratio and gain of every element with touches enough; by its number."""
        found = fit_elements(self.body, self.begin, *self.part(which, loads), share, Freedom(True, True))
        return {number: one for number, one in enumerate(found) if one is not None}

    def error(self, one: ElementFit) -> float:
        """Return an element's standard error in per cent of peak."""
        return 100.0 * one.residual * one.gain / self.peak

    def noise(self, fits: Mapping[int, ElementFit]) -> list[float]:
        """Return the noise of one frame, of peak."""
        own = self.result.touches.noise
        return [100.0 * float(own[n]) * one.gain / self.peak for n, one in fits.items()]

    def table_3_4(self) -> Table:
        """First seven elements."""
        published = ((143.0, 20.5, 9.77, 0.47, 1.77), (132.9, 19.2, 10.31, 0.41, 1.28), (123.8, 57.4, 9.77, 0.48, 3.95),
                     (115.3, 41.4, 10.43, 0.45, 2.26), (105.9, 35.6, 10.36, 0.43, 2.23), (97.4, 42.3, 9.91, 0.46, 2.05),
                     (87.7, 44.0, 10.22, 0.47, 1.62))  # fmt: skip
        rows = []
        fits = self.fits(self.edge, 0.0)
        for number, other in enumerate(published):
            if number not in fits:
                continue
            one = fits[number]
            mine = (
                math.degrees(one.angle_rad),
                one.gain / self.peak,
                1e3 * one.radius_m,
                one.poisson,
                self.error(one),
            )
            rows.append(tuple(f"{a:.2f} ({b:g})" for a, b in zip(mine, other, strict=True)))
        return Table(
            "Table 3.4: fitted parameters of the first seven elements; published finger 0 in brackets",
            ("place, deg", "% peak per % output", "rs, mm", "nu", "error, % peak"), rows,
        )  # fmt: skip

    def table_3_5(self) -> Table:
        """Model fits to edges."""
        fits = self.fits(self.edge, 0.0)
        mine = ("this finger", _three([o.poisson for o in fits.values()], 2),
                _three([1e3 * o.radius_m for o in fits.values()], 1),
                _three([self.error(o) for o in fits.values()], 2), _three(self.noise(fits), 2))  # fmt: skip
        rows = [mine, ("published 0", "0.41 0.46 0.48", "9.8 10.3 10.7", "1.28 2.16 3.95", "0.95 1.72 2.87"),
                ("published 4", "0.36 0.43 0.48", "9.8 10.1 10.7", "1.04 2.46 4.29", "0.42 0.97 1.50"),
                ("published 6", "0.38 0.46 0.50", "10.7 10.9 11.1", "1.91 3.62 5.99", "0.88 2.38 4.39")]  # fmt: skip
        return Table("Table 3.5: model fits to edges, least, mean, most over the elements",
                     ("finger", "nu", "rs, mm", "error, % peak", "noise, % peak"), rows)  # fmt: skip

    def by_contact(self) -> Iterator[tuple[str, TouchLoads, float]]:
        """Return the contact models with their tractions and share of adhesion."""
        half = touch_loads(self.body, hertz_table(self.body), self.result.touches, self.result.loads.highest)
        yield "Hertz", half, 0.0
        yield "frictionless", self.result.loads, 0.0
        yield "full adhesion", self.result.loads, 1.0

    def table_3_6(self) -> Table:
        """Model fits to flat and edge by contact model."""
        mine = [
            _three([self.error(o) for o in self.fits(self.both, share, loads).values()], 2)
            for _, loads, share in self.by_contact()
        ]
        rows = [("this finger", *mine), ("published 0", "3.44 4.24 5.73", "1.75 2.25 3.60", "2.17 2.77 4.08"),
                ("published 4", "3.33 4.02 5.40", "1.83 3.39 5.38", "1.67 3.19 6.89")]  # fmt: skip
        return Table("Table 3.6: error of model fits to flats and edges, % peak: least, mean, most",
                     ("finger", "Hertz", "frictionless", "full adhesion"), rows)  # fmt: skip

    def table_3_7(self) -> Table:
        """Uniform fits."""
        places, _ = fit_together(
            self.body, self.begin, *self.part(self.edge), 0.0, Common(depth=True, extent=self.extent > 0.0)
        )
        fits = {number: one for number, one in enumerate(places) if one is not None}
        one = next(iter(fits.values()))
        rows = [
            (
                "this finger",
                f"{one.poisson:.2f}",
                f"{1e3 * one.radius_m:.1f}",
                _three([self.error(o) for o in fits.values()], 2),
                _three(self.noise(fits), 2),
            ),
            ("published 0", "0.45", "10.3", "1.86 3.18 5.07", "0.95 1.73 2.80"),
            ("published 4", "0.43", "10.1", "3.17 5.61 8.13", "0.39 0.96 1.50"),
            ("published 6", "0.45", "10.9", "2.91 4.38 6.96", "0.86 2.36 4.28"),
        ]
        return Table(
            "Table 3.7: uniform fits to edges",
            ("finger", "nu", "rs, mm", "error, % peak", "noise, % peak"),
            rows,
        )

    def identified(self, which: NDArray[np.bool_], share: float, loads: TouchLoads | None = None) -> list[float]:
        """Return the residual of a directly identified map per element, % peak."""
        touches, tractions = self.part(which, loads)
        e = self.result.finger.elements
        pressure, shear = series_of(touches, tractions)
        tangential = np.split(
            e_map(self.body, e.angle_rad, e.radius_m, tractions.highest, self.body.poisson, self.extent),
            2,
            axis=1,
        )[1]
        strain = -touches.output * np.array(e.gain) - share * shear @ tangential.T
        found = truncated(pressure, strain)
        residual: list[float] = (
            100.0 * np.sqrt(np.mean((strain - pressure @ found.rows.T) ** 2, axis=0)) / self.peak
        ).tolist()
        return residual

    def table_3_8(self) -> Table:
        """Direct identification on edges."""
        rows = [("this finger", _three(self.identified(self.edge, 0.0), 2)), ("published 0", "0.93 1.41 1.76"),
                ("published 4", "0.45 0.92 1.93"), ("published 6", "1.07 2.30 2.84")]  # fmt: skip
        return Table(
            "Table 3.8: error of the identified map on edges, % peak: least, mean, most",
            ("finger", "error"),
            rows,
        )

    def table_3_9(self) -> Table:
        """Direct identification on flat and edge by contact model."""
        mine = [_three(self.identified(self.both, share, loads), 2) for _, loads, share in self.by_contact()]
        rows = [("this finger", *mine), ("published 0", "1.73 2.10 2.42", "1.36 1.59 2.09", "1.04 1.42 2.02"),
                ("published 4", "1.47 2.28 3.11", "0.87 1.71 2.36", "0.49 1.27 2.14")]  # fmt: skip
        return Table("Table 3.9: error of the identified map on flats and edges, % peak: least, mean, most",
                     ("finger", "Hertz", "frictionless", "full adhesion"), rows)  # fmt: skip

    def indenters(self) -> Touches:
        """Return the touches of the round indenters and the flat near 200 N/m over the middle of the finger."""
        all_of = self.result.touches
        middle = (all_of.angle_rad > math.radians(54.0)) & (all_of.angle_rad < math.radians(95.0))
        return all_of.pick(middle & (np.abs(all_of.load / 200.0 - 1.0) < 0.2))

    def estimator(self, finger: Finger) -> Estimator:
        """Return an estimator of the touches, which are means of frames."""
        return Estimator(finger, compiled=None, averaged=max(self.result.touches.averaged, 1.0))

    def mean_rc(
        self, estimator: Estimator, touches: Touches, radius_m: float, load: bool = False
    ) -> tuple[float, float]:
        """Return mean and deviation of rc [mm] of one indenter; the mean by way of R, which behaves for flats."""
        mine = touches.pick(np.isclose(touches.radius_m, radius_m, atol=1e-9))
        found = np.array([r for _, _, r in fitted(estimator, mine, load)])
        body = estimator.finger.cylinder
        rc = np.array([indenter_radius(body, min(r, 0.999 * body.outer_m)) for r in found])
        mean = indenter_radius(body, min(float(np.nanmean(found)), 0.999 * body.outer_m))
        return 1e3 * mean, 1e3 * float(np.nanstd(rc))

    def table_3_10(self) -> Table:
        """Mean radii by contact model and map."""
        touches, rows = self.indenters(), []
        model, mapped = without_map(self.result.finger), with_map(self.result)
        fingers = [self.estimator(one) for one in (hertzian(model), hertzian(mapped), model, mapped)]
        for rc, published in PUBLISHED_3_10.items():
            if np.any(np.isclose(touches.radius_m, 1e-3 * rc, atol=1e-9)):
                mine = [self.mean_rc(one, touches, 1e-3 * rc)[0] for one in fingers]
                rows.append((f"{rc:g}", *(f"{a:.2f} ({b:.2f})" for a, b in zip(mine, published, strict=True))))
        return Table(
            "Table 3.10: mean rc, mm; published in brackets",
            ("rc", "Hertz, model", "Hertz, map", "approximate frictionless, model", "the same, map"),
            rows,
        )

    def table_3_11(self) -> Table:
        """Deviations of raw and averaged frames."""
        rows = []
        for name, finger in (("model", without_map(self.result.finger)), ("map", with_map(self.result))):
            total, by_place, noise = scatter(self.data, self.result, finger)
            for what, mine in (("total", total), ("by place", by_place), ("noise", noise)):
                published = PUBLISHED_3_11[name, what]
                rows.append((name, what, *(f"{a:.3g} ({b:g})" for a, b in zip(mine, published, strict=True))))
        return Table(
            "Table 3.11: standard deviations; published in brackets",
            ("calibration", "of", "place, deg", "load, N/m", "R, mm"),
            rows,
        )

    def table_3_12(self) -> Table:
        """Radii without and with load information."""
        touches, rows = self.indenters(), []
        estimator = self.estimator(with_map(self.result))
        for rc, published in PUBLISHED_3_12.items():
            if np.any(np.isclose(touches.radius_m, 1e-3 * rc, atol=1e-9)):
                free, loaded = (self.mean_rc(estimator, touches, 1e-3 * rc, load) for load in (False, True))
                mine = (free[0], loaded[0], free[1], loaded[1])
                rows.append((f"{rc:g}", *(f"{a:.2f} ({b:.2f})" for a, b in zip(mine, published, strict=True))))
        return Table(
            "Table 3.12: rc without and with the force sensor, mm; published in brackets",
            ("rc", "mean, no load", "mean, with load", "deviation, no load", "deviation, with load"),
            rows,
        )


def fitted(estimator: Estimator, touches: Touches, with_load: bool) -> list[tuple[float, float, float]]:
    """Fit touches with linear outputs; return place [rad], load [N/m] and R [m] of each, nan for none."""
    strains = -np.array(estimator.finger.elements.gain) * touches.output
    loads = [Load(float(p), 4.0) if with_load and p > 0.0 else None for p in touches.load]
    shapes = [estimator.frame(y, p) for y, p in zip(strains, loads, strict=True)]
    return [(s.angle_rad, s.load_n_per_m, s.equivalent_radius_m) for s in shapes]


def scatter(data: Data, result: Calibration, finger: Finger) -> tuple[Floats, Floats, Floats]:
    """Return deviations of place [deg], load [N/m] and R [mm]: all frames, means by place, frames about these means."""
    touches, recording = data.touches["indenters"], data.recordings["indenters"]
    radii = np.unique(touches.radius_m)
    chosen = np.isin(
        touches.radius_m, radii[np.linspace(0, radii.size - 1, min(NOISY, radii.size)).round().astype(int)]
    )
    quadratic, scale = np.array(finger.elements.quadratic), finger.signal.scale
    single = Estimator(finger, compiled=None)
    meant = Estimator(finger, compiled=None, averaged=max(touches.averaged, 1.0))
    by_place, frames = [], []
    for number in np.flatnonzero(chosen):
        mine = recording.touch == number
        rest = recording.raw[mine & (recording.phase != LOADED)].mean(0)
        output = linearise(scale * (recording.raw[mine & (recording.phase == LOADED)] - rest), quadratic)
        mean, count = output.mean(0, keepdims=True), len(output)
        copies = Touches(output, np.full(count, touches.angle_rad[number]), np.full(count, touches.load[number]),
                         np.full(count, touches.radius_m[number]), np.full(count, np.nan), touches.noise)  # fmt: skip
        truth = np.array([math.degrees(touches.angle_rad[number]), touches.load[number],
                          1e3 * equivalent_radius(finger.cylinder, float(touches.radius_m[number]))])  # fmt: skip
        units = np.array([180.0 / math.pi, 1.0, 1e3])
        by_place.append(np.array(fitted(meant, copies.pick(np.arange(1)).with_output(mean), False))[0] * units - truth)
        frames.append(np.array(fitted(single, copies, False)) * units - truth)
    means, every = np.array(by_place), np.concatenate(frames)
    about = np.concatenate([part - mean for part, mean in zip(frames, by_place, strict=True)])
    return np.nanstd(every, axis=0), np.nanstd(means, axis=0), np.nanstd(about, axis=0)


def without_map(finger: Finger) -> Finger:
    """Return the finger as the model says, the share of adhesion left out: the published calibration."""
    return msgspec.structs.replace(finger, identified=None)


def with_map(result: Calibration) -> Finger:
    """Return the finger with its identified map, whichever calibration preferred."""
    if result.corrected is None:
        return result.finger
    rows = tuple(tuple(row) for row in result.corrected.rows.tolist())
    if len(rows) != len(result.finger.angles_rad):
        return result.finger  # a map of some elements only is in the file already
    return msgspec.structs.replace(result.finger, identified=IdentifiedMap(rows))


def hertzian(finger: Finger) -> Finger:
    """Return the finger with Hertz's contact."""
    table = hertz_table(finger.cylinder)
    contact = ContactModel("hertz", 0.0, tuple(table.half_widths.tolist()), tuple(table.ratio.tolist()))
    return msgspec.structs.replace(finger, contact=contact)


def _three(values: Sequence[float], digits: int) -> str:
    return f"{min(values):.{digits}f} {float(np.mean(values)):.{digits}f} {max(values):.{digits}f}"
