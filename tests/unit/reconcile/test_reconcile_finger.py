"""Bad input of ``sioms reconcile tactile``, and the parts of its model, each by a fact that does not use it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from sioms.plant.finger import FingerShape, TactileArray
from sioms.reconcile import command as reconcile
from sioms.reconcile.descent import descend, within
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.finger import read_experiments, read_model
from sioms.reconcile.finger.belief import Belief, late, outputs, scene_of
from sioms.reconcile.finger.data import CELL, COURSE, STRENGTH, TOUCH, behind
from sioms.reconcile.finger.effects import library
from sioms.reconcile.finger.model_file import from_table, to_toml
from sioms.reconcile.finger.plan import Bench, catalogue, first, one_place, propose
from sioms.reconcile.finger.prepare import cell_level, cell_spread, prepare
from sioms.reconcile.finger.pressures import WAVES, hertz, sheet
from sioms.reconcile.finger.records import Line, Ramped, find_lines, reduce_untouched, without_lines
from sioms.reconcile.finger.twin import FingerTwin
from sioms.reconcile.sensors.effect import SensorModel
from sioms.reconcile.sensors.excitation import gate
from sioms.reconcile.sensors.fit import half_intervals, refit
from sioms.reconcile_selftest.finger_draw import HiddenFinger, draw_finger
from sioms.reconcile_selftest.finger_world import FingerWorld
from sioms.reconcile_selftest.layer import Body, Indenters, strain_factors
from sioms.tactile.contact import frictionless
from sioms.tactile.cylinder import FINGER_B
from sioms.tactile.indenter import FLAT, Round, Wedge
from sioms.tactile.touches import Recording

ANGLES = np.radians(143.0 - 9.22 * np.arange(16))


def believed(**change: object) -> Belief:
    b = FINGER_B
    given = {
        "core": b.core_m,
        "outer": b.outer_m,
        "shear": b.shear_pa,
        "poisson": b.poisson,
        "angle": ANGLES,
        "radius": np.full(16, 10.3e-3),
        "gain": np.full(16, 3.0),
        "quadratic": np.zeros(16),
        "temperature": np.zeros(16),
    }
    return Belief(**{**given, **change})  # type: ignore[arg-type]


def edge(place_deg: float, load: float = 200.0, radius: float = 0.0) -> np.ndarray:
    scene = scene_of(np.radians([place_deg]), np.array([load]), np.array([radius]))
    return outputs(believed(), scene)[0]


def test_tabulated_contacts_are_those_of_the_solver() -> None:
    for radius, indenter, half in (
        (6e-3, Round(6e-3), 0.13),
        (np.inf, FLAT, 0.2),
        (0.0, Wedge(np.pi / 4.0), 0.035),
    ):
        solved = frictionless(FINGER_B, indenter, half)
        exact = solved.series(0.0, len(WAVES) - 1)[: 2 * len(WAVES) - 1 : 2] / solved.load
        table = sheet(FINGER_B, radius == 0.0)
        argument = solved.load if radius == 0.0 else solved.load / (1.0 / FINGER_B.outer_m + 1.0 / radius)
        found = table.series(np.array([argument]))[0][0]
        assert np.max(np.abs(found - exact)) < 2e-3 * abs(exact[1])
        assert table.width(np.array([argument]))[0] == pytest.approx(solved.half_width, rel=5e-3)


def test_a_hertz_contact_is_wider_than_one_over_the_core() -> None:
    argument = np.array([2.0])
    assert hertz(FINGER_B).width(argument)[0] > 1.02 * sheet(FINGER_B, False).width(argument)[0]


def test_outputs_are_even_about_a_touch_and_drag_makes_them_lopsided() -> None:
    middle = 0.5 * (ANGLES[7] + ANGLES[8])
    scene = scene_of(np.array([middle]), np.array([150.0]), np.array([8e-3]))
    still = outputs(believed(), scene)[0]
    assert np.allclose(still, still[::-1], atol=1e-9)
    dragged = outputs(believed(friction=0.4), scene)[0]
    assert not np.allclose(dragged, dragged[::-1], atol=1e-3)
    assert np.allclose(dragged + dragged[::-1], 2.0 * still, atol=1e-9)


def test_finite_elements_and_pressed_points_agree_with_the_series() -> None:
    body = Body(FINGER_B.core_m, FINGER_B.outer_m, FINGER_B.shear_pa, FINGER_B.poisson)
    factors, indenters = strain_factors(body, 10.3e-3)[:, 0], Indenters(body)
    for radius in (0.0, 6.01e-3, np.inf):
        strain = float(indenters.touch(200.0, radius)[0] @ factors)
        place = np.degrees(ANGLES[6])
        assert -strain / 3.0 == pytest.approx(edge(place, 200.0, radius)[6], rel=3e-3)


def test_what_comes_late_is_there_at_last() -> None:
    b = believed(creep=0.2, creep_time=0.5)
    assert late(b, np.array([0.0]))[0] == pytest.approx(0.8)
    assert late(b, np.array([20.0]))[0] == pytest.approx(1.0)


def test_every_effect_does_nothing_at_its_neutral_value_and_something_beside_it() -> None:
    model = SensorModel(believed(), 16, library())
    scene = scene_of(np.radians([60.0, 72.5]), np.array([120.0, 200.0]), np.array([0.0, np.inf]))
    before = outputs(model.belief(), scene)
    for name, effect in library().items():
        if not effect.rankable:
            continue
        plain = model.plain(name)
        assert np.allclose(outputs(model.with_effect(name, plain).belief(), scene), before, atol=1e-12), name
        moved = {
            **plain,
            effect.primary.symbol: plain[effect.primary.symbol]
            + (-effect.primary.size if effect.primary.upper <= 0.0 else effect.primary.size),
        }
        b = model.with_effect(name, moved).belief()
        changed = not np.allclose(outputs(b, scene), before, atol=1e-7)
        assert changed or b.creep or b.cell or b.temperature.any(), name


@pytest.mark.parametrize("radius", [0.0, 6e-3, np.inf])
def test_a_softer_skin_is_one_of_a_smaller_shear_modulus(radius: float) -> None:
    """Strains depend on the load over the stiffness."""
    scene = scene_of(np.radians([60.0, 72.5]), np.array([80.0, 250.0]), np.full(2, radius))
    soft = SensorModel(believed(), 16, library()).with_effect("soft_skin", {"s": np.array([0.25])})
    wanted = outputs(believed(shear=FINGER_B.shear_pa / 1.25), scene)
    np.testing.assert_allclose(outputs(soft.belief(), scene), wanted, atol=1e-5 * wanted.max())


def test_an_element_more_sensitive_over_its_strip_is_so_in_the_simulated_finger() -> None:
    finger = TactileArray(FingerShape(gain=3.0, length_m=0.012, strip_gain=0.1, strip_width_rad=0.09))
    plain = TactileArray(FingerShape(gain=3.0, length_m=0.012))
    peak = {"c": np.array([0.1]), "width": np.array([0.09])}
    models = [m := SensorModel(believed(), 16, library()), m.with_effect("strip_peak", peak)]
    for place in (1.2, 1.3, 1.31):
        scene = scene_of(np.array([place]), np.array([200.0]), np.zeros(1))
        before, after = (outputs(m.belief(), scene)[0] for m in models)
        out = (f.read(2.4, place, 0.0, np.empty(16)) for f in (plain, finger))
        was, now = (o.copy() for o in out)
        np.testing.assert_allclose(after / before, now / was, rtol=1e-6)


def test_confounders_are_effects_of_the_library() -> None:
    names = set(library())
    for effect in library().values():
        assert {*effect.confounders, *effect.replaces, *effect.twins} <= names


def test_a_model_file_reads_back_exactly_and_effects_can_be_switched_off() -> None:
    model = SensorModel(believed(blur=0.04**2), 16, library(), name="x")
    model = model.with_effect("poisson", {"dnu": np.array([-0.03])}).with_effect(
        "gain_scatter", {"g": 0.01 * np.arange(16.0)}
    )
    import tomllib

    text = to_toml(model)
    again, stated = from_table(tomllib.loads(text), "x")
    assert stated
    assert np.array_equal(again.belief().gain, model.belief().gain)
    assert again.belief().poisson == model.belief().poisson
    off, _ = from_table(tomllib.loads(text.replace("on = true", "on = false", 1)), "x")
    assert set(off.effects) == set(model.effects) - {next(iter(model.effects))}


def test_the_experiment_fits_the_pair() -> None:
    creep = believed(creep=0.15, creep_time=1.0)
    warm = believed(temperature=np.full(16, 3e-3))
    assert propose([believed(), creep], 5e-4)[0].name == "hold"
    assert propose([believed(), warm], 5e-4)[0].name == "warm"


def test_a_line_that_the_frames_fold_to_a_constant_takes_nothing_off_a_touch() -> None:
    time = np.arange(20) / 50.0
    frames = 0.1 + 2e-3 * np.sin(2.0 * np.pi * 62.0 * time + 1.0)[:, None] * np.ones(3)
    assert np.allclose(without_lines(frames, time, [Line(50.0, 2e-3, 1e-5)])[0], frames)
    both = [Line(62.0, 2e-3, 1e-5), Line(50.0, 2e-3, 1e-5)]
    left, spent, _ = without_lines(frames, time, both)
    assert np.allclose(left, 0.1, atol=1e-5)
    assert spent == 2


def test_creep_on_a_ramp_is_that_of_many_small_steps() -> None:
    since = np.linspace(0.1, 3.9, 200)
    load = 10.0 + 30.0 * since
    own = 1e-3 * load**0.9
    tau, fine = 0.4, np.linspace(0.0, 3.9, 20000)
    level = 1e-3 * (10.0 + 30.0 * fine) ** 0.9
    steps = np.concatenate([[level[0]], np.diff(level)])
    exact = [float(np.sum(steps[fine <= t] * np.exp(-(t - fine[fine <= t]) / tau))) for t in since[::20]]
    assert behind(own, Ramped(0, own, load, since, 1.0), tau)[::20] == pytest.approx(exact, rel=5e-3)


def test_a_line_is_found_in_noise_and_none_where_there_is_none() -> None:
    rng = np.random.default_rng(1)
    time = np.arange(4000) / 400.0
    noise = 0.05 * rng.standard_normal((4000, 4))
    nothing = np.full(4000, -1, dtype=np.int64)

    def recording(raw: np.ndarray) -> Recording:
        return Recording(raw, time, nothing, nothing + 3, np.zeros(4000), np.full(4000, 20.0), 400.0)

    assert find_lines(recording(noise), 0.01) == []
    (line,) = find_lines(recording(noise + 0.1 * np.sin(2 * np.pi * 50.02 * time)[:, None]), 0.01)
    assert line.frequency == pytest.approx(50.02, abs=3.0 * line.frequency_deviation)
    assert line.frequency_deviation < 0.005
    assert line.amplitude == pytest.approx(1e-3, rel=0.01)


@lru_cache(maxsize=1)
def _hidden() -> tuple[HiddenFinger, dict[str, dict[str, np.ndarray]]]:
    finger = draw_finger("f", "null", np.random.default_rng(3))
    world = FingerWorld(finger, np.random.default_rng(4))
    places = np.radians(np.arange(20.0, 130.0, 4.0))
    return finger, {"edge": world.touches(places, np.full(len(places), 200.0), np.zeros(len(places)))}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    finger, session = _hidden()
    data = tmp_path / "data"
    data.mkdir()
    for name, arrays in session.items():
        np.savez(data / f"{name}.npz", **arrays)  # type: ignore[arg-type]
    (data / "nominal.toml").write_text(finger.public())
    return data


def spoil(folder: Path, change: Callable[[dict[str, np.ndarray]], None]) -> None:
    with np.load(folder / "edge.npz") as file:
        arrays = {k: file[k].copy() for k in file.files}
    change(arrays)
    np.savez(folder / "edge.npz", **arrays)  # type: ignore[arg-type]


def run(folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    out = folder.parent / "report"
    status = reconcile.main(
        ["tactile", str(folder), "--model", str(folder / "nominal.toml"), "--out", str(out), "--quiet"]
    )
    assert status == 2
    assert not (out / "verdict.json").exists()
    return capsys.readouterr().err


def _set(name: str, value: object) -> Callable[[dict[str, np.ndarray]], None]:
    def change(a: dict[str, np.ndarray]) -> None:
        a[name] = np.asarray(value(a[name])) if callable(value) else np.asarray(value)

    return change


def _only(count: int) -> Callable[[dict[str, np.ndarray]], None]:
    def change(a: dict[str, np.ndarray]) -> None:
        for name in ("cmd_theta", "cmd_P", "cmd_rc"):
            a[name] = a[name][:count]

    return change


def _shuffled(a: dict[str, np.ndarray]) -> None:
    a["cmd_theta"] = np.random.default_rng(2).permutation(a["cmd_theta"])


@pytest.mark.parametrize(("change", "said"), [
    (lambda a: a.pop("raw"), "no array raw"),
    (lambda a: a.pop("cmd_P"), "no array cmd_P"),
    (_set("raw", lambda r: r[:, :5]), "columns; the finger has"),
    (_set("raw", lambda r: 0.0 * r + 1.0), "are constant"),
    (_set("raw", lambda r: np.nan * r), "holds no number"),
    (_set("raw", lambda r: np.clip(r, -0.5, 0.5)), "the electronics is saturated"),
    (_set("raw", lambda r: r / 1000.0), "about 0.001"),
    (_set("raw", lambda r: -r), "change the sign of raw"),
    (_set("cmd_P", lambda p: 1000.0 * p), "about 0.001"),
    (_set("cmd_P", lambda p: np.nan * p), "are no numbers"),
    (_set("cmd_P", lambda p: -p), "pressing loads are positive"),
    (_set("cmd_rc", lambda r: r + 5000.0), "a factor of 1000"),
    (_set("cmd_theta", np.radians), "radians"),
    (_set("cmd_theta", lambda t: 1000.0 * t), "needs degrees"),
    (_set("force", lambda f: f / 1000.0), "times cmd_P (about 0.001)"),
    (_set("time", lambda t: t[::-1]), "does not rise"),
    (_set("time", lambda t: 1000.0 * t), "a factor of 1000"),
    (_only(10), "touches are too few"),
    (_shuffled, "it is another finger"),
])  # fmt: skip
def test_what_cannot_be_used_is_refused_with_a_reason(
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    change: Callable[[dict[str, np.ndarray]], None],
    said: str,
) -> None:
    spoil(folder, change)
    assert said in run(folder, capsys)


@pytest.mark.parametrize(("old", "new", "said"), [
    ("outer_m = 0.0", "outer_m = 12", "a factor of 1000"),
    ("radius_m = 0.0", "radius_m = 10", "mm?"),
    ("poisson = 0.4", "poisson = 4", "Poisson's ratio"),
    ("gain = ", "gain = -", "strain per output"),
    ("core_m", "cor_m", "nobody reads cor_m"),
    ("[finger]", "[sensor]", "unknown field `sensor`"),
])  # fmt: skip
def test_a_model_that_makes_no_sense_is_refused(
    folder: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, said: str
) -> None:
    path = folder / "nominal.toml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    assert said in run(folder, capsys)


def test_an_empty_folder_and_a_missing_model_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "data").mkdir()
    assert "no such file" in run(tmp_path / "data", capsys)


def test_other_names_and_units_are_read(folder: Path) -> None:
    before = read_experiments(folder)[0]

    def rename(a: dict[str, np.ndarray]) -> None:
        a["dc"], a["place"] = 0.01 * a.pop("raw"), np.radians(a.pop("cmd_theta"))

    spoil(folder, rename)
    (folder / "columns.toml").write_text(
        '[columns]\nraw = { name = "dc", unit = "1" }\ncmd_theta = { name = "place", unit = "rad" }\n'
    )
    after = read_experiments(folder)[0]
    assert np.allclose(after.recording.raw, before.recording.raw)
    assert after.touches is not None and before.touches is not None
    assert np.allclose(after.touches[0], before.touches[0])
    (folder / "columns.toml").write_text('[columns]\nrow = { name = "dc" }\n')
    with pytest.raises(BadInputError, match="nobody reads row"):
        read_experiments(folder)


def test_a_dead_element_and_missing_frames_are_said_and_do_no_harm(folder: Path) -> None:
    def change(a: dict[str, np.ndarray]) -> None:
        a["raw"][:, 4] = 0.0
        a["raw"][a["touch"] == 3, 7] = np.nan

    spoil(folder, change)
    out = folder.parent / "report"
    status = reconcile.main(
        ["tactile", str(folder), "--model", str(folder / "nominal.toml"), "--out", str(out), "--quiet"]
    )
    found = json.loads((out / "verdict.json").read_text())
    assert status == 0
    assert found["effects"] == ["dead_element"]
    assert found["parameters"]["dead_element"] == {"index": 4.0}
    assert any("1 of" in n and "left out" in n for n in found["notes"])
    assert "used = [true, true, true, true, false" in (out / "finger.toml").read_text()
    shutil.rmtree(out)


def test_the_nominal_finger_may_be_a_calibrated_one(folder: Path) -> None:
    from sioms.tactile.finger import nominal_finger
    from sioms.tactile.finger import to_toml as finger_toml

    path = folder / "finger.toml"
    path.write_text(finger_toml(nominal_finger(FINGER_B, ANGLES, 10.3e-3, 3.0)))
    belief, _, stated = read_model(path, folder)
    assert not stated
    assert np.allclose(belief.gain, 3.0)


def test_a_twin_answers_as_the_finger_of_another_mechanics_with_the_same_gains_and_creep() -> None:
    """The simulated finger of ``sioms.plant`` solves its contacts in quite another way."""
    creep, tau = 0.2, 0.5
    finger = TactileArray(FingerShape(gain=3.0, gain_scatter=0.1, seed=3, creep=creep, creep_s=tau, length_m=0.012))
    model = SensorModel(believed(), 16, library())
    model = model.with_effect("gain_scatter", {"g": finger.truth.gains / 3.0 - 1.0})
    model = model.with_effect("creep", {"c": np.array([creep]), "tau": np.array([tau])})
    twin = FingerTwin(model, 0.012)
    for began, radius in ((0.0, 0.0), (50.0, 6e-3)):
        for step in range(40):
            now = began + 0.05 * step
            wanted, got = (a.read(2.4, 1.3, radius, np.empty(16), now).copy() for a in (finger, twin))
            if step:
                assert np.allclose(got, wanted, atol=0.012 * wanted.max())
    assert not twin.read(0.0, 1.3, 0.0, np.empty(16), 100.0).any()


def test_touches_keep_the_limits_of_the_bench() -> None:
    bench = Bench((6e-3, 0.0), 120.0, 150.0, 0.8, 1.9)
    for name, _, scene in (
        *first(believed(), bench),
        *one_place(believed(), bench),
        *catalogue(believed(), bench),
    ):
        assert len(scene.place) > 0, name
        assert scene.load.max() <= 150.0 and scene.load.min() > 0.0, name
        assert scene.place.min() >= 0.8 and scene.place.max() <= 1.9, name
        assert set(scene.radius) <= {6e-3, 0.0}, name


def test_loads_told_by_the_load_cell_alone_do_not_judge_its_scale(folder: Path) -> None:
    for path in folder.glob("*.npz"):
        with np.load(path) as file:
            arrays = {k: file[k].copy() for k in file.files}
        if "cmd_P" in arrays:
            mine = [(arrays["touch"] == i) for i in range(len(arrays["cmd_P"]))]
            felt = [
                arrays["force"][m & (arrays["phase"] == 1)].mean() - arrays["force"][m & (arrays["phase"] == 0)].mean()
                for m in mine
            ]
            arrays["cmd_P"] = np.array(felt)
            np.savez(path, **arrays)
    nominal, name, stated = read_model(folder / "nominal.toml", folder)
    subject = prepare(read_experiments(folder), nominal, name, refine_extent=not stated)
    assert not np.any(subject.whole.view == CELL)
    assert any("its scale is not judged" in note for note in subject.notes)
    assert "force_gain" in gate(subject)[0]


def test_a_load_that_is_off_shows_in_the_strength_of_touches_and_nowhere_else(folder: Path) -> None:
    nominal, name, stated = read_model(folder / "nominal.toml", folder)
    subject = prepare(read_experiments(folder), nominal, name, refine_extent=not stated)
    data = subject.whole
    more = replace(data, scene=replace(data.scene, load=1.01 * data.scene.load)).predict(subject.model)
    change = np.where(data.view == TOUCH, more - data.predict(subject.model), 0.0)
    louder = data.whiten(change)
    assert np.linalg.norm(louder[data.view == TOUCH]) < 0.05 * np.linalg.norm(change)  # but for noise
    assert np.all(louder[(data.view != TOUCH) & (data.view != STRENGTH)] == 0.0)
    assert np.all(louder[data.view == STRENGTH] > 0.0)
    assert np.all(louder[data.view == STRENGTH] < 0.01 / data.load_share)
    assert data.footing[STRENGTH] == data.footing[TOUCH]


@pytest.mark.parametrize("cause", ["simulation", "loads"])
def test_an_interval_knows_that_all_touches_may_be_too_strong(
    folder: Path, monkeypatch: pytest.MonkeyPatch, cause: str
) -> None:
    if cause == "simulation":
        monkeypatch.setattr("sioms.reconcile.finger.data.OWN_LEVEL", 0.05)
    nominal, name, stated = read_model(folder / "nominal.toml", folder)
    subject = prepare(read_experiments(folder), nominal, name, refine_extent=not stated)
    data = subject.whole if cause == "simulation" else replace(subject.whole, unsure=0.05)
    model = subject.model.with_effect("gain_scatter", subject.model.plain("gain_scatter"))
    fit = refit(data, model, np.ones(len(data.view)))
    half = half_intervals(data, fit, np.ones(len(data.view)))
    mine = [f.effect == "gain_scatter" for f in fit.free]
    assert np.median(half[mine]) == pytest.approx(1.96 * 0.05, rel=0.3)  # 5 % too strong is 5 % of gain


def _rewritten(folder: Path, change: Callable[[dict[str, np.ndarray]], None]) -> None:
    for path in folder.glob("*.npz"):
        with np.load(path) as file:
            arrays = {k: file[k].copy() for k in file.files}
        change(arrays)
        np.savez(path, **arrays)


def test_the_zero_goes_on_drifting_between_baseline_and_touch(folder: Path) -> None:
    nominal, name, stated = read_model(folder / "nominal.toml", folder)

    def warm(a: dict[str, np.ndarray]) -> None:
        a["temperature"] = 20.0 + 0.02 * a["time"]

    def drift(a: dict[str, np.ndarray]) -> None:
        a["raw"] = a["raw"] + 100.0 * 0.01 * (a["temperature"][:, None] - 20.0)

    missed = []
    for change, k in ((warm, 0.0), (drift, 0.01), (None, 0.0)):
        if change:
            _rewritten(folder, change)
        subject = prepare(read_experiments(folder), nominal, name, refine_extent=not stated)
        values = {"k": np.array([k])}
        data = subject.whole
        missed.append(data.miss(data.predict(subject.model.with_effect("temperature_drift", values))))
    still, drifting, unknown = (m[(data.view == TOUCH) | (data.view == COURSE)] for m in missed)
    assert np.sqrt(np.mean((drifting - still) ** 2)) < 0.05
    assert np.sqrt(np.mean((unknown - still) ** 2)) > 0.5


@pytest.mark.parametrize("proportional", [False, True])
def test_the_load_cell_scatters_alike_or_in_proportion_as_it_shows(folder: Path, proportional: bool) -> None:
    nominal, name, stated = read_model(folder / "nominal.toml", folder)
    touched = prepare(read_experiments(folder), nominal, name, refine_extent=not stated).whole.touched
    load = np.resize([50.0, 100.0, 200.0, 300.0], len(touched))
    expected = 0.03 * load if proportional else np.full(len(load), 4.0)
    cell = 1.1 * load + expected * np.random.default_rng(3).standard_normal(len(load))
    found = cell_spread(replace(touched, load=load, cell=cell, cell_noise=np.full(len(load), 0.1)), 1.1)
    assert np.allclose(found / found.mean(), expected / expected.mean(), atol=0.05)
    assert found.mean() == pytest.approx(expected.mean(), rel=0.3)


def test_the_level_of_the_load_cell_is_as_uncertain_as_it_says(folder: Path) -> None:
    nominal, name, stated = read_model(folder / "nominal.toml", folder)
    touched = prepare(read_experiments(folder), nominal, name, refine_extent=not stated).whole.touched
    load, off, median = np.resize([20.0, 50.0, 200.0, 300.0], len(touched)), [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        cell = 1.1 * (load + 4.0 * rng.standard_normal(len(load)))
        level, deviation, _ = cell_level(replace(touched, load=load, cell=cell, cell_noise=np.full(len(load), 0.1)))
        off.append((level - 1.1) / deviation)
        median.append((float(np.median(cell / load)) - 1.1) / deviation)
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.4
    assert np.mean(np.square(median)) > 1.5 * np.mean(np.square(off))


def test_numbers_that_trade_go_far_together() -> None:
    """Their sum is told, their difference hardly: where one is held, the other keeps the sum."""
    j, wanted = np.array([[100.0, 100.0], [0.1, -0.1]]), np.array([5.0, -4.9])
    h, none = j.T @ j, np.full(2, np.inf)
    assert within(h, -h @ wanted, -none, none) == pytest.approx(wanted, rel=1e-6)
    assert within(h, -h @ wanted, -np.ones(2), np.ones(2)) == pytest.approx([1.0, -0.9], abs=1e-3)
    assert within(h, -h @ wanted, np.zeros(2), np.ones(2)) == pytest.approx([0.1, 0.0], abs=1e-3)


def test_a_fit_leaves_elements_without_width(folder: Path) -> None:
    nominal, name, _ = read_model(folder / "nominal.toml", folder)
    subject = prepare(read_experiments(folder), nominal, name)
    sharp = replace(subject.model, base=replace(subject.model.base, blur=0.0))
    fit = refit(subject.whole, sharp, np.ones(len(subject.whole.view)), iterations=20)
    assert 0.02 < fit.model.base.extent < 0.06  # what the generator draws


def test_gains_beside_a_sensitivity_that_ages_are_as_uncertain_as_when_they_were_stated(folder: Path) -> None:
    rate = 2e-3

    def age(a: dict[str, np.ndarray]) -> None:
        untouched = a["raw"][a["phase"] == 0].mean(0)
        a["raw"] = untouched + (a["raw"] - untouched) * (1.0 + rate * (a["time"] - a["time"].mean()))[:, None]

    halves = []
    for change, k in ((lambda a: None, 0.0), (age, rate)):
        _rewritten(folder, change)
        nominal, name, stated = read_model(folder / "nominal.toml", folder)
        subject = prepare(read_experiments(folder), nominal, name, refine_extent=not stated)
        data, weights = subject.whole, np.ones(len(subject.whole.view))
        model = subject.model.with_effect("gain_scatter", subject.model.plain("gain_scatter"))
        fit = refit(data, model.with_effect("term_time", {"k": np.array([k]), "c": np.zeros(1)}), weights)
        half = half_intervals(data, fit, weights)
        halves.append(np.median(half[[f.effect == "gain_scatter" for f in fit.free]]))
    span = 0.5 * rate * float(np.ptp(data.scene.time))
    assert 0.5 < halves[1] / (1.96 * span) < 1.5
    assert halves[0] < 0.5 * halves[1]


def test_the_fit_finds_the_bottom_of_a_bent_valley_within_its_bounds() -> None:
    """Rosenbrock's valley: the lowest point is (1, 1), or at the bound beside it."""

    def residual(x: np.ndarray) -> np.ndarray:
        return np.array([1.0 - x[0], 10.0 * (x[1] - x[0] ** 2)])

    def slopes(x: np.ndarray, r: np.ndarray) -> np.ndarray:
        return np.array([[-1.0, 0.0], [-20.0 * x[0], 10.0]])

    none, one = np.full(2, np.inf), np.ones(2)
    at, r, _ = descend(residual, slopes, np.array([-1.2, 1.0]), one, -none, none, 200, 1e-12)
    assert at == pytest.approx(one, abs=1e-4) and r @ r < 1e-8
    at, _, _ = descend(residual, slopes, np.array([-1.2, 1.0]), one, -none, np.array([0.5, np.inf]), 200, 1e-12)
    assert at == pytest.approx([0.5, 0.25], abs=1e-3)


