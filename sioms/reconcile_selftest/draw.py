"""Draw axes, hidden effects and controllers at random. All numbers SI; a draw is reproducible by its seed.

What is drawn is run before it is taken: the loop must hold, and a drive that saturates do so in some of the samples,
    not in most.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sioms.reconcile_selftest.axis import Axis, Numbers, Servo
from sioms.reconcile_selftest.commands import REACH, commands
from sioms.reconcile_selftest.near import BESIDE as BESIDE_NEAR
from sioms.reconcile_selftest.near import NEAR, draw_near
from sioms.reconcile_selftest.world import World

#: What may be confounded with what under which poor excitation, or for want of which channel.
CONFOUNDED = {
    "cruise": ("coulomb", "viscous"),
    "oneway": ("coulomb", "offset"),
    "small": ("gravity", "offset"),
    "no_marks": ("payload", "encoder_scale"),
    "no_current": ("delay", "lag"),
}
NAMED = (
    "viscous",
    "viscous_direction",
    "quadratic_drag",
    "coulomb",
    "coulomb_position",
    "stribeck",
    "presliding",
    "lugre",
    "friction_variation",
    "load_friction",
    "power_drag",
    "quadratic_direction",
    "load_square_friction",
    "warming_friction",
    "backlash",
    "elastic",
    "swinging_load",
    "payload",
    "cogging",
    "gravity",
    "spring",
    "hardening_spring",
    "asymmetric_spring",
    "offset",
    "torque_ripple",
    "delay",
    "lag",
    "saturation",
    "slew_limit",
    "supply_limit",
    "thermal_gain",
    "dead_band",
    "gain_asymmetry",
    "encoder_scale",
    "encoder_quantisation",
    "eccentricity",
    "interpolation_error",
)
NAMELESS = (
    "falling_drag",
    "composite",
    "hysteresis",
    "swinging_inertia",
    "knocks",
    "stop",
    "detent",
)
#: Effects that are hidden from a solver who must do without them: unmet, and like nothing else in the library.
UNMET = (
    "hardening_spring",
    "asymmetric_spring",
    "dead_band",
    "gain_asymmetry",
    "quadratic_direction",
    "load_square_friction",
    "warming_friction",
    "swinging_load",
)
#: Of each of these at most one is in a mixture: one drive, one transmission, one law of dry friction, one force along
#: the range.
EXCLUSIVE = (
    ("coulomb", "coulomb_position", "stribeck", "presliding", "lugre"),
    ("delay", "lag", "saturation", "slew_limit", "supply_limit"),
    ("elastic", "backlash", "swinging_load"),
    ("gravity", "spring", "hardening_spring", "asymmetric_spring"),
    ("viscous", "quadratic_drag", "power_drag"),
    ("viscous_direction", "quadratic_direction"),
    ("load_friction", "load_square_friction", "dead_band"),
    ("thermal_gain", "warming_friction"),
    ("encoder_quantisation", "backlash"),
    ("encoder_quantisation", "interpolation_error"),
)
#: Laws of dry friction, of which one is beside a variation of it.
VARYING = ("stribeck", "presliding", "lugre")
#: Known effects that may be beside one that is outside the library.
BESIDE = {
    "composite": ("coulomb", "payload"),
    "falling_drag": ("coulomb", "payload"),
    "stop": ("coulomb", "viscous"),
    "detent": ("viscous", "payload"),
    **BESIDE_NEAR,
}
#: Only a measured current, or index marks, tell these from their confounders.
BY_CURRENT, BY_MARKS = {"delay", "lag", "saturation"}, {"payload", "encoder_scale"}
#: Effects of angle, and a frequent sample time for each rare one.
TURNING = ("gravity", "swinging_inertia")
SAMPLES_S = (0.005, 0.002, 0.001, 0.001, 0.001, 0.0005, 0.00025)
#: One count of the encoder may change the force by this share of the rated one, a coarser one than stated by this.
CHATTER, COARSE = 0.1, 0.5
#: In how many of the samples a drive saturates, and a controller at most.
SATURATED, AT_LIMIT = (0.03, 0.35), 0.02
#: A drive of a limited rate is as far behind its command as this share of the rated force, root mean square.
BEHIND = 0.04
#: A thermal loss is of such a share in the end; a small range is within this angle [rad].
WARM, SMALL = (0.06, 0.4), 0.4
TRIES, DRY_RUN_S = 200, 5.0


def draw_axis(name: str, kind: str, rng: np.random.Generator, only: str = "") -> Axis:
    """Draw one axis of a kind; ``only`` asks for a certain effect (single, unknown) or excitation (confounded).

    Raises:
        ValueError: no draw gave a loop that holds.
    """
    for _ in range(TRIES):
        axis = _drawn(name, kind, rng, only)
        if _sound(axis):
            return axis
    raise ValueError(f"draw axis {name}: none of {TRIES} draws of {kind} {only} gave a loop that holds")


def _sound(axis: Axis) -> bool:
    """Say whether the loop holds, the drive saturates as it should, the motor warms up enough, and a small range is
    small.
    """
    world = World(axis)
    runs = [world.record(c) for c in commands(axis, DRY_RUN_S)]
    force, place = np.abs([r.force for r in runs]), np.abs([r.counts for r in runs]) * axis.resolution
    if float(np.max(np.mean(force >= 0.999 * axis.servo.limit, axis=1))) > AT_LIMIT:
        return False
    if "saturation" in axis.named:
        share = float(np.mean(force[:4] > axis.named["saturation"]["limit"]))
        if not SATURATED[0] < share < SATURATED[1]:
            return False
    if "supply_limit" in axis.named:
        share = float(np.mean(force[:4] > 0.8 * axis.named["supply_limit"]["F0"]))
        if not SATURATED[0] < share < SATURATED[1]:
            return False
    if "slew_limit" in axis.named:  # the chatter of a count may be steep, and moves nothing
        behind = np.array([r.force_measured - r.force for r in runs[:4]])
        if float(np.sqrt(np.mean(behind**2))) < BEHIND * axis.rated:
            return False
    if "near_heat" in axis.nameless and not WARM[0] < _lost(axis.nameless["near_heat"], world.heat) < WARM[1]:
        return False
    if "thermal_gain" in axis.named and not WARM[0] < axis.named["thermal_gain"]["loss"] * world.heat < WARM[1]:
        return False
    return axis.excitation != "small" or float(np.max(place[:4])) < SMALL


def _lost(numbers: Numbers, heat: float) -> float:
    return numbers["size"] * heat / (1.0 + heat / numbers["more"])


def _drawn(name: str, kind: str, rng: np.random.Generator, only: str) -> Axis:
    excitation = (only or str(rng.choice(list(CONFOUNDED)))) if kind == "confounded" else "full"
    turning = excitation == "small" or only in TURNING
    axis = _plant(name, kind, bool(turning or rng.random() < 0.6), excitation, rng)
    named: list[str] = []
    nameless: list[str] = []
    rival = ""
    if kind == "single":
        named = [only or _pick(NAMED, axis, rng)]
        if named == ["friction_variation"]:
            named.append(str(rng.choice(VARYING)))
    elif kind == "multi":
        named = _mixture(axis, int(rng.integers(2, 4)), rng)
    elif kind == "confounded":
        hidden, rival = (str(p) for p in rng.permutation(CONFOUNDED[excitation]))
        named = [hidden]
    elif kind in ("unknown", "near"):
        nameless = [only or _pick((*NAMELESS, *UNMET), axis, rng)]
        beside = BESIDE.get(nameless[0], ())
        named = [str(rng.choice(beside))] if beside and rng.random() < 0.5 else []
    current = excitation != "no_current" and bool(BY_CURRENT & set(named) or rng.random() < 0.65)
    marks = excitation != "no_marks" and bool(BY_MARKS & set(named) or rng.random() < 0.75)
    numbers = {n: _effect(n, axis, rng) for n in (*named, *nameless)}
    return replace(
        axis,
        current=current,
        marks=marks,
        named={n: _alike(n, excitation, axis, numbers[n], rng) for n in named},
        nameless={n: numbers[n] for n in nameless},
        rival=rival,
    )


def _alike(name: str, excitation: str, axis: Axis, numbers: Numbers, rng: np.random.Generator) -> Numbers:
    """Make an effect one with its confounder where the excitation is poor, or a channel is missing."""
    match excitation, name:
        case "small", "gravity":  # near the horizontal, where a little travel does not show its slope
            drawn = numbers["phase"]
            phase = np.copysign(0.5 * np.pi + 0.2 * (abs(drawn) - 0.5 * np.pi), drawn)
            return {**numbers, "phase": float(phase)}
        case "oneway", "offset":  # a force along with the motion is no friction, whatever is recorded
            return {"off": -abs(numbers["off"])}
        case "no_marks", "encoder_scale":  # as much as a payload
            return {"gain": 1.0 / (1.0 + float(rng.uniform(0.07, 0.17)))}
        case "no_marks", "payload":  # no more than an encoder may be off
            return {"J_extra": axis.inertia * float(rng.uniform(0.07, 0.17))}
        case "no_current", _:  # short against what moves
            return {symbol: 0.5 * v for symbol, v in numbers.items()}
        case _:
            return numbers


def _pick(names: tuple[str, ...], axis: Axis, rng: np.random.Generator) -> str:
    return str(rng.choice([n for n in names if axis.rotary or n not in TURNING]))


def _mixture(axis: Axis, count: int, rng: np.random.Generator) -> list[str]:
    picks = {_pick(NAMED, axis, rng) for _ in range(count)}
    mixed = len(picks) == count and all(len(picks.intersection(group)) < 2 for group in EXCLUSIVE)
    mixed = mixed and ("friction_variation" not in picks or bool(picks.intersection(VARYING)))
    return sorted(picks) if mixed else _mixture(axis, count, rng)


def _plant(name: str, kind: str, rotary: bool, excitation: str, rng: np.random.Generator) -> Axis:
    u = rng.uniform
    if rotary:
        inertia, acceleration, speed, pitch = 10 ** u(-3.2, -2.0), u(250, 500), u(12, 30), 2.0 * np.pi
        resolution = pitch / float(rng.choice([2048, 4096, 8192, 16384, 65536]))
    else:
        inertia, acceleration, speed = u(2, 25), u(4, 9), u(0.15, 0.4)
        pitch = float(rng.choice([0.005, 0.01, 0.02]))
        resolution = float(rng.choice([5e-8, 1e-7, 5e-7, 1e-6, 4e-6]))
    rated, dt = float(inertia * acceleration), float(rng.choice(SAMPLES_S))
    return Axis(
        name=name,
        kind=kind,
        rotary=rotary,
        sample_s=dt,
        inertia=float(inertia),
        viscous=float(u(0.004, 0.03)) * rated / float(speed),
        rated=rated,
        speed=float(speed),
        resolution=resolution,
        pitch=pitch,
        servo=_servo(float(inertia), rated, resolution, dt, rng),
        excitation=excitation,
        current=True,
        marks=True,
        seed=int(rng.integers(2**31)),
    )


def _servo(inertia: float, rated: float, resolution: float, dt: float, rng: np.random.Generator) -> Servo:
    """Draw a controller, as fast as one count of the encoder lets it be.

    Lead-lag, PD (without the lag), or a cascade: position gain with velocity feedback, filtered or over two samples.
    """
    form = str(rng.choice(["lead", "lead", "pd", "cascade", "mean"]))
    w = 2.0 * np.pi * float(rng.uniform(7.0, 14.0)) * (0.6 if dt > 2e-3 else 1.0)
    damping, filtered = float(rng.uniform(0.7, 1.0)), float(rng.uniform(8.0, 15.0))
    while True:
        limit = 2.5 * rated
        if form in ("lead", "pd"):
            # phase lead around the crossover w, where |C(jw)| |1 / (J w^2)| = 1
            kz = -float(np.exp(-w / 3.0 * dt))
            kp = -float(np.exp(-3.5 * w * dt)) if form == "lead" else 0.0
            z = np.exp(1j * w * dt)
            k = inertia * w**2 * float(abs((1.0 + kp / z) / (1.0 + kz / z)))
            servo = Servo(k, kz, kp, 0.0, limit)
        else:
            hz = filtered * w / (2.0 * np.pi) if form == "cascade" else 0.0
            own = 0.7 * w  # the speed loop's crossover is near w
            servo = Servo(inertia * own**2, 0.0, 0.0, -2.0 * damping * inertia * own, limit, hz, form == "mean")
        if _by_count(servo, dt) * resolution < CHATTER * rated:
            return servo
        w *= 0.9


def _by_count(servo: Servo, dt: float) -> float:
    """Return by how much the force jumps with the position at once."""
    share = 0.5 if servo.mean else 1.0
    if servo.filter_hz > 0.0:
        share = 1.0 - float(np.exp(-2.0 * np.pi * servo.filter_hz * dt))
    return servo.k - servo.kb * share / dt


def _composite(axis: Axis, reach: float, rng: np.random.Generator) -> Numbers:
    """Draw a law that has no name: bends over the place, or a drag that bends over speed or place."""
    kind = float(rng.integers(3))
    size = axis.speed if kind == 1.0 else reach
    amp = axis.rated * float(rng.uniform(0.08, 0.2))
    at = rng.uniform(-0.5, 0.5, 2)
    widths = rng.uniform(0.1, 0.4, 2)
    return {
        "kind": kind,
        "amp": amp if kind == 0.0 else amp / axis.speed,
        "size": size,
        "at": float(at[0]),
        "width": float(widths[0]),
        "more": float(rng.uniform(-0.8, 1.0)) if kind == 0.0 else float(rng.uniform(0.0, 1.0)),
        "at_more": float(at[1]),
        "width_more": float(widths[1]),
    }


def _effect(name: str, axis: Axis, rng: np.random.Generator) -> Numbers:
    """Draw the size of an effect, clear of the noise and within what machines show."""
    f, v, j, x, q = axis.rated, axis.speed, axis.inertia, axis.pitch, axis.resolution
    reach, slow = REACH[axis.rotary], max(axis.sample_s / 1e-3, 1.0)

    def u(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    def order(low: int, high: int) -> float:
        """Of an angle, or of a short pitch that goes by many times a second."""
        return float(rng.integers(low, high)) if axis.rotary else float(rng.integers(1, 7))

    if name in NEAR:
        return draw_near(name, f, v, reach, order(2, 13), rng)
    phase, sign, fc = u(-np.pi, np.pi), float(rng.choice([-1, 1])), f * u(0.06, 0.2)
    fs, vs = fc * u(1.6, 2.4), v * u(0.015, 0.05)
    yields = max(x * u(5e-4, 3e-3), 4.0 * q)
    lost = slow**0.5 * 1e-3
    match name:
        case "viscous":
            return {"b_extra": f / v * u(0.08, 0.4)}
        case "viscous_direction":
            return {"b_dir": sign * f / v * u(0.05, 0.15)}
        case "quadratic_drag":
            return {"c": f / v**2 * u(0.1, 0.4)}
        case "coulomb":
            return {"Fc": fc}
        case "coulomb_position":
            return {"Fc": fc, "Fm": fc * u(0.3, 0.6), "n": order(2, 13), "phase": phase}
        case "stribeck":
            return {"Fc": fc, "Fs": fs, "vs": vs}
        case "presliding":
            return {"Fc": fc, "xs": yields}
        case "lugre":
            return {"Fc": fc, "Fs": fs, "vs": vs, "xs": yields}
        case "friction_variation":
            return {"depth": u(0.12, 0.4), "n": order(1, 13), "phase": phase}
        case "load_friction":
            return {"mu": u(0.08, 0.25)}
        case "backlash":
            gap = x * u(0.004, 0.01) if axis.rotary else 1e-4 * u(1.0, 4.0)
            return {"gap": max(gap, 20.0 * q), "load_fraction": u(0.4, 0.6)}
        case "elastic":
            return {"f_res": u(14, 28), "load_fraction": u(0.35, 0.6), "zeta": u(0.03, 0.08)}
        case "payload":
            return {"J_extra": j * u(0.12, 0.5)}
        case "cogging":
            return {"amp": f * u(0.06, 0.14), "n": order(4, 25), "phase": phase}
        case "gravity":
            return {"amp": f * u(0.08, 0.3), "phase": phase}
        case "spring":
            return {"k": f / reach * u(0.1, 0.3)}
        case "offset":
            return {"off": f * u(0.04, 0.12) * sign}
        case "torque_ripple":
            return {"depth": u(0.08, 0.2), "n": order(4, 13), "phase": phase}
        case "delay":
            return {"delay": lost * u(1.5, 4.0)}
        case "lag":
            return {"tau": lost * u(1.5, 4.0)}
        case "saturation":
            return {"limit": f * u(0.25, 0.55)}
        case "thermal_gain":
            return {"loss": u(0.7, 1.5), "tau": u(5, 12)}
        case "encoder_scale":
            return {"gain": 1.0 + u(0.012, 0.03) * sign}
        case "encoder_quantisation":
            coarse = [n for n in (4, 8, 16, 32) if n * _by_count(axis.servo, axis.sample_s) * q < COARSE * f]
            return {"factor": float(rng.choice(coarse))}
        case "eccentricity":
            amp = x * (u(0.004, 0.01) if axis.rotary else u(0.001, 0.003))
            return {"amp": max(amp, 6.0 * q), "phase": phase}
        case "hardening_spring":
            return {"k3": f / reach**3 * u(0.2, 0.5)}
        case "asymmetric_spring":
            return {"d": sign * f / reach * u(0.1, 0.3)}
        case "dead_band":
            return {"w": f * u(0.04, 0.15)}
        case "gain_asymmetry":
            return {"d": sign * u(0.03, 0.12)}
        case "power_drag":
            n = float(rng.choice([u(0.4, 0.6), u(1.4, 1.7), u(2.5, 3.0)]))
            return {"c": f / v**n * u(0.1, 0.3), "n": n}
        case "quadratic_direction":
            return {"c": sign * f / v**2 * u(0.08, 0.2)}
        case "load_square_friction":
            return {"g": u(0.2, 0.4) / f}
        case "warming_friction":
            return {"g": f / v * u(0.2, 0.5), "tau": u(3.0, 10.0)}
        case "swinging_load":
            return {"f_res": u(0.5, 1.5), "load_fraction": u(0.2, 0.4), "zeta": u(0.01, 0.05)}
        case "composite":
            return _composite(axis, reach, rng)
        case "falling_drag":
            return {"c": 2.0 * f * u(0.08, 0.16) / (v * 0.18), "v0": 0.18 * v}
        case "hysteresis":
            return {
                "level": f * u(0.08, 0.16),
                "length": x * u(0.03, 0.07) if axis.rotary else 4e-3 * u(0.7, 1.5),
            }
        case "swinging_inertia":
            return {"depth": u(0.2, 0.35), "n": float(rng.integers(1, 4)), "phase": phase}
        case "knocks":
            return {"height": f * u(0.4, 0.8), "count": 6.0}
        case "stop":
            return {"k": f / reach * u(0.6, 1.5), "x0": reach * u(0.1, 0.3)}
        case "detent":
            return {"amp": f * u(0.1, 0.2), "x0": reach * u(-0.2, 0.2), "width": reach * u(0.06, 0.12)}
        case "supply_limit":
            return {"F0": f * u(0.3, 0.6), "v0": v * u(1.0, 1.6)}
        case "slew_limit":
            return {"rate": f / (lost * u(8.0, 30.0))}
        case "interpolation_error":
            n = float(rng.integers(32, 129))
            return {"amp": max(x / n * u(0.01, 0.04), 3.0 * q), "n": n, "phase": phase}
        case _:
            raise ValueError(f"draw effect {name}: unknown; known are {', '.join((*NAMED, *NAMELESS))}")
