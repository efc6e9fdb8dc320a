"""What would make up for a drift: the corrected twin, and gains with which the axis follows as it did.

Nothing is applied here. Gains change by so much as keeps a margin of stability, which is told; a drift of the
mechanics that gains cannot mend (play, place, scale) has its own key.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sioms.reconcile.model import AxisModel

from .axis import About, Drift
from .causes import OF_REFERENCE
from .moves import Array
from .normal import Normal
from .rows import CONSTANT, DRY, GAP, MASS, VISCOUS

#: The least distance of the open loop from -1: a gain margin of 2 and a phase margin of 29 degrees.
MARGIN = 0.5
#: What margin there was is not lowered by more than this.
KEEPS = 0.9
#: Gains change by these factors at most.
LEAST, MOST = 0.4, 5.0
#: A take-up is longer than the play by this factor.
TAKE_UP = 1.3


@dataclass(frozen=True, slots=True)
class Gains:
    """Gains of the law u = k (e + kz e1) - kp u1 + kb v, and a constant force beside."""

    k: float
    kz: float
    kp: float
    kb: float

    def scaled(self, stiffness: float, damping: float) -> Gains:
        """Return gains with another stiffness and another damping, as factors."""
        lead = -self.k * self.kz * damping
        k = self.k * (1.0 + self.kz) * stiffness + lead
        return Gains(k, -lead / k, self.kp, self.kb * damping)


@dataclass(frozen=True, slots=True)
class Proposal:
    """What would make up for a drift.

    Attributes:
        gains, before: None where gains do not change it.
        margin, margin_before: distance of the open loop from -1; expected: following error against the normal one,
            without and with the gains.
        offset: constant force to add [N or N m].
        keys: lines of the axis's table in the configuration.
        todo: sentences for who looks after the machine.
    """

    before: Gains | None
    gains: Gains | None
    margin_before: float
    margin: float
    expected_before: float
    expected: float
    offset: float
    keys: tuple[str, ...]
    todo: tuple[str, ...]


def margin(gains: Gains, mass: float, viscous: float, tick_s: float) -> float:
    """Return the distance of the open loop from -1 where the closed loop is stable, else 0.

    Of a mass with viscous friction under a force that is held over a tick, and a velocity from one difference.
    """
    b = max(viscous, 1e-4 * mass / tick_s)
    decay = np.exp(-b * tick_s / mass)
    # x(z)/u(z) of the held plant
    first = tick_s / b - mass / b**2 * (1 - decay)
    num = np.array([0.0, first, mass / b**2 * (1 - decay) ** 2 - decay * first])
    den = np.array([1.0, -(1.0 + decay), decay])
    law = np.array([gains.k - gains.kb / tick_s, gains.k * gains.kz + gains.kb / tick_s])
    open_num, open_den = np.polymul(law, num), np.polymul(np.array([1.0, gains.kp]), den)
    if np.any(np.abs(np.roots(np.polyadd(open_den, open_num))) >= 1.0):
        return 0.0
    z = np.exp(1j * np.geomspace(1e-3, np.pi, 800))
    return float(np.min(np.abs(1.0 + np.polyval(open_num, z) / np.polyval(open_den, z))))


def propose(about: About, normal: Normal, drift: Drift, gram: Array, gains: Gains | None) -> Proposal:
    """Return what would make up for a drift.

    Args:
        gram: sums of squares of the latest blocks, of what the axis is used for.
        gains: of now.
    """
    was, now = normal.theta, normal.theta + drift.finding.change
    needed = _needed(was, now, gram)
    known = [drift.name] if drift.name else list(drift.names)
    of_force = not known or any(name not in ("place", "scale", "backlash", *OF_REFERENCE) for name in known)
    before = after = 0.0
    fresh = None
    r = 1.0
    if gains is not None and of_force and np.isfinite([gains.k, gains.kz, gains.kp, gains.kb]).all() and gains.k > 0.0:
        mass, viscous = max(now[MASS], 0.05 * was[MASS]), max(now[VISCOUS], 0.0)
        before = margin(gains, mass, viscous, about.tick_s)
        least = min(MARGIN, KEEPS * margin(gains, max(was[MASS], 1e-12), max(was[VISCOUS], 0.0), about.tick_s))
        heavier = mass / max(was[MASS], 1e-12)
        for r in np.geomspace(min(max(needed, LEAST), MOST), 1.0, 25).tolist():
            fresh = gains.scaled(r, float(np.sqrt(r * heavier)))
            after = margin(fresh, mass, viscous, about.tick_s)
            if after >= least:
                break
        else:
            fresh, r = None, 1.0
    offset = float(now[CONSTANT] - was[CONSTANT]) if drift.name == "constant force" else 0.0
    keys, todo = _said(about, drift, fresh, offset)
    return Proposal(
        gains if fresh is not None else None, fresh, before, after, needed, needed / r if fresh is not None else needed,
        offset, keys, todo,
    )  # fmt: skip


def _needed(was: Array, now: Array, gram: Array) -> float:
    """Return how much more force the moves need than they did."""
    at = [MASS, VISCOUS, DRY]
    g = gram[np.ix_(at, at)]
    before, after = (float(theta[at] @ g @ theta[at]) for theta in (was, now))
    return float(np.sqrt(max(after, 1e-300) / max(before, 1e-300)))


def _said(about: About, drift: Drift, gains: Gains | None, offset: float) -> tuple[tuple[str, ...], tuple[str, ...]]:
    f, keys, todo = drift.finding, [], []
    if gains is not None:
        keys += [f"{name} = {getattr(gains, name):.6g}" for name in ("k", "kz", "kp", "kb")]
    if offset:
        keys.append(f"force_offset = {offset:.4g}  # to be added to the present one")
    match drift.name:
        case "backlash":
            keys.append(f"backlash = {{ distance = {TAKE_UP * max(f.high, f.size):.3g} }}")
            todo.append("adjust or replace what joins motor and load; until then point moves may take up the play")
        case "place":
            todo.append(
                f"tension the belt or tighten the coupling, then home: it is off by {f.size:+.4g} {about.unit('{x}')}"
            )
        case "scale":
            todo.append(
                f"look at pulleys, couplings and encoder; else divide the travel per turn by {1.0 + f.size:.6f}"
            )
        case "dry friction" | "viscous friction" | "friction":
            todo.append("clean and lubricate; look at bearings and guides")
        case "lower force":
            todo.append("look at supply, phases, magnets and the drive's current limit")
        case "late reference" | "reference hysteresis":
            todo.append("look at the reference: its sensor and target, filters of the input, how often it is read")
        case "mass":
            todo.append("look at what is mounted; enter its mass in the model")
        case _:
            todo.append("look at the axis before gains are changed: the cause is open")
    return tuple(keys), tuple(todo)


def corrected(model: AxisModel | None, about: About, normal: Normal, drift: Drift | None) -> AxisModel:
    """Return the twin as the axis is now; without a model file one of mass, viscous and dry friction."""
    theta = normal.theta + (drift.finding.change if drift is not None else 0.0)
    base = model or AxisModel(
        about.rotary, about.tick_s, 1.0, 0.0, about.step, max(about.travel / 10.0, 1e-9), normal.force, about.speed,
        name=about.name,
    )  # fmt: skip
    gone = base
    for name in ("payload", "viscous", "offset"):
        gone = gone.without_effect(name)
    out = replace(gone, inertia=max(float(theta[MASS]), 1e-9), viscous=max(float(theta[VISCOUS]), 0.0))
    if not any(name in out.effects for name in ("stribeck", "presliding", "lugre", "coulomb_position")):
        out = out.with_effect("coulomb", {"Fc": max(float(theta[DRY]), 0.0)})
    out = out.with_effect("offset", {"off": -float(theta[CONSTANT])})
    if drift is not None and drift.name == "backlash":
        behind = float(np.clip(np.max(theta[GAP : GAP + 3]) / max(theta[MASS], 1e-12), 0.1, 0.9))
        out = out.with_effect(
            "backlash", {"gap": drift.finding.size, "load_fraction": behind, "f_contact": 120.0, "zeta": 0.3}
        )
    return out
