"""Integrate a drawn axis in continuous time, at a fixed small step, until its records are full.

Drift, kick, drift steps of 10 us; dry friction as a spring-loaded bristle that breaks (elasto-plastic), presliding as
LuGre's bristle with its damping; backlash contact as a spring with damping in proportion to the depth; everything
written against time.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.signal import lfilter

from sioms.reconcile_selftest.axis import Array, Axis
from sioms.reconcile_selftest.near import BUILD, ELEMENTS, HEAT, NEAR, near_force, near_level

STEP_S = 1e-5
#: Samples of command before the first, for what comes late.
BEFORE_S = 0.05
#: Displacement over which plain dry friction yields, in pitches.
YIELD = 5e-6
#: Time constant [s] and size (of the rated force) of the force noise, and of the noise of the current.
COLOUR_S, DISTURBANCE, CURRENT = 0.02, 0.003, 0.004
CONTACT_HZ, CONTACT_ZETA = 110.0, 0.08


@dataclass(frozen=True, slots=True)
class Recording:
    """What is measured of one axis in one record; shape (n,)."""

    counts: NDArray[np.int64]
    command: Array
    force: Array
    force_measured: Array
    index: NDArray[np.bool_]


class Plant(NamedTuple):
    """The numbers of an axis, those of the hidden effects as EFFECT_SYMBOL; the defaults do nothing."""

    sample_s: float
    inertia: float
    viscous: float
    rated: float
    speed: float
    pitch: float
    resolution: float
    k: float
    kz: float
    kp: float
    kb: float
    top: float
    filter_share: float
    mean: float
    encoder_scale_gain: float = 1.0
    encoder_quantisation_factor: float = 1.0
    eccentricity_amp: float = 0.0
    eccentricity_phase: float = 0.0
    delay_delay: float = 0.0
    lag_tau: float = 0.0
    saturation_limit: float = np.inf
    thermal_gain_loss: float = 0.0
    thermal_gain_tau: float = 1.0
    torque_ripple_depth: float = 0.0
    torque_ripple_n: float = 0.0
    torque_ripple_phase: float = 0.0
    payload_J_extra: float = 0.0
    viscous_b_extra: float = 0.0
    viscous_direction_b_dir: float = 0.0
    quadratic_drag_c: float = 0.0
    coulomb_Fc: float = 0.0
    coulomb_position_Fc: float = 0.0
    coulomb_position_Fm: float = 0.0
    coulomb_position_n: float = 0.0
    coulomb_position_phase: float = 0.0
    stribeck_Fc: float = 0.0
    stribeck_Fs: float = 0.0
    stribeck_vs: float = 1.0
    load_friction_mu: float = 0.0
    presliding_Fc: float = 0.0
    presliding_xs: float = 1.0
    lugre_Fc: float = 0.0
    lugre_Fs: float = 0.0
    lugre_vs: float = 1.0
    lugre_xs: float = 1.0
    friction_variation_depth: float = 0.0
    friction_variation_n: float = 0.0
    friction_variation_phase: float = 0.0
    offset_off: float = 0.0
    spring_k: float = 0.0
    gravity_amp: float = 0.0
    gravity_phase: float = 0.0
    cogging_amp: float = 0.0
    cogging_n: float = 0.0
    cogging_phase: float = 0.0
    hardening_spring_k3: float = 0.0
    asymmetric_spring_d: float = 0.0
    dead_band_w: float = 0.0
    gain_asymmetry_d: float = 0.0
    power_drag_c: float = 0.0
    power_drag_n: float = 1.0
    quadratic_direction_c: float = 0.0
    load_square_friction_g: float = 0.0
    warming_friction_g: float = 0.0
    warming_friction_tau: float = 0.0
    swinging_load_f_res: float = 0.0
    swinging_load_load_fraction: float = 0.0
    swinging_load_zeta: float = 0.0
    elastic_f_res: float = 0.0
    elastic_load_fraction: float = 0.0
    elastic_zeta: float = 0.0
    backlash_gap: float = 0.0
    backlash_load_fraction: float = 0.0
    composite_kind: float = 0.0
    composite_amp: float = 0.0
    composite_size: float = 1.0
    composite_at: float = 0.0
    composite_width: float = 1.0
    composite_more: float = 0.0
    composite_at_more: float = 0.0
    composite_width_more: float = 1.0
    falling_drag_c: float = 0.0
    falling_drag_v0: float = 1.0
    hysteresis_level: float = 0.0
    hysteresis_length: float = 1.0
    swinging_inertia_depth: float = 0.0
    swinging_inertia_n: float = 0.0
    swinging_inertia_phase: float = 0.0
    stop_k: float = 0.0
    stop_x0: float = 0.0
    detent_amp: float = 0.0
    detent_x0: float = 0.0
    detent_width: float = 1.0
    supply_limit_F0: float = np.inf
    supply_limit_v0: float = 1.0
    slew_limit_rate: float = np.inf
    interpolation_error_amp: float = 0.0
    interpolation_error_n: float = 0.0
    interpolation_error_phase: float = 0.0
    near_kind: int = -1
    near_size: float = 0.0
    near_scale: float = 1.0
    near_shape: float = 1.0
    near_more: float = 0.0
    near_phase: float = 0.0
    knocks_height: float = 0.0
    knocks_count: float = 0.0


def _plant(axis: Axis) -> Plant:
    servo, dt = axis.servo, axis.sample_s
    effects = {"near" if n in NEAR else n: numbers for n, numbers in axis.hidden.items()}
    return Plant(
        sample_s=dt,
        inertia=axis.inertia,
        viscous=axis.viscous,
        rated=axis.rated,
        speed=axis.speed,
        pitch=axis.pitch,
        resolution=axis.resolution,
        k=servo.k,
        kz=servo.kz,
        kp=servo.kp,
        kb=servo.kb,
        top=servo.limit,
        filter_share=1.0 - float(np.exp(-2.0 * np.pi * servo.filter_hz * dt)) if servo.filter_hz > 0 else 1.0,
        mean=float(servo.mean),
        near_kind=next((NEAR.index(n) for n in axis.nameless if n in NEAR), -1),
        **{f"{effect}_{s}": float(v) for effect, numbers in effects.items() for s, v in numbers.items()},
    )


@dataclass(slots=True)
class World:
    """One axis on its bench; the heat of its motor carries over from record to record. Use from one thread.

    Attributes:
        rng: of its noise.
    """

    axis: Axis
    rng: np.random.Generator = field(init=False)
    heat: float = 0.0

    def __post_init__(self) -> None:
        self.rng = self.axis.rng(2)

    def record(self, command: Array, noise: float = 1.0) -> Recording:
        """Run one record from rest at zero, with so many times the usual noise."""
        plant, rng, n = _plant(self.axis), self.rng, len(command)
        late = round(BEFORE_S / plant.sample_s)
        queue, counts = np.zeros(n + late), np.zeros(n, dtype=np.int64)
        measured, marks = noise * CURRENT * plant.rated * rng.standard_normal(n), np.zeros(n, dtype=np.bool_)
        self.heat = _march(
            plant,
            round(plant.sample_s / STEP_S),
            command,
            noise * 0.3 * plant.resolution * rng.standard_normal(n),
            noise * self._pushed(n) + self._knocks(n),
            self.heat,
            late,
            queue,
            counts,
            measured,
            marks,
        )
        return Recording(counts, command, queue[late:], measured, marks)

    def _pushed(self, n: int) -> Array:
        """Draw the noise of force: one pole of ``COLOUR_S``."""
        keep = float(np.exp(-self.axis.sample_s / COLOUR_S))
        kick = DISTURBANCE * self.axis.rated * np.sqrt(1.0 - keep**2)
        return np.asarray(lfilter([kick], [1.0, -keep], self.rng.standard_normal(n)))

    def _knocks(self, n: int) -> Array:
        """Draw force pulses of 25 ms at random times."""
        out = np.zeros(n)
        spec = self.axis.nameless.get("knocks", {"count": 0.0, "height": 0.0})
        for at in self.rng.integers(n // 25, n - n // 50, int(spec["count"])):
            out[at : at + round(0.025 / self.axis.sample_s)] += spec["height"] * self.rng.choice([-1.0, 1.0])
        return out


@njit(cache=True, nogil=True)
def _held(queue: Array, at: float, step: float) -> float:
    """Mean over a step from ``at``, both in samples, of a command that is held for a sample each."""
    first, last = int(np.floor(at + 1e-9)), int(np.floor(at + step - 1e-9))
    if last <= first:
        return float(queue[first])
    return float((queue[first] * (last - at) + queue[last] * (at + step - last)) / step)


@njit(cache=True, nogil=True)
def _composite(p: Plant, x: float, v: float) -> float:
    """Force of a form made anew: two bends over the place, or a drag that bends over speed or place."""
    z = (v if p.composite_kind == 1.0 else x) / p.composite_size
    one = 1.0 + np.tanh((z - p.composite_at) / p.composite_width)
    two = 1.0 + np.tanh((z - p.composite_at_more) / p.composite_width_more)
    bend = one + p.composite_more * two
    return float(-p.composite_amp * (bend if p.composite_kind == 0.0 else bend * v))


@njit(cache=True, nogil=True)
def _march(
    p: Plant,
    sub: int,
    command: Array,
    jitter: Array,
    push: Array,
    heat: float,
    late: int,
    queue: Array,
    counts: NDArray[np.int64],
    measured: Array,
    marks: NDArray[np.bool_],
) -> float:
    """Fill the commands of the controller (after ``late`` samples), counts, mean currents (added to their noise) and
    marks.

    Returns:
        The heat at the end.
    """
    h, turn = p.sample_s / sub, 2.0 * np.pi / p.pitch
    total = p.inertia + p.payload_J_extra
    share = p.elastic_load_fraction + p.swinging_load_load_fraction + p.backlash_load_fraction
    motor, load, two, loose = total * (1.0 - share), total * share, share > 0.0, 0.5 * p.backlash_gap
    reduced = total * share * (1.0 - share)
    stiff = reduced * (2 * np.pi * (CONTACT_HZ if loose > 0.0 else p.elastic_f_res + p.swinging_load_f_res)) ** 2
    damp = 2.0 * (CONTACT_ZETA if loose > 0.0 else p.elastic_zeta + p.swinging_load_zeta) * np.sqrt(stiff * reduced)
    give = YIELD * p.pitch
    quantum = p.resolution * p.encoder_quantisation_factor
    follow = 1.0 - np.exp(-h / p.lag_tau) if p.lag_tau > 0.0 else 1.0
    # LuGre's bristle: stiffness and damping
    held = p.lugre_Fs if p.lugre_Fs > 0.0 else p.presliding_Fc
    slid, fall = p.lugre_Fc + p.presliding_Fc, p.lugre_vs
    s0 = held / (p.lugre_xs if p.lugre_Fs > 0.0 else p.presliding_xs)
    s1 = 0.1 * np.sqrt(s0 * motor)
    near = (p.near_size, p.near_scale, p.near_shape, p.near_more, p.near_phase)
    way, yields = 0.0, np.zeros(ELEMENTS)
    x = v = xl = vl = z = bristle = hyst = lagged = 0.0
    e_old = u_old = y_old = y_older = speed = slewed = 0.0
    for i in range(len(command)):
        seen = p.encoder_scale_gain * x + p.eccentricity_amp * np.sin(turn * x + p.eccentricity_phase)
        seen += p.interpolation_error_amp * np.sin(p.interpolation_error_n * turn * x + p.interpolation_error_phase)
        counts[i] = int(np.floor((seen + jitter[i]) / quantum + 0.5) * np.round(p.encoder_quantisation_factor))
        y = counts[i] * p.resolution
        if i == 0:
            y_old = y_older = y
        if p.mean > 0.0:
            speed = 0.5 * (y - y_older) / p.sample_s
        else:
            speed += p.filter_share * ((y - y_old) / p.sample_s - speed)
        y_older, y_old = y_old, y
        e = command[i] - y
        u = min(max(p.k * (e + p.kz * e_old) - p.kp * u_old + p.kb * speed, -p.top), p.top)
        e_old, u_old = e, u
        queue[late + i] = u
        before, passed, mean = np.floor(x / p.pitch), False, 0.0
        for s in range(sub):
            goal = _held(queue, late + i + s / sub - p.delay_delay / p.sample_s, 1.0 / sub)
            slewed += min(max(goal - slewed, -p.slew_limit_rate * h), p.slew_limit_rate * h)
            goal = slewed
            drive = lagged + 0.5 * follow * (goal - lagged) if p.lag_tau > 0.0 else goal
            lagged += follow * (goal - lagged)
            drive = min(max(drive, -p.saturation_limit), p.saturation_limit)
            most, least = 1.0 - v / p.supply_limit_v0, 1.0 + v / p.supply_limit_v0
            drive = min(max(drive, -p.supply_limit_F0 * max(least, 0.0)), p.supply_limit_F0 * max(most, 0.0))
            mean += drive
            if p.thermal_gain_loss > 0.0:
                heat += h / p.thermal_gain_tau * ((drive / p.rated) ** 2 - heat)
            x += 0.5 * h * v
            xl += 0.5 * h * vl
            theta = turn * x
            f = drive * (1.0 - p.thermal_gain_loss * heat) * (1.0 + p.gain_asymmetry_d * np.sign(drive))
            f -= min(max(drive, -p.dead_band_w), p.dead_band_w)
            if p.warming_friction_tau > 0.0:
                heat += h / p.warming_friction_tau * (abs(v) - heat)
            f *= 1.0 + p.torque_ripple_depth * np.sin(p.torque_ripple_n * theta + p.torque_ripple_phase)
            f += push[i] + p.offset_off - p.spring_k * x - p.hardening_spring_k3 * x**3
            f -= p.asymmetric_spring_d * abs(x) + p.quadratic_direction_c * v * v
            f -= p.power_drag_c * np.sign(v) * abs(v) ** p.power_drag_n
            if p.composite_amp != 0.0:
                f += _composite(p, x, v)
            f += p.gravity_amp * np.sin(x + p.gravity_phase)
            f += p.cogging_amp * np.sin(p.cogging_n * theta + p.cogging_phase)
            f -= (p.viscous + p.viscous_b_extra) * v
            f -= (p.viscous_direction_b_dir + p.quadratic_drag_c * v) * abs(v)
            f -= p.falling_drag_c * v / (1.0 + (v / p.falling_drag_v0) ** 2)
            f -= p.stop_k * max(x - p.stop_x0, 0.0)
            well = (x - p.detent_x0) / p.detent_width
            f -= p.detent_amp * well * np.exp(0.5 - 0.5 * well * well)
            hyst += abs(v) * h / p.hysteresis_length * (p.hysteresis_level * np.sign(v) - hyst)
            f -= hyst
            level = p.coulomb_Fc + p.coulomb_position_Fc
            level += p.coulomb_position_Fm * np.sin(p.coulomb_position_n * theta + p.coulomb_position_phase)
            level += p.stribeck_Fc + (p.stribeck_Fs - p.stribeck_Fc) * np.exp(-((v / p.stribeck_vs) ** 2))
            level += p.load_friction_mu * abs(drive) + p.load_square_friction_g * drive * drive
            level += p.warming_friction_g * heat
            if p.near_kind == HEAT:
                heat += h / p.near_scale * ((drive / p.rated) ** 2 - heat)
            if p.near_kind >= 0:
                way += abs(v) * h / p.speed
                f += near_force(p.near_kind, near, x, v, drive, theta, heat)
                level += near_level(p.near_kind, near, v, drive, theta, way, (i + s / sub) * p.sample_s)
            if p.near_kind == BUILD:
                for j in range(ELEMENTS):
                    most = p.near_scale * p.near_shape**j
                    yields[j] = min(max(yields[j] + v * h, -most), most)
                    f -= p.near_size / ELEMENTS * yields[j] / most
                    if abs(yields[j]) < most:
                        f -= 0.3 * np.sqrt(p.near_size / ELEMENTS / most * motor) * v
            varied = 1.0 + p.friction_variation_depth * np.sin(
                p.friction_variation_n * theta + p.friction_variation_phase
            )
            level *= varied
            if level > 0.0:
                z = min(max(z + v * h, -give), give)
                f -= level * z / give
                if abs(z) < give:
                    f -= 1.2 * np.sqrt(level / give * motor) * v
            if s0 > 0.0:
                dropped = slid + (held - slid) * np.exp(-((v / fall) ** 2)) if p.lugre_Fs > 0.0 else slid
                dropped *= varied
                ahead = dropped / s0 * np.sign(v)
                moved = (ahead - bristle) * (1.0 - np.exp(-s0 * abs(v) / dropped * h))
                f -= s0 * (bristle + 0.5 * moved) + s1 * moved / h
                bristle += moved
            if two:
                wind = x - xl
                depth = np.sign(wind) * max(abs(wind) - loose, 0.0)
                link = stiff * depth + damp * (v - vl) if loose == 0.0 or depth != 0.0 else 0.0
                if loose > 0.0 and link * depth < 0.0:
                    link = 0.0
                f -= link
                vl += h * link / load
            swing = p.swinging_inertia_n * theta + p.swinging_inertia_phase
            f -= 0.5 * motor * p.swinging_inertia_depth * p.swinging_inertia_n * turn * np.cos(swing) * v * v
            v += h * f / (motor * (1.0 + p.swinging_inertia_depth * np.sin(swing)))
            x += 0.5 * h * v
            xl += 0.5 * h * vl
            now = np.floor(x / p.pitch)
            passed |= now != before
            before = now
        measured[i] += mean / sub
        marks[i] = passed
    return heat
