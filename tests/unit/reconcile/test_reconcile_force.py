"""Bad input of ``sioms reconcile force``, and the parts of its model."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sioms.plant.force_sensor import Contact, Flaws, ForceSensor
from sioms.reconcile import command as reconcile
from sioms.reconcile.command.selftest_sensors import COLUMNS
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.force.belief import Loads, lagged, late, readings
from sioms.reconcile.force.model_file import from_table, to_toml
from sioms.reconcile.force.records import ForceRecords
from sioms.reconcile.force.subject import prepare
from sioms.reconcile.force.twin import ForceTwin
from sioms.reconcile.sensors.analyse import Options, analyse
from sioms.reconcile.sensors.search import Saving, Searcher
from sioms.reconcile.sensors.steady import changes
from sioms.reconcile_selftest.force_world import COMPONENTS, draw_sensor, record

SENSOR = {"sensor": {"name": "s", "components": ["fx", "tz"], "full_range": [100.0, 5.0]}}


def test_the_lag_is_odd_full_after_its_reach_and_remembers_where_a_loop_began() -> None:
    load = np.array([0.0, 0.05, 0.3, 0.26, 0.29, 0.26, 0.3, 0.1, -0.4])[:, None]
    record = np.zeros(len(load), dtype=np.int64)
    lag = lagged(load, np.array([0.1]), 0.0, record)[:, 0]
    assert np.allclose(lagged(-load, np.array([0.1]), 0.0, record)[:, 0], -lag)
    assert lag[0] == 0.0 and -1.0 < lag[1] < -0.5
    assert lag[2] == pytest.approx(-1.0)  # beyond the reach every part has given way
    assert lag[7:] == pytest.approx(1.0)  # and after twice the reach back, the other way
    assert lag[5] == pytest.approx(lag[3]) and lag[6] == pytest.approx(lag[2])  # a loop within a loop closes
    again = lagged(np.concatenate([load, load]), np.array([0.1]), 0.0, np.repeat([0, 1], len(load)))[:, 0]
    assert np.allclose(again[len(load) :], lag)  # every record begins at rest


def test_the_law_that_forgets_goes_straight_back_to_the_middle_and_on_as_an_exponential() -> None:
    load = np.array([0.0, 0.02, 0.07, 0.04, 0.0, -0.4, -0.37, -0.4])[:, None]
    record = np.zeros(len(load), dtype=np.int64)
    lag = lagged(load, np.array([0.3]), 0.0, record, 1.0)[:, 0]  # a third of the reach is 0.1
    top = 1.0 - np.exp(-0.7)
    middle = 0.07 - 0.1 * top
    assert -lag[:3] == pytest.approx([0.0, 1.0 - np.exp(-0.2), top])
    assert -lag[3] == pytest.approx(top - 0.3)
    assert -lag[4] == pytest.approx(np.exp(-10.0 * middle) - 1.0)
    assert -lag[5] == pytest.approx(-1.0, abs=0.02)
    assert -lag[6] == pytest.approx(-lag[5] + 0.3)
    assert -lag[7] > -lag[5] + 0.1  # a loop within a loop stays open


def test_what_comes_late_decays_with_its_time_constant_and_begins_anew_with_every_record() -> None:
    time = np.array([0.0, 1.0, 2.0, 4.0, 0.0, 1.0])
    load = np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0])[:, None]
    loads = Loads(load, time, 0.0 * time, np.array([0, 0, 0, 0, 1, 1]))
    assert np.allclose(late(loads, 2.0)[:, 0], [0.0, np.exp(-0.5), np.exp(-1.0), np.exp(-2.0), 0.0, 0.0])


def test_a_twin_reads_what_the_model_says_row_by_row() -> None:
    model, _ = from_table(SENSOR, "x")
    model = model.with_effect("gain", {"g": np.array([0.02, -0.03])})
    model = model.with_effect("offset_drift", {"d": np.array([1e-4, -2e-4])})
    shape = {"r": np.array([0.1, 0.2]), "a": np.array([0.7]), "m": np.array([0.4])}
    model = model.with_effect("hysteresis", {"b": np.array([0.02, 0.01]), **shape})
    walk = np.cumsum(np.random.default_rng(3).normal(0.0, 0.1, (60, 2)), axis=0)
    load = np.concatenate([np.zeros((1, 2)), walk])
    time = np.arange(61.0)
    said = readings(model.belief(), Loads(load, time, 0.0 * time, np.zeros(61, dtype=np.int64)))
    twin = ForceTwin(model)
    read = np.array([twin.read(x * model.base.full, 7.0 + t) for x, t in zip(load, time, strict=True)])
    assert np.allclose(read, said * model.base.full)


def test_a_saving_and_an_error_that_both_lose_are_no_gain() -> None:
    assert Saving(-1.6, -5.0, "touch", 0.0, 0.0).weight < Saving(0.01, 0.5, "ramp", 0.0, 0.0).weight
    assert Saving(0.3, -1.0, "touch", 0.0, 0.0).weight < 0.0


def staircase(n: int) -> ForceRecords:
    """Each of n components of a plant's sensor alone, up and down in both directions."""
    up = np.concatenate([np.linspace(0, 1, 6), np.linspace(0.8, -1, 10), np.linspace(-0.8, 0, 5)])
    load = np.concatenate([np.outer(up, np.eye(n)[i]) for i in range(n)])
    time = 10.0 * np.arange(len(load))
    nothing = np.full(len(load), np.nan)
    names = ("fx", "fy", "fz", "tx", "ty", "tz")[:n]
    return ForceRecords(names, 100.0 * load, 0.0 * load, time, nothing, np.zeros(len(load), dtype=np.int64))