def test_a_line_that_slow_frames_fold_is_taken_off_and_the_temperature_left() -> None:
    rng, time = np.random.default_rng(2), 100.0 * np.arange(60)
    warm = 20.0 + np.sin(2 * np.pi * time / 1500.0)
    nothing = np.full(60, -1, dtype=np.int64)
    line = Line(100.0 + 0.28 / 1000.0, 1e-3, 1e-6, 1e-4)
    output = 1e-5 * rng.standard_normal((60, 4)) + 5e-4 * warm[:, None]
    loud = output + 1e-3 * np.sin(2 * np.pi * (line.frequency + 1.5e-4) * time)[:, None]
    said = [
        reduce_untouched(Recording(raw, time, nothing, nothing + 3, np.zeros(60), warm, 0.01), 1.0, lines)
        for raw, lines in ((loud, ()), (loud, (line,)), (output, ()))
    ]
    with_line, without, never = (u.output - u.output.mean(0) for u in said if u is not None)
    assert np.std(with_line - never) > 5e-4
    assert np.std(without - never) < 2e-5
    assert all(u is not None and np.all(u.noise < 2e-5) for u in said[1:])


def test_what_a_load_changes_beyond_proportion_is_told_beside_a_model(folder: Path) -> None:
    """A pull that no load makes larger, and outputs that saturate: an uncertain load changes less, and in another
    profile.
    """
    nominal, name, stated = read_model(folder / "nominal.toml", folder)
    subject = prepare(read_experiments(folder), nominal, name, refine_extent=not stated)
    data, model = subject.whole, subject.model
    pull = {"A": np.array([-0.03]), "range": np.array([0.3])}
    bent = {"q": np.full(model.count, -5.0)}
    assert data.turned(data.loaded(model)) == pytest.approx(0.0, abs=1e-9)
    for effect, values in (("proximity", pull), ("quadratic", bent)):
        other = data.loaded(model.with_effect(effect, values))
        assert other.turned(data) > 0.1
    plain = outputs(model.belief(), data.scene)[:, data.alive]
    less = other.beyond - np.asarray(data.beyond)
    assert less == pytest.approx(-5.0 * plain**2, abs=0.1 * float(np.max(5.0 * plain**2)))
