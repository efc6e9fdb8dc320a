"""Describe a calibrated finger: the text that calibration writes and the driver loads.

The text is TOML, checked by msgspec: a key that nobody reads is an error.  Outputs are fractions of the
untouched output (compression positive), strains are fractions (tension positive): strain = -gain (d -
quadratic d^2) for an output d free of its offset.  Reading and writing the file itself is the caller's
business.

    finger = from_toml(path.read_text())
    path.write_text(to_toml(finger))
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from sioms.documents import toml_of, toml_text
from sioms.tactile.cylinder import DEFAULT_SHEAR_MODULUS_PA, Cylinder
from sioms.tactile.emap import MOST_EXTENT, e_map, highest_needed
from sioms.tactile.model import Spectra, StrainTable, adhering, bounded, elliptic, strain_table
from sioms.tactile.strips import Strips
from sioms.tactile.width import WidthTable, hertz_table, rigid_core_table

Floats = NDArray[np.float64]

FORMAT = "sioms finger 1"
MOST_ADHESION = 1.5  # full adhesion has no size of its own below Poisson's ratio 1/2: see `contact.adhere`
ContactKind = Literal["frictionless", "adhering", "hertz"]
PressureKind = Literal["exact", "elliptic"]


LEAST, LARGEST = 1e-12, 1e12
"""Size of any number of a finger that is not 0 or may not be."""
POSITIVE = frozenset(
    {
        "core_m", "outer_m", "shear_modulus_pa", "noise", "ratio", "drift_time_s", "proximity_range_rad",
        "most_load_n_per_m",
    }
)  # fmt: skip


class Geometry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Radii [m] and material of the layer; half angle over which every element averages (half its strip's width)."""

    core_m: float
    outer_m: float
    poisson: float
    shear_modulus_pa: float = DEFAULT_SHEAR_MODULUS_PA
    extent_rad: float = 0.0


