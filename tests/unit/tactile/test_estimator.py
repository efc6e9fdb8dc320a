"""The estimator finds what was touched, knows how well, and says when it does not."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sioms.tactile import emap, kernel, series
from sioms.tactile.closedform import equivalent_radius
from sioms.tactile.cylinder import FINGER_B
from sioms.tactile.estimator import Estimator
from sioms.tactile.finger import Finger, nominal_finger
from sioms.tactile.linearity import linearise
from sioms.tactile.model import pressed
from sioms.tactile.quality import Load, Quality

ANGLES = np.radians(143.0 - 9.22 * np.arange(16))
MATRIX = emap.e_map(FINGER_B, ANGLES, 10.3e-3, 100)[:, :201]


@pytest.fixture(scope="module")
def estimator(nominal: Finger) -> Estimator:
    return Estimator(nominal)


def strains(finger: Finger, place: float, load: float, rc: float):  # type: ignore[no-untyped-def]
    half = finger.width_table().half_width(load * equivalent_radius(FINGER_B, rc))
    return MATRIX @ series.spread(FINGER_B, -load, pressed(FINGER_B, 100)(half), place)


@settings(max_examples=60, deadline=None)
@given(
    place=st.floats(10.0, 138.0),
    load=st.floats(25.0, 400.0),
    rc=st.one_of(st.floats(1e-3, 50e-3), st.just(math.inf)),
)
def test_clean_touches_are_found(place: float, load: float, rc: float) -> None:
    finger = _nominal()
    shape = _estimator().frame(strains(finger, math.radians(place), load, rc))
    assert shape.usable
    angle, force, radius = shape.deviations
    # the tables interpolate: a small part of what one frame's noise does
    assert abs(shape.angle_rad - math.radians(place)) < 0.03 * angle
    assert abs(shape.load_n_per_m - load) < 0.03 * force
    assert abs(shape.equivalent_radius_m - equivalent_radius(FINGER_B, rc)) < 0.03 * radius
    assert shape.misfit < 0.01


_CACHE: list[tuple[Finger, Estimator]] = []


def _nominal() -> Finger:
    if not _CACHE:
        finger = nominal_finger(FINGER_B, ANGLES, 10.3e-3, 1.0, 1e-3)
        _CACHE.append((finger, Estimator(finger)))
    return _CACHE[0][0]


def _estimator() -> Estimator:
    _nominal()
    return _CACHE[0][1]


def test_exact_contact_is_close_to_the_elliptic_one(estimator: Estimator, touch) -> None:  # type: ignore[no-untyped-def]
    shape = estimator.frame(touch(math.radians(75.0), 200.0, 6e-3))
    assert math.degrees(shape.angle_rad) == pytest.approx(75.0, abs=1e-3)
    assert shape.load_n_per_m == pytest.approx(200.0, rel=2e-3)
    assert shape.radius_m == pytest.approx(6e-3, rel=0.03)


def test_noise_gives_the_promised_deviations(estimator: Estimator, nominal: Finger) -> None:
    random = np.random.default_rng(5)
    clean = strains(nominal, math.radians(80.0), 150.0, 6e-3)
    shapes = list(estimator.batch(clean + 1e-3 * random.normal(size=(400, 16))))
    found = np.array([(s.angle_rad, s.load_n_per_m, s.equivalent_radius_m) for s in shapes])
    promised = np.mean([s.deviations for s in shapes], axis=0)
    # 400 samples know a deviation to 3.5 %
    assert found.std(0) == pytest.approx(promised, rel=0.14)
    assert np.mean([s.misfit for s in shapes]) == pytest.approx(1.0, abs=0.12)
    correlation = np.corrcoef(found.T)
    told = np.array(shapes[0].covariance) / np.outer(promised, promised)
    assert correlation[1, 2] == pytest.approx(told[1, 2], abs=0.12)


def test_no_gross_errors_of_place(nominal: Finger, estimator: Estimator) -> None:
    random = np.random.default_rng(9)
    for _ in range(300):
        place, load = math.radians(random.uniform(14.0, 133.0)), random.uniform(25.0, 400.0)
        rc = float(random.choice([0.5e-3, 6e-3, math.inf]))
        shape = estimator.frame(strains(nominal, place, load, rc) + 1e-3 * random.normal(size=16))
        assert abs(math.degrees(shape.angle_rad - place)) < 2.0
        assert not shape.quality & Quality.NOT_CONVERGED


def test_load_cell_sharpens_the_radius_and_an_exact_one_fixes_the_load(nominal: Finger, estimator: Estimator) -> None:
    frame = strains(nominal, math.radians(70.0), 200.0, 6e-3) + 1e-3 * np.random.default_rng(1).normal(size=16)
    free, weak, exact = (
        estimator.frame(frame),
        estimator.frame(frame, Load(200.0, 1e6)),
        estimator.frame(frame, Load(200.0, 0.0)),
    )
    assert weak.load_n_per_m == pytest.approx(free.load_n_per_m, rel=1e-6)
    assert exact.load_n_per_m == pytest.approx(200.0, rel=1e-4)
    assert exact.deviations[1] < 1e-2 * free.deviations[1]
    assert exact.deviations[2] < free.deviations[2]
    told = estimator.frame(frame, Load(230.0, 2.0))
    assert free.load_n_per_m < told.load_n_per_m < 230.0
    assert told.misfit > 4.0 * free.misfit  # a wrong load cell shows


@pytest.mark.parametrize("compiled", [False, True])
def test_both_ways_agree(nominal: Finger, estimator: Estimator, compiled: bool) -> None:
    if compiled:
        pytest.importorskip("numba")
    other = Estimator(nominal, compiled=compiled)
    frame = strains(nominal, math.radians(100.0), 120.0, 4e-3) + 1e-3 * np.random.default_rng(2).normal(size=16)
    one, two = estimator.frame(frame), other.frame(frame)
    assert two.angle_rad == pytest.approx(one.angle_rad, rel=1e-10)
    assert two.load_n_per_m == pytest.approx(one.load_n_per_m, rel=1e-9)
    assert two.equivalent_radius_m == pytest.approx(one.equivalent_radius_m, rel=1e-7)
    assert two.quality == one.quality


def test_quality_flags(nominal: Finger, estimator: Estimator) -> None:
    good = strains(nominal, math.radians(75.0), 200.0, 6e-3)
    assert estimator.frame(good).quality is Quality.GOOD
    assert estimator.frame(np.zeros(16)).quality is Quality.NO_CONTACT
    noise = 1e-3 * np.random.default_rng(4).normal(size=16)
    quiet = estimator.frame(noise)
    assert quiet.quality is Quality.NO_CONTACT
    assert math.isnan(quiet.angle_rad)
    two = strains(nominal, math.radians(40.0), 150.0, 6e-3) + strains(nominal, math.radians(110.0), 150.0, 6e-3)
    assert estimator.frame(two).quality & Quality.POOR_FIT
    pull = estimator.frame(0.1 * np.ones(16))
    assert pull.quality & (Quality.WRONG_SIGN | Quality.POOR_FIT)
    outside = strains(nominal, math.radians(152.0), 300.0, 6e-3)
    assert estimator.frame(outside).quality & Quality.OUT_OF_ARC
    heavy = strains(nominal, math.radians(75.0), 1500.0, 3e-3)
    assert estimator.frame(heavy).quality & Quality.OVERLOAD
    # sharper than an edge can be
    line, blunt = (strains(nominal, math.radians(75.0), 200.0, rc) for rc in (1e-9, 3e-3))
    assert estimator.frame(line + 0.2 * (line - blunt)).quality & Quality.SHARP
    hollow = sum(strains(nominal, math.radians(place), 100.0, math.inf) for place in (70.0, 80.0))
    assert estimator.frame(hollow).quality & Quality.FLAT_OR_HOLLOW


def test_dead_elements_are_left_out(nominal: Finger, estimator: Estimator) -> None:
    frame = strains(nominal, math.radians(75.0), 200.0, 6e-3)
    frame[3] = math.nan
    usable = np.ones(16, dtype=bool)
    usable[12] = False
    frame[12] = 0.3
    shape = estimator.frame(frame, usable=usable)
    assert shape.quality is Quality.BAD_ELEMENTS
    assert math.degrees(shape.angle_rad) == pytest.approx(75.0, abs=1e-3)
    assert shape.load_n_per_m == pytest.approx(200.0, rel=1e-3)
    near = np.abs(ANGLES - math.radians(75.0)) < math.radians(6.0)
    assert estimator.frame(frame, usable=usable & ~near).deviations[0] > 2.0 * shape.deviations[0]
    assert estimator.frame(np.where(np.arange(16) < 3, frame, math.nan)).quality & Quality.TOO_FEW_ELEMENTS
    elements = msgspec.structs.replace(nominal.elements, used=(False,) * 2 + (True,) * 14)
    partly = Estimator(msgspec.structs.replace(nominal, elements=elements))
    frame = strains(nominal, math.radians(75.0), 200.0, 6e-3)
    frame[0] = 5.0
    assert partly.frame(frame).quality is Quality.BAD_ELEMENTS


def test_means_of_frames_are_told_more_exactly(nominal: Finger, estimator: Estimator) -> None:
    frame = strains(nominal, math.radians(80.0), 200.0, 6e-3)
    one, mean = estimator.frame(frame), Estimator(nominal, averaged=16).frame(frame)
    assert mean.deviations == pytest.approx([d / 4.0 for d in one.deviations], rel=1e-3)
    with pytest.raises(ValueError, match=r"frames are means of 0\.5; need 1 or more"):
        Estimator(nominal, averaged=0.5)


def test_calibrated_misfit_widens_the_deviations(nominal: Finger, estimator: Estimator) -> None:
    elements = msgspec.structs.replace(nominal.elements, misfit=(0.03,) * 16)
    rough = Estimator(msgspec.structs.replace(nominal, elements=elements))
    frame = strains(nominal, math.radians(75.0), 200.0, 6e-3)
    assert rough.frame(frame).deviations[0] > 3.0 * estimator.frame(frame).deviations[0]


def test_bad_input_is_refused(estimator: Estimator) -> None:
    with pytest.raises(ValueError, match=r"frame has 15 strains in shape \(15,\); the finger has 16 elements"):
        estimator.frame(np.zeros(15))
    with pytest.raises(ValueError, match=r"load is -3\.0 \+- 1\.0 N/m; need a finite pressing load"):
        estimator.frame(np.zeros(16), Load(-3.0, 1.0))
    with pytest.raises(ValueError, match="need a finite pressing load"):
        estimator.frame(np.zeros(16), Load(math.nan, 1.0))


def test_batch_tells_progress(nominal: Finger, estimator: Estimator) -> None:
    told: list[int] = []
    frames = [strains(nominal, math.radians(75.0), 200.0, 6e-3)] * 3
    assert len(list(estimator.batch(frames, progress=told.append))) == 3
    assert told == [1, 2, 3]


def test_a_light_touch_beside_the_last_element_is_no_heavy_one_further_out(nominal: Finger, touch) -> None:  # type: ignore[no-untyped-def]
    """Without the bound on hollows the frame fits a contact a third of a radian wide, twice as heavy, degrees away."""
    place, strains = np.radians(8.1), touch(np.radians(8.1), 43.0, 3.9e-3)
    frames = strains + 1e-3 * np.random.default_rng(8).normal(size=(400, 16))
    fits = [Estimator(nominal, compiled=False, most_hollow=most) for most in (1e3, 1.5)]
    free, held = ([fit.frame(y) for y in frames] for fit in fits)
    for shape in held:
        assert shape.equivalent_radius_m < 1.55 * nominal.cylinder.outer_m
    worst_free, worst_held = (max(abs(s.angle_rad - place) for s in shapes) for shapes in (free, held))
    assert worst_held < 0.8 * worst_free


def test_a_place_that_is_hardly_known_is_flagged_and_its_deviations_hold(
    nominal: Finger, estimator: Estimator, touch
) -> None:  # type: ignore[no-untyped-def]
    """The best fit's covariance says 4 degrees there and its errors run to 3; the mean's keep what they promise."""
    place, random = np.radians(6.0), np.random.default_rng(17)
    frames = touch(place, 30.0, np.inf) + 1e-3 * random.normal(size=(150, 16))
    shapes = [estimator.frame(y) for y in frames]
    vague = [s for s in shapes if Quality.IMPRECISE in s.quality]
    assert len(vague) > 50
    errors = np.array([(s.angle_rad - place, s.load_n_per_m - 30.0) for s in vague])
    promised = np.array([s.deviations[:2] for s in vague])
    assert np.all(np.sqrt(np.mean((errors / promised) ** 2, axis=0)) < 1.2)
    assert np.abs(errors[:, 0]).max() < np.radians(2.0)
    for s in vague:
        assert 1.0 / s.equivalent_curvature_per_m == pytest.approx(s.equivalent_radius_m)
    in_the_middle = estimator.frame(touch(np.radians(75.0), 30.0, np.inf))
    assert in_the_middle.deviations[0] < np.radians(0.5) and Quality.IMPRECISE not in in_the_middle.quality


@pytest.mark.parametrize("compiled", [False, True])
def test_light_touches_of_a_conductor_are_found_by_their_pull_too(nominal: Finger, compiled: bool) -> None:
    """The pull is ten times the output of 25 N/m: taken off at a wrong place it leaves a touch 16 degrees away."""
    signal = msgspec.structs.replace(nominal.signal, proximity=-0.1, proximity_range_rad=0.25)
    elements = msgspec.structs.replace(nominal.elements, quadratic=(2.0,) * 16)
    finger = msgspec.structs.replace(nominal, signal=signal, elements=elements)
    fit, angles = Estimator(finger, compiled=compiled), np.array(nominal.angles_rad)
    random = np.random.default_rng(4)
    for place, load, rc in (
        (80.0, 25.0, np.inf),
        (31.7, 40.0, 2e-3),
        (10.0, 60.0, 6e-3),
        (120.4, 300.0, 1.6e-3),
    ):
        t = math.radians(place)
        linear = -strains(nominal, t, load, rc)
        output = linear + 2.0 * linear**2 - 0.1 * np.exp(-np.abs(angles - t) / 0.25)
        felt = -linearise(output + 1e-3 * random.normal(size=16), np.full(16, 2.0))
        shape = fit.frame(felt)
        errors = np.abs([shape.angle_rad - t, shape.load_n_per_m - load])
        assert not shape.doubtful and np.all(errors < 4.0 * np.array(shape.deviations[:2]))
        assert errors[0] < math.radians(1.0)


def test_no_touch_of_the_table_fits_better_than_the_estimate(nominal: Finger) -> None:
    """Light touches at the arc's ends have several minima and flat valleys; every node of the table is a rival."""
    random, estimator = np.random.default_rng(12), Estimator(nominal, compiled=None)
    table, widths = nominal.strain_table(), nominal.width_table()
    bank = table.nodes[:, :, 0].reshape(-1, 16)
    own, square = np.sum(bank**2, axis=1), np.repeat(table.half_widths**2, table.nodes.shape[1])
    for _ in range(500):
        place = float(random.choice([4.7, 143.0])) + float(random.uniform(-5.0, 5.0))
        load, rc = random.uniform(25.0, 120.0), float(random.choice([0.5e-3, 6e-3, math.inf]))
        frame = strains(nominal, math.radians(place), load, rc) + 1e-3 * random.normal(size=16)
        shape = estimator.frame(frame)
        assert not shape.quality & Quality.NOT_CONVERGED
        p = bank @ frame / own
        allowed = (p > 0.0) & (widths.product(square) <= 1.5 * FINGER_B.outer_m * p)
        rival = np.sum((frame - p[:, None] * bank) ** 2, axis=1)[allowed].min() / 1e-6
        assert 13.0 * shape.misfit < rival + 0.5  # less is no difference


def test_what_is_compiled_can_be_read_from_the_cache() -> None:
    pytest.importorskip("numba")
    functions = [kernel.compiled()]
    for _ in range(2):
        inner = [
            found for name, found in functions[-1].py_func.__globals__.items() if name in ("_fit", "_products")
            and name in functions[-1].py_func.__code__.co_names
        ]  # fmt: skip
        functions += inner
    assert [function.py_func.__name__ for function in functions] == ["_solve", "_fit", "_products_loops"]
    # numba compiles a function that encloses a compiled one anew in each process, and keeps each result for ever
    assert not any(function.py_func.__closure__ for function in functions)
