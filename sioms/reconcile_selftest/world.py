"""Integrate the drawn axes: all of them side by side, at a fixed small step, until the records are full.

Semi-implicit Euler steps of 25 us; dry friction as a spring-loaded bristle that breaks (elasto-plastic);
backlash contact as a spring with damping in proportion to the depth; everything written against time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile_selftest.draw import SAMPLE_S, Array, Axis

STEP_S = 25e-6


@dataclass(frozen=True, slots=True)
class Recording:
    """What is measured of one axis in one record; shape (n,)."""

    counts: NDArray[np.int64]
    command: Array
    force: Array
    force_measured: Array
    index: NDArray[np.bool_]


def _row(axes: list[Axis], effect: str, symbol: str, default: float = 0.0) -> Array:
    return np.array([{**a.named, **a.nameless}.get(effect, {}).get(symbol, default) for a in axes])


def _has(axes: list[Axis], effect: str) -> Array:
    return np.array([1.0 if effect in a.named or effect in a.nameless else 0.0 for a in axes])


def _held(queue: Array, start: Array) -> Array:
    """Mean over one step of commands that are held for a sample each; ``start`` in samples, shape (m,)."""
    end = start + STEP_S / SAMPLE_S
    first, last = np.floor(start + 1e-9).astype(int), np.floor(end - 1e-9).astype(int)
    each = np.arange(queue.shape[1])
    share = np.where(last > first, (end - last) / (end - start), 0.0)
    return np.asarray((1.0 - share) * queue[first, each] + share * queue[last, each])


@dataclass(slots=True)
class World:
    """All axes side by side. Use from one thread."""

    axes: list[Axis]
    rng: np.random.Generator
    heat: Array

    def record(self, commands: list[Array]) -> list[Recording]:
        """Run one record from rest at zero; the heat carries over from the last one."""
        axes, rng = self.axes, self.rng
        m, n = len(axes), len(commands[0])
        inertia = np.array([a.inertia for a in axes]) + _row(axes, "payload", "J_extra")
        viscous = np.array([a.viscous for a in axes]) + _row(axes, "viscous", "b_extra")
        rated = np.array([a.rated for a in axes])
        turn = 2.0 * np.pi / np.array([a.pitch for a in axes])
        quantum = np.array([a.resolution for a in axes])
        coarse = _row(axes, "encoder_quantisation", "factor", 1.0)
        scale = _row(axes, "encoder_scale", "gain", 1.0)
        k, kz, kp, _, top = (np.array([a.gains[i] for a in axes]) for i in range(5))
        fc = np.maximum(_row(axes, "coulomb", "Fc"), _row(axes, "stribeck", "Fc"))
        extra = _row(axes, "stribeck", "Fs") - _row(axes, "stribeck", "Fc")
        vs = _row(axes, "stribeck", "vs", 1.0)
        bristle = np.maximum(fc, 1e-9) / (0.5 * quantum)
        off = _row(axes, "offset", "off")
        g_amp, g_ph = _row(axes, "gravity", "amp"), _row(axes, "gravity", "phase")
        c_amp, c_n, c_ph = (_row(axes, "cogging", s) for s in ("amp", "n", "phase"))
        r_d, r_n, r_ph = (_row(axes, "torque_ripple", s) for s in ("depth", "n", "phase"))
        late = _row(axes, "delay", "delay")
        limit = np.where(_has(axes, "saturation") > 0, _row(axes, "saturation", "limit"), np.inf)
        loss, tau = _row(axes, "thermal_gain", "loss"), _row(axes, "thermal_gain", "tau", 1.0)
        cubic = _row(axes, "cubic_spring", "k")
        d_c, d_v = _row(axes, "falling_drag", "c"), _row(axes, "falling_drag", "v0", 1.0)
        h_f, h_x = _row(axes, "hysteresis", "level"), _row(axes, "hysteresis", "length", 1.0)
        s_d, s_n, s_ph = (_row(axes, "swinging_inertia", s) for s in ("depth", "n", "phase"))
        knock = self._knocks(n)
        two = np.maximum(_has(axes, "elastic"), _has(axes, "backlash"))
        share = _row(axes, "elastic", "load_fraction") + _row(axes, "backlash", "load_fraction")
        loose = _row(axes, "backlash", "gap") * 0.5
        hz = np.where(loose > 0, 110.0, _row(axes, "elastic", "f_res"))
        zeta = np.where(loose > 0, 0.08, _row(axes, "elastic", "zeta"))
        reduced = inertia * share * (1.0 - share)
        stiff = reduced * (2 * np.pi * hz) ** 2
        damp = 2.0 * zeta * np.sqrt(stiff * reduced)
        load = np.where(two > 0, inertia * share, 1.0)
        motor = inertia * (1.0 - share)

        sub = round(SAMPLE_S / STEP_S)
        x, v, xl, vl = (np.zeros(m) for _ in range(4))
        z, hyst = np.zeros(m), np.zeros(m)
        disturbance = np.zeros(m)
        e_old, u_old = np.zeros(m), np.zeros(m)
        queue = np.zeros((n + 12, m))
        counts = np.zeros((n, m), dtype=np.int64)
        force, measured, marks = np.zeros((n, m)), np.zeros((n, m)), np.zeros((n, m), dtype=bool)
        command = np.stack(commands, axis=1)
        for i in range(n):
            seen = scale * x + 0.3 * quantum * rng.standard_normal(m)
            counts[i] = (np.floor(seen / (quantum * coarse)) * coarse).astype(np.int64)
            e = command[i] - counts[i] * quantum
            u = np.clip(k * (e + kz * e_old) - kp * u_old, -top, top)
            e_old, u_old = e, u
            force[i] = u
            queue[i + 10] = u
            disturbance += SAMPLE_S / 0.02 * -disturbance + 0.003 * rated * np.sqrt(
                2 * SAMPLE_S / 0.02
            ) * rng.standard_normal(m)
            before = np.floor(x * turn / (2 * np.pi))
            passed = np.zeros(m, dtype=bool)
            mean = np.zeros(m)
            for s in range(sub):
                mean += np.clip(_held(queue, i + 10 + (s * STEP_S - late) / SAMPLE_S), -limit, limit)
                # Velocities live half a step after positions (leapfrog), so the force that moves them half a step before.
                acting = np.clip(_held(queue, i + 10 + ((s - 0.5) * STEP_S - late) / SAMPLE_S), -limit, limit)
                self.heat += STEP_S / tau * ((acting / rated) ** 2 - self.heat) * (loss > 0)
                theta = turn * x
                f = (
                    acting * (1.0 - loss * self.heat) * (1.0 + r_d * np.sin(r_n * theta + r_ph))
                    + disturbance
                    + knock[i]
                )
                f += (
                    off
                    + g_amp * np.sin(theta + g_ph)
                    + c_amp * np.sin(c_n * theta + c_ph)
                    - viscous * v
                    - cubic * x**3
                )
                f -= d_c * v / (1.0 + (v / d_v) ** 2)
                hyst += np.abs(v) * STEP_S / h_x * (h_f * np.sign(v) - hyst)
                f -= hyst
                level = fc + extra * np.exp(-((v / vs) ** 2))
                z = np.clip(z + v * STEP_S, -level / bristle, level / bristle)
                f -= (
                    bristle * z
                    + (np.abs(z) < 0.999 * level / bristle) * (fc > 0) * 1.2 * np.sqrt(bristle * motor) * v
                )
                wind = x - xl
                depth = np.where(loose > 0, np.sign(wind) * np.maximum(np.abs(wind) - loose, 0.0), wind)
                link = np.where((loose > 0) & (depth == 0.0), 0.0, stiff * depth + damp * (v - vl)) * two
                link = np.where((loose > 0) & (link * depth < 0), 0.0, link)
                mass = motor * (1.0 + s_d * np.sin(s_n * theta + s_ph))
                f -= 0.5 * motor * s_d * s_n * turn * np.cos(s_n * theta + s_ph) * v * v
                v = v + STEP_S * (f - link) / mass
                x = x + STEP_S * v
                vl = vl + STEP_S * link / load
                xl = xl + STEP_S * vl
                now = np.floor(x * turn / (2 * np.pi))
                passed |= now != before
                before = now
            measured[i] = mean / sub + 0.004 * rated * rng.standard_normal(m)
            marks[i] = passed
        return [
            Recording(counts[:, j], command[:, j], force[:, j], measured[:, j], marks[:, j]) for j in range(m)
        ]

    def _knocks(self, n: int) -> Array:
        """Draw short force pulses at random times for axes that are knocked."""
        out = np.zeros((n, len(self.axes)))
        for j, a in enumerate(self.axes):
            spec = a.nameless.get("knocks")
            if spec is None:
                continue
            for at in self.rng.integers(200, n - 100, int(spec["count"])):
                out[at : at + 25, j] += spec["height"] * self.rng.choice([-1.0, 1.0])
        return out
