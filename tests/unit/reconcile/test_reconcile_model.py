"""Effects, packing, model files and column files."""

from __future__ import annotations

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sioms.reconcile.effect import NONE, Mechanism, Slot
from sioms.reconcile.effects import known, library
from sioms.reconcile.files.axis import read_data, read_model
from sioms.reconcile.jit import compiled
from sioms.reconcile.kernel import summed
from sioms.reconcile.model import AxisModel, Controller
from sioms.reconcile.model_file import model_from, write_model
from sioms.reconcile.screen import shapes
from sioms.reconcile.simulate import pack, simulate
from sioms.reconcile.verdict import BadInputError

AXIS = AxisModel(
    True, 1e-3, 2e-3, 1e-3, 1e-4, 2 * np.pi, 0.7, 20.0, Controller(20.0, -0.985, -0.7, 0.0, 0.0, 1.8, 100.0)
)
AXES = Path(__file__).parents[2] / "physics" / "reconcile_axes"
#: The list of the specification: every one of these must be nameable.
DEMANDED = {
    "viscous",
    "viscous_direction",
    "coulomb",
    "coulomb_position",
    "stribeck",
    "presliding",
    "load_friction",
    "backlash",
    "cogging",
    "torque_ripple",
    "gravity",
    "offset",
    "delay",
    "lag",
    "saturation",
    "elastic",
    "encoder_scale",
    "eccentricity",
    "encoder_quantisation",
    "payload",
    "thermal_gain",
    "spring",
    "quadratic_drag",
}


def test_the_library_holds_what_is_demanded() -> None:
    assert set(library()) >= DEMANDED


@pytest.mark.parametrize("name", sorted(known()))
def test_an_effect_says_everything_about_itself(name: str) -> None:
    effect = known()[name]
    assert effect.equation
    assert effect.parameters
    assert set(effect.confounders) <= set(known())
    assert set(effect.replaces) <= set(known())
    for p in effect.parameters:
        assert p.lower <= p.start <= p.upper, p.symbol
        assert "{" not in AXIS.unit(p)
    if name in library():
        assert effect.signature
        assert effect.separate
        assert effect.confounders


@pytest.mark.parametrize("name", sorted(n for n, e in known().items() if e.function is not None))
def test_state_functions_take_arrays_of_axes(name: str) -> None:
    effect = known()[name]
    rng = np.random.default_rng(3)
    x, v, u, t = rng.normal(size=(4, 5))
    p = effect.row(np.array([q.start * AXIS.scale(q) for q in effect.parameters]), AXIS.pitch)
    together = effect.evaluate(x, v, u, t, p)
    alone = [float(effect.function(*(float(a[i]) for a in (x, v, u, t)), p)) for i in range(5)]  # type: ignore[misc]
    np.testing.assert_allclose(together, alone, rtol=1e-12)
    each = effect.evaluate(x, v, u, t, np.repeat(p[:, None], 5, axis=1))
    np.testing.assert_allclose(each, together, rtol=1e-12)


def test_an_effect_without_state_function_cannot_be_evaluated() -> None:
    z = np.zeros(2)
    with pytest.raises(TypeError, match="delay"):
        library()["delay"].evaluate(z, z, z, z, z)


def test_a_state_function_that_cannot_be_compiled_says_what_it_may_do() -> None:
    def summed(x: float, v: float, u: float, temperature: float, p: np.ndarray) -> float:
        return -x * float(p[1:3].sum())

    with pytest.raises(TypeError, match=r"compile state function summed .* single p\[i\]"):
        compiled(summed)


def test_every_effect_is_screened_fitted_and_carried_out_by_what_it_says_itself() -> None:
    for name, effect in known().items():
        assert effect.slot is not None or effect.mechanism is not NONE, name
        assert (effect.slot is None) == (effect.function is None), name
        assert effect.slot is not None or effect.trials is not None or effect.mechanism.column is not None, name
        assert effect.neutral == 0.0 or effect.primary.lower < effect.neutral < effect.primary.upper, name


def test_a_users_own_mechanism_is_packed_by_names(monkeypatch: pytest.MonkeyPatch) -> None:
    def enter(row, p):  # type: ignore[no-untyped-def]
        row.delay, row.lag = p

    own = replace(
        library()["delay"],
        name="slow_drive",
        mechanism=Mechanism(enter, substeps=4),
        parameters=tuple(replace(library()["delay"].primary, symbol=s) for s in ("delay", "tau")),
    )
    monkeypatch.setitem(known(), own.name, own)
    slow = pack(AXIS.with_effect(own.name, {"delay": 2e-3, "tau": 3e-3}))
    both = pack(AXIS.with_effect("delay", {"delay": 2e-3}).with_effect("lag", {"tau": 3e-3}))
    assert (slow.plant == both.plant).all()
    assert (slow.substeps, both.substeps) == (4, 2)


