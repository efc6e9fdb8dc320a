"""Cost of a tick of the simulated physics by number of axes and by what acts on them.

Run: python tests/bench/bench_plant.py. Reports percentiles; asserts nothing.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from sioms.plant.effects import build_effects
from sioms.plant.motor import MotorBank
from sioms.plant.parameters import Motor, Wall
from sioms.plant.stepper import Stepper, StepperBank

TICKS = 2000
TICK_S = 1e-3
SIZES = (4, 16, 200, 2000)
BASE: Mapping[str, Any] = {
    "mass": 1.0, "viscous": 2.0, "coulomb": 1.0, "stiction": 1.5, "force_max": 50.0, "encoder_step": 1e-6,
    "stop_minus": -1.0, "stop_plus": 1.0, "limit_minus": -0.9, "limit_plus": 0.9, "home": 0.0, "index_pitch": 0.1,
    "load_force": 0.2,
}  # fmt: skip
CASES: Mapping[str, tuple[Mapping[str, Any], Mapping[str, Any]]] = {
    "friction, stops, switches, encoder": ({}, {}),
    "the same, walls out of reach": ({"wall": Wall(5.0, 1e4, 10.0)}, {}),
    "pressed on walls": ({"wall": Wall(1e-3, 1e4, 10.0), "load_force": 20.0}, {}),
    "gravity": ({}, {"gravity": {"amplitude": 1.0}}),
    "directed friction, Stribeck, cogging": (
        {},
        {
            "coulomb": {"level": 1.0, "level_minus": 2.0},
            "stribeck": {"rise": 1.0, "velocity": 0.01},
            "cogging": {"amplitude": 0.5, "pitch": 0.01},
        },
    ),
    "backlash": ({}, {"backlash": {"gap": 1e-3, "load_fraction": 0.4}}),
}


def motors(n: int, parameters: Mapping[str, Any], effects: Mapping[str, Any]) -> MotorBank:
    """Return n equal motors with the same effects."""
    names = [str(axis) for axis in range(n)]
    return MotorBank([Motor(**(BASE | parameters))] * n, TICK_S, build_effects({"*": effects}, names))


def measure(advance: Callable[[np.ndarray], None], command: np.ndarray) -> np.ndarray:
    """Return the duration of each tick [us]; the command turns round now and then."""
    samples = np.empty(TICKS)
    for tick in range(TICKS):
        if tick % 100 == 0:
            command = -command
        begin = time.perf_counter_ns()
        advance(command)
        samples[tick] = time.perf_counter_ns() - begin
    return samples * 1e-3


def report(what: str, n: int, substeps: int, samples: np.ndarray) -> None:
    """Print percentiles."""
    median, high = np.percentile(samples, [50, 99])
    print(f"{what:40} {n:5} axes {substeps:2} substeps  median {median:7.1f}  p99 {high:7.1f} us")


def main() -> None:
    """Run all cases."""
    gc.disable()
    random = np.random.default_rng(0)
    for what, (parameters, effects) in CASES.items():
        for n in SIZES:
            bank = motors(n, parameters, effects)
            report(what, n, bank.substeps, measure(bank.advance, 5 * random.normal(size=n)))
    for n in SIZES:
        steppers = StepperBank([Stepper(mass=0.4, step=2e-4, hold_force=60.0, coulomb=3.0)] * n, TICK_S)
        report("steppers at rest", n, steppers.substeps, measure(steppers.advance, np.zeros(n)))
        goals, field = 1e-4 * random.normal(size=n), np.zeros(n)

        def move(step: np.ndarray, bank: StepperBank = steppers, field: np.ndarray = field) -> None:
            np.add(field, step, out=field)
            bank.advance(field)

        report("steppers moving", n, steppers.substeps, measure(move, goals))


if __name__ == "__main__":
    main()
