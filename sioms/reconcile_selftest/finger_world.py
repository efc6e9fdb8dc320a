"""Touch the drawn fingers and record frames, as a rig would: one array per experiment, nothing of the truth in it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sioms.reconcile_selftest.finger_draw import HiddenFinger
from sioms.reconcile_selftest.layer import HARMONICS, Body, Indenters, strain_factors

Array = NDArray[np.float64]
Tables = dict[str, Array]

RATE_HZ, FAST_HZ = 33.0, 432.0
FRAMES = 20
SHEAR_PA = 8.3e4
LOAD_NOISE, CELL_NOISE = 3.0, 3.5  # of a touch's load, and of a frame of the load cell [N/m]
_HOLD_S, _GAP_S = 1.0, 2.0
_DEPTHS = 9


class FingerWorld:
    """One finger with its rig. Not thread-safe; time runs on from experiment to experiment."""

    def __init__(self, finger: HiddenFinger, rng: np.random.Generator) -> None:
        self.f, self._rng = finger, rng
        nu = finger.poisson + float(finger.named.get("poisson", {"dnu": np.zeros(1)})["dnu"][0])
        body = Body(finger.core, finger.outer, SHEAR_PA, nu)
        self._indenters = Indenters(body)
        count = len(finger.angle)
        self.angle = finger.angle + self._value("angle_scatter", "dt", count)
        self.radius = finger.radius + self._value("depth_scatter", "dr", count)
        self.gain = finger.gain * (1.0 + self._value("gain_scatter", "g", count))
        self._factors = self._by_depth(body)
        self._clock = 2.0
        self._thermal = float(rng.uniform(0.0, 6.0))
        self._power_up = self._temperature(0.0)
        self._touches = 0

    def _value(self, effect: str, symbol: str, count: int = 1) -> Array:
        return self.f.named[effect][symbol] if effect in self.f.named else np.zeros(count)

    def _one(self, effect: str, symbol: str) -> float:
        return float(self._value(effect, symbol)[0])

    def _by_depth(self, body: Body) -> Array:
        """Strain per harmonic for every element, by a polynomial through a few depths, shape (ns, waves, 2)."""
        low, high = self.radius.min() - 1e-6, self.radius.max() + 1e-6
        if high - low < 1e-5:
            return np.repeat(strain_factors(body, float(self.radius.mean()))[None], len(self.radius), axis=0)
        x = np.cos(np.pi * (np.arange(_DEPTHS) + 0.5) / _DEPTHS)
        nodes = 0.5 * (low + high) + 0.5 * (high - low) * x
        table = np.array([strain_factors(body, float(r)) for r in nodes])
        fit = np.polynomial.chebyshev.chebfit(x, table.reshape(_DEPTHS, -1), _DEPTHS - 1)
        at = (2.0 * self.radius - low - high) / (high - low)
        out: Array = np.polynomial.chebyshev.chebval(at, fit).T.reshape(len(self.radius), HARMONICS + 1, 2)
        return out

    def _temperature(self, t: float | Array) -> Array:
        return np.asarray(22.0 + np.sin(2 * np.pi * np.asarray(t) / 1500.0 + self._thermal))

    def steady(self, place: float, load: float, radius: float, time: float) -> Array:
        """Return the outputs long after the load came on, without zero, shape (ns,)."""
        f = self.f
        p, stuck = self._indenters.touch(load, radius)
        q_even = self._one("sliding_friction", "f") * p
        q_odd = self._one("adhesion", "share") * stuck
        middle = place + self._one("angle_offset", "off")
        k = np.arange(HARMONICS + 1)
        strain = np.zeros(len(self.angle))
        for share, weight in zip(
            *np.polynomial.legendre.leggauss(5), strict=True
        ):  # an element averages over its width
            x = k * (self.angle + f.extent * share - middle)[:, None]
            # q cos kt about the touch strains as the sine family: e = -e^q sin with this sign of the factors
            here = self._factors[:, :, 0] * p * np.cos(x) + self._factors[:, :, 1] * (
                q_odd * np.cos(x) - q_even * np.sin(x)
            )
            strain += 0.5 * weight * here.sum(1)
        out: Array = -strain / self.gain
        if "strip_peak" in f.named:
            away = (self.angle - middle) / self._one("strip_peak", "width")
            out = out * (1.0 + self._one("strip_peak", "c") * np.exp(-(away**2)))
        if "strip_inhomogeneity" in f.named:  # of the layer: before whatever the elements make of its strain
            e = f.named["strip_inhomogeneity"]
            turn = 2 * np.pi * place / float(e["period"][0]) + float(e["phase"][0])
            out = out * (1.0 + float(e["G"][0]) * np.sin(turn))
        out = out + self._value("quadratic", "q", len(out)) * out**2
        if "cubic" in f.nameless:
            out = out + f.nameless["cubic"]["k"] * out**3
        if "cross_talk" in f.named:
            x_ = self._one("cross_talk", "x")
            out = out + x_ * (np.concatenate([[0.0], out[:-1]]) + np.concatenate([out[1:], [0.0]]))
        if "proximity" in f.named:
            out = out + self._one("proximity", "A") * np.exp(
                -np.abs(self.angle - middle) / self._one("proximity", "range")
            )
        if "ageing" in f.nameless:
            out = out * (1.0 + f.nameless["ageing"]["share"] * min(time / 2500.0, 1.5))
        if "warm_gain" in f.nameless:
            out = out * (1.0 + f.nameless["warm_gain"]["k"] * float(self._temperature(time) - self._power_up))
        return out

    def _read(self, ideal: Array, time: Array) -> Array:
        """Add zero, drift, line, noise and the converter's step; per cent."""
        f, rng = self.f, self._rng
        out = ideal + self._one("temperature_drift", "k") * (self._temperature(time) - self._power_up)[:, None]
        if "mains_line" in f.named:
            phase = 0.7 * np.arange(ideal.shape[1]) ** 2
            out = out + self._one("mains_line", "a") * np.sin(
                2 * np.pi * self._one("mains_line", "f") * time[:, None] + phase
            )
        out = out + f.noise * rng.standard_normal(ideal.shape)
        out = np.round(out / f.step) * f.step
        if "dead_element" in f.named:
            out[:, int(self._one("dead_element", "index"))] = 0.0
        return 100.0 * out

    def _cell(self, load: Array) -> Array:
        gain = 1.0 + self._one("force_gain", "g")
        return np.asarray(gain * load + CELL_NOISE * self._rng.standard_normal(len(load)))

    def touches(self, place: Array, load: Array, radius: Array) -> Tables:
        """Touch at places [rad] with loads [N/m] and indenters [m]; baseline frames, a second's hold, frames under
        load.
        """
        raw, time, touch, phase, force = [], [], [], [], []
        step = np.arange(FRAMES) / RATE_HZ
        late = self.f.named.get("creep")
        for j in range(len(place)):
            self._clock += _GAP_S
            true = max(float(load[j]) + LOAD_NOISE * float(self._rng.standard_normal()), 2.0)
            still = np.zeros((FRAMES, len(self.angle)))
            onset = self._clock + step[-1]
            under = onset + _HOLD_S + step
            out = np.repeat(self.steady(float(place[j]), true, float(radius[j]), onset)[None], FRAMES, axis=0)
            if late is not None:
                out = out * (1.0 - float(late["c"][0]) * np.exp(-(under - onset) / float(late["tau"][0])))[:, None]
            if "knocks" in self.f.nameless and self._touches % 17 == 5:
                out = out + self.f.nameless["knocks"]["height"] * self._rng.standard_normal(len(self.angle))
            self._touches += 1
            for number, when, ideal, pressed in ((0, self._clock + step, still, 0.0), (1, under, out, true)):
                raw.append(self._read(ideal, when))
                time.append(when)
                phase.append(np.full(FRAMES, number))
                touch.append(np.full(FRAMES, j))
                force.append(self._cell(np.full(FRAMES, pressed)))
            self._clock = float(under[-1])
        clock = np.concatenate(time)
        return {
            "raw": np.concatenate(raw),
            "time": clock,
            "touch": np.concatenate(touch),
            "phase": np.concatenate(phase),
            "force": np.concatenate(force),
            "temperature": self._thermometer(clock),
            "cmd_theta": np.degrees(place),
            "cmd_P": load,
            "cmd_rc": 1e3 * radius,
            "fs": np.array(RATE_HZ),
        }

    def _thermometer(self, time: Array) -> Array:
        return np.asarray(self._temperature(time) + 0.02 * self._rng.standard_normal(len(time)))

    def untouched(self, frames: int, rate: float, averaged: int = 1) -> Tables:
        """Record untouched frames, each the mean of some."""
        time = self._clock + np.arange(1, frames + 1) / rate
        self._clock = float(time[-1])
        if averaged == 1:
            raw = self._read(np.zeros((frames, len(self.angle))), time)
            warm = self._thermometer(time)
        else:
            near = time[:, None] + np.arange(averaged) / RATE_HZ
            raw = self._read(np.zeros((near.size, len(self.angle))), near.ravel()).reshape(frames, averaged, -1).mean(1)
            warm = self._thermometer(near.ravel()).reshape(frames, averaged).mean(1)
        nothing = np.full(frames, -1)
        return {
            "raw": raw,
            "time": time,
            "touch": nothing,
            "phase": np.full(frames, 2),
            "force": self._cell(np.zeros(frames)),
            "temperature": warm,
            "fs": np.array(rate),
        }

    def session(self) -> dict[str, Tables]:
        """Record everything: edges along the arc, indenters, loads, warmth and noise."""
        low, high = np.degrees(self.f.angle.min()) - 4.0, np.degrees(self.f.angle.max()) + 4.0
        if self.f.one_place:
            middle = float(self.f.angle[len(self.f.angle) // 2])
            loads = np.tile([60.0, 100.0, 140.0, 180.0, 220.0], 8)
            return {
                "loads": self.touches(np.full(40, middle), loads, np.zeros(40)),
                "noise": self.untouched(6000, FAST_HZ),
            }
        places = np.radians(np.arange(low, high, 1.5))
        few = np.radians(np.linspace(low + 25.0, high - 25.0, 12))
        kinds = np.array([3e-3, 8e-3, np.inf])
        heavy = np.tile([40.0, 80.0, 160.0, 250.0], 6)
        at = np.repeat(few[[1, 5, 9]], 8)
        return {
            "edge": self.touches(places, np.full(len(places), 200.0), np.zeros(len(places))),
            "indenters": self.touches(np.tile(few, 3), np.full(36, 200.0), np.repeat(kinds, 12)),
            "loads": self.touches(at, heavy, np.tile(np.repeat([0.0, np.inf], 4), 3)),
            "thermal": self.untouched(60, 1.0 / 100.0, 40),
            "noise": self.untouched(6000, FAST_HZ),
        }
