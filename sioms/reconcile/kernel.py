"""The time step of an axis: one scalar loop that closes the loop or follows a measurement.

Two uses of the same plant. *Closed*: the controller sees the simulated, quantised position and computes the
force (what a user sees). *Tracking*: the recorded force drives the plant and a steady Kalman gain (l1, l2)
pulls the state to the recorded position; the innovation is what the model cannot predict over a short window.

Integration: every sample is cut into ``sub`` steps; smooth forces by the midpoint rule, dry friction by
exact splitting at the moment the speed crosses zero (then either stick or slip the other way), so that the
order is two away from events and the error of an event is of the order of one step's change of force.
Contact of a backlash is a stiff spring-damper whose frequency the caller chooses.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sioms.reconcile.effect import Array
from sioms.reconcile.jit import kernel, typed_list

TypedList = typed_list()

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
    LOAD_VISCOUS,
    MOD_A,
    MOD_PHASE,
    MOD_N,
    PLANT_SIZE,
) = range(25)
# Places in the controller row.
CTL_K, CTL_KZ, CTL_KP, CTL_KB, CTL_OFFSET, CTL_MAX, CTL_ALPHA, CTL_MEAN, CTL_SIZE = range(9)
# Columns of the output.
OUT_Y, OUT_FORCE, OUT_INNOVATION, OUT_X, OUT_V, OUT_APPLIED, OUT_T, OUT_SIZE = range(8)
TINY_SPEED = 1e-12
#: Samples for which a tracking model may be off before its speed is set anew, and over which speed is measured.
PATIENCE, MEASURED = 20, 10
#: A hot drive keeps at least this share of its force constant; keeps a wild trial value harmless.
LEAST_GAIN = 0.05


@kernel
def listed(functions: Any) -> Any:
    """Put state functions into the container that a compiled kernel takes at no cost per call."""
    out = TypedList()
    for f in functions:
        out.append(f)
    return out


@kernel
def smooth(forces: Any, n: int, p: Array, x: float, v: float, u: float, t: float) -> float:
    """Sum the FORCE effects."""
    total = 0.0
    for i in range(n):
        total += forces[i](x, v, u, t, p[i])
    return total


@kernel
def friction(levels: Any, n: int, p: Array, x: float, v: float, u: float, t: float) -> float:
    """Sum the FRICTION levels in the direction of v, never negative."""
    total = 0.0
    for i in range(n):
        total += levels[i](x, v, u, t, p[i])
    return max(total, 0.0)


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
def delayed(u: Array, n: int, start: float, end: float, delay: float, dt: float) -> float:
    """Mean over [start, end] inside sample n of the held command, late by ``delay``."""
    a, b = n * dt + start - delay, n * dt + end - delay
    i, j = int(np.floor(a / dt + 1e-9)), int(np.floor(b / dt - 1e-9))
    ui = u[i] if i >= 0 else 0.0
    if j <= i:
        return ui
    uj = u[j] if j >= 0 else 0.0
    cut = j * dt
    return (ui * (cut - a) + uj * (b - cut)) / (b - a)


@kernel
def slide(
    x: float,
    v: float,
    a: float,
    level: float,
    mass: float,
    force: float,
    h: float,
    break_p: float,
    break_m: float,
) -> tuple[float, float]:
    """Advance one step under constant ``force`` and dry friction, splitting at rest.

    Args:
        a: acceleration while sliding in the present direction.
        break_p, break_m: friction levels that hold against forward and backward motion.
    """
    if v != 0.0:
        v1 = v + a * h
        if v1 * v > 0.0:
            return x + 0.5 * (v + v1) * h, v1
        t0 = h * v / (v - v1) if v1 != v else h
        x += 0.5 * v * t0
        h -= t0
    if force > break_p:
        a = (force - break_p) / mass
    elif force < -break_m:
        a = (force + break_m) / mass
    else:
        return x, 0.0
    return x + 0.5 * a * h * h, a * h


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
    nf: int,
    pf: Array,
    levels: Any,
    nl: int,
    pl: Array,
    gains: Any,
    ng: int,
    pg: Array,
    l1: float,
    l2: float,
    lost: float,
    start: Array,
    sub: int,
    out: Array,
) -> None:
    """Run the axis over one record.

    Args:
        command, measured, force_in: shape (n,); ``command`` is read when closed, ``measured`` when tracking; ``force_in``
            is the whole force when tracking, and what is added to the controller's when closed.
        external: force on the axis beside the drive's, shape (n,).
        lost: innovation at which, held for ``PATIENCE`` samples, the speed is taken from the measurement.
        start: x, v, temperature, and error and force of the controller at the sample before the first.
        out: shape (n, OUT_SIZE), filled.
    """
    # Local tuples: picking a function out of a list costs ten times as much, handing tuples in a millisecond.
    force_of = (forces[0], forces[1], forces[2], forces[3], forces[4], forces[5])
    level_of = (levels[0], levels[1], levels[2], levels[3], levels[4], levels[5])
    gain_of = (gains[0], gains[1], gains[2], gains[3], gains[4], gains[5])
    n = command.shape[0]
    dt = plant[DT]
    h = dt / sub
    two = plant[LOAD] > 0.0
    total = plant[INERTIA]
    jl = total * plant[LOAD]
    jm = total - jl
    x, v, temp = start[0], start[1], start[2]
    xl, vl = x, v
    lagged = 0.0
    hyst = 0.0
    e_old, u_old, y_old, y_older, v_f = start[3], start[4], 0.0, 0.0, 0.0
    off = 0
    u_all = np.zeros(n)
    for i in range(n):
        y = plant[GAIN_Y] * x + plant[ECC_AMP] * np.sin(plant[TURN_X] * x + plant[ECC_PHASE])
        if closed:
            if plant[QUANTUM] > 0.0:
                y = np.round(y / plant[QUANTUM]) * plant[QUANTUM]
            if i == 0:
                y_old = y
                y_older = y
            if ctl[CTL_MEAN] > 0.0:
                v_f = 0.5 * (y - y_older) / dt
            else:
                v_f += ctl[CTL_ALPHA] * ((y - y_old) / dt - v_f)
            y_older = y_old
            y_old = y
            e = command[i] - y
            u = (
                ctl[CTL_K] * (e + ctl[CTL_KZ] * e_old)
                - ctl[CTL_KP] * u_old
                + ctl[CTL_KB] * v_f
                + ctl[CTL_OFFSET]
            )
            u = min(max(u, -ctl[CTL_MAX]), ctl[CTL_MAX])
            e_old, u_old = e, u
            u = min(max(u + force_in[i], -ctl[CTL_MAX]), ctl[CTL_MAX])
            innovation = 0.0
        else:
            u = force_in[i]
            innovation = measured[i] - y
            dx = l1 * innovation / plant[GAIN_Y]
            dv = l2 * innovation / plant[GAIN_Y]
            x += dx
            v += dv
            if plant[GAP] > 0.0 and np.abs(x - xl) < 0.5 * plant[GAP]:
                dv = 0.0
            xl += dx
            vl += dv
            off = off + 1 if np.abs(innovation) > lost else 0
            if off >= PATIENCE and i >= MEASURED:
                v = (measured[i] - measured[i - MEASURED]) / (MEASURED * dt * plant[GAIN_Y])
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
            if plant[DELAY] > 0.0:
                ua = delayed(u_all, i, s * h, (s + 1) * h, plant[DELAY], dt)
            if plant[LAG] > 0.0:
                decay = np.exp(-h / plant[LAG])
                nxt = ua + (lagged - ua) * decay
                ua = ua + (lagged - ua) * (1.0 - decay) * plant[LAG] / h
                lagged = nxt
            ua = min(max(ua, -plant[LIMIT]), plant[LIMIT])
            applied += ua
            if plant[LOSS] > 0.0:
                heat = (ua / plant[RATED]) ** 2
                temp = heat + (temp - heat) * np.exp(-h / plant[TAU_T])
            # Midpoint prediction.
            drive = ua * max(1.0 - plant[LOSS] * temp, LEAST_GAIN)
            xp = x + 0.5 * h * v
            for k in range(ng):
                drive *= gain_of[k](xp, v, ua, temp, pg[k])
            sign = 1.0 if v > 0.0 else -1.0
            level = 0.0
            if v != 0.0 and nl > 0:
                level = sign * friction(level_of, nl, pl, x, v, ua, temp)
            base = drive + external[i] + smooth(force_of, nf, pf, x, v, ua, temp) - hyst
            link = coupling(plant, x - xl, v - vl) if two else 0.0
            a0 = (base - plant[VISCOUS] * v - level - link) / jm
            vp = v + 0.5 * h * a0
            if v != 0.0 and vp * v < 0.0:
                vp = 0.0
            if plant[HYST_F] > 0.0:
                way = np.exp(-np.abs(vp) * h / plant[HYST_X])
                goal = plant[HYST_F] if vp > 0.0 else -plant[HYST_F]
                before = hyst
                hyst = goal + (hyst - goal) * way
                base += before - 0.5 * (before + hyst)
            force = (
                base - smooth(force_of, nf, pf, x, v, ua, temp) + smooth(force_of, nf, pf, xp, vp, ua, temp)
            )
            force -= plant[VISCOUS] * vp
            if plant[MOD_A] != 0.0:
                w = plant[MOD_N] * plant[TURN_X]
                jm = total - jl + plant[MOD_A] * np.sin(w * xp + plant[MOD_PHASE])
                jm = max(jm, 0.05 * total)
                force -= 0.5 * vp * vp * plant[MOD_A] * w * np.cos(w * xp + plant[MOD_PHASE])
            if two:
                al0 = (link - plant[LOAD_VISCOUS] * vl) / jl
                xlp = xl + 0.5 * h * vl
                vlp = vl + 0.5 * h * al0
                link = coupling(plant, xp - xlp, vp - vlp)
                al = (link - plant[LOAD_VISCOUS] * vlp) / jl
                xl += h * vlp
                vl += h * al
                force -= link
            if nl > 0:
                if v != 0.0:
                    level = sign * friction(
                        level_of, nl, pl, xp, vp if vp != 0.0 else sign * TINY_SPEED, ua, temp
                    )
                x, v = slide(
                    x,
                    v,
                    (force - level) / jm,
                    level,
                    jm,
                    force,
                    h,
                    friction(level_of, nl, pl, x, TINY_SPEED, ua, temp),
                    friction(level_of, nl, pl, x, -TINY_SPEED, ua, temp),
                )
            else:
                a = force / jm
                x += h * (v + 0.5 * h * a)
                v += h * a
        out[i, OUT_APPLIED] = applied / sub
