"""Noise, lines, temperature, creep and proximity are found where they are and not where they are not."""

from __future__ import annotations

import numpy as np
import pytest

from sioms.tactile.characterize import creep_of, noise_of, proximity_of, relaxation_of, thermal_of
from sioms.tactile.touches import Recording, ramps_of

RANDOM = np.random.default_rng(12)


def recording(raw, rate: float = 100.0, **columns) -> Recording:  # type: ignore[no-untyped-def]
    frames = len(raw)
    whole = {
        "time_s": np.arange(frames) / rate, "touch": np.full(frames, -1), "phase": np.full(frames, 2),
        "force": np.zeros(frames), "temperature_c": np.full(frames, 21.0),
    }  # fmt: skip
    return Recording(raw=np.asarray(raw), rate_hz=rate, **{**whole, **columns})


def test_noise_and_its_lines() -> None:
    clock = np.arange(8192) / 432.0
    quiet = 0.05 * RANDOM.normal(size=(8192, 4))
    assert noise_of(recording(quiet, 432.0)).lines == ()
    loud = noise_of(recording(quiet + 0.2 * np.sin(2 * np.pi * 120.0 * clock)[:, None], 432.0))
    ((frequency, amplitude),) = loud.lines
    assert frequency == pytest.approx(120.0, abs=0.5)
    assert amplitude == pytest.approx(0.2, rel=0.25)
    assert np.trapezoid(loud.density, loud.frequency_hz) == pytest.approx(0.05**2 + 0.02, rel=0.05)
    coarse = noise_of(recording(np.round(quiet / 0.05) * 0.05))
    assert coarse.step == pytest.approx(0.05)
    with pytest.raises(ValueError, match="10 frames; need at least 64"):
        noise_of(recording(quiet[:10]))


def test_thermal_slope() -> None:
    warm = 21.0 + np.sin(np.arange(200) / 10.0)
    slope = np.array([-0.8, 0.0, 0.3])
    raw = warm[:, None] * slope + 0.05 * RANDOM.normal(size=(200, 3))
    found = thermal_of(recording(raw, temperature_c=warm))
    assert found is not None
    assert np.all(np.abs(found.slope - slope) < 4.0 * found.deviation)
    assert np.all(found.deviation < 0.01)
    assert thermal_of(recording(raw)) is None  # no change of temperature


def touches(course, count: int = 60, noise: float = 0.01) -> Recording:  # type: ignore[no-untyped-def]
    rows, touch, phase = [], [], []
    for number in range(count):
        rows.append(noise * RANDOM.normal(size=(10, 16)))
        under = noise * RANDOM.normal(size=(len(course), 16))
        under[:, 8] += course
        under[:, :2] -= 0.3
        rows.append(under)
        touch += [number] * (10 + len(course))
        phase += [0] * 10 + [1] * len(course)
    return recording(np.concatenate(rows), touch=np.array(touch), phase=np.array(phase))


def test_creep() -> None:
    clock = np.arange(100) / 100.0
    found = creep_of(touches(4.0 * (1.0 + 0.15 * -np.expm1(-clock / 0.3))))
    assert found is not None
    assert found.share == pytest.approx(0.15, rel=0.1)
    assert found.time_s == pytest.approx(0.3, rel=0.2)
    still = creep_of(touches(np.full(100, 4.0)))
    assert still is not None
    assert abs(still.share) < 0.01
    assert creep_of(recording(np.zeros((10, 16)))) is None


def test_creep_is_not_told_by_touches_beside_the_array() -> None:
    """Their output is all noise, which divided by itself is anything."""
    clock = np.arange(100) / 100.0
    held = touches(4.0 * (1.0 + 0.15 * -np.expm1(-clock / 0.3)))
    raw = held.raw.copy()
    wild = np.random.default_rng(1).normal(size=raw.shape)
    few = (held.touch >= 0) & (held.touch % 10 == 0)
    raw[few] = 0.05 * wild[few]
    first = few & (held.phase == 1)
    raw[np.flatnonzero(first)[:1]] += 0.5  # as a pull that ends while the touch begins
    found = creep_of(recording(raw, touch=held.touch, phase=held.phase))
    assert found is not None
    assert found.share == pytest.approx(0.15, rel=0.1) and found.deviation < 0.02


def test_relaxation_after_release() -> None:
    clock = np.arange(150) / 100.0
    course = np.where(clock < 0.5, 4.0, 0.4 * np.exp(-(clock - 0.5) / 0.25))
    held = touches(course)
    phase = np.tile(np.repeat([0, 1, 2], [10, 50, 100]), 60)
    found = relaxation_of(recording(held.raw, touch=held.touch, phase=phase))
    assert found is not None
    assert found.share == pytest.approx(0.1, abs=5 * found.deviation) and found.deviation < 0.01
    assert found.time_s == pytest.approx(0.25, rel=0.1)
    assert relaxation_of(held) is None  # nothing was recorded after the release


def test_proximity_is_what_far_elements_feel() -> None:
    far = proximity_of(touches(np.full(20, 4.0)))
    assert far[:2] == pytest.approx([-0.3, -0.3], abs=0.01)
    assert np.isnan(far[8])


def test_ramps_are_read_with_a_straight_load() -> None:
    load = np.linspace(0.0, 250.0, 150)
    raw = np.concatenate([np.zeros((20, 4)), np.outer(load, [0.0, 0.04, 0.0, 0.0])])
    force = np.concatenate([np.full(20, 5.0), load + 5.0]) + 3.0 * RANDOM.normal(size=170)
    marks = recording(raw, touch=np.full(170, 1), phase=np.repeat([0, 1], [20, 150]), force=force)
    (ramp,) = ramps_of(marks, 0.01)
    assert ramp.element == 1
    assert ramp.load == pytest.approx(load[-ramp.load.size :], abs=3.0)
    assert ramp.output == pytest.approx(4e-4 * load[-ramp.load.size :], abs=1e-6)
