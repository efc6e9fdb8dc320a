"""Finger models as TOML text: the nominal finger and its effects, and the corrected finger for driver and estimator."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from sioms.reconcile.errors import BadInputError
from sioms.reconcile.finger.belief import Belief
from sioms.reconcile.finger.effects import library
from sioms.reconcile.given import only, table_in
from sioms.reconcile.sensors.effect import SensorModel
from sioms.reconcile.sensors.model_file import effects_from, effects_to_toml, number_or_list, numbers
from sioms.tactile.cylinder import Cylinder
from sioms.tactile.finger import MOST_ADHESION, ContactModel, Finger, nominal_finger

KEYS = (
    "name",
    "core_m",
    "outer_m",
    "shear_modulus_pa",
    "poisson",
    "angle_rad",
    "radius_m",
    "gain",
    "extent_rad",
)


def belief_of(finger: Finger) -> Belief:
    """Return what a finger of ``sioms.tactile`` believes; an identified map is not part of it."""
    g, e = finger.geometry, finger.elements
    ratio = float(np.mean(e.poisson))
    c = finger.contact
    return Belief(
        g.core_m,
        g.outer_m,
        g.shear_modulus_pa,
        ratio,
        np.array(e.angle_rad),
        np.array(e.radius_m),
        np.array(e.gain),
        np.array(e.quadratic),
        np.zeros(len(e.angle_rad)),
        blur=g.extent_rad**2,
        hertz=float(c.model == "hertz"),
        adhesion=c.adhesion if c.model == "adhering" else 0.0,
    )


def from_table(table: Mapping[str, Any], where: str) -> tuple[SensorModel, bool]:
    """Build a model from the tables [finger] and [effects.*]; say whether the elements' width is stated.

    Raises:
        BadInputError: a key is missing, unknown or makes no sense.
    """
    odd = sorted(set(table) - {"finger", "effects"})
    if odd or "finger" not in table:
        raise BadInputError(
            f"read model {where}: needs the tables finger and effects; got {', '.join(sorted(table)) or 'nothing'}"
        )
    t = table_in(table, "finger", f"read model {where}")
    only(t, KEYS, f"read model {where}, [finger]")
    angle = numbers(t, "angle_rad", where)
    count = len(angle)
    core, outer, shear, ratio = (
        float(numbers(t, k, where, 1)[0]) for k in ("core_m", "outer_m", "shear_modulus_pa", "poisson")
    )
    extent = float(numbers(t, "extent_rad", where, 1)[0]) if "extent_rad" in t else 0.0
    if not 0.0 <= extent < 1.0:
        raise BadInputError(f"read model {where}: extent_rad is {extent:g}; needs the half angle of an element, 0 to 1")
    b = Belief(
        core=core,
        outer=outer,
        shear=shear,
        poisson=ratio,
        angle=angle,
        radius=numbers(t, "radius_m", where, count),
        gain=numbers(t, "gain", where, count),
        quadratic=np.zeros(count),
        temperature=np.zeros(count),
        blur=extent**2,
    )
    check(b, where)
    model = SensorModel(b, count, library(), {}, (), str(t.get("name", "finger")))
    return effects_from(model, table, where), "extent_rad" in t


def check(b: Belief, where: str) -> None:
    """Check a finger's numbers.

    Raises:
        BadInputError: radii, gains or Poisson's ratio make no sense; factors of 1000 are recognised.
    """
    if not 0.0 < b.core < b.outer:
        raise BadInputError(
            f"read model {where}: core {b.core:g} m and outer radius {b.outer:g} m; need 0 < core < outer"
        )
    if b.outer > 1.0:
        raise BadInputError(
            f"read model {where}: outer radius is {b.outer:g} m, a factor of 1000 too much for a finger; needs metres"
        )
    if not (np.all(b.radius > b.core) and np.all(b.radius < b.outer)):
        worst = float(b.radius[np.argmax(np.abs(b.radius - 0.5 * (b.core + b.outer)))])
        hint = " (a factor of 1000: mm?)" if worst > 100.0 * b.outer else ""
        raise BadInputError(
            f"read model {where}: an element lies at {worst:g} m{hint}; need {b.core:g} < radius < {b.outer:g} m"
        )
    if not np.all(b.gain > 0.0):
        raise BadInputError(f"read model {where}: gain {float(b.gain.min()):g}; needs strain per output, > 0")
    if not b.shear > 0.0:
        raise BadInputError(f"read model {where}: shear modulus is {b.shear:g} Pa; needs one above zero")
    if not 0.3 <= b.poisson <= 0.5:
        raise BadInputError(f"read model {where}: Poisson's ratio is {b.poisson:g}; rubber needs 0.3 to 0.5")


def to_toml(model: SensorModel) -> str:
    """Write a model: nominal finger and effects."""
    b: Belief = model.base
    lines = [
        "[finger]",
        f'name = "{model.name}"',
        f"core_m = {b.core!r}",
        f"outer_m = {b.outer!r}",
        f"shear_modulus_pa = {b.shear!r}",
        f"poisson = {b.poisson!r}",
        f"extent_rad = {b.extent!r}",
        f"angle_rad = {number_or_list(b.angle)}",
        f"radius_m = {number_or_list(b.radius)}",
        f"gain = {number_or_list(b.gain)}",
    ]
    return "\n".join(lines) + "\n" + effects_to_toml(model)


def corrected(model: SensorModel, nominal: Finger | None, dead: tuple[int, ...] = ()) -> Finger:
    """Return the finger that driver and estimator load: elements, body and contact as the model now has them.

    The turn of the fixture belongs to the rig and not to the finger; creep and drift have no place in a finger's file,
    and strips are what a calibration finds: all three stay in the model.
    """
    b: Belief = model.belief()
    if nominal is None:
        nominal = _plain(b, model.name)
    e = nominal.elements
    elements = msgspec.structs.replace(
        e,
        angle_rad=tuple(b.angle.tolist()),
        radius_m=tuple(b.radius.tolist()),
        gain=tuple(b.gain.tolist()),
        quadratic=tuple(b.quadratic.tolist()),
        poisson=(b.poisson,) * len(b.angle),
        used=tuple(u and i not in dead for i, u in enumerate(e.used)),
    )
    signal = nominal.signal
    if "proximity" in model.effects:
        v = model.effects["proximity"]
        signal = msgspec.structs.replace(signal, proximity=float(v["A"][0]), proximity_range_rad=float(v["range"][0]))
    contact = ContactModel(
        "adhering" if b.adhesion > 0.0 else "hertz" if b.hertz > 0.5 else "frictionless",
        min(b.adhesion, MOST_ADHESION),
        (),
        (),
        nominal.contact.most_load_n_per_m,
    )
    geometry = msgspec.structs.replace(nominal.geometry, poisson=b.poisson, extent_rad=b.extent)
    return msgspec.structs.replace(
        nominal,
        elements=elements,
        signal=signal,
        contact=contact,
        geometry=geometry,
        identified=None,
        notes={**nominal.notes, "map": "model"},
    )


def _plain(b: Belief, name: str) -> Finger:
    return nominal_finger(
        Cylinder(b.core, b.outer, b.poisson, b.shear),
        b.angle,
        float(b.radius[0]),
        float(b.gain[0]),
        name=name,
    )
