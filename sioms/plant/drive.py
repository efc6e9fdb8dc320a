"""From the commanded force to the force of the drive: the effects of place DRIVE, once a tick.

A command is held over its tick, as by the converter of a real drive.
"""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .effects import Effect

Array = NDArray[np.float64]


class DriveEffect(Protocol):
    """Changes the force of the drive."""

    def apply(self, force: Array) -> None:
        """Change force [N], shape (n,), in place."""


class Delay:
    """Transport delay: whole ticks by a ring of commands, the remainder as the mean over the tick.

    A delay of m + f ticks makes the held command change f into the tick; the mean force of the tick,
    hence its impulse, is exact.
    """

    def __init__(self, effect: Effect, tick_s: float) -> None:
        ticks = effect.values["delay_s"] / tick_s
        whole = np.floor(ticks + 1e-9)
        self._fraction = np.maximum(ticks - whole, 0.0)
        self._rest = 1 - self._fraction
        self._axes = np.arange(ticks.size)
        self._length = int(whole.max()) + 2
        self._ring = np.zeros((self._length, ticks.size))
        self._back = whole.astype(np.intp)
        self._newest = 0

    def apply(self, force: Array) -> None:
        """Take the newest command and give the delayed one."""
        self._newest = (self._newest + 1) % self._length
        self._ring[self._newest] = force
        late = (self._newest - self._back) % self._length
        np.multiply(self._ring[late, self._axes], self._rest, out=force)
        force += self._fraction * self._ring[late - 1, self._axes]


class Lag:
    """First-order lag: mean over the tick of the response to held commands."""

    def __init__(self, effect: Effect, tick_s: float) -> None:
        tau = effect.values["tau_s"]
        ratio = tick_s / np.maximum(tau, 1e-6 * tick_s)
        self._keep = np.exp(-ratio)
        self._mean_of_gap = -np.expm1(-ratio) / ratio
        self._output, self._gap = np.zeros((2, tau.size))

    def apply(self, force: Array) -> None:
        """Replace the command by the mean output of this tick."""
        output, gap = self._output, self._gap
        np.subtract(output, force, out=gap)
        np.multiply(gap, self._keep, out=output)
        np.add(output, force, out=output)
        np.multiply(gap, self._mean_of_gap, out=gap)
        np.add(force, gap, out=force)


class SlewLimit:
    """Limited rate of change: mean over the tick of the ramp towards a held command."""

    def __init__(self, effect: Effect, tick_s: float) -> None:
        self._most = effect.values["rate"] * tick_s  # in a tick
        self._output, self._step, self._way = np.zeros((3, self._most.size))

    def apply(self, force: Array) -> None:
        """Replace the command by the mean output of this tick."""
        output, step, way = self._output, self._step, self._way
        np.subtract(force, output, out=way)
        np.minimum(way, self._most, out=step)
        np.maximum(step, -self._most, out=step)
        np.add(output, step, out=output)
        # a ramp that lasts for a share |step| / most of the tick is behind its end by half the step for so long
        np.copyto(force, output)
        np.multiply(step, np.abs(step), out=way)
        np.divide(way, -2.0 * self._most, out=way)
        np.add(force, way, out=force)


class Saturation:
    """Clips between -limit_minus and limit."""

    def __init__(self, effect: Effect, tick_s: float) -> None:
        self._low, self._high = -effect.values["limit_minus"], effect.values["limit"]

    def apply(self, force: Array) -> None:
        """Clip the command."""
        np.minimum(force, self._high, out=force)
        np.maximum(force, self._low, out=force)


class ThermalGain:
    """Force constant over temperature; the temperature follows the square of the force."""

    def __init__(self, effect: Effect, tick_s: float) -> None:
        values = effect.values
        self._loss = values["loss"]
        self._share = -np.expm1(-tick_s / values["tau_s"])
        self._inverse = 1 / values["rated_force"]
        self.temperature = values["start"].copy()
        self._work = np.zeros_like(self._loss)

    def apply(self, force: Array) -> None:
        """Warm up by this tick's command, then weaken it."""
        work = self._work
        np.multiply(force, self._inverse, out=work)
        np.multiply(work, work, out=work)
        np.subtract(work, self.temperature, out=work)
        np.multiply(work, self._share, out=work)
        np.add(self.temperature, work, out=self.temperature)
        np.multiply(self.temperature, self._loss, out=work)
        np.add(work, 1.0, out=work)
        np.divide(force, work, out=force)


# In the order of a drive: the command travels and is limited in rate, the current loop follows and limits, the motor
# weakens.
_ORDER: dict[str, Callable[[Effect, float], DriveEffect]] = {
    "delay": Delay,
    "lag": Lag,
    "slew_limit": SlewLimit,
    "saturation": Saturation,
    "thermal_gain": ThermalGain,
}


def build_drive(effects: tuple[Effect, ...], tick_s: float) -> list[DriveEffect]:
    """Return the drive's effects in the order of the drive."""
    return [make(effect, tick_s) for name, make in _ORDER.items() for effect in effects if effect.name == name]
