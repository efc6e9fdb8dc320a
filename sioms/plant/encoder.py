"""From true position to reading: resolution, scale and eccentricity of n encoders, index marks.

The effects of place ENCODER. Index marks sit at multiples of the pitch of the true position.
"""

import math

import numpy as np
from numpy.typing import NDArray

from .effects import Effect
from .motor_step import Encoders, read

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
        gain, step, waves = np.ones(n), step.copy(), []
        for effect in effects:
            values = effect.values
            match effect.name:
                case "encoder_scale":
                    gain = gain * values["gain"]
                case "encoder_quantisation":
                    step *= values["factor"]
                case _:
                    waves.append((values["amplitude"], 2 * math.pi / values["pitch"], values["phase"]))
        ideal = step == 0
        step[ideal] = 1.0
        amplitude, wave_number, phase = np.array(waves, dtype=np.float64).reshape(-1, 3, n).transpose(1, 0, 2)
        has_index = np.isfinite(index_pitch)
        self.position, self._true = np.zeros((2, n))
        self.index = np.zeros(n, dtype=np.bool_)
        self.latch = np.full(n, np.nan)
        self._cell, self._per_pitch = np.zeros(n), np.where(has_index, 1 / index_pitch, 0.0)
        self.record = Encoders(
            n=n, waves=len(waves), has_index=int(has_index.any()), true=self._true, reading=self.position,
            amplitude=amplitude.copy(), wave_number=wave_number.copy(), phase=phase.copy(), gain=gain,
            step=step, per_step=1 / step, ideal=ideal, pitch=np.where(has_index, index_pitch, 0.0),
            per_pitch=self._per_pitch, cell=self._cell, index=self.index, latch=self.latch,
        )  # fmt: skip

    def start(self, position: Array) -> None:
        """Take the true position without passing any index mark."""
        np.floor(position * self._per_pitch, out=self._cell)
        self.read(position)

    def read(self, position: Array) -> None:
        """Take the true position [m or rad], shape (n,), and set the attributes."""
        np.copyto(self._true, position)
        read(self.record)