def test_flaws_of_a_simulated_sensor_are_named_by_the_workflow() -> None:
    """Springs on dry friction are no plays, but the loop is one; the limit is full range."""
    records = staircase(3)
    flaws = Flaws(gain=(0.03, -0.02, 0.025, 0.0, 0.0, 0.0), loop=(0.01,) * 6)
    axes = [Contact((1, 0, 0)), Contact((0, 1, 0)), Contact((0, 0, 1))]
    sensor = ForceSensor(axes, 0.04, limit=100.0, seed=4, flaws=flaws)
    for row, out in zip(records.load, records.reading, strict=True):
        out[:] = sensor.read(row, np.zeros(6))[:3]
    table = {"sensor": {"components": ["fx", "fy", "fz"], "full_range": [110.0] * 3}}
    found = analyse(prepare(records, from_table(table, "x")[0]), Options(pictures=False))
    assert {e.name for e in found.effects} == {"gain", "hysteresis"}
    gains = next(e for e in found.effects if e.name == "gain").parameters
    assert [p.value for p in gains] == pytest.approx([0.03, -0.02, 0.025], abs=2e-3)


@pytest.mark.parametrize("dull", [False, True])
def test_a_saturation_and_a_dead_band_are_refused_and_pass_for_no_gain(dull: bool) -> None:
    records = staircase(3)
    rng = np.random.default_rng(5)
    true = records.load
    bent = np.sign(true) * np.maximum(np.abs(true) - 1.5, 0.0) if dull else np.clip(true, -70.0, 70.0)
    records.reading[:] = bent + rng.normal(0.0, 0.05, true.shape)
    table = {"sensor": {"components": ["fx", "fy", "fz"], "full_range": [100.0] * 3}}
    found = analyse(prepare(records, from_table(table, "x")[0]), Options(pictures=False))
    assert found.outcome.value == "unexplained"
    assert not found.effects
    assert found.symbolic[0].name == ("term_dull" if dull else "term_knee")


