"""Hands with hidden effects: drawn, closed on objects in static equilibrium, and read. Nothing is shared with the
solver.

A grasp is built from the object outwards, in complex numbers: contacts, the force through both, what it bends, and only
then what encoders, fingers and wrists would say. The rubber is a power law, not the solver's table; places have the
error of an array of elements 9.2 degrees apart; the platen holds the object with a force that nothing tells.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

OF_FINGERS = ("link_length", "mounting_angle", "joint_stiffness", "drive_stiffness", "load_gain")
NAMED = (*(f"{name}_{finger}" for name in OF_FINGERS for finger in (1, 2)), "friction_level", "friction_load")
NAMELESS = ("finger_radius", "play", "place_scale", "hardening", "wandering")
SPRINGS = tuple(f"{name}_{finger}" for name in ("joint_stiffness", "drive_stiffness") for finger in (1, 2))
CONFOUNDED = ("one_load", "springs")
_SYMBOLS = {
    "link_length": "dl", "mounting_angle": "beta", "joint_stiffness": "share", "drive_stiffness": "share",
    "load_gain": "g", "friction_level": "share", "friction_load": "m",
}  # fmt: skip
PRIMARY = {name: _SYMBOLS[name.rstrip("_12")] for name in NAMED}
"""The parameter that says how large an effect is."""

LINK, RADIUS, LENGTH = 0.140, 0.0127, 0.020
JOINT, CARRIAGE, DRIVE = 3.0, 25e3, 0.303
TABLE = ((0.0, 3.4), (1.0 / 0.0127, 2.0), (1.0 / 0.0025, 2.0), (1.0 / 0.0003, 1.4))
DISKS, BARS, LOADS = (0.011, 0.018, 0.030), (0.016, 0.036), (0.4, 1.0, 2.2)
GRASPS, SLIPS = 60, 50
COLUMNS = (
    "time", "grasp", "kind", "thing", "size", *(f"{what}{n}" for n in (1, 2) for what in ("cmd_x", "cmd_y", "cmd_th")),
    *(f"{what}{n}" for n in (1, 2) for what in ("x", "y", "th")), "place1", "place2", "load1", "load2", "fx1", "fy1",
    "fx2", "fy2", "slip",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class HiddenHand:
    """One hand and what it hides.

    Attributes:
        excitation: full; straight, all links across the line of contacts of one disk, without slips; or one_load.
        wrist: whether wrists are read.
        rival: effects that look like the hidden ones, joined by " + ".
    """

    name: str
    kind: str
    excitation: str = "full"
    wrist: bool = True
    named: dict[str, dict[str, float]] = field(default_factory=dict)
    nameless: dict[str, dict[str, float]] = field(default_factory=dict)
    rival: str = ""

    def public(self) -> str:
        """Return what the solver may know: a model file."""
        return (
            f'[hand]\nname = "{self.name}"\njoint_stiffness = {JOINT}\ncarriage_stiffness = {CARRIAGE}\n'
            f"drive_stiffness = {DRIVE}\n"
        )

    def number(self, effect: str, symbol: str) -> float:
        """Return a hidden number, 0 where it is not hidden."""
        return self.named.get(effect, {}).get(symbol, 0.0)


def draw_hand(name: str, kind: str, rng: np.random.Generator, only: str = "") -> HiddenHand:
    """Draw one hand of a kind; ``only`` asks for a certain effect or excitation."""
    named: dict[str, dict[str, float]] = {}
    nameless: dict[str, dict[str, float]] = {}
    rival, excitation, wrist = "", "full", bool(rng.random() < 0.6)
    if kind == "single":
        pick = only or str(rng.choice(NAMED))
        named[pick] = _effect(pick, rng)
    elif kind == "multi":
        for pick in rng.choice(NAMED, 2, replace=False):
            named[str(pick)] = _effect(str(pick), rng)
    elif kind == "confounded":
        if (only or str(rng.choice(CONFOUNDED))) == "one_load":
            excitation, wrist = "one_load", True
            pick, rival = (
                ("friction_level", "friction_load") if rng.random() < 0.5 else ("friction_load", "friction_level")
            )
            named[pick] = _effect(pick, rng)
        else:  # all springs by one factor, and nothing tells the loads
            softer = {"share": -float(rng.uniform(0.15, 0.25))}
            named, rival, wrist = dict.fromkeys(SPRINGS, softer), "load_gain_1 + load_gain_2", False
    elif kind == "unknown":
        pick = only or str(rng.choice(NAMELESS))
        nameless[pick] = _nameless(pick, rng)
    if any(n.startswith("load_gain") for n in named):
        wrist = True
    return HiddenHand(name, kind, excitation, wrist, named, nameless, rival)


def _effect(name: str, rng: np.random.Generator) -> dict[str, float]:
    sign = float(rng.choice([-1.0, 1.0]))
    match name.rstrip("_12"):
        case "link_length":
            return {"dl": sign * float(rng.uniform(1e-3, 3e-3))}
        case "mounting_angle":
            return {"beta": sign * float(np.radians(rng.uniform(1.0, 2.5)))}
        case "joint_stiffness" | "drive_stiffness":
            return {"share": float(rng.choice([-1.0, 1.3])) * float(rng.uniform(0.15, 0.3))}
        case "load_gain":
            return {"g": sign * float(rng.uniform(0.1, 0.25))}
        case "friction_level":
            return {"share": sign * float(rng.uniform(0.1, 0.25))}
        case _:
            return {"m": sign * float(rng.uniform(0.1, 0.3))}


def _nameless(name: str, rng: np.random.Generator) -> dict[str, float]:
    sign, finger = float(rng.choice([-1.0, 1.0])), float(rng.integers(2))
    size = {
        "finger_radius": sign * float(rng.uniform(0.6e-3, 1.2e-3)), "play": float(rng.uniform(0.02, 0.04)),
        "place_scale": sign * float(rng.uniform(0.05, 0.1)), "hardening": sign * float(rng.uniform(0.3, 0.8)),
        "wandering": sign * float(rng.uniform(1.5e-3, 4e-3)),
    }[name]  # fmt: skip
    return {"size": size, "finger": finger}


def record(h: HiddenHand, rng: np.random.Generator) -> dict[str, Array]:
    """Close the hand on objects and read; columns in m, rad, N and s."""
    session = _Session(h, rng)
    rows: list[list[float]] = []
    for grasp in range(GRASPS):
        setting = session.setting(grasp)
        rows += [session.row(grasp, *setting, load, 0) for load in LOADS]
    for slip in range(SLIPS if h.excitation != "straight" else 0):
        load = 1.5 if h.excitation == "one_load" else float(np.exp(rng.uniform(np.log(0.2), np.log(1.8))))
        rows.append(session.slip(GRASPS + slip, load))
    table = np.array(rows)
    return {name: table[:, i] for i, name in enumerate(COLUMNS)}


class _Session:
    """One session of one hand: its homing, its platen, its clock."""

    def __init__(self, h: HiddenHand, rng: np.random.Generator) -> None:
        self.h, self.rng, self.time = h, rng, 0.0
        self.home = rng.normal(0.0, 2e-4, 4) @ np.array([[1, 0], [1j, 0], [0, 1], [0, 1j]])
        self.zero, self.told = rng.normal(0.0, 2e-3, 2), rng.normal(0.0, 2e-3, 2)
        self.wave = rng.uniform(0.0, 2.0 * np.pi, 2)

    def setting(self, grasp: int) -> tuple[int, int, float, float, Array, Array]:
        """Return kind, number and size of the object, psi, the shares of its contacts' angles and the places."""
        rng = self.rng
        if self.h.excitation == "straight":
            return 1, 0, 0.02, float(rng.uniform(-1.2, 1.2)), np.zeros(2), np.full(2, 0.5 * np.pi)
        at = grasp % 5
        kind, size = (1, DISKS[at]) if at < 3 else (2, BARS[at - 3])
        return kind, at, size, float(rng.uniform(-1.2, 1.2)), rng.uniform(-0.3, 0.3, 2), rng.uniform(0.85, 2.2, 2)

    def slip(self, grasp: int, load: float) -> list[float]:
        """Return the row in which a finger begins to slide under a normal force."""
        rng, number = self.rng, int(self.rng.integers(1, 3))
        kind, at, size = (1, 2, DISKS[2]) if grasp % 2 else (2, 4, BARS[1])
        bend = 1.0 / RADIUS + (1.0 / size if kind == 1 else 0.0)
        mu = float(np.interp(bend, [b for b, _ in TABLE], [c for _, c in TABLE])) * (
            1.0 + self.h.number("friction_level", "share")
        )
        mu *= load ** self.h.number("friction_load", "m") * np.exp(rng.normal(0.0, 0.04))
        eta = float(rng.choice([-1.0, 1.0])) * np.arctan(mu)
        shares = np.array([-eta, eta]) if kind == 1 else np.array([eta, eta])
        force = load / np.cos(eta)
        return self.row(
            grasp, kind, at, size, float(rng.uniform(-1.0, 1.0)), shares, rng.uniform(1.1, 1.9, 2), force, number
        )

    def row(
        self, grasp: int, kind: int, thing: int, size: float, psi: float, shares: Array, place: Array, force: float,
        slip: int,
    ) -> list[float]:  # fmt: skip
        """Return one row; ``shares``: angles by which the contacts' normals lie off the line through both."""
        h, rng = self.h, self.rng
        self.time += float(rng.uniform(5.0, 15.0))
        out = [np.exp(1j * (psi + np.pi)), np.exp(1j * psi)]  # from the object to each finger, along the line
        if kind == 1:
            normals = [out[0] * np.exp(1j * shares[0]), out[1] * np.exp(1j * shares[1])]
            contacts = [size * n for n in normals]
        else:
            normals = [out[0] * np.exp(1j * shares[0]), out[1] * np.exp(1j * shares[0])]
            tilt = 1j * out[1] * np.exp(1j * shares[0])
            contacts = [
                0.5 * size * n - s * 0.5 * size * np.tan(shares[0]) * tilt
                for n, s in zip(normals, (-1, 1), strict=True)
            ]
        line = contacts[1] - contacts[0]
        line /= abs(line)
        platen = 0.04 * (rng.normal() + 1j * rng.normal())
        loads = [-force * line, force * line]
        loads[0 if slip == 2 else 1] -= platen  # a finger that slides bears just what its friction does
        cells = [
            self._finger(i, contacts[i], normals[i], loads[i], float(place[i]), size if kind == 1 else np.inf)
            for i in (0, 1)
        ]
        commands, joints = [c[0] for c in cells], [c[1] for c in cells]
        wrists = [(c[4].real, c[4].imag) if h.wrist else (np.nan, np.nan) for c in cells]
        return [
            self.time, float(grasp), float(kind), float(thing), size, *commands[0], *commands[1], *joints[0],
            *joints[1],
            cells[0][2], cells[1][2], cells[0][3], cells[1][3], *wrists[0], *wrists[1], float(slip),
        ]  # fmt: skip

    def _finger(
        self, i: int, contact: complex, normal: complex, load: complex, place: float, size: float
    ) -> tuple[list[float], list[float], float, float, complex]:
        """Return command, encoders, place, load and wrist of a finger that a contact presses with a force."""
        h, rng, n = self.h, self.rng, f"_{i + 1}"
        press = float((load * np.conj(normal)).real)
        odd = {k: v["size"] if int(v["finger"]) == i else 0.0 for k, v in h.nameless.items()}
        bend = 1.0 / RADIUS + 1.0 / size
        give = 1.25e-4 * (max(press, 0.0) / LENGTH / 50.0) ** 0.64 * (bend * RADIUS) ** 0.32
        centre = contact + (RADIUS + odd.get("finger_radius", 0.0) - give) * normal
        turn = float(np.angle(-normal)) - place  # of the link: the contact is seen at this place
        root = centre - (LINK + h.number(f"link_length{n}", "dl")) * np.exp(1j * turn)
        torque = float((np.conj(contact - root) * load).imag)
        joint = JOINT * (1.0 + h.number(f"joint_stiffness{n}", "share"))
        bent = torque / joint + odd.get("play", 0.0) * np.tanh(torque / 0.05)
        bent += odd.get("hardening", 0.0) * torque * abs(torque)
        encoder = turn - bent + self.zero[i]
        drive = DRIVE * (1.0 + h.number(f"drive_stiffness{n}", "share"))
        told = encoder - torque / drive + self.told[i]
        at = root - load / CARRIAGE + self.home[i] + odd.get("wandering", 0.0) * self.time / 2000.0
        felt = place - h.number(f"mounting_angle{n}", "beta")
        felt += odd.get("place_scale", 0.0) * (felt - 0.5 * np.pi)
        felt += 2.2e-3 * np.sin(39.05 * felt + self.wave[i]) + rng.normal(0.0, 2e-3)
        tells = press * (1.0 + h.number(f"load_gain{n}", "g")) * (1.0 + rng.normal(0.0, 0.015)) + rng.normal(0.0, 5e-3)
        wrist = load + 0.01 * (rng.normal() + 1j * rng.normal())
        x, y, th = _stepped(at.real, 3e-5), _stepped(at.imag, 3e-5), _stepped(encoder, np.radians(6e-3))
        return [x, y, told], [x, y, th], felt, tells, wrist


def _stepped(value: float, step: float) -> float:
    return float(np.round(value / step) * step)
