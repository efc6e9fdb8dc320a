"""Short probings of the simulated finger with each of its parameters off in turn: none is given another's name.

The simulated finger (``sioms.plant``) solves its contacts in quite another way than the workflow.
"""

from __future__ import annotations

import numpy as np
import pytest

from sioms.plant.finger import FingerShape, TactileArray
from sioms.reconcile.finger.belief import Belief, Scene
from sioms.reconcile.finger.plan import Bench, first
from sioms.reconcile.finger.prepare import Experiment, reconcile
from sioms.reconcile.sensors.verdict import SensorVerdict
from sioms.reconcile.verdict import Outcome
from sioms.tactile.touches import BASELINE, LOADED, Recording

RATE_HZ, FRAMES, LENGTH_M = 400.0, 20, 0.012
ANGLES = np.radians(90.0 - 9.22 * np.arange(4))
NOMINAL = Belief(
    9.6e-3, 12.7e-3, 8.3e4, 0.46, ANGLES, np.full(4, 10.3e-3), np.full(4, 3.0), np.zeros(4), np.zeros(4)
)  # fmt: skip
NOISE = STEP = 0.05


def recorded(finger: TactileArray, scene: Scene, rng: np.random.Generator) -> Experiment:
    """Touch as the prober does: frames before, a tenth of a second, frames under load; the load cell tells the load."""
    frames: list[np.ndarray] = []
    rows: list[tuple[float, int, int, float]] = []
    now, felt = 0.0, []
    for touch, (place, load, radius) in enumerate(zip(scene.place, scene.load, scene.radius, strict=True)):
        true = load * (1.0 + 0.02 * rng.standard_normal())
        cell = []
        for phase, count in ((BASELINE, FRAMES), (None, 40), (LOADED, FRAMES)):
            pressed = 0.0 if phase == BASELINE else true
            for _ in range(count):
                now += 1.0 / RATE_HZ
                out = np.empty(len(ANGLES))
                finger.read(pressed * LENGTH_M, place, radius, out, now, 2e-3)
                if phase is not None:
                    frames.append(out)
                    rows.append((now, touch, phase, pressed + 0.3 * rng.standard_normal()))
                    cell.append((phase, rows[-1][3]))
        felt.append(np.mean([f for p, f in cell if p == LOADED]) - np.mean([f for p, f in cell if p == BASELINE]))
    time_s, touch_, phase_, force = (np.array(c) for c in zip(*rows, strict=True))
    recording = Recording(np.array(frames), time_s, touch_, phase_, force, np.full(len(rows), np.nan), RATE_HZ)
    return Experiment("touches", recording, (scene.place, np.array(felt), scene.radius))


def probed(seed: int, **hidden: float) -> SensorVerdict:
    """Probe a short finger with an edge: 30 touches of 20 to 100 N/m."""
    rng = np.random.default_rng(seed)
    shape = FingerShape(gain=3.0, length_m=LENGTH_M, angles_rad=tuple(ANGLES), seed=seed, **hidden)
    finger = TactileArray(shape, noise=NOISE, resolution=STEP, seed=seed)
    plans = [scene for _, _, scene in first(NOMINAL, Bench((0.0,), 80.0, 100.0))]
    whole = Scene(*(np.concatenate([getattr(s, n) for s in plans]) for n in Scene.__slots__[:6]))
    return reconcile([recorded(finger, whole, rng)], NOMINAL, "short")


@pytest.mark.parametrize("size", [0.1, -0.1])
def test_elements_more_sensitive_over_their_strips_are_named(size: float) -> None:
    verdict = probed(3, strip_gain=size)
    assert verdict.outcome is Outcome.NAMED and [e.name for e in verdict.effects] == ["strip_peak"]
    c, width = verdict.effects[0].parameters
    assert c.value == pytest.approx(size, abs=0.015) and width.value == pytest.approx(0.07, abs=0.015)


def test_a_softer_skin_is_told_as_what_looks_alike_under_an_edge() -> None:
    verdict = probed(27, shear_modulus_pa=7.0e4)
    assert verdict.outcome is Outcome.AMBIGUOUS and [e.name for e in verdict.effects] == ["soft_skin"]
    assert verdict.effects[0].parameters[0].value == pytest.approx(8.3 / 7.0 - 1.0, abs=0.01)
    assert {("gain_scatter",), ("creep",)} <= set(verdict.alternatives)


def test_a_smaller_core_is_named_and_nothing_else_is() -> None:
    verdict = probed(44, core_m=9.2e-3)
    assert verdict.outcome is Outcome.NAMED and [e.name for e in verdict.effects] == ["core_radius"]
    assert verdict.effects[0].parameters[0].value == pytest.approx(-4e-4, abs=3e-5)
