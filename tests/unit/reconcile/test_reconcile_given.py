"""What a person wrote into model files and column descriptions of sensors: whatever is wrong is said."""

from __future__ import annotations

from pathlib import Path

import pytest

from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.finger import read_experiments
from sioms.reconcile.files.force import read_loads
from sioms.reconcile.finger.model_file import from_table as finger_from
from sioms.reconcile.force.model_file import from_table as sensor_from
from sioms.reconcile.given import parsed

SENSOR = {"name": "w", "components": ["fz"], "full_range": [200.0]}
FINGER = {
    "core_m": 9.6e-3,
    "outer_m": 12.7e-3,
    "shear_modulus_pa": 83e3,
    "poisson": 0.46,
    "angle_rad": [0.0, 0.2, 0.4],
    "radius_m": 10.3e-3,
    "gain": 3.0,
}
LOADS = (
    '[columns]\ntime = { name = "t" }\n[load]\nfz = { name = "w", unit = "N" }\n[reading]\nfz = { name = "c", unit = '
    '"N" }\n'
)


@pytest.mark.parametrize(
    ("text", "says"),
    [(b"[axis", "read x: "), (b"name = \xff", "read x: it is not text in UTF-8")],
)
def test_a_file_that_is_no_toml_says_so(text: bytes, says: str) -> None:
    with pytest.raises(BadInputError, match=says):
        parsed(text, "read x")


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ({"sensor": 3}, "sensor is 3; needs a table"),
        ({"sensor": SENSOR | {"components": "fz"}}, "components is 'fz'; needs a list"),
        ({"sensor": SENSOR | {"colour": 1}}, "nobody reads colour"),
        ({"sensor": SENSOR | {"matrix": [["a"]]}}, "matrix holds what is not a number"),
        ({"sensor": SENSOR, "effects": 3}, "effects is 3; needs a table"),
        ({"sensor": SENSOR, "effects": {"gain": 3}}, "gain is 3; needs a table"),
        ({"sensor": SENSOR, "effects": {"gain": {"on": "no"}}}, "true or false"),
        ({"sensor": SENSOR, "effects": {"gain": {"gain": "a"}}}, "is 'a'; needs a number"),
    ],
)
def test_a_sensor_model_is_checked(table: dict[str, object], says: str) -> None:
    with pytest.raises(BadInputError, match=says):
        sensor_from(table, "m.toml")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"shear_modulus_pa": 0.0}, "shear modulus is 0 Pa"),
        ({"extent_rad": -1.0}, "extent_rad is -1"),
        ({"gain": [3.0, -3.0, 3.0]}, "gain -3"),
        ({"colour": 1}, "nobody reads colour"),
    ],
)
def test_a_finger_model_is_checked(change: dict[str, object], says: str) -> None:
    assert finger_from({"finger": FINGER | {"extent_rad": 0.047}}, "m.toml")[0].base.extent == 0.047
    with pytest.raises(BadInputError, match=says):
        finger_from({"finger": FINGER | change}, "m.toml")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (LOADS.replace('{ name = "w", unit = "N" }', '"w"'), "fz is 'w'; needs"),
        ("load = 3\n", "load is 3; needs a table"),
        ('files = "a.csv"\n' + LOADS, "needs a list of names of files"),
        (LOADS.replace('unit = "N" }', 'unit = "N", scale = "a" }'), "scale is 'a'"),
        (LOADS.replace("[load]\nfz", "[load]\nfq"), "nobody reads fq; known are fz"),
    ],
)
def test_a_description_of_loads_is_checked(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "a.csv").write_text("t,w,c\n0,0,0\n1,5,5\n2,9,9\n")
    (tmp_path / "columns.toml").write_text(LOADS)
    assert len(read_loads(tmp_path, ("fz",)).load) == 3
    (tmp_path / "columns.toml").write_text(text)
    with pytest.raises(BadInputError, match=says):
        read_loads(tmp_path, ("fz",))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("columns = 3\n", "columns is 3; needs a table"),
        ("[columns]\nraw = { scale = 2.0 }\n", "nobody reads scale; known are name, unit"),
        ("[columns]\nraw = { name = 3 }\n", "raw is"),
    ],
)
def test_a_description_of_touches_is_checked(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "columns.toml").write_text(text)
    with pytest.raises(BadInputError, match=says):
        read_experiments(tmp_path)
