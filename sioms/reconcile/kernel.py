"""The time step of an axis: one scalar loop that closes the loop or follows a measurement.

Two uses of the same plant. *Closed*: the controller sees the simulated, quantised position and computes the
force (what a user sees). *Tracking*: the recorded force drives the plant and a steady Kalman gain
pulls the state to the recorded position; the innovation is what the model cannot predict over a short window.

Integration: every sample is cut into ``sub`` steps; smooth forces by the midpoint rule, its prediction with the forces
of the middle of the step before (of second order still, with half the evaluations), dry friction by exact splitting at
the moment the speed crosses zero (then either stick or slip the other way), so that the order is two away from events
and the error of an event is of the order of one step's change of force.
Contact of a backlash is a stiff spring-damper whose frequency the caller chooses.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sioms.reconcile.effect import Array
from sioms.reconcile.jit import caller, inlined, kernel

call = caller()

# Places in the plant row.
(
    INERTIA,
    VISCOUS,
    DT,
    QUANTUM,
    GAIN_Y,
    ECC_AMP,
    ECC_PHASE,
    TURN_X,
    DELAY,
    LAG,
    LIMIT,
    LOSS,
    TAU_T,
    RATED,
    LOAD,
    STIFF,
    DAMP,
    GAP,
    HYST_F,
    HYST_X,
    HYST_S,
    HYST_V,
    LOAD_VISCOUS,
    MOD_A,
    MOD_PHASE,
    MOD_N,
    WARMING,
    VARY_A,
    VARY_PHASE,
    VARY_N,
    SLEW,
    ERR_AMP,
    ERR_PHASE,
    ERR_N,
    PLANT_SIZE,
) = range(35)
# Places in the controller row.
CTL_K, CTL_KZ, CTL_KP, CTL_KB, CTL_OFFSET, CTL_MAX, CTL_ALPHA, CTL_MEAN, CTL_SIZE = range(9)
# Columns of the output.
OUT_Y, OUT_FORCE, OUT_INNOVATION, OUT_X, OUT_V, OUT_APPLIED, OUT_T, OUT_SIZE = range(8)
TINY_SPEED = 1e-12
#: Samples for which a tracking model may be off before its speed is set anew, and over which speed is measured.
PATIENCE, MEASURED = 20, 10
#: Friction that drops with speed, or varies over the turn, keeps this share of its level in what it divides by.
LEAST_LEVEL = 1e-6
#: A hot drive keeps at least this share of its force constant; keeps a wild trial value harmless.
LEAST_GAIN = 0.05


@inlined
def summed(functions: Any, p: Array, x: float, v: float, u: float, t: float) -> float:
    """Sum state functions, each with its row of p."""
    total = 0.0
    for k in range(len(p)):
        total += call(functions, k, p, x, v, u, t)
    return total


@inlined
def varied(level: float, wave: tuple[float, float, float], x: float) -> float:
    """Return a level of dry friction as it is at x; ``wave``: depth, wave number and phase of what varies."""
    depth, number, phase = wave
    return level if depth == 0.0 else level * (1.0 + depth * np.sin(number * x + phase))


@inlined
def friction(levels: Any, p: Array, wave: tuple[float, float, float], x: float, v: float, u: float, t: float) -> float:
    """Sum the FRICTION levels in the direction of v, never negative."""
    return varied(max(summed(levels, p, x, v, u, t), 0.0), wave, x)


@kernel
def coupling(plant: Array, dx: float, dv: float) -> float:
    """Force through the transmission for a wind-up dx and its rate dv."""
    half = 0.5 * plant[GAP]
    if dx > half:
        f = plant[STIFF] * (dx - half) + plant[DAMP] * dv
        return max(f, 0.0) if half > 0.0 else float(f)
    if dx < -half:
        f = plant[STIFF] * (dx + half) + plant[DAMP] * dv
        return min(f, 0.0) if half > 0.0 else float(f)
    return 0.0 if half > 0.0 else float(plant[STIFF] * dx + plant[DAMP] * dv)


@kernel
def delayed(u: Array, before: float, n: int, start: float, end: float, delay: float, dt: float) -> float:
    """Mean over [start, end] inside sample n of the held command, late by ``delay``; ``before`` is that before the
    first.
    """
    a, b = n * dt + start - delay, n * dt + end - delay
    i, j = int(np.floor(a / dt + 1e-9)), int(np.floor(b / dt - 1e-9))
    ui = u[i] if i >= 0 else before
    if j <= i:
        return ui
    uj = u[j] if j >= 0 else before
    cut = j * dt
    return (ui * (cut - a) + uj * (b - cut)) / (b - a)


@inlined
def ramped(start: float, goal: float, rate: float, h: float) -> tuple[float, float]:
    """Follow a goal at a rate of change at most for a time h: return the mean over it and the end."""
    way = 1.0 if goal > start else -1.0
    lasts = min(np.abs(goal - start) / rate, h)
    end = goal if lasts < h else start + way * rate * h
    return end - 0.5 * way * rate * lasts * lasts / h, end


@inlined
def slide(x: float, v: float, a: float, h: float) -> tuple[float, float, float]:
    """Advance one step under constant acceleration, or to where the speed crosses zero.

    Returns:
        Position, speed and what is left of the step.
    """
    if v == 0.0:
        return x, v, h
    v1 = v + a * h
    if v1 * v > 0.0:
        return x + 0.5 * (v + v1) * h, v1, 0.0
    t0 = h * v / (v - v1) if v1 != v else h
    return x + 0.5 * v * t0, 0.0, h - t0


@inlined
def leave(force: float, break_p: float, break_m: float) -> float:
    """Return the force that is left of one at rest, against friction that holds forward and backward."""
    if force > break_p:
        return force - break_p
    if force < -break_m:
        return force + break_m
    return 0.0


@kernel
def march(
    closed: bool,
    command: Array,
    measured: Array,
    force_in: Array,
    external: Array,
    ctl: Array,
    plant: Array,
    forces: Any,
    pf: Array,
    levels: Any,
    pl: Array,
    gains: Any,
    pg: Array,
    gain: Array,
    lost: float,
    start: Array,
    sub: int,
    out: Array,
) -> None:
    """Run the axis over one record.

    Args:
        command, measured, force_in: shape (n,); ``command`` is read when closed, ``measured`` when tracking;
            ``force_in`` is the whole force when tracking, and what is added to the controller's when closed.
        external: force on the axis beside the drive's, and how the command to the drive goes within the sample, or this
            force where there is no drive, as of ``Record.bends``; shape (n, 3).
        gain: corrections of place and speed of the motor, and of the load, by the innovation: in contact, and out of
            it; shape (8,).
        lost: innovation at which, held for ``PATIENCE`` samples, the speed is taken from the measurement.
        start: x, v, temperature, error of the controller and force at the sample before the first, and by how much the
            load is behind the motor, and slower.
        out: shape (n, OUT_SIZE), filled.
    """
    n = command.shape[0]
    dt = plant[DT]
    h = dt / sub
    two, dry = plant[LOAD] > 0.0, len(pl) > 0
    total = plant[INERTIA]
    jl = total * plant[LOAD]
    jm = total - jl
    # Local copies: a function that is called by its address might have changed an array.
    viscous, limit, delay, lag, loss = plant[VISCOUS], plant[LIMIT], plant[DELAY], plant[LAG], plant[LOSS]
    slew = plant[SLEW]
    hyst_f, hyst_s, mod, gain_y = plant[HYST_F], plant[HYST_S], plant[MOD_A], plant[GAIN_Y]
    wave = (plant[VARY_A], plant[VARY_N] * plant[TURN_X], plant[VARY_PHASE])
    decay = np.exp(-h / lag) if lag > 0.0 else 0.0
    per_mass = 1.0 / jm
    x, v, temp = start[0], start[1], start[2]
    xl, vl = x - start[5], v - start[6]
    held = start[4]
    lagged = slewed = held
    hyst = 0.0
    e_old, u_old, y_old, y_older, v_f = start[3], start[4], 0.0, 0.0, gain_y * v
    off = 0
    level, acting = 0.0, summed(forces, pf, x, v, u_old, temp)
    u_all = np.zeros(n)
    for i in range(n):
        y = gain_y * x
        if plant[ECC_AMP] != 0.0:
            y += plant[ECC_AMP] * np.sin(plant[TURN_X] * x + plant[ECC_PHASE])
        if plant[ERR_AMP] != 0.0:
            y += plant[ERR_AMP] * np.sin(plant[ERR_N] * plant[TURN_X] * x + plant[ERR_PHASE])
        if closed:
            if plant[QUANTUM] > 0.0:
                y = np.round(y / plant[QUANTUM]) * plant[QUANTUM]
            if i == 0:
                y_old = y - v_f * dt
                y_older = y_old - v_f * dt
            if ctl[CTL_MEAN] > 0.0:
                v_f = 0.5 * (y - y_older) / dt
            else:
                v_f += ctl[CTL_ALPHA] * ((y - y_old) / dt - v_f)
            y_older = y_old
            y_old = y
            e = command[i] - y
            u = ctl[CTL_K] * (e + ctl[CTL_KZ] * e_old) - ctl[CTL_KP] * u_old + ctl[CTL_KB] * v_f + ctl[CTL_OFFSET]
            u = min(max(u, -ctl[CTL_MAX]), ctl[CTL_MAX])
            e_old, u_old = e, u
            u = min(max(u + force_in[i], -ctl[CTL_MAX]), ctl[CTL_MAX])
            innovation = 0.0
        else:
            u = force_in[i]
            innovation = measured[i] - y
            at = 4 if plant[GAP] > 0.0 and np.abs(x - xl) < 0.5 * plant[GAP] else 0
            moved = innovation / gain_y
            x += gain[at] * moved
            v += gain[at + 1] * moved
            xl += gain[at + 2] * moved
            vl += gain[at + 3] * moved
            off = off + 1 if np.abs(innovation) > lost else 0
            if off >= PATIENCE and i >= MEASURED:
                v = (measured[i] - measured[i - MEASURED]) / (MEASURED * dt * gain_y)
                vl = v
                off = 0
        u_all[i] = u
        out[i, OUT_Y] = y
        out[i, OUT_FORCE] = u
        out[i, OUT_INNOVATION] = innovation
        out[i, OUT_X] = x
        out[i, OUT_V] = v
        out[i, OUT_T] = temp
        applied = 0.0
        for s in range(sub):
            ua = u
            if delay > 0.0:
                ua = delayed(u_all, held, i, s * h, (s + 1) * h, delay, dt)
            if external[i, 1] != 0.0 or external[i, 2] != 0.0:
                a, b = 2.0 * s / sub - 1.0, 2.0 * (s + 1) / sub - 1.0
                ua += external[i, 1] * 0.5 * (a + b) + external[i, 2] * 0.5 * (a * a + a * b + b * b - 1.0)
            if slew > 0.0:
                ua, slewed = ramped(slewed, ua, slew, h)
            if lag > 0.0:
                nxt = ua + (lagged - ua) * decay
                ua = ua + (lagged - ua) * (1.0 - decay) * lag / h
                lagged = nxt
            ua = min(max(ua, -limit), limit)
            applied += ua
            if loss > 0.0 or plant[WARMING] > 0.0:
                heat = (ua / plant[RATED]) ** 2 if plant[WARMING] == 0.0 else np.abs(v)
                temp = heat + (temp - heat) * np.exp(-h / plant[TAU_T])
            # Midpoint prediction.
            drive = ua * max(1.0 - loss * temp, LEAST_GAIN)
            xp = x + 0.5 * h * v
            for k in range(len(pg)):
                drive *= call(gains, k, pg, xp, v, ua, temp)
            sign = 1.0 if v > 0.0 else -1.0
            if v == 0.0:
                level = 0.0
            elif dry and level * v <= 0.0:
                level = sign * friction(levels, pl, wave, x, v, ua, temp)
            base = drive + external[i, 0] + acting - hyst
            link = coupling(plant, x - xl, v - vl) if two else 0.0
            a0 = (base - viscous * v - level - link) * per_mass
            vp = v + 0.5 * h * a0
            if v != 0.0 and vp * v < 0.0:
                vp = 0.0
            if hyst_f > 0.0 or hyst_s > 0.0:
                goal, path = hyst_f, np.abs(vp) * h / plant[HYST_X]
                if hyst_s > 0.0:
                    goal += (hyst_s - hyst_f) * np.exp(-((vp / plant[HYST_V]) ** 2))
                    path *= hyst_s / max(goal, LEAST_LEVEL * hyst_s)
                if wave[0] != 0.0:
                    share = varied(1.0, wave, xp)  # of the level; the stiffness before it does not vary
                    goal *= share
                    path /= max(share, LEAST_LEVEL)
                way = np.exp(-path)
                goal = goal if vp > 0.0 else -goal
                before = hyst
                hyst = goal + (hyst - goal) * way
                base += before - 0.5 * (before + hyst)
            force = base - acting
            acting = summed(forces, pf, xp, vp, ua, temp)
            force += acting
            force -= viscous * vp
            if mod != 0.0:
                w = plant[MOD_N] * plant[TURN_X]
                jm = total - jl + mod * np.sin(w * xp + plant[MOD_PHASE])
                per_mass = 1.0 / max(jm, 0.05 * total)
                force -= 0.5 * vp * vp * mod * w * np.cos(w * xp + plant[MOD_PHASE])
            if two:
                al0 = (link - plant[LOAD_VISCOUS] * vl) / jl
                xlp = xl + 0.5 * h * vl
                vlp = vl + 0.5 * h * al0
                link = coupling(plant, xp - xlp, vp - vlp)
                al = (link - plant[LOAD_VISCOUS] * vlp) / jl
                xl += h * vlp
                vl += h * al
                force -= link
            if dry:
                if v != 0.0:
                    vm = vp if vp != 0.0 else sign * TINY_SPEED
                    level = sign * friction(levels, pl, wave, xp, vm, ua, temp)
                xs = x
                x, v, rest = slide(x, v, (force - level) * per_mass, h)
                if rest > 0.0:
                    break_p = friction(levels, pl, wave, xs, TINY_SPEED, ua, temp)
                    break_m = friction(levels, pl, wave, xs, -TINY_SPEED, ua, temp)
                    v = leave(force, break_p, break_m) * per_mass * rest
                    x += 0.5 * v * rest
            else:
                a = force * per_mass
                x += h * (v + 0.5 * h * a)
                v += h * a
        out[i, OUT_APPLIED] = applied / sub
