"""What the simulation believes about a finger and its rig, and the outputs that follow.

Chain: place and load of a touch, tractions (``pressures``), strain at the elements by the layer's response, linear
output ``-strain / gain``, quadratic, creep, then responses that effects add. Outputs are fractions of the untouched
output, compression positive.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from sioms.reconcile.finger import pressures
from sioms.reconcile.finger.pressures import WAVES, Complex, Floats
from sioms.tactile.cylinder import Cylinder, respond

#: Poisson's ratios about the nominal one at which contacts are solved; between them series follow a parabola.
_POISSON = (-0.07, 0.0, 0.035)
_CORE = (-5e-4, 0.0, 5e-4)  # of the core likewise [m]
_BELOW = (-0.08, -0.04, 0.0)  # where the nominal one is close to 1/2
#: ``response(output, scene, parameters)`` returns the changed output, shape (touches, elements).
Response = Callable[[Floats, "Scene", Floats], Floats]


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Touches as commanded; immutable.

    Attributes:
        place: commanded middle of contact [rad], shape (nt,).
        load: P [N/m], shape (nt,).
        radius: indenter radius [m], 0 an edge, infinite a flat, shape (nt,).
        time, temperature: of each touch [s, deg C] less the mean of all, zero where not known, shape (nt,).
        since: time since the load came on, of ``parts`` parts of each touch [s], shape (nt, parts).
        distance: angle of every element less the place as believed [rad], shape (nt, ns); filled in by ``outputs``.
    """

    place: Floats
    load: Floats
    radius: Floats
    since: Floats
    time: Floats
    temperature: Floats
    distance: Floats | None = None


def scene_of(place: Floats, load: Floats, radius: Floats) -> Scene:
    """Return touches of which nothing else is known."""
    nothing = np.zeros(len(place))
    return Scene(place, load, radius, np.full((len(place), 1), np.inf), nothing, nothing)


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """The finger and its rig as the simulation has them; immutable.

    Attributes:
        core, outer, shear: radii [m] and shear modulus [Pa]; poisson: Poisson's ratio.
        angle, radius, gain: of the elements [rad, m, strain per output], shape (ns,).
        blur: square of the half angle that an element averages over [rad^2]: outputs change in proportion to it, from 0
            on.
        quadratic: per element [1/output], shape (ns,).
        offset: angle by which every touch is further on than commanded [rad].
        hertz, adhesion: shares of Hertz's widths and of full adhesion.
        friction: coefficient, positive where the indenter drags towards larger angles.
        apex: share of the apex's shift under sliding (0: the commanded place is the middle of contact).
        around, about: Poisson's ratio and core [m] about which contacts are solved, 0 for the body's own.
        strip: half widths of contact vary by amplitude [1] and phase [rad] over a period of the place [rad].
        uneven: the linear output varies by amplitude [1] and phase [rad] over a period of the place [rad].
        soft: share by which what a load does goes beyond it: strains depend on the load over the stiffness.
        peak: the linear output is greater by amplitude [1] right under the touch, falling off as a Gaussian of a width
            [rad].
        creep, creep_time: share of a step that comes late, and its time constant [s].
        cell: relative error of the load cell.
        temperature: drift of the output [1/K], shape (ns,); common: the part of it that all elements have.
        responses: further changes of the output with their parameters, in order.
    """

    core: float
    outer: float
    shear: float
    poisson: float
    angle: Floats
    radius: Floats
    gain: Floats
    quadratic: Floats
    temperature: Floats
    common: float = 0.0
    blur: float = 0.0
    offset: float = 0.0
    hertz: float = 0.0
    adhesion: float = 0.0
    friction: float = 0.0
    apex: float = 0.0
    around: float = 0.0
    about: float = 0.0
    strip: tuple[float, float, float] = (0.0, 0.0, 1.0)
    uneven: tuple[float, float, float] = (0.0, 0.0, 1.0)
    soft: float = 0.0
    peak: tuple[float, float] = (0.0, 1.0)
    creep: float = 0.0
    creep_time: float = 1.0
    cell: float = 0.0
    responses: tuple[tuple[Response, Floats], ...] = ()

    @property
    def extent(self) -> float:
        """Half angle that an element averages over [rad]."""
        return float(np.sqrt(self.blur))

    def responding(self, response: Response, parameters: Floats) -> Belief:
        """Return the belief with one more response."""
        return replace(self, responses=(*self.responses, (response, parameters)))


@lru_cache(maxsize=64)
def _factors(body: Cylinder, radii: tuple[float, ...]) -> tuple[Floats, Floats]:
    """Return e_rr per p and per q of elements at some radii, shape (ns, waves)."""
    h = respond(body, WAVES, np.array(radii)).e_rr
    return h[:, :, 0].T, h[:, :, 1].T


@dataclass(frozen=True, slots=True)
class _Contact:
    """The part of a belief that tractions depend on; a key to remember them by."""

    core: float
    outer: float
    shear: float
    poisson: float
    hertz: float
    adhesion: float
    friction: float
    apex: float
    around: float
    about: float
    strip: tuple[float, float, float]
    soft: float

    @property
    def body(self) -> Cylinder:
        return Cylinder(self.core, self.outer, self.poisson, self.shear)


