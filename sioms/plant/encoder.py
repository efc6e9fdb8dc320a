"""From true position to reading: resolution, scale and eccentricity of n encoders, index marks.

The effects of place ENCODER. Index marks sit at multiples of the pitch of the true position.
"""

import math

import numpy as np
from numpy.typing import NDArray

from .effects import Effect

Array = NDArray[np.float64]


class Encoder:
    """Encoders of a bank.

    Args:
        step: resolution [m or rad], shape (n,); 0 for an ideal encoder.
        index_pitch: distance of index marks [m or rad]; infinite where there is none.
        effects: the encoder effects of the bank.

    Attributes:
        position: reading [m or rad].
        index: True where a mark was passed since the reading before.
        latch: reading at the mark passed last, not a number before the first.
    """

    def __init__(self, step: Array, index_pitch: Array, effects: tuple[Effect, ...] = ()) -> None:
        n = step.size
        self.position = np.zeros(n)
        self.index = np.zeros(n, dtype=np.bool_)
        self.latch = np.full(n, np.nan)
        self._gain: Array | None = None
        self._waves: list[tuple[Array, Array, Array]] = []
        self._step = step.copy()
        for effect in effects:
            self._take(effect)
        self._ideal = self._step == 0
        self._step[self._ideal] = 1.0
        self._per_step = 1 / self._step
        self._any_ideal, self._all_ideal = bool(self._ideal.any()), bool(self._ideal.all())
        self._has_index = bool(np.isfinite(index_pitch).any())
        self._per_pitch, self._pitch = 1 / index_pitch, index_pitch
        self._cell = np.zeros(n)
        self._new_cell, self._true = np.zeros((2, n))

    def _take(self, effect: Effect) -> None:
        """Enter an effect."""
        values = effect.values
        match effect.name:
            case "encoder_scale":
                self._gain = values["gain"] if self._gain is None else self._gain * values["gain"]
            case "encoder_quantisation":
                self._step *= values["factor"]
            case _:
                self._waves.append((values["amplitude"], 2 * math.pi / values["pitch"], values["phase"]))

    def start(self, position: Array) -> None:
        """Take the true position without passing any index mark."""
        np.floor(position * self._per_pitch, out=self._cell)
        self.read(position)

    def read(self, position: Array) -> None:
        """Take the true position [m or rad], shape (n,), and set the attributes."""
        self._reading(position, self.position)
        if self._has_index:
            self._pass_index(position)

    def _reading(self, position: Array, out: Array) -> None:
        np.copyto(out, position)
        for amplitude, wave_number, phase in self._waves:
            out += amplitude * np.sin(wave_number * position + phase)
        if self._gain is not None:
            np.multiply(out, self._gain, out=out)
        if self._all_ideal:
            return
        if self._any_ideal:
            exact = out[self._ideal]
        # The small surplus keeps a position that is a multiple of the step from falling below it.
        np.multiply(out, self._per_step, out=out)
        np.add(out, 1e-9, out=out)
        np.floor(out, out=out)
        np.multiply(out, self._step, out=out)
        if self._any_ideal:
            out[self._ideal] = exact

    def _pass_index(self, position: Array) -> None:
        """Find the marks between this position and the one before, and latch the reading at the mark."""
        np.multiply(position, self._per_pitch, out=self._new_cell)
        np.floor(self._new_cell, out=self._new_cell)
        np.not_equal(self._new_cell, self._cell, out=self.index)
        if np.count_nonzero(self.index):
            # The last mark passed is the lower edge of the new cell going up, its upper edge going down.
            mark = np.where(self._new_cell > self._cell, self._new_cell, self._new_cell + 1)
            np.copyto(self._true, mark * np.where(np.isfinite(self._pitch), self._pitch, 0.0))
            reading = np.empty_like(self._true)
            self._reading(self._true, reading)
            np.copyto(self.latch, reading, where=self.index)
            np.copyto(self._cell, self._new_cell)