def test_unknown_parameters_are_refused() -> None:
    with pytest.raises(ValueError, match="Fc"):
        AXIS.with_effect("coulomb", {"fc": 1.0})


def test_any_number_of_forces_act_at_once() -> None:
    forces = [e for e in known().values() if e.slot is Slot.FORCE]
    model = AXIS
    for e in forces:
        model = model.with_effect(e.name, {p.symbol: p.start for p in e.parameters})
    packed, state = pack(model), (0.3, -0.2, 0.1, 0.5)
    total = summed(packed.functions[Slot.FORCE], packed.rows[Slot.FORCE], *state)
    x, v, u, t = (np.array([s]) for s in state)
    each = [e.evaluate(x, v, u, t, e.row(e.values(model.effects[e.name]), AXIS.pitch))[0] for e in forces]
    assert len(forces) > 7
    assert total == pytest.approx(sum(each), rel=1e-12)


def test_a_model_survives_its_file(tmp_path: Path) -> None:
    model = AXIS.with_effect("coulomb", {"Fc": 0.05}).with_effect(
        "cogging", {"amp": 0.1, "phase": 1.0, "n": 7.0, "amp2": 0.0, "phase2": 0.0}
    )
    (tmp_path / "m.toml").write_text(write_model(model))
    assert read_model(tmp_path / "m.toml") == model


def test_an_effect_can_be_switched_off_in_the_file(tmp_path: Path) -> None:
    text = write_model(AXIS.with_effect("coulomb", {"Fc": 0.05})).replace("on = true", "on = false")
    (tmp_path / "m.toml").write_text(text)
    assert read_model(tmp_path / "m.toml") == AXIS


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"kind": "round"}, "rotary or linear"),
        ({"speling": 1}, "nobody reads speling"),
        ({"inertia": -1.0}, "inertia is -1; needs above zero"),
        ({"pitch": 0}, "pitch is 0; needs above zero"),
        ({"viscous": "2"}, "viscous is '2'; needs a finite number"),
        ({"rated_force": float("nan")}, "rated_force is nan"),
        ({"max_speed": None}, "has no max_speed"),
        ({"refine": ["mass"]}, "refine is"),
        ({"refine": "inertia"}, "refine is 'inertia'; needs a list"),
    ],
)
def test_a_model_file_is_checked(change: dict[str, object], says: str) -> None:
    axis: dict[str, object] = {
        "name": "a",
        "kind": "linear",
        "sample_time_s": 1e-3,
        "inertia": 1.0,
        "viscous": 1.0,
        "resolution": 1e-6,
        "pitch": 0.01,
        "rated_force": 1.0,
        "max_speed": 1.0,
    }
    with pytest.raises(ValueError, match=says):
        model_from({"axis": axis | change})


@pytest.mark.parametrize(
    ("effects", "says"),
    [
        ({"coulomb": 3}, "coulomb is 3; needs a table"),
        ({"coulomb": {"Fc": "a"}}, "Fc is 'a'"),
        ({"coulomb": {"Fc": -5.0}}, "Fc is -5; needs zero or more"),
        ({"coulomb": {"on": "no", "Fc": 1.0}}, "true or false"),
        ({"coulomb": {"on": True}}, "Fc"),
        ({"glue": {"Fc": 1.0}}, "'glue' is not known"),
    ],
)
def test_effects_of_a_model_file_are_checked(effects: dict[str, object], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        model_from(tomllib.loads(write_model(AXIS)) | {"effects": effects})


def test_a_controller_is_checked_and_may_have_no_limit() -> None:
    axis = tomllib.loads(write_model(AXIS))
    none = {**axis["controller"], "limit": float("inf")}
    assert AXIS.controller is not None
    assert model_from(axis | {"controller": none}).controller == replace(AXIS.controller, limit=float("inf"))
    with pytest.raises(ValueError, match=r"\[controller\] has no kb"):
        model_from(axis | {"controller": {k: v for k, v in none.items() if k != "kb"}})
    with pytest.raises(ValueError, match="limit is 0"):
        model_from(axis | {"controller": none | {"limit": 0.0}})


@pytest.mark.parametrize(("marks", "first"), [(1, 2.0), (100, 1.0)])
def test_cogging_of_one_period_in_a_turn_of_the_axis_is_gravity_and_not_tried(marks: int, first: float) -> None:
    model = replace(AXIS, pitch=2.0 * np.pi / marks)
    tried = [s["n"] for s in shapes(known()["cogging"], model, (0.0, 7.0))]
    assert tried[0] == first
    assert len(set(tried)) == 61 - first


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"inertia": "a"}, "inertia is 'a'; needs a finite number"),
        ({"kind": "round"}, "rotary or linear"),
        ({"controller": 3}, "controller is 3; needs a table"),
        ({"max_acceleration": None}, "has no max_acceleration"),
    ],
)
def test_a_nominal_json_is_checked_as_a_model_file_is(tmp_path: Path, change: dict[str, object], says: str) -> None:
    given = json.loads((AXES / "s05" / "nominal.json").read_text())
    path = tmp_path / "nominal.json"
    path.write_text(json.dumps(given))
    assert read_model(path).rated_force == pytest.approx(given["inertia"] * given["max_acceleration"])
    path.write_text(json.dumps(given | change))
    with pytest.raises(BadInputError, match=says):
        read_model(path)


