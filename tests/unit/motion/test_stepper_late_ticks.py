"""A stepper stays on its profile through ticks that come late, and never swings about its goal."""

from __future__ import annotations

import numpy as np
import pytest

from sioms.client.command import command
from sioms.motion import AxisBank, AxisKind, AxisSettings
from sioms.protocol.flags import NodeClass
from sioms.protocol.records import numpy_dtype

TICK_NS = 1_000_000
STEP = 1.25e-5


class NoMarkers:
    def capture(self, token_or_number: int, *, signal: bool) -> tuple[int, int]:
        raise NotImplementedError

    def state(self, number: int, generation: int) -> bool | None:
        raise NotImplementedError

    def signal(self, number: int, generation: int, now_ns: int) -> None:
        raise NotImplementedError


@pytest.mark.parametrize("k", [None, 200.0])
@pytest.mark.parametrize("seed", range(4))
def test_late_ticks_bring_no_overshoot(k: float | None, seed: int) -> None:
    axis = AxisSettings(name="belt", kind=AxisKind.STEPPER, velocity_max=0.25, acceleration_max=1.0, k=k)
    bank = AxisBank([axis], tick_s=1e-3, markers=NoMarkers(), capacity=16)
    random = np.random.default_rng(seed)
    now_ns = 1_000_000_000
    output = bank.tick(now_ns, np.zeros(1), np.zeros(1, dtype=np.int64)).copy()
    for target in (0.05, 0.2, 0.0):
        start = float(output[0])
        records = np.frombuffer(command(position=target), numpy_dtype(NodeClass.AXIS))
        bank.append(records, np.array([0]), now_ns)
        beyond = 0.0
        for _ in range(2500):
            now_ns += TICK_NS * (int(random.integers(2, 30)) if random.random() < 0.03 else 1)
            measured = np.round(output / STEP) * STEP
            output = bank.tick(now_ns, measured, np.zeros(1, dtype=np.int64)).copy()
            beyond = max(beyond, (float(output[0]) - target) * np.sign(target - start))
        assert float(output[0]) == pytest.approx(target, abs=1e-6)
        assert beyond < (1e-9 if k is None else 2e-3)
        assert bank.is_idle(np.array([0]))
