"""Bad input of ``sioms reconcile force``, and the parts of its model."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sioms.reconcile.force.belief import Loads, lagged, readings
from sioms.reconcile.force.model_file import from_table, to_toml
from sioms.reconcile_selftest.force_world import COMPONENTS, draw_sensor, record
from sioms.tools import reconcile
from sioms.tools.reconcile_selftest_sensors import COLUMNS

SENSOR = {"sensor": {"name": "s", "components": ["fx", "tz"], "full_range": [100.0, 5.0]}}


def test_the_lag_is_odd_full_after_its_reach_and_remembers_where_a_loop_began() -> None:
    load = np.array([0.0, 0.05, 0.3, 0.26, 0.29, 0.26, 0.3, 0.1, -0.4])[:, None]
    record = np.zeros(len(load), dtype=np.int64)
    lag = lagged(load, 0.1, record)[:, 0]
    assert np.allclose(lagged(-load, 0.1, record)[:, 0], -lag)
    assert lag[0] == 0.0 and -1.0 < lag[1] < -0.5
    assert lag[2] == pytest.approx(-1.0)  # beyond the reach every part has given way
    assert lag[7:] == pytest.approx(1.0)  # and after twice the reach back, the other way
    assert lag[5] == pytest.approx(lag[3]) and lag[6] == pytest.approx(lag[2])  # a loop within a loop closes
    again = lagged(np.concatenate([load, load]), 0.1, np.repeat([0, 1], len(load)))[:, 0]
    assert np.allclose(again[len(load) :], lag)  # every record begins at rest


def test_every_effect_does_nothing_at_its_neutral_value_and_something_beside_it() -> None:
    model, _ = from_table(SENSOR, "x")
    rng = np.random.default_rng(1)
    loads = Loads(
        rng.uniform(-1, 1, (30, 2)), np.arange(30.0), rng.uniform(-1, 1, 30), np.zeros(30, dtype=np.int64)
    )
    before = readings(model.belief(), loads)
    for name, effect in model.library.items():
        plain = model.plain(name)
        assert np.allclose(readings(model.with_effect(name, plain).belief(), loads), before), name
        moved = {**plain, effect.primary.symbol: plain[effect.primary.symbol] + effect.primary.size}
        assert not np.allclose(readings(model.with_effect(name, moved).belief(), loads), before, atol=1e-9), (
            name
        )


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
    a["fy"][7] = np.nan


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
    (times("fx", 1000.0), "(about 1000)"),
    (times("load_tz", 1000.0), "(about 0.001)"),
    (times("fx", -1.0), "turned round"),
    (_nan, "reading fy has 1 values that are no numbers"),
    (_constant, "reading fz is constant"),
    (_short, "rows are too few"),
    (_unloaded, "no load changes"),
    (_other, "it is another sensor"),
    (lambda a: a.pop("fx"), "no column 'fx'"),
    (times("t", -1.0), "time does not rise"),
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
