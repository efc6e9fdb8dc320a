"""A motor driven where its load swings alone: no inertia shows, and yet the motion follows from the force."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from sioms.reconcile.errors import BadInputError
from sioms.reconcile.model import AxisModel
from sioms.reconcile.prepare import Options, prepare
from sioms.reconcile.records import Record, Session
from sioms.reconcile.scale import follows
from sioms.reconcile.thresholds import FORETOLD

DT, N = 4e-4, 8000
#: The two inertias as one, of which the motor has a tenth, as a test bench with a flexible coupling.
BENCH = AxisModel(True, DT, 9e-3, 0.13, 2e-6, 2 * np.pi, 14.0, 12.0, refine=("inertia", "viscous"))


def torque(seed: int) -> NDArray[np.float64]:
    """Return sines about the frequency at which the load swings alone, with random phases."""
    rng = np.random.default_rng(seed)
    t = np.arange(N) * DT
    return np.sum([np.sin(2 * np.pi * (f * t + rng.random())) for f in range(12, 72, 2)], axis=0)


def bench(u: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Integrate both inertias; return the angle of the motor, read with noise."""
    stiff, damp, jm, jl, fine = 150.0, 0.02, 9e-4, 8.1e-3, 8
    x, y, v, w, out = 0.0, 0.0, 0.0, 0.0, []
    for torque_now in u:
        out.append(x)
        for _ in range(fine):
            between = stiff * (x - y) + damp * (v - w)
            v += DT / fine * (torque_now - between - 0.01 * v) / jm
            w += DT / fine * (between - 0.05 * w) / jl
            x, y = x + DT / fine * v, y + DT / fine * w
    return np.array(out) + np.random.default_rng(seed).normal(scale=2e-6, size=len(out))


def test_an_elastic_machine_about_its_resonance_is_not_refused() -> None:
    u = torque(1)
    session = Session((Record("bench", bench(u, 2), u),))
    assert follows(session.records) > 1.6 * FORETOLD
    said = " ".join(prepare(session, BENCH, Options(pictures=False)).notes)
    assert "the motion follows from it" in said


def test_a_force_of_another_run_is() -> None:
    record = Record("bench", bench(torque(1), 2), torque(3))
    assert follows((record,)) < 0.8 * FORETOLD
    with pytest.raises(BadInputError, match="not of the same run"):
        prepare(Session((record,)), BENCH, Options(pictures=False))
    hiss = np.random.default_rng(5).normal(size=N)
    assert abs(follows((replace(record, force=hiss),))) < 0.1 * FORETOLD
    shuffled = replace(record, force=np.random.default_rng(4).permutation(record.force))
    assert abs(follows((shuffled,))) < 0.1 * FORETOLD