def test_gains_that_only_tell_the_time_of_their_components_are_refused() -> None:
    """Every component is loaded in its own turn while the sensitivity ages."""
    records = staircase(6)
    noise = np.random.default_rng(7).normal(0.0, 0.05, records.load.shape)
    records.reading[:] = records.load * (1.0 + 4e-5 * records.time)[:, None] + noise
    names = list(records.names)
    found = analyse(
        prepare(records, from_table({"sensor": {"components": names, "full_range": [100.0] * 6}}, "x")[0]),
        Options(pictures=False),
    )
    assert found.outcome.value == "unexplained" and not found.effects
    assert found.symbolic[0].name == "term_time"
    assert found.symbolic[0].parameters[0].value == pytest.approx(4e-5, rel=0.05)


def random_loads(noise: float, bend: Callable[[np.ndarray], np.ndarray], rows: int = 300) -> ForceRecords:
    """Random loads of one component, seed 8; a reading that bends, with noise."""
    rng = np.random.default_rng(8)
    load = rng.uniform(-90.0, 90.0, (rows, 1))
    reading = bend(load) + rng.normal(0.0, noise, load.shape)
    time, nothing = 5.0 * np.arange(float(rows)), np.full(rows, np.nan)
    return ForceRecords(("fx",), load, reading, time, nothing, np.zeros(rows, np.int64))


ONE = {"sensor": {"components": ["fx"], "full_range": [100.0]}}


def test_what_a_model_explains_is_no_noise_any_more() -> None:
    """Row after row jumps through a dead band: without a model of it that passes for noise."""
    records = random_loads(0.05, lambda true: np.sign(true) * np.maximum(np.abs(true) - 2.0, 0.0))
    model = from_table(ONE, "x")[0]
    subject = prepare(records, model)
    assert subject.whole.sigma[0] > 4 * 5e-4
    known = model.with_effect("term_dull", {"c": np.ones(1), "s": np.full(1, 0.02)})
    sharper = subject.sharpened(known, {})
    assert sharper is not None and sharper.whole.sigma == pytest.approx(5e-4, rel=0.3)
    assert sharper.sharpened(known, {}) is None


@pytest.mark.parametrize("size", [0.0, 0.022])
def test_a_cube_that_hides_in_the_margin_of_the_floor_is_seen_and_noise_is_none(size: float) -> None:
    """Beside a gain it adds a tenth to the noise; so many rows tell it by ten standard deviations."""
    records = random_loads(0.5, lambda true: 1.02 * true + size * 100.0 * (true / 100.0) ** 3, 600)
    found = analyse(prepare(records, from_table(ONE, "x")[0]), Options(pictures=False))
    assert next(s for s in found.path if s.effect == "gain").ratio < 1.15
    assert [e.name for e in found.symbolic] == (["term_cube"] if size else [])
    assert {e.name for e in found.effects} == {"gain"}


@pytest.mark.parametrize("power", [1, 3])
def test_a_stand_in_is_larger_at_some_loads_and_a_true_gain_is_not(power: int) -> None:
    records = random_loads(0.05, lambda true: true + 3.0 * (true / 100.0) ** power)
    subject = prepare(records, from_table(ONE, "x")[0])
    searcher = Searcher(subject.whole, ())
    fit = searcher.fit(subject.model.with_effect("gain", {"g": np.zeros(1)}))
    seen = {
        c.variable: c for c in changes(subject.whole, fit, searcher.weights, ["gain"], subject.variables(subject.whole))
    }
    size = seen["size of its load"]
    assert (abs(size.share) > 0.3 and abs(size.share) > 5 * size.half) == (power == 3)
    assert abs(seen["time"].share) < max(0.2, 2 * seen["time"].half)


def test_a_confounder_too_weak_by_nature_to_be_searched_is_not_ruled_out_by_that() -> None:
    """A zero that runs off within a minute is no drift of the usual size; the temperature that rose meanwhile must not
    be named alone.
    """
    records = staircase(1)
    time = np.linspace(0.0, 60.0, 63)
    load = np.tile(records.load, (3, 1))
    noise = np.random.default_rng(6).normal(0.0, 0.05, load.shape)
    warm = 20.0 + time / 20.0 + 0.02 * np.sin(time)
    one = ForceRecords(("fx",), load, load + 0.02 * time[:, None] + noise, time, warm, np.zeros(63, dtype=np.int64))
    table = {"sensor": {"components": ["fx"], "full_range": [100.0]}}
    found = analyse(prepare(one, from_table(table, "x")[0]), Options(pictures=False))
    assert found.outcome.value == "ambiguous"
    assert {e.name for e in found.effects} | set(sum(found.alternatives, ())) == {
        "offset_drift",
        "temperature",
    }