def test_gravity_comes_once_a_turn_of_the_axis_however_many_marks_a_turn_has() -> None:
    model = replace(AXIS, pitch=2.0 * np.pi / 100)
    effect = known()["gravity"]
    angles, still = np.linspace(0.0, 2.0 * np.pi, 9), np.zeros(9)
    row = effect.row(effect.values({"amp": 14.0, "phase": 0.0}), model.pitch)
    force = effect.evaluate(angles, still, still, still, row)
    np.testing.assert_allclose(force, [0, 9.8995, 14, 9.8995, 0, -9.8995, -14, -9.8995, 0], atol=1e-4)


def _write(folder: Path, columns: str, data: str = "t,x,f\n0,0,1\n0.001,1,2\n0.002,2,3\n") -> None:
    (folder / "run.csv").write_text(data)
    (folder / "columns.toml").write_text(columns)


def test_columns_are_converted(tmp_path: Path) -> None:
    _write(
        tmp_path,
        '[columns]\nposition = { name = "x", unit = "deg" }\nforce = { name = "f", unit = "mN m", scale = 2.0 }\n',
    )
    record = read_data(tmp_path, AXIS).records[0]
    np.testing.assert_allclose(record.position, np.radians([0, 1, 2]))
    np.testing.assert_allclose(record.force, [2e-3, 4e-3, 6e-3])


@pytest.mark.parametrize(
    ("columns", "says"),
    [
        ('[columns]\nposition = { name = "y" }\nforce = { name = "f" }\n', "no column 'y'"),
        ('[columns]\nposition = { name = "x", unit = "furlong" }\nforce = { name = "f" }\n', "furlong"),
        ('[columns]\nposition = { name = "x" }\n', "names no force"),
        (
            '[columns]\nposition = { name = "x" }\nforce = { name = "f" }\nspeed = { name = "f" }\n',
            "nobody reads speed",
        ),
        ("[columns\n", "columns.toml"),
        ("columns = 3\n", "columns is 3; needs a table"),
        ('[columns]\nposition = "x"\nforce = { name = "f" }\n', "position is 'x'"),
        ('files = "run.csv"\n[columns]\n', "needs a list of names"),
        ('sample_time_s = "a"\n[columns]\n', "sample_time_s is 'a'"),
        ('continuous = "yes"\n[columns]\n', "true or false"),
        ('[columns]\nposition = { name = "x", scale = "a" }\nforce = { name = "f" }\n', "scale is 'a'"),
    ],
)
def test_bad_column_files_say_what_is_wrong(tmp_path: Path, columns: str, says: str) -> None:
    _write(tmp_path, columns)
    with pytest.raises(BadInputError, match=says):
        read_data(tmp_path, AXIS)


@pytest.mark.parametrize(
    ("resolution", "scale", "per_count"),
    [
        (0.0, "0.01", 0.01),
        (0.01, "0.01", 0.01),
        (0.01, "-0.01", -0.01),
        (0.01, "0.25", 0.0025),
        (0.01, "1", 0.01),
    ],
)
def test_a_count_is_worth_its_resolution_or_the_scale_that_says_so(
    tmp_path: Path, resolution: float, scale: str, per_count: float
) -> None:
    columns = f'position = {{ name = "x", unit = "count", scale = {scale} }}\nforce = {{ name = "f" }}\n'
    _write(tmp_path, "[columns]\n" + columns)
    record = read_data(tmp_path, replace(AXIS, resolution=resolution)).records[0]
    np.testing.assert_allclose(record.position, np.array([0.0, 1.0, 2.0]) * per_count)


def test_missing_data_say_so(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="no such file"):
        read_data(tmp_path / "nothing", AXIS)
    (tmp_path / "run.csv").write_text("a\n1\n")
    with pytest.raises(BadInputError, match="column description"):
        read_data(tmp_path, AXIS)


def test_a_closed_loop_needs_a_controller() -> None:
    bare = AxisModel(True, 1e-3, 2e-3, 1e-3, 1e-4, 6.28, 0.7, 20.0)
    with pytest.raises(ValueError, match="no controller"):
        simulate(bare, np.zeros(10))