class Elements(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One number for each element.

    Args:
        angle_rad: place.
        radius_m: effective radius (an element measures the mean strain from the core to its strip).
        poisson: Poisson's ratio as the element sees it.
        gain: strain per output.
        quadratic: of the output [1/output].
        noise: standard deviation of one frame's output.
        misfit: root mean square of what calibration could not explain, as a share of the peak strain.
        used: False leaves an element out.
    """

    angle_rad: tuple[float, ...]
    radius_m: tuple[float, ...]
    poisson: tuple[float, ...]
    gain: tuple[float, ...]
    quadratic: tuple[float, ...]
    noise: tuple[float, ...]
    misfit: tuple[float, ...]
    used: tuple[bool, ...]


class Signal(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How raw frames become outputs.

    Args:
        scale: output per raw unit; 0.01 for frames in per cent.
        lowest: raw readings at or below are saturated.
        highest: raw readings at or above are saturated.
        drift_time_s: time constant of the baseline while untouched.
        release_hold_s: how long after a touch the baseline rests, for creep to fade.
        proximity: output that a conducting indenter draws without strain, at its own place.
        proximity_range_rad: angle over which that falls to 1/e.
        thermal: what temperature does to each element's output, over what it does to their median; empty: to all
            alike.
    """

    scale: float = 0.01
    lowest: float = -100.0
    highest: float = 100.0
    drift_time_s: float = 2.0
    release_hold_s: float = 1.0
    proximity: float = 0.0
    proximity_range_rad: float = 0.25
    thermal: tuple[float, ...] = ()


class ContactModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a round indenter presses.

    Args:
        model: hertz takes the pressure for elliptic.
        adhesion: share of full adhesion.
        half_width_rad: of the width table [rad], rising from 0.
        ratio: of P R to Hertz's at these.
        most_load_n_per_m: load beyond which an estimate is flagged as overload.
        pressure: exact, or the ellipse of the dissertation, by which R of wide contacts comes out small.
        circles: standard deviation of R in units of what finger and indenters being circles, not the model's parabolas,
            does to it; 0 where they are parabolas.
    """

    model: ContactKind = "frictionless"
    adhesion: float = 0.0
    half_width_rad: tuple[float, ...] = ()
    ratio: tuple[float, ...] = ()
    most_load_n_per_m: float = 1000.0
    pressure: PressureKind = "exact"
    circles: float = 0.0


class IdentifiedMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An E map found directly from touches: pressure columns [1/Pa], one row for each element."""

    rows: tuple[tuple[float, ...], ...]


class Systematic(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Standard deviations of the finger's own errors, beside those of noise and residuals: of the place [rad], and of
    load and R, relative.
    """

    place_rad: float = 0.0
    load: float = 0.0
    radius: float = 0.0


class Finger(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A calibrated finger; immutable, safe to share."""

    format: str
    name: str
    geometry: Geometry
    elements: Elements
    signal: Signal = Signal()
    contact: ContactModel = ContactModel()
    identified: IdentifiedMap | None = None
    strips: Strips | None = None
    systematic: Systematic = Systematic()
    notes: dict[str, str] = {}

    def __post_init__(self) -> None:
        what = f"load finger {self.name!r}"
        if self.format != FORMAT:
            raise ValueError(f"{what}: format is {self.format!r}; need {FORMAT!r}")
        self._check_sizes(what)
        self.cylinder  # noqa: B018 - refuses a bad geometry
        self._check_elements(what)
        if self.identified is not None:
            self._check_map(what, self.identified)
        if not 0.0 <= self.geometry.extent_rad <= MOST_EXTENT:
            raise ValueError(f"{what}: extent_rad is {self.geometry.extent_rad}; need 0 to {MOST_EXTENT} rad")
        if not 0.0 <= self.contact.adhesion <= MOST_ADHESION:
            raise ValueError(f"{what}: share of adhesion is {self.contact.adhesion}; need 0 to {MOST_ADHESION}")
        if len(self.contact.half_width_rad) != len(self.contact.ratio):
            raise ValueError(f"{what}: contact table has unequal columns; give as many ratios as half widths")
        for name in self.systematic.__struct_fields__:
            if not 0.0 <= getattr(self.systematic, name) < math.inf:
                raise ValueError(
                    f"{what}: systematic {name} is {getattr(self.systematic, name)}; need 0 or more, finite"
                )
        if not self.signal.lowest < self.signal.highest:
            raise ValueError(f"{what}: lowest reading {self.signal.lowest} is not below {self.signal.highest}")

    def _check_sizes(self, what: str) -> None:
        """Refuse numbers of no finger: what is squared and divided from them overflows, or is not a number."""
        for part in (self.geometry, self.elements, self.signal, self.contact, self.identified):
            for name in () if part is None else part.__struct_fields__:
                value = getattr(part, name)
                for number in _numbers(value) if name not in ("lowest", "highest") else ():
                    if not abs(number) <= LARGEST:
                        raise ValueError(
                            f"{what}: {name} holds {number}; need finite numbers, at most {LARGEST:g}; used = false "
                            "leaves an element out"
                        )
                    if name in POSITIVE and not number >= LEAST:
                        raise ValueError(f"{what}: {name} holds {number}; need > 0, at least {LEAST:g}")
        for name, number in (
            ("misfit", min(self.elements.misfit, default=0.0)), ("circles", self.contact.circles),
            ("release_hold_s", self.signal.release_hold_s),
        ):  # fmt: skip
            if number < 0.0:
                raise ValueError(f"{what}: {name} is {number}; need 0 or more")
        if not abs(self.signal.scale) >= LEAST:
            raise ValueError(f"{what}: scale is {self.signal.scale}; need the output per raw unit")
        widths = self.contact.half_width_rad
        if widths and (widths[0] != 0.0 or any(not a < b for a, b in pairwise(widths))):
            raise ValueError(f"{what}: half_width_rad is {widths[:3]} ...; need widths that rise from 0")

    def _check_elements(self, what: str) -> None:
        count, geometry = len(self.elements.angle_rad), self.geometry
        if count < 4:
            raise ValueError(f"{what}: {count} elements; need at least 4 to tell place, load and radius")
        for name in self.elements.__struct_fields__:
            column = getattr(self.elements, name)
            if len(column) != count:
                raise ValueError(f"{what}: {len(column)} values of {name} for {count} elements")
        for place, (radius, gain) in enumerate(zip(self.elements.radius_m, self.elements.gain, strict=True)):
            if not geometry.core_m < radius <= geometry.outer_m:
                raise ValueError(
                    f"{what}: element {place} has radius {radius} m; need {geometry.core_m} < radius <= "
                    f"{geometry.outer_m}"
                )
            if not gain >= LEAST:
                raise ValueError(f"{what}: element {place} has gain {gain}; need > 0")
        if len(self.signal.thermal) not in (0, count):
            raise ValueError(f"{what}: {len(self.signal.thermal)} values of thermal for {count} elements")
        if len({round(angle, 6) for angle in self.elements.angle_rad}) < count:
            raise ValueError(f"{what}: two elements have one angle_rad; need places that differ")

    def _check_map(self, what: str, found: IdentifiedMap) -> None:
        widths = {len(row) for row in found.rows}
        if len(found.rows) != len(self.elements.angle_rad) or len(widths) != 1 or widths.pop() % 2 != 1:
            raise ValueError(f"{what}: the identified map needs one row of 2 nc + 1 numbers for each element")

    @property
    def cylinder(self) -> Cylinder:
        """Return the body."""
        g = self.geometry
        return Cylinder(g.core_m, g.outer_m, g.poisson, g.shear_modulus_pa)

    @property
    def angles_rad(self) -> tuple[float, ...]:
        """Return the places of the elements."""
        return self.elements.angle_rad

    @property
    def most_load_n_per_m(self) -> float:
        """Return the load beyond which an estimate is flagged as overload."""
        return self.contact.most_load_n_per_m

    @property
    def strain_noise(self) -> Floats:
        """Return the standard deviation of one frame's strains; infinite for an unused element."""
        noise = np.asarray(self.elements.gain) * np.asarray(self.elements.noise)
        return np.where(np.asarray(self.elements.used), noise, np.inf)

    @property
    def misfit(self) -> Floats:
        """Return calibration's residual as a share of the peak strain."""
        return np.asarray(self.elements.misfit, dtype=np.float64)

    def highest(self) -> int:
        """Return nc: of the identified map, or what the shallowest element needs."""
        if self.identified is not None:
            return len(self.identified.rows[0]) // 2
        return min(highest_needed(self.cylinder, max(self.elements.radius_m), 1e-4), 150)

    def e_map(self) -> Floats:
        """Return E of the elements' model, shape (ns, 4 nc + 2) [1/Pa], even if a map was identified."""
        e = self.elements
        return e_map(
            self.cylinder, e.angle_rad, np.asarray(e.radius_m), self.highest(), np.asarray(e.poisson),
            self.geometry.extent_rad,
        )  # fmt: skip

    def spectra(self) -> Spectra:
        """Return the spectra of the contact model."""
        contact, highest = self.contact, self.highest()
        is_ellipse = contact.model == "hertz" or contact.pressure == "elliptic"
        base = elliptic(highest) if is_ellipse else bounded(self.cylinder, highest)
        if contact.model == "adhering" and contact.adhesion > 0.0:
            return adhering(self.cylinder, contact.adhesion, base)
        return base

    def strain_table(self) -> StrainTable:
        """Tabulate the strains under round contacts; takes about a second, and a tenth for the next finger of that
        body.
        """
        angles, outer, spectra = np.asarray(self.angles_rad), self.geometry.outer_m, self.spectra()
        full = self.e_map()
        half = full.shape[1] // 2
        normal = full[:, :half] if self.identified is None else np.asarray(self.identified.rows)
        table = strain_table(outer, angles, normal, full[:, half:], spectra)
        return table if self.strips is None else self.strips.applied(table)

    def width_table(self) -> WidthTable:
        """Return the width table of the file, or compute it."""
        if self.contact.half_width_rad:
            return WidthTable(self.cylinder, np.asarray(self.contact.half_width_rad), np.asarray(self.contact.ratio))
        return hertz_table(self.cylinder) if self.contact.model == "hertz" else rigid_core_table(self.cylinder)


def nominal_finger(
    cylinder: Cylinder,
    angles_rad: Floats,
    radius_m: float,
    gain: float = 1.0,
    noise: float = 1e-3,
    name: str = "nominal",
) -> Finger:
    """Return a finger as designed, every element alike: for design, simulation, and as the start of calibration."""
    count = len(angles_rad)

    def alike(value: float) -> tuple[float, ...]:
        return (value,) * count

    table = rigid_core_table(cylinder)
    return Finger(
        format=FORMAT,
        name=name,
        geometry=Geometry(cylinder.core_m, cylinder.outer_m, cylinder.poisson, cylinder.shear_pa),
        elements=Elements(
            angle_rad=tuple(float(t) for t in angles_rad),
            radius_m=alike(radius_m),
            poisson=alike(cylinder.poisson),
            gain=alike(gain),
            quadratic=alike(0.0),
            noise=alike(noise),
            misfit=alike(0.0),
            used=(True,) * count,
        ),
        contact=ContactModel(half_width_rad=tuple(table.half_widths.tolist()), ratio=tuple(table.ratio.tolist())),
    )


def from_toml(text: str) -> Finger:
    """Read a finger from TOML.

    Raises:
        ValueError: not TOML, an unknown or missing key, or a value that makes no sense; the message names it.
    """
    try:
        return msgspec.convert(toml_of(text), Finger)
    except (msgspec.ValidationError, ValueError) as error:
        raise ValueError(f"load finger: {error}") from error


def to_toml(finger: Finger) -> str:
    """Write a finger as TOML that `from_toml` reads back exactly."""
    tree: dict[str, Any] = msgspec.to_builtins(finger)
    return toml_text({key: value for key, value in tree.items() if value is not None})


def _numbers(value: Any) -> Iterator[float]:
    """Return the numbers in a value and the tuples in it."""
    if isinstance(value, tuple):
        for inner in value:
            yield from _numbers(inner)
    elif isinstance(value, float):
        yield value
