"""Nominal hands as TOML text. Everything has a default, that of the source; a number stands for both fingers.

[hand]
name = "left cell"
link_m = [0.14, 0.14]              # from the revolute axis to the finger's centre
mount_rad = [0.0, 0.0]             # angle by which each finger is turned on its link
finger_m = 0.0127                  # radius of the fingers
contact_m = 0.02                   # length of contact along a finger
pitch_rad = 0.161                  # between the elements of a finger: places may be off with that period
joint_stiffness = inf              # N m/rad, between encoder and finger; inf where the encoder tells the finger's place
carriage_stiffness = inf           # N/m, the same of x and y
drive_stiffness = 0.275            # N m/rad, between command and encoder
rubber_load = [0.0, 50.0, 200.0]   # N/m; rubber_m: how far the rubber gives against a flat [m]
rubber_m = [0.0, 1.3e-4, 3.1e-4]
friction_bend = [0.0, 78.7]        # 1/R of the contact [1/m]; friction: coefficient there
friction = [3.4, 2.0]
[noise]
place_rad = 0.0033                 # of the place that a finger tells
load_share = 0.02                  # of the load that a finger tells, and load_n [N]
load_n = 0.01
joint_m = 1e-5                     # of the encoders, and joint_rad
joint_rad = 3e-5
wrist_n = 0.02                     # of a wrist's force
platen_n = 0.1                     # force of the platen on the object [N], which nothing tells
friction_share = 0.05              # scatter of the coefficient from slip to slip
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from sioms.reconcile.errors import BadInputError
from sioms.reconcile.given import only, table_in
from sioms.reconcile.hand.belief import HandBelief
from sioms.reconcile.hand.effects import library
from sioms.reconcile.hand.grasps import Floats
from sioms.reconcile.sensors.effect import SensorModel
from sioms.reconcile.sensors.model_file import effects_from, effects_to_toml, number_or_list

LINK_M, FINGER_M, CONTACT_M, PITCH_RAD = 0.140, 12.7e-3, 20e-3, math.radians(9.22)
DRIVE = 4.8e-3 * 180.0 / math.pi
"""N m/rad: 4.8 N mm/deg, table 4.1."""
RUBBER = ((0.0, 2.5, 5.0, 10.0, 25.0, 50.0, 100.0, 150.0, 200.0),
          (0.0, 1.358e-5, 2.364e-5, 4.039e-5, 7.926e-5, 1.283e-4, 2.029e-4, 2.628e-4, 3.147e-4))  # fmt: skip
"""Line load [N/m] and approach [m] of the source's finger and a flat: the elastic layer of `sioms.plant.skin`."""
FRICTION = ((0.0, 1 / 12.7e-3, 1 / 2.5e-3, 1 / 0.3e-3), (3.4, 2.0, 2.0, 1.4))
"""1/R [1/m] and coefficient of the source's rubber: table 4.2."""
OF_BOTH = ("link_m", "mount_rad", "joint_stiffness", "drive_stiffness")
CURVES = {"rubber_load": "rubber_m", "friction_bend": "friction"}
KEYS = ("name", "finger_m", "contact_m", "pitch_rad", "carriage_stiffness", *OF_BOTH, *CURVES, *CURVES.values())


@dataclass(frozen=True, slots=True)
class Noise:
    """What the numbers of a recorded grasp scatter by, standard deviations; immutable.

    Attributes:
        place_rad: of a place; load_share, load_n: of a load, of its own size and [N]; joint_m, joint_rad: of encoders.
        wrist_n: of a wrist's force; platen_n: force of the platen on the object [N].
        friction_share: of a coefficient of friction, of its own size.
    """

    place_rad: float = 3.3e-3
    load_share: float = 0.02
    load_n: float = 0.01
    joint_m: float = 1e-5
    joint_rad: float = 3e-5
    wrist_n: float = 0.02
    platen_n: float = 0.1
    friction_share: float = 0.05


NOISES = tuple(f.name for f in fields(Noise))


def from_table(table: Mapping[str, Any], where: str) -> tuple[SensorModel, Noise]:
    """Build a model from the tables [hand], [noise] and [effects.*]; return it with the noise of its records.

    Raises:
        BadInputError: a key is unknown or makes no sense.
    """
    if "hand" not in table:
        raise BadInputError(f"read model {where}: has no table hand; got {', '.join(sorted(table)) or 'nothing'}")
    only(table, ("hand", "noise", "effects"), f"read model {where}")
    t = table_in(table, "hand", f"read model {where}")
    only(t, KEYS, f"read model {where}, [hand]")
    said = table_in(table, "noise", f"read model {where}", needed=False)
    only(said, NOISES, f"read model {where}, [noise]")
    noise = Noise(**{k: float(_positive(said, k, where, 0.0, None)[0]) for k in said})
    model = SensorModel(_belief(t, where), 1, library(), {}, (), str(t.get("name", "hand")))
    return effects_from(model, table, where), noise