def test_every_effect_does_nothing_at_its_neutral_value_and_something_beside_it() -> None:
    model, _ = from_table(SENSOR, "x")
    rng = np.random.default_rng(1)
    loads = Loads(rng.uniform(-1, 1, (30, 2)), np.arange(30.0), rng.uniform(-1, 1, 30), np.zeros(30, dtype=np.int64))
    before = readings(model.belief(), loads)
    for name, effect in model.library.items():
        plain = model.plain(name)
        assert np.allclose(readings(model.with_effect(name, plain).belief(), loads), before), name
        moved = {**plain, effect.primary.symbol: plain[effect.primary.symbol] + effect.primary.size}
        assert not np.allclose(readings(model.with_effect(name, moved).belief(), loads), before, atol=1e-9), name


def test_a_matrix_is_in_newtons_and_reads_back() -> None:
    model, _ = from_table({"sensor": {**SENSOR["sensor"], "matrix": [[1.0, 2.0], [0.01, 0.9]]}}, "x")
    loads = Loads(np.array([[0.5, 0.2]]), np.zeros(1), np.zeros(1), np.zeros(1, dtype=np.int64))
    newtons = readings(model.belief(), loads)[0] * model.base.full
    assert np.allclose(newtons, [50.0 + 2.0 * 1.0, 0.01 * 50.0 + 0.9 * 1.0])
    changed = model.with_effect("gain", {"g": np.array([0.01, -0.02])})
    again, _ = from_table(tomllib.loads(to_toml(changed)), "x")
    assert np.allclose(again.belief().total, changed.belief().total)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    hidden = draw_sensor("s", "null", np.random.default_rng(1))
    data = tmp_path / "data"
    data.mkdir()
    np.savez(data / "loads.npz", **record(hidden, np.random.default_rng(2)))  # type: ignore[arg-type]
    (data / "columns.toml").write_text(COLUMNS)
    (data / "nominal.toml").write_text(hidden.public())
    return data


