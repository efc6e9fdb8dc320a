"""A ball-screw stage whose preload varies once per turn, made here by a bristle equation in steps of 50 us, and what is
said of it.
"""

from __future__ import annotations

from math import copysign, exp, pi, sin

import numpy as np
import pytest

from sioms.reconcile.axis import analyse
from sioms.reconcile.model import AxisModel
from sioms.reconcile.prepare import Options
from sioms.reconcile.records import Record, Session
from sioms.reconcile.verdict import Outcome

DT, FINE, PITCH, COUNT = 2e-3, 40, 0.01, 1e-6
MASS, VISCOUS, FC, FS, VS, STIFFNESS = 40.0, 60.0, 25.0, 34.0, 0.008, 34.0 / 3e-5
NOMINAL = AxisModel(False, DT, MASS, VISCOUS, COUNT, PITCH, 100.0, 0.15)


def record(name: str, seed: int, depth: float, ripple: float, seconds: float = 2.5) -> Record:
    """Let a servo move the stage to and fro, ever slower, and write what it would log."""
    rng = np.random.default_rng(seed)
    count, h = int(seconds / DT), DT / FINE
    t = np.arange(count + 1) * DT
    aim = 0.03 * np.sin(2 * pi * rng.uniform(0.5, 0.6) * t * (1.0 - 0.12 * t)) + 0.004 * np.sin(2 * pi * 2.3 * t)
    x, v, z, held, last = 0.0, 0.0, 0.0, 0.0, 0.0
    place, force = np.empty(count), np.empty(count)
    for k in range(count):
        place[k] = seen = round(x / COUNT) * COUNT
        error = 30.0 * (aim[k] - seen) + (aim[k + 1] - aim[k]) / DT - (seen - last) / DT
        held, last = held + 15.0 * error * DT, seen
        force[k] = u = MASS * 60.0 * (error + held) + 0.2 * rng.standard_normal()
        for _ in range(FINE):
            turn = 2 * pi * x / PITCH
            g = (FC + (FS - FC) * exp(-((v / VS) ** 2))) * (1.0 + depth * sin(turn + 0.9))
            z += h * v
            z = copysign(abs(z) / (1.0 + STIFFNESS * abs(v) * h / g), z)
            drive = u * (1.0 + ripple * sin(4 * turn - 0.4))
            v += (drive - STIFFNESS * z - VISCOUS * v) / MASS * h
            x += v * h
    return Record(name, place, force)


@pytest.mark.parametrize(("depth", "ripple"), [(0.2, 0.0), (0.0, 0.06)])
def test_friction_that_varies_and_a_force_constant_that_does_are_told_apart(depth: float, ripple: float) -> None:
    session = Session(tuple(record(f"r{k}", k, depth, ripple) for k in range(2)))
    verdict = analyse(session, NOMINAL, Options(pictures=False))
    assert verdict.outcome is Outcome.NAMED
    found = verdict.model.effects
    assert found["lugre"]["Fc"] == pytest.approx(FC, rel=0.02)
    if depth:
        assert set(found) == {"lugre", "friction_variation"}
        assert found["friction_variation"] == pytest.approx({"depth": depth, "phase": 0.9, "n": 1.0}, rel=0.05)
    else:
        assert set(found) == {"lugre", "torque_ripple"}
        assert found["torque_ripple"] == pytest.approx({"depth": ripple, "phase": -0.4, "n": 4.0}, rel=0.05)