@lru_cache(maxsize=24)
def _tractions(c: _Contact, scene: Scene) -> tuple[Complex, Complex]:
    """Return p and q of every touch per unit load at the believed Poisson's ratio."""
    middle, stated = c.around or c.poisson, c.about or c.core
    ratios = _parabola(c.poisson, [middle + d for d in (_POISSON if middle + _POISSON[2] < 0.5 else _BELOW)])
    cores = _parabola(c.core, [stated + d for d in _CORE])
    p = q = np.zeros((len(scene.place), len(WAVES)), dtype=np.complex128)
    for poisson, by_ratio in ratios.items():
        for core, by_core in cores.items():
            own = _tractions_at(replace(c, poisson=poisson, core=core), scene)
            p, q = p + by_ratio * by_core * own[0], q + by_ratio * by_core * own[1]
    return p, q


def _parabola(at: float, nodes: list[float]) -> dict[float, float]:
    """Return the nodes that a parabola at a place needs, with their weights."""
    if min(abs(v - at) for v in nodes) < 1e-9:
        return {at: 1.0}
    return {v: float(np.prod([(at - o) / (v - o) for o in nodes if o != v])) for v in nodes}


def _tractions_at(c: _Contact, scene: Scene) -> tuple[Complex, Complex]:
    body, edge = c.body, scene.radius == 0.0
    p = np.empty((len(scene.place), len(WAVES)), dtype=np.complex128)
    q = np.zeros_like(p)
    half = np.empty(len(scene.place))
    load = scene.load * (1.0 + c.soft)
    argument = np.where(edge, load, load / (1.0 / c.outer + 1.0 / np.where(edge, 1.0, scene.radius)))
    depth, phase, period = c.strip
    if depth:
        wider = 1.0 + depth * np.sin(2.0 * np.pi * scene.place / period + phase)
        argument = argument * np.where(edge, wider, wider**2)
    for sharp in (True, False):
        mine = edge == sharp
        if not mine.any():
            continue
        table, at = pressures.sheet(body, sharp), argument[mine]
        p[mine], half[mine] = table.series(at)[0], table.width(at)
        if c.hertz and not sharp:
            p[mine] += c.hertz * (pressures.hertz(body).series(at)[0] - p[mine])
        if c.friction:
            q[mine] = c.friction * p[mine]
            if c.apex:
                p[mine], q[mine] = _shifted(c, sharp, at, p[mine])
    if c.adhesion:
        q += c.adhesion * pressures.stuck(body)(half)
    return p, q


def _shifted(c: _Contact, sharp: bool, at: Floats, still: Complex) -> tuple[Complex, Complex]:
    """Add the share ``apex`` of the shift that sliding makes: mirror images at f and -f, a parabola in f."""
    ahead = pressures.sheet(c.body, sharp, pressures.SLIDING).series(at)[0]
    odd, even = 0.5 * (ahead - ahead.conj()), 0.5 * (ahead + ahead.conj()) - still
    ratio = c.friction / pressures.SLIDING
    p = still + c.apex * (ratio * odd + ratio**2 * even)
    return p, c.friction * p


@lru_cache(maxsize=12)
def _turn(scene: Scene) -> Complex:
    """Return load and place of every touch as factors of its series."""
    out: Complex = scene.load[:, None] * np.exp(1j * WAVES * scene.place[:, None])
    return out


def strains(b: Belief, scene: Scene) -> Floats:
    """Return the strain of every element under every touch, shape (nt, ns)."""
    # what acts on nothing is left out of the key
    apex, strip = b.apex if b.friction else 0.0, b.strip if b.strip[0] else (0.0, 0.0, 1.0)
    body = b.core, b.outer, b.shear, b.poisson
    contact = _Contact(*body, b.hertz, b.adhesion, b.friction, apex, b.around, b.about, strip, b.soft)
    return _strains(contact, scene, b.angle.tobytes(), tuple(np.round(b.radius, 10)), b.extent, b.offset)


@lru_cache(maxsize=48)
def _strains(
    c: _Contact, scene: Scene, angles: bytes, radii: tuple[float, ...], extent: float, offset: float
) -> Floats:
    p, q = _tractions(c, scene)
    by_p, by_q = _factors(c.body, radii)
    turn = _turn(scene)
    here = np.exp(-1j * WAVES * (np.frombuffer(angles) - offset)[:, None]) * np.sinc(WAVES * extent / np.pi)
    full = (p * turn) @ (by_p * here).T
    if c.friction or c.adhesion:
        full += (1j * q * turn) @ (by_q * here).T
    out: Floats = full.real * (1.0 + c.soft)
    out.setflags(write=False)
    return out


def outputs(b: Belief, scene: Scene) -> Floats:
    """Return the output of every element under every touch, without creep, shape (nt, ns)."""
    away = b.angle - (scene.place + b.offset)[:, None]
    seen = replace(scene, distance=away)
    linear = -strains(b, scene) / b.gain
    if b.peak[0]:
        linear = linear * (1.0 + b.peak[0] * np.exp(-((away / b.peak[1]) ** 2)))
    amplitude, phase, period = b.uneven
    if amplitude:
        linear = linear * (1.0 + amplitude * np.sin(2.0 * np.pi * scene.place / period + phase))[:, None]
    out: Floats = linear + b.quadratic * linear**2
    for response, parameters in b.responses:
        out = response(out, seen, parameters)
    return out


def late(b: Belief, since: Floats) -> Floats:
    """Return the share of a step that has come [1] some time [s] after it."""
    out: Floats = 1.0 - b.creep * np.exp(-np.maximum(since, 0.0) / b.creep_time)
    return out
