"""Invariants of the reconcile core under arbitrary parameters."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sioms.reconcile.blocks import better
from sioms.reconcile.current import Law
from sioms.reconcile.effects import library
from sioms.reconcile.engine.fit import get, put
from sioms.reconcile.fit import free_parameters
from sioms.reconcile.model import AxisModel, Controller
from sioms.reconcile.noise import effective_samples, observer, rigid
from sioms.reconcile.refuse import hats, since_reversal
from sioms.reconcile.simulate import simulate

AXIS = AxisModel(
    True, 1e-3, 2e-3, 1e-3, 1e-4, 2 * np.pi, 0.7, 20.0, Controller(20.0, -0.985, -0.7, 0.0, 0.0, 1.8, 100.0)
)
COMMAND = np.sin(2 * np.pi * np.arange(300) * 2e-3)
NAMES = st.lists(st.sampled_from(sorted(library())), unique=True, max_size=5)
SHARE = st.floats(0.0, 1.0)


def model_of(names: list[str], share: float) -> AxisModel:
    model = AXIS
    for n in names:
        values = {}
        for p in library()[n].parameters:
            most = 3.0 * abs(p.start) + 0.01
            low, high = max(p.lower, -most) * AXIS.scale(p), min(p.upper, most) * AXIS.scale(p)
            values[p.symbol] = low + share * (high - low) if not p.fixed else p.start
        model = model.with_effect(n, values)
    return model


@settings(max_examples=40, deadline=None)
@given(NAMES, SHARE)
def test_any_mixture_within_bounds_simulates_to_numbers(names: list[str], share: float) -> None:
    run = simulate(model_of(names, share), COMMAND)
    assert np.all(np.isfinite(run.force))
    assert np.max(np.abs(run.force)) <= 1.8


@settings(max_examples=40, deadline=None)
@given(NAMES, SHARE, st.floats(-2.0, 2.0))
def test_free_numbers_go_in_and_come_out(names: list[str], share: float, push: float) -> None:
    model = model_of(names, share)
    free = free_parameters(model)
    at = get(model, free)
    assert get(put(model, free, at), free) == pytest.approx(at, abs=1e-12)
    moved = get(put(model, free, at + push * np.array([f.scale for f in free])), free)
    for f, m in zip(free, moved, strict=True):
        assert not f.phase or -np.pi <= m <= np.pi


@given(st.floats(0.0, 0.01), st.floats(0.05, 3.0), st.integers(0, 30))
def test_a_drive_neither_makes_nor_loses_impulse(delay: float, limit: float, at: int) -> None:
    force = np.zeros(60)
    force[at] = 1.0
    out = Law(delay, 0.0).output(force, 1e-3)
    assert np.sum(out) == pytest.approx(1.0)
    assert np.max(np.abs(Law(delay, 0.0, limit=limit).output(force, 1e-3))) <= limit


@settings(max_examples=30, deadline=None)
@given(st.floats(1e-7, 1e-2), st.floats(1e-5, 1.0))
def test_the_observer_is_stable(sensor: float, drive: float) -> None:
    gain = np.array(observer(AXIS, sensor, drive).gain)
    a, _ = rigid(AXIS)
    closed = a @ (np.eye(2) - np.outer(gain, [1.0, 0.0]))
    assert np.max(np.abs(np.linalg.eigvals(closed))) < 1.0


@given(st.lists(st.floats(-5, 5), min_size=3, max_size=60))
def test_hats_share_unity_and_displacement_is_never_negative(points: list[float]) -> None:
    x = np.array(points)
    np.testing.assert_allclose(hats(x, np.linspace(-5, 5, 7)).sum(1), 1.0)
    assert np.all(since_reversal(x, np.sign(np.gradient(x))) >= 0.0)


@given(st.lists(st.floats(0.1, 10.0), min_size=4, max_size=40), st.floats(0.3, 3.0))
def test_saving_is_antisymmetric(losses: list[float], factor: float) -> None:
    a = np.array(losses)
    gain, errors = better(a, factor * a)
    assert (gain > 0) == (factor > 1) or factor == 1
    assert (errors > 0) == (factor > 1) or factor == 1


def test_correlated_samples_count_less() -> None:
    rng = np.random.default_rng(1)
    white = rng.standard_normal(20000)
    slow = np.convolve(white, np.ones(50) / 50, mode="valid")
    assert effective_samples(white) > 0.8 * len(white)
    assert effective_samples(slow) < len(slow) / 30
