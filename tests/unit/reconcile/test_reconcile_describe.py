"""Drafts of both descriptions: what a column seems to be, and what is asked because nothing tells."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

from sioms.reconcile.command import main
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.axis import read_data, read_model
from sioms.reconcile.files.describe import _by_head, describe, guessed
from sioms.reconcile.files.table import Table, load_table, measures, unit_of
from sioms.reconcile.model import AxisModel

ROTARY = AxisModel(True, 1e-3, 1e-2, 0.1, 1e-4, 2 * np.pi, 8.0, 10.0)
LINEAR = AxisModel(False, 1e-3, 1e-2, 0.1, 1e-4, 0.01, 8.0, 10.0)
T = np.arange(2000) * 1e-3
X = np.sin(2.0 * np.pi * T) + 0.3 * np.sin(17.0 * T)
V = np.gradient(X, T)
U = np.gradient(V, T) + 2.0 * np.sign(V)
FOLLOWED = X + 1e-4 * np.sin(300.0 * T)


def quantities(columns: dict[str, np.ndarray], units: dict[str, str] | None = None) -> dict[str, str | None]:
    return {g.head: g.quantity for g in guessed(Table(columns, units or {}))}


def test_heads_tell_what_numbers_do_not_contradict() -> None:
    found = quantities({"time [s]": T, "actual_pos": X, "pos_ref": FOLLOWED, "motorSpeed": V, "Torque": U})
    assert found == {
        "time [s]": "time",
        "actual_pos": "position",
        "pos_ref": "command",
        "motorSpeed": "velocity",
        "Torque": "force",
    }
    assert quantities({"t": T[::-1], "x": X})["t"] is None  # time does not run backwards


@pytest.mark.parametrize(("head", "quantity"), [
    ("Encoder 1 Pos", "position"), ("Commanded Pos", "command"), ("joint_pos_target_0", "command"),
    ("theta1", "position"), ("phi", "position"), ("z", "position"), ("dq7", "velocity"), ("ddq7", "acceleration"),
    ("omega_max", "velocity"), ("target velocity", "velocity"), ("torque_ref", "force"), ("iq set", "force"),
    ("measured torque", "force_measured"), ("current", "force_measured"), ("current position", "position"),
    ("F", "force"), ("f", None), ("tau_est", "force"), ("q7_tau_J", "force"), ("Control Effort", "force"),
    ("a", "acceleration"), ("x y", None), ("PWM", "force"), ("Stribeck", None),
])  # fmt: skip
def test_words_of_a_head_are_weighed_together(head: str, quantity: str | None) -> None:
    assert _by_head(head, Table({head: X}, {})) == quantity


def test_columns_of_several_joints_are_one_question(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", q1=X, q2=V, q3=U, dq1=V, dq2=U, tau1=U, tau2=X)
    draft = describe(tmp_path)
    asked = [q for q in draft.questions if "The first is taken" in q]
    assert asked == [
        "which column is the position, 'q1' or 'q2', 'q3'? The first is taken.",
        "which column is the force, 'tau1' or 'tau2'? The first is taken.",
    ]
    assert not [q for q in draft.questions if q.startswith("what is") and "time" not in q]
    assert tomllib.loads(draft.columns)["columns"].keys() == {"position", "force"}
    assert 'not needed: "dq2", a speed' in draft.columns


def test_columns_without_heads_are_told_by_their_numbers() -> None:
    marks = (np.arange(2000) % 300 == 0).astype(float)
    found = quantities({f"d(:,{i})": a for i, a in enumerate((T, X, V, FOLLOWED, marks, 0.0 * T, U), 1)})
    assert list(found.values()) == ["time", "position", "velocity", "command", "index", None, None]


def test_a_time_of_which_some_rows_come_late_is_no_position() -> None:
    late = np.cumsum(np.where(np.arange(len(T)) % 60 == 7, 260.0, np.where(np.arange(len(T)) % 12 == 3, 11.0, 10.0)))
    found = quantities({"column 1": late, "column 2": X})
    assert found["column 1"] == "time"
    assert found["column 2"] != "time"


def test_a_speed_beside_it_tells_a_position_and_steps_tell_none() -> None:
    set_by_hand = np.repeat([0.2, -0.3, 0.1, 0.4], 500)
    turning = 30.0 * T + X  # it runs on and on
    columns = (set_by_hand, T, turning, np.gradient(turning, T), np.gradient(np.gradient(turning, T), T))
    found = quantities({f"d(:,{i})": a for i, a in enumerate(columns, 1)})
    assert list(found.values()) == [None, "time", "position", "velocity", None]


def test_a_unit_says_more_than_a_head() -> None:
    assert quantities({"t": T, "y": X, "i": U}, {"i": "lbf", "y": "in"})["y"] == "position"
    assert quantities({"v": X}, {"v": "rpm"}) == {"v": "velocity"}


def test_a_voltage_is_no_speed_and_its_scale_is_explained(tmp_path: Path) -> None:
    assert quantities({"t": T, "x": X, "v [V]": U})["v [V]"] == "force"
    assert quantities({"t": T, "x": X, "v [%]": U})["v [%]"] is None
    rows = "\n".join(f"{t:.6g};{x:.9f};{u:.6f}" for t, x, u in zip(T, X, U, strict=True))
    (tmp_path / "run.csv").write_text(f"t [s];theta [rad];v [V]\n{rows}\n")
    (asked,) = [q for q in describe(tmp_path).questions if "scale" in q]
    assert "k_t/R" in asked and "back-EMF" in asked


def test_the_largest_of_all_records_is_drafted(tmp_path: Path) -> None:
    for name, scale, last in (("a", 1.0, "F [N]"), ("b", 3.0, "F [N]"), ("c", 2.0, "load")):
        rows = "\n".join(f"{t:.6g},{scale * x:.9f},{scale * u:.6f}" for t, x, u in zip(T, X, U, strict=True))
        (tmp_path / f"{name}.csv").write_text(f"t [s],x [m],{last}\n{rows}\n")
    draft = describe(tmp_path)
    axis = tomllib.loads(draft.model)["axis"]
    assert axis["rated_force"] == pytest.approx(3.0 * np.abs(U).max(), rel=1e-3)
    assert axis["max_speed"] == pytest.approx(3.0 * np.abs(X[5:] - X[:-5]).max() / (T[5] - T[0]), rel=1e-3)
    assert "is c.csv another kind of record? It has no column 'F [N]', as a.csv has." in draft.questions


def test_volts_and_amps_are_words_of_a_drive() -> None:
    found = quantities({"t": T, "x": X, "volts": U, "motor amps": U})
    assert (found["volts"], found["motor amps"]) == ("force", "force_measured")


def test_what_is_not_known_is_asked_and_the_draft_is_not_used_before(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", t=T, pos=X, u=U, other=np.random.default_rng(1).normal(size=2000))
    draft = describe(tmp_path)
    assert tomllib.loads(draft.columns)["columns"]["position"]["unit"] == "?"
    said = "\n".join(draft.questions)
    assert all(f"'{name}'" in said for name in ("t", "pos", "u", "other"))
    assert "inertia" in said and "pitch" in said
    (tmp_path / "columns.toml").write_text(draft.columns)
    with pytest.raises(BadInputError, match="unit '\\?' is not known"):
        read_data(tmp_path, LINEAR)
    (tmp_path / "nominal.toml").write_text(draft.model)
    with pytest.raises(BadInputError, match="kind"):
        read_model(tmp_path / "nominal.toml")


def test_a_file_that_says_all_needs_four_numbers_more(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = "\n".join(f"{1e3 * t:.3f};{x:.9f};{u:.6f}" for t, x, u in zip(T, X, U, strict=True)).replace(".", ",")
    (tmp_path / "run.csv").write_text(f"t [ms];Position [inch];Force [lbf]\n{rows}\n")
    out = tmp_path / "drafts"
    assert main(["describe", str(tmp_path), "--out", str(out)]) == 0
    assert "inertia" in capsys.readouterr().out
    text = (out / "nominal.toml").read_text()
    answered = text.replace("# inertia = ?", "inertia = 0.4").replace("# pitch = ?", "pitch = 0.01")
    (out / "nominal.toml").write_text(answered)
    model = read_model(out / "nominal.toml")
    assert not model.rotary
    assert model.sample_time_s == pytest.approx(1e-3)
    (record,) = read_data(tmp_path / "run.csv", model, out / "columns.toml").records
    np.testing.assert_allclose(record.position, 0.0254 * X, atol=1e-9)
    np.testing.assert_allclose(record.force, 4.4482216152605 * U, atol=1e-4)
    assert main(["describe", str(tmp_path), "--out", str(out)]) == 2  # nothing that was answered is lost


@pytest.mark.parametrize(
    ("text", "kind", "si"),
    [
        ("kip", "force", 4448.2216152605),
        ("lb-ft", "torque", 1.3558179483314),
        ("oz-in", "torque", 0.0070615518142),
        ("thou", "length", 2.54e-5),
        ("arcmin", "angle", np.pi / 10800.0),
        ("kgf", "force", 9.80665),
    ],
)
def test_units_of_workshops(text: str, kind: str, si: float, tmp_path: Path) -> None:
    unit = unit_of(text)
    assert unit is not None and measures(unit) == kind
    rotary = kind in ("torque", "angle")
    model, of = (ROTARY, "position") if kind == "angle" else (LINEAR, "position") if kind == "length" else (
        ROTARY if rotary else LINEAR, "force")  # fmt: skip
    np.savez(tmp_path / "run.npz", a=np.ones(9), b=np.ones(9))
    other = {"position": "force", "force": "position"}[of]
    (tmp_path / "columns.toml").write_text(
        f'[columns]\n{of} = {{ name = "a", unit = "{text}" }}\n{other} = {{ name = "b" }}\n'
    )
    (record,) = read_data(tmp_path, model).records
    assert record.arrays()[of][0] == pytest.approx(si, rel=1e-9)


def test_percent_is_of_the_rated_force(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", x=np.ones(9), u=np.full(9, 25.0))
    columns = '[columns]\nposition = { name = "x", unit = "rad" }\nforce = { name = "u", unit = "%" }\n'
    (tmp_path / "columns.toml").write_text(columns)
    (record,) = read_data(tmp_path, ROTARY).records
    assert record.force[0] == 2.0


def test_columns_of_a_matrix_are_read_by_their_number(tmp_path: Path) -> None:
    np.savez(tmp_path / "run.npz", data=np.stack([T, X, U], axis=1), down=np.stack([X, U]), cube=np.zeros((2, 2, 2)))
    table = load_table(tmp_path / "run.npz")
    assert list(table.columns) == ["data(:,1)", "data(:,2)", "data(:,3)", "down(1,:)", "down(2,:)"]
    np.testing.assert_array_equal(table.columns["data(:,3)"], table.columns["down(2,:)"])


@pytest.mark.parametrize("data", ["run.csv", "."])
def test_without_a_model_it_is_told_how_to_get_one(
    data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "run.csv").write_text("time [s],position [m],force [N]\n0,0,0\n")
    monkeypatch.chdir(tmp_path)
    assert main(["axis", data, "--quiet"]) == 2
    assert f"want --model FILE; `sioms reconcile describe {data}` drafts one" in capsys.readouterr().err
