"""A finger's file says everything, says it exactly, and refuses nonsense."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from sioms.tactile.finger import Finger, IdentifiedMap, from_toml, to_toml


def test_file_comes_back_exactly(nominal: Finger) -> None:
    rows = tuple(tuple(row) for row in nominal.e_map()[:, :81].tolist())
    finger = msgspec.structs.replace(
        nominal,
        identified=IdentifiedMap(rows),
        notes={"by": 'a "quoted" name\n', "map": "corrected"},
        name="ä\\1",
    )
    assert from_toml(to_toml(finger)) == finger
    assert from_toml(to_toml(nominal)) == nominal


def test_identified_map_replaces_the_model(nominal: Finger) -> None:
    rows = 2.0 * nominal.e_map()[:, : 2 * nominal.highest() + 1]
    twice = msgspec.structs.replace(nominal, identified=IdentifiedMap(tuple(tuple(row) for row in rows.tolist())))
    assert twice.strain_table().nodes == pytest.approx(2.0 * nominal.strain_table().nodes)


def test_adhering_model_narrows_the_response(nominal: Finger) -> None:
    contact = msgspec.structs.replace(nominal.contact, model="adhering", adhesion=1.0)
    stuck = msgspec.structs.replace(nominal, contact=contact).strain_table()
    free = nominal.strain_table()
    row = 16
    middle = int(np.abs(free.nodes[row, :, 0, 8]).argmax())
    peak = slice(middle - 6, middle + 7)
    wide, narrow = (np.abs(t.nodes[row, peak, 0, 8] / t.nodes[row, middle, 0, 8]).sum() for t in (free, stuck))
    assert narrow < wide
    step = 1e-6
    for table in (free, stuck):  # derivatives of the table against its own neighbours
        ahead = (table.nodes[row, middle + 4, 0, 8] - table.nodes[row, middle + 2, 0, 8]) / 2
        assert table.nodes[row, middle + 3, 1, 8] == pytest.approx(ahead, rel=0.02)
        square = table.half_widths**2
        across = (table.nodes[row + 1, middle, 0, 8] - table.nodes[row - 1, middle, 0, 8]) / (
            square[row + 1] - square[row - 1]
        )
        assert table.nodes[row, middle, 2, 8] == pytest.approx(across, rel=0.05)
    assert step > 0.0


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("core_m = 0.0096", "core_m = 0.0127", r"need 0 < core < outer"),
        ("poisson = 0.46\n", "poisson = 0.6\n", r"Poisson's ratio is 0\.6"),
        ("extent_rad = 0.0", "extent_rad = 3.0", r"extent_rad is 3\.0; need 0 to 0\.2 rad"),
        ("adhesion = 0.0", "adhesion = 2.0", r"share of adhesion is 2\.0; need 0 to 1\.5"),
        ("scale = 0.01", "scael = 0.01", r"unknown field `scael`"),
        ("sioms finger 1", "sioms finger 9", r"need 'sioms finger 1'"),
        ("lowest = -100.0", "lowest = 200.0", r"lowest reading 200\.0 is not below"),
        ("gain = [1.0,", "gain = [-1.0,", r"element 0 has gain -1\.0"),
        ("gain = [1.0,", "gain = [nan,", r"gain holds nan; need finite numbers"),
        ("gain = [1.0,", "gain = [1e-300,", r"element 0 has gain 1e-300; need > 0"),
        ("misfit = [0.0,", "misfit = [-1.0,", r"misfit is -1\.0; need 0 or more"),
        ("drift_time_s = 2.0", "drift_time_s = 0.0", r"drift_time_s holds 0\.0; need > 0"),
        ("shear_modulus_pa = 83000.0", "shear_modulus_pa = 1e300", r"shear_modulus_pa holds 1e\+300; need finite"),
        ("circles = 0.0", "circles = -1.0", r"circles is -1\.0; need 0 or more"),
        ("most_load_n_per_m = 1000.0", "most_load_n_per_m = nan", r"most_load_n_per_m holds nan"),
        ("scale = 0.01", "scale = 0.0", r"scale is 0\.0; need the output"),
        ("[2.4958208303518914", "[2.334901473318014", r"two elements have one angle_rad"),
        ("noise = [0.001,", "noise = [0.0,", r"noise holds 0\.0; need > 0"),
        ("radius_m = [0.0103,", "radius_m = [0.0096,", r"element 0 has radius 0\.0096 m"),
        ("gain = [1.0, ", "gain = [", r"15 values of gain for 16 elements"),
        ("[geometry]", "[geometry", r"load finger: "),
    ],
)
def test_nonsense_is_refused(nominal: Finger, old: str, new: str, message: str) -> None:
    text = to_toml(nominal)
    assert old in text
    with pytest.raises(ValueError, match=message):
        from_toml(text.replace(old, new, 1))
