"""Calibration finds the truth of a moulded finger, and says what the touches cannot tell."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from sioms.tactile import calibration
from sioms.tactile.calibrate import DEEP, SHALLOW, SMALLEST, TURN, ElementFit
from sioms.tactile.calibration import Calibration, Options, calibrate
from sioms.tactile.closedform import equivalent_radius
from sioms.tactile.emap import MOST_EXTENT
from sioms.tactile.estimator import Estimator
from sioms.tactile.finger import Finger, from_toml, to_toml
from sioms.tactile.identify import corrected, truncated
from sioms.tactile.linearity import Quadratic, find_quadratic, linearise, with_ramps
from sioms.tactile.preparation import _cell_share
from sioms.tactile.proximity import LONGEST, SHORTEST, Proximity
from sioms.tactile.quality import Quality
from sioms.tactile.touches import Recording, Touches, average, join, touch_loads


@pytest.fixture(scope="module")
def start(nominal: Finger) -> Finger:
    return msgspec.structs.replace(nominal, elements=msgspec.structs.replace(nominal.elements, gain=(3.0,) * 16))


@pytest.fixture(scope="module")
def result(start: Finger, made) -> Calibration:  # type: ignore[no-untyped-def]
    told: list[str] = []
    found = calibrate(start, made.touches(), tick=told.append)
    assert len(told) > 20
    return found


def half(touches: Touches) -> np.ndarray:
    """Choose every second touch: what shows in a few dense ones shows in fewer."""
    return np.arange(len(touches)) % 2 == 0


def test_elements_are_found(result: Calibration, made) -> None:  # type: ignore[no-untyped-def]
    fits = [fit for fit in result.elements if fit is not None]
    assert len(fits) == 16
    assert np.degrees([fit.angle_rad for fit in fits]) == pytest.approx(np.degrees(made.angles), abs=0.1)
    # depth, gain and Poisson's ratio trade against each other: the product is what strain feels
    assert np.array([fit.radius_m for fit in fits]) == pytest.approx(made.radii, abs=1.5e-4)
    assert np.corrcoef([fit.radius_m for fit in fits], made.radii)[0, 1] > 0.95
    assert np.array([fit.gain for fit in fits]) == pytest.approx(made.gain, rel=0.12)
    assert result.finger.geometry.poisson == pytest.approx(0.46, abs=0.01)
    assert result.finger.geometry.extent_rad == pytest.approx(made.extent, abs=0.01)


def test_quadratic_is_kept_apart_from_the_contacts_growth(result: Calibration, made) -> None:  # type: ignore[no-untyped-def]
    assert result.quadratic is not None
    assert result.quadratic.common == pytest.approx(made.quadratic, abs=0.5)
    assert np.array(result.finger.elements.quadratic) == pytest.approx(np.full(16, made.quadratic), abs=1.5)


def test_frictionless_contact_is_chosen(result: Calibration) -> None:
    assert result.finger.contact.model == "frictionless"
    assert result.contacts["hertz"] > 1.5 * result.contacts["frictionless"]
    assert result.contacts["adhesion 0.8"] > 1.2 * result.contacts["frictionless"]


def test_calibrated_finger_measures(result: Calibration, made) -> None:  # type: ignore[no-untyped-def]
    finger = from_toml(to_toml(result.finger))
    estimator, gain = Estimator(finger), np.array(finger.elements.gain)
    for place, load, rc in ((40.3, 200.0, 6e-3), (77.7, 150.0, 12e-3), (101.2, 220.0, math.inf)):
        output = made.output(math.radians(place), load, rc)
        shape = estimator.frame(-gain * linearise(output, np.array(finger.elements.quadratic)))
        assert not shape.quality & Quality.POOR_FIT
        assert math.degrees(shape.angle_rad) == pytest.approx(place, abs=0.12)
        assert shape.load_n_per_m == pytest.approx(load, rel=0.04)
        assert shape.equivalent_radius_m == pytest.approx(equivalent_radius(finger.cylinder, rc), abs=0.7e-3)


def test_residuals_are_those_of_left_out_touches(result: Calibration, made) -> None:  # type: ignore[no-untyped-def]
    noise = made.noise * math.sqrt(0.1) * made.gain.mean() / result.peak
    for name in ("elements", "corrected"):
        assert noise * 0.7 < np.mean(result.residuals[name]) < 0.012
    assert np.mean(result.residuals["elements"]) < np.mean(result.residuals["uniform"])


def test_half_a_finger_is_left_out_and_said(start: Finger, made) -> None:  # type: ignore[no-untyped-def]
    touches = made.touches()
    half = touches.pick(touches.angle_rad < math.radians(70.0))
    found = calibrate(start, half, Options(identify=False, contact="frictionless"))
    used = np.array(found.finger.elements.used)
    assert not used[:5].any()
    assert used[9:].all()
    assert any("element 0: too few touches" in warning for warning in found.warnings)


def test_what_is_not_supported_is_said_and_a_dead_element_left_out(start: Finger, made) -> None:  # type: ignore[no-untyped-def]
    """Edges only, a load cell that reads a tenth too little, fractions taken for per cent, an element that is torn
    off.
    """
    touches = made.touches()
    edges = touches.pick(touches.radius_m == 0.0)
    output = 0.01 * edges.output
    output[:, 6] = 0.0
    scaled = Touches(output, edges.angle_rad, edges.load, edges.radius_m, 0.9 * edges.load, 0.01 * edges.noise)
    found = calibrate(start, scaled, Options(contact="frictionless"))
    assert found.quadratic is None
    assert [n for n, used in enumerate(found.finger.elements.used) if not used] == [6]
    for words in (
        "quadratic not fitted",
        "load cell reads -10.0 %",
        "element 6: too few touches within 25 degrees, or no answer",
        "times the nominal ones: outputs must be",
    ):
        assert any(words in warning for warning in found.warnings), words


def test_nonsense_is_refused(start: Finger, made) -> None:  # type: ignore[no-untyped-def]
    touches = made.touches()
    with pytest.raises(ValueError, match="10 touches; need at least 30"):
        calibrate(start, touches.pick(np.arange(10)))
    with pytest.raises(ValueError, match="compression must be positive"):
        calibrate(start, touches.with_output(-touches.output))
    with pytest.raises(ValueError, match="touches have 12 elements; the finger has 16"):
        calibrate(start, touches.with_output(touches.output[:, :12]))
    pulled = np.where(np.arange(len(touches)) == 0, -200.0, touches.load)
    bad = Touches(touches.output, touches.angle_rad, pulled, touches.radius_m, touches.force, touches.noise)
    with pytest.raises(ValueError, match=r"load -200\.0 N/m; pressing loads are positive"):
        calibrate(start, bad)


def test_linearise_undoes_the_quadratic() -> None:
    linear = np.linspace(-0.05, 0.1, 31)
    for q in (0.0, 4.0, -2.0):
        assert linearise(linear + q * linear**2, q) == pytest.approx(linear, abs=1e-15)
    assert linearise(-0.2, 4.0) == pytest.approx(-0.125)  # beyond the vertex: saturated


def test_quadratic_needs_load_series(made) -> None:  # type: ignore[no-untyped-def]
    touches = made.touches()
    edges = touches.pick(touches.radius_m == 0.0)
    assert find_quadratic(edges, -np.abs(edges.output)) is None


def test_identified_maps_recover_a_known_one() -> None:
    random = np.random.default_rng(8)
    known, pressure = random.normal(size=(4, 21)), random.normal(size=(60, 21))
    strain = pressure @ known.T
    assert truncated(pressure, strain).rows == pytest.approx(known, abs=1e-9)
    assert corrected(pressure, strain, known).rows == pytest.approx(known, abs=1e-9)
    model = known + 0.1 * random.normal(size=known.shape)
    found = corrected(pressure, strain, model)
    assert np.abs(found.rows - known).max() < 0.1 * np.abs(model - known).max()
    # where no touch speaks, the model stays and the source's way says nothing
    silent = pressure.copy()
    silent[:, 20] = 0.0
    assert corrected(silent, silent @ known.T, model).rows[:, 20] == pytest.approx(model[:, 20])
    assert truncated(silent, silent @ known.T).rows[:, 20] == pytest.approx(np.zeros(4), abs=1e-12)
    with pytest.raises(ValueError, match="60 pressures for 59 touches"):
        truncated(pressure, strain[:59])


def test_average_subtracts_each_touchs_baseline() -> None:
    raw = np.repeat(np.array([[1.0, 2.0], [3.0, 2.5], [10.0, 20.0], [11.0, 20.0]]), 5, axis=0)
    touch, phase = np.repeat([0, 0, 1, 1], 5), np.repeat([0, 1, 0, 1], 5)
    column = np.zeros(20)
    recording = Recording(raw, np.arange(20.0), touch, phase, 10.0 * phase, column, 33.0)
    found = average(recording, np.zeros(2), np.full(2, 10.0), np.zeros(2), 0.01)
    assert found.output == pytest.approx(np.array([[0.02, 0.005], [0.01, 0.0]]))
    assert found.force == pytest.approx([10.0, 10.0])
    assert len(join([found, found])) == 4
    with pytest.raises(ValueError, match="average touch 2 of 3: 0 baseline and 0 loaded frames"):
        average(recording, np.zeros(3), np.full(3, 10.0), np.zeros(3), 0.01)
    raw[7, 1] = np.nan  # one of five
    assert average(recording, np.zeros(2), np.full(2, 10.0), np.zeros(2), 0.01).output == pytest.approx(found.output)
    raw[5:10, 1] = np.nan
    with pytest.raises(ValueError, match="touch 0: element 1 holds a reading that is not finite"):
        average(recording, np.zeros(2), np.full(2, 10.0), np.zeros(2), 0.01)


def test_an_element_at_the_end_of_its_range_is_refused() -> None:
    random, count = np.random.default_rng(5), 40
    touch, phase = np.repeat(np.arange(count), 8), np.tile(np.repeat([0, 1], 4), count)
    pressed = np.where(phase == 1, 3.0 + np.sin(touch), 0.0)[:, None]
    raw = np.round(pressed + 0.05 * random.normal(size=(touch.size, 3)), 2)
    none = np.full(touch.size, np.nan)

    def averaged(readings: np.ndarray) -> Touches:
        recording = Recording(readings, np.arange(touch.size) / 33.0, touch, phase, none, none, 33.0)
        return average(recording, np.zeros(count), np.ones(count), np.zeros(count), 0.01)

    stuck = raw.copy()
    stuck[:, 1] = 1.5  # never answers: for calibration to say
    assert averaged(stuck).output.shape == (count, 3)
    raw[:, 2] = np.minimum(raw[:, 2], 2.5)
    with pytest.raises(
        ValueError, match=r"element 2 reads exactly 2\.5 in all frames of \d+ touches.*end of its range"
    ):
        averaged(raw)


def test_a_mains_line_is_noise_of_frames_but_not_of_their_means() -> None:
    random, frames, count = np.random.default_rng(4), 40, 50
    time_s = np.arange(count * frames) / 33.0
    raw = 0.05 * random.normal(size=(time_s.size, 4)) + 0.3 * np.sin(2 * np.pi * 120.0 * time_s)[:, None]
    touch, phase = np.repeat(np.arange(count), frames), np.tile(np.repeat([0, 1], frames // 2), count)
    none = np.full(time_s.size, np.nan)
    recording = Recording(raw, time_s, touch, phase, none, none, 33.0)
    found = average(recording, np.zeros(count), np.ones(count), np.zeros(count), 0.01)
    assert found.noise == pytest.approx(np.full(4, 0.01 * math.hypot(0.05, 0.3 / math.sqrt(2))), rel=0.05)
    told = float(found.noise.mean()) / math.sqrt(found.averaged)
    assert float(found.output.std()) / 1.5 < told < 1.5 * float(found.output.std())
    assert told < 0.3 * float(found.noise.mean()) / math.sqrt(10.0)


def test_ramps_give_the_differences_and_series_the_level() -> None:
    own = np.array([0.03, 0.05, 0.04, 0.06])
    creep = 0.01
    ramps = own + creep
    series = Quadratic(np.full(4, 0.045), np.full(4, np.inf), np.array([0, 5, 5, 0]), 0.045)
    assert with_ramps(ramps, series).value == pytest.approx(own)
    assert with_ramps(np.array([0.04, np.nan, 0.05, 0.07]), series).value[1] == 0.045
    assert with_ramps(ramps, None).value == pytest.approx(ramps)


def test_load_cell_is_believed_where_touches_follow_it(start: Finger, made) -> None:  # type: ignore[no-untyped-def]
    touches = made.touches()
    random = np.random.default_rng(2)
    share = 1.0 + 0.03 * random.normal(size=len(touches))
    real = Touches(
        touches.output * share[:, None],
        touches.angle_rad,
        touches.load,
        touches.radius_m,
        touches.load * share,
        touches.noise,
    )
    blind = Touches(real.output, real.angle_rad, real.load, real.radius_m, np.full(len(real), np.nan), real.noise)
    edges = [t.pick(t.radius_m == 0.0) for t in (real, blind)]
    with_cell, without = (calibrate(start, t, Options(identify=False, contact="frictionless")) for t in edges)
    assert any("follow the load cell" in warning for warning in with_cell.warnings)
    assert not any("follow the load cell" in warning for warning in without.warnings)
    assert np.mean(with_cell.residuals["elements"]) < 0.5 * np.mean(without.residuals["elements"])


def test_pull_of_a_conductor_is_found_and_undone(start: Finger, made) -> None:  # type: ignore[no-untyped-def]
    touches = made.touches()
    touches = touches.pick((touches.radius_m == 0.0) & half(touches) | (touches.load != 200.0))
    pull = Proximity(-0.03, math.radians(14.0))
    distance = made.angles - touches.angle_rad[:, None]
    drawn = touches.with_output(touches.output + pull.output(distance))
    found = calibrate(start, drawn, Options(identify=False, contact="frictionless"))
    assert found.finger.signal.proximity == pytest.approx(pull.amplitude, rel=0.15)
    assert found.finger.signal.proximity_range_rad == pytest.approx(pull.range_rad, rel=0.15)
    assert any("without strain" in warning for warning in found.warnings)
    quadratic, gain = np.array(found.finger.elements.quadratic), np.array(found.finger.elements.gain)
    place = math.radians(77.0)
    frame = -gain * linearise(made.output(place, 200.0, 6e-3) + pull.output(made.angles - place), quadratic)
    undone, left = (Estimator(found.finger, conductor=conductor).frame(frame) for conductor in (True, False))
    assert undone.load_n_per_m == pytest.approx(200.0, rel=0.05)
    assert math.degrees(undone.angle_rad) == pytest.approx(77.0, abs=0.3)
    assert abs(left.load_n_per_m - 200.0) > 4.0 * abs(undone.load_n_per_m - 200.0)


def test_a_conductors_pull_is_no_quadratic(made) -> None:  # type: ignore[no-untyped-def]
    """The pull is the same for all loads at one place: with an offset of its own a series gives the true quadratic."""
    touches = made.touches()
    distance = made.angles - touches.angle_rad[:, None]
    pulled = touches.with_output(touches.output + Proximity(-0.03, 0.25).output(distance))
    series = touches.radius_m == 1.6e-3
    model = np.array(
        [made._strains(t, p, rc) for t, p, rc in zip(
            touches.angle_rad[series], touches.load[series], touches.radius_m[series], strict=True)]
    )  # fmt: skip
    plain = find_quadratic(pulled.pick(series), model)
    parted = find_quadratic(pulled.pick(series), model, drawn=True)
    assert plain is not None and parted is not None
    assert parted.common == pytest.approx(made.quadratic, abs=0.6)
    assert abs(plain.common - made.quadratic) > 1.5


def test_what_no_model_explains_is_doubted(start: Finger, made) -> None:  # type: ignore[no-untyped-def]
    """Recordings that contradict each other: in half of the touches the elements answer as if pressed elsewhere, and
    the cell reads thrice the load.
    """
    touches = made.touches()
    touches = touches.pick((touches.radius_m == 0.0) & half(touches) | (touches.load != 200.0))
    options = Options(identify=False, contact="frictionless")
    assert not calibrate(start, touches, options).doubts
    turned = np.where(np.arange(len(touches)) % 2, np.radians(2.5), np.radians(-2.5))
    wrong = Touches(
        touches.output, touches.angle_rad + turned, touches.load, touches.radius_m, 3.0 * touches.load, touches.noise
    )
    doubts = calibrate(start, wrong, options).doubts
    (doubt,) = [d for d in doubts if "unexplained" in d]
    assert "a sound finger leaves less than 2 %" in doubt
    assert any("3.00 times the commanded load" in d for d in doubts)


def _told(start: Finger, poisson: float = 0.46, **changes: Any) -> list[str]:
    """Return the doubts of a calibration that has ended with these numbers."""
    body, found = start.cylinder, {"quadratic": 2.0, "pull": None, "extent_rad": 0.0, **changes}
    thick = body.outer_m - body.core_m
    fits = [
        ElementFit(
            angle + found.get("turned", 0.0),
            body.core_m + found.get("depth", 0.5) * thick,
            0.46,
            gain,
            0.0,
            20,
        )
        for angle, gain in zip(start.elements.angle_rad, start.elements.gain, strict=True)
    ]
    count = len(fits)
    elements = msgspec.structs.replace(start.elements, misfit=(0.0,) * count)
    geometry = msgspec.structs.replace(start.geometry, extent_rad=found["extent_rad"])
    finger = msgspec.structs.replace(start, elements=elements, geometry=geometry)
    quadratic = SimpleNamespace(value=np.full(count, found["quadratic"]))
    faults: Any = SimpleNamespace(quadratic=quadratic, proximity=found["pull"])
    return calibration._doubts(start, finger, fits, poisson, faults, np.ones(count))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"depth": SHALLOW}, "its effective radius runs to the end of what it can be"),
        ({"depth": DEEP}, "its effective radius runs to the end of what it can be"),
        ({"turned": TURN}, "its place runs to the end of what was searched, 8.6 degrees"),
        ({"turned": -TURN}, "its place runs to the end of what was searched"),
        ({"extent_rad": MOST_EXTENT}, "the arc of an element runs to the widest that was searched"),
        ({"poisson": SMALLEST}, "Poisson's ratio runs to the least that was searched"),
        ({"quadratic": 16.0}, "the quadratic comes out as 0.16 per per cent"),
        ({"pull": Proximity(-0.2, 0.3)}, "lies beyond the lowest output"),
        ({"pull": Proximity(-0.12, 0.3)}, "lies near the lowest output"),
        ({"pull": Proximity(-0.01, LONGEST)}, "reaches 40 degrees, the end of what was searched"),
        ({"pull": Proximity(-0.01, SHORTEST)}, "reaches 6 degrees, the end of what was searched"),
    ],
)
def test_a_number_at_the_end_of_what_was_searched_is_doubted(
    start: Finger, changes: dict[str, Any], words: str
) -> None:
    assert not _told(start) and not _told(start, pull=Proximity(-0.05, 0.3))
    doubts = _told(start, **changes)
    assert doubts and all(words in doubt for doubt in doubts)


def test_a_noisy_cell_is_believed_by_its_share_and_more_touches_lose_nothing(nominal: Finger, made) -> None:  # type: ignore[no-untyped-def]
    """Half of the cell's variation is its own noise; the touches of indenters have scatter of another origin beside."""
    random = np.random.default_rng(4)
    touches = made.touches()
    share = 1.0 + 0.04 * random.normal(size=len(touches))
    told = share + 0.04 * random.normal(size=len(touches))
    scatter = np.where(touches.radius_m == 0.0, 1.0, 1.0 + 0.08 * random.normal(size=len(touches)))
    real = Touches(
        touches.output * (share * scatter)[:, None], touches.angle_rad, touches.load, touches.radius_m,
        touches.load * told, touches.noise,
    )  # fmt: skip
    start = msgspec.structs.replace(nominal, elements=msgspec.structs.replace(nominal.elements, gain=(3.0,) * 16))
    widths = nominal.width_table()
    found = []
    for part in (real.pick(real.radius_m == 0.0), real):
        found.append(_cell_share(start, part, touch_loads(nominal.cylinder, widths, part, 60)))
    assert 0.2 < found[0] < 0.9  # the regression on a reading of which half is noise
    assert found[1] > 0.2
    nothing = Touches(
        real.output, real.angle_rad, real.load, real.radius_m, real.load * (1.0 + 0.04 * random.normal(size=len(real))),
        real.noise,
    )  # fmt: skip
    assert _cell_share(start, nothing, touch_loads(nominal.cylinder, widths, nothing, 60)) == 0.0