def _belief(t: Mapping[str, Any], where: str) -> HandBelief:
    curves = [
        _curve(t, *keys, default, where) for keys, default in zip(CURVES.items(), (RUBBER, FRICTION), strict=True)
    ]
    return HandBelief(
        link=_positive(t, "link_m", where, LINK_M, 2),
        finger=float(_positive(t, "finger_m", where, FINGER_M)[0]),
        mount=_numbers(t, "mount_rad", where, 0.0, 2),
        carriage=np.repeat(_positive(t, "carriage_stiffness", where, math.inf), 2),
        joint=_positive(t, "joint_stiffness", where, math.inf, 2),
        drive=_positive(t, "drive_stiffness", where, DRIVE, 2),
        gain=np.zeros(2),
        soft_load=curves[0][0],
        soft=curves[0][1],
        length=float(_positive(t, "contact_m", where, CONTACT_M)[0]),
        pitch=float(_positive(t, "pitch_rad", where, PITCH_RAD)[0]),
        bend=curves[1][0],
        coefficient=curves[1][1],
    )


def _numbers(t: Mapping[str, Any], key: str, where: str, default: float, count: int | None) -> Floats:
    """Read a number, or a list of so many."""
    try:
        out = np.atleast_1d(np.asarray(t.get(key, default), dtype=np.float64))
    except (TypeError, ValueError) as e:
        raise BadInputError(f"read model {where}: {key} is {t[key]!r}; needs a number or a list of numbers") from e
    need = count or 1
    if out.size == 1:
        out = np.full(need, out.flat[0])
    if out.shape != (need,) or np.isnan(out).any():
        raise BadInputError(f"read model {where}: {key} is {t[key]!r}; needs {need} numbers, or one")
    return out


def _positive(t: Mapping[str, Any], key: str, where: str, default: float, count: int | None = None) -> Floats:
    out = _numbers(t, key, where, default, count)
    endless = key.endswith("_stiffness")
    if not (np.all(out > 0.0) or (key in NOISES and np.all(out >= 0.0))) or not (endless or np.isfinite(out).all()):
        raise BadInputError(
            f"read model {where}: {key} is {t.get(key)!r}; needs more than 0" + ("" if endless else ", finite")
        )
    return out


def _curve(t: Mapping[str, Any], over: str, of: str, default: tuple[Any, Any], where: str) -> tuple[Floats, Floats]:
    """Read a curve: what it is over rises from 0."""
    if (over in t) != (of in t):
        raise BadInputError(f"read model {where}: {over} and {of} come together or not at all")
    try:
        x, y = (np.asarray(v, dtype=np.float64) for v in ((t[over], t[of]) if over in t else default))
    except (TypeError, ValueError) as e:
        raise BadInputError(f"read model {where}: {over} or {of} holds what is no number") from e
    if x.ndim != 1 or x.shape != y.shape or len(x) < 2 or not np.isfinite([x, y]).all() or np.any(np.diff(x) <= 0.0):
        raise BadInputError(f"read model {where}: {over} and {of} need two numbers or more each, {over} rising")
    if x[0] != 0.0 or (of == "friction" and np.any(y <= 0.0)) or (of == "rubber_m" and np.any(np.diff(y) <= 0.0)):
        raise BadInputError(
            f"read model {where}: {over} begins at 0; {of} is above 0, for rubber it begins at 0 and rises"
        )
    return x, y


def to_toml(model: SensorModel, noise: Noise | None = None) -> str:
    """Write a model: nominal hand, noise and effects."""
    b: HandBelief = model.base
    said = noise or Noise()
    table = {
        "link_m": b.link, "mount_rad": b.mount, "finger_m": b.finger, "contact_m": b.length,
        "pitch_rad": b.pitch,
        "joint_stiffness": b.joint, "carriage_stiffness": b.carriage[:1], "drive_stiffness": b.drive,
        "rubber_load": b.soft_load, "rubber_m": b.soft, "friction_bend": b.bend, "friction": b.coefficient,
    }  # fmt: skip
    lines = ["[hand]", f'name = "{model.name}"']
    lines += [f"{key} = {number_or_list(np.atleast_1d(np.asarray(value)))}" for key, value in table.items()]
    lines += ["", "[noise]", *(f"{key} = {getattr(said, key)!r}" for key in NOISES)]
    return "\n".join(lines) + "\n" + effects_to_toml(model)