def run(folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    out = folder.parent / "report"
    status = reconcile.main(
        ["force", str(folder), "--model", str(folder / "nominal.toml"), "--out", str(out), "--quiet"]
    )
    assert status == 2
    assert not (out / "verdict.json").exists()
    return capsys.readouterr().err


def times(name: str, factor: float) -> Callable[[dict[str, np.ndarray]], None]:
    def change(a: dict[str, np.ndarray]) -> None:
        a[name] = a[name] * factor

    return change


def _nan(a: dict[str, np.ndarray]) -> None:
    a["fy"][::3] = np.nan


def _constant(a: dict[str, np.ndarray]) -> None:
    a["fz"] = 0.0 * a["fz"] + 3.0


def _short(a: dict[str, np.ndarray]) -> None:
    for name in a:
        a[name] = a[name][:12]


def _unloaded(a: dict[str, np.ndarray]) -> None:
    for name in COMPONENTS:
        a[f"load_{name}"] = 0.0 * a[f"load_{name}"]


def _other(a: dict[str, np.ndarray]) -> None:
    rng = np.random.default_rng(1)
    for name in COMPONENTS:
        a[name] = rng.permutation(a[name])


@pytest.mark.parametrize(("change", "said"), [
    (times("fx", 1000.0), "by a factor of 1000"),
    (times("fx", 1.0 / 4.448), "lbf against N"),
    (times("load_tz", 1000.0), "times its full_range"),
    (times("fx", -1.0), "turned round"),
    (_nan, "reading fy has 288 of 864 values that are no numbers"),
    (_constant, "reading fz is constant"),
    (_short, "rows are too few"),
    (_unloaded, "no load changes"),
    (_other, "it is another sensor"),
    (lambda a: a.update(fx=np.random.default_rng(2).permutation(a["fx"])), "fx of the readings do not follow"),
    (lambda a: a.pop("fx"), "no column 'fx'"),
    (times("t", -1.0), "time does not rise"),
    (times("t", 0.0), "time does not rise"),
])  # fmt: skip
def test_what_cannot_be_used_is_refused_with_a_reason(
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    change: Callable[[dict[str, np.ndarray]], None],
    said: str,
) -> None:
    with np.load(folder / "loads.npz") as file:
        arrays = {k: file[k].copy() for k in file.files}
    change(arrays)
    np.savez(folder / "loads.npz", **arrays)  # type: ignore[arg-type]
    assert said in run(folder, capsys)


@pytest.mark.parametrize(("file", "old", "new", "said"), [
    ("nominal.toml", "full_range", "range", "nobody reads range"),
    ("nominal.toml", "[sensor]", "[finger]", "needs the tables sensor and effects"),
    ("nominal.toml", "full_range = [", "full_range = [-", "> 0"),
    ("columns.toml", 'name = "fx"', 'name = "nothing"', "no column 'nothing'"),
    ("columns.toml", 'name = "fx", unit = "N"', 'name = "fx", unit = "lbf"', "unit 'lbf' is not known"),
    ("columns.toml", 'name = "tx", unit = "N m"', 'name = "tx", unit = "N"', "unit 'N' is not known"),
    ("columns.toml", "[reading]", "[readings]", "nobody reads readings"),
])  # fmt: skip
def test_files_that_make_no_sense_are_refused(
    folder: Path, capsys: pytest.CaptureFixture[str], file: str, old: str, new: str, said: str
) -> None:
    path = folder / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    assert said in run(folder, capsys)


THREE = {"sensor": {"components": ["fx", "fy", "fz"], "full_range": [100.0] * 3}}


def honest(**change: object) -> ForceRecords:
    """A sensor that reads what it is loaded with, but for what is changed."""
    records = staircase(3)
    noise = np.random.default_rng(9).normal(0.0, 0.05, records.load.shape)
    return replace(replace(records, reading=records.load + noise), **change)  # type: ignore[arg-type]


GIVEN = honest()
WRONG = {
    "millinewton": (GIVEN.reading * np.array([1.0, 1e3, 1.0]), GIVEN.load, "fy reads 1000 times"),
    "kilogram-force": (GIVEN.reading / 9.81, GIVEN.load, "fx reads 0.1019 times"),
    "exchanged": (GIVEN.reading[:, [1, 0, 2]], GIVEN.load, "fx does not go with .* that of fy"),
    "turned round": (GIVEN.reading * np.array([1.0, 1.0, -1.0]), GIVEN.load, "fz falls"),
    "another range": (GIVEN.reading * 1e-3, GIVEN.load * 1e-3, "times its full_range of 100"),
}


@pytest.mark.parametrize("case", sorted(WRONG))
def test_columns_that_do_not_belong_together_are_no_flaw_of_the_sensor(case: str) -> None:
    reading, load, said = WRONG[case]
    with pytest.raises(BadInputError, match=said):
        prepare(honest(reading=reading, load=load), from_table(THREE, "x")[0])


def test_rows_without_numbers_or_time_are_told() -> None:
    torn = GIVEN.reading.copy()
    torn[[3, 30], 1] = np.nan
    subject = prepare(honest(reading=torn, time=np.full(len(torn), np.nan)), from_table(THREE, "x")[0])
    assert len(subject.records.load) == len(torn) - 2
    assert any("no time" in n for n in subject.notes) and any("2 of 63" in n for n in subject.notes)


def test_a_model_file_keeps_the_names_of_the_components() -> None:
    table = {"sensor": {"components": ["load"], "full_range": [100.0]}}
    assert from_table(tomllib.loads(to_toml(from_table(table, "x")[0])), "x")[1] == ("load",)
