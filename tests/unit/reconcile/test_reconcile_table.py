"""Tables as people have them: decimal commas, units in heads, lines of remarks, counts and degrees."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sioms.reconcile.errors import BadInputError
from sioms.reconcile.files.axis import read_data
from sioms.reconcile.files.table import load_table, named
from sioms.reconcile.model import AxisModel

AXIS = AxisModel(True, 1e-3, 1e-2, 0.1, 1e-4, 2 * np.pi, 1.0, 10.0)
COLUMNS = '[columns]\ntime = { name = "t" }\nposition = { name = "pos" }\nforce = { name = "M" }\n'
ROWS = "0;0;0\n1;1,5;0,25\n2;3,0;0,5\n"


def _folder(tmp_path: Path, text: str, columns: str = COLUMNS, encoding: str = "utf-8") -> Path:
    (tmp_path / "run.csv").write_bytes(text.encode(encoding))
    if columns:
        (tmp_path / "columns.toml").write_text(columns)
    return tmp_path


@pytest.mark.parametrize(("text", "encoding"), [
    ("\ufeff# bench 3\nDate;12.3.2025\n\nt [ms];pos [°];M [Nm]\n" + ROWS, "utf-8"),
    ("t / ms;pos (deg);M_Nm\n".replace("M_Nm", "M [N m]") + ROWS, "utf-8"),
    ("t [ms];pos [°];M [Nm]\n" + ROWS, "latin-1"),
    ("t [ms];pos [°];M [Nm]\n" + ROWS, "utf-16"),
    ("t [ms];pos [°];M [Nm]\n" + ROWS, "utf-16-le"),
    ("t [ms];pos [°];M [Nm]\n" + ROWS, "utf-16-be"),
    ("state;t [ms];pos [°];M [Nm];ok\n" + "".join(f'"in; out";{r};TRUE\n' for r in ROWS.split()), "utf-8"),
    ("t [ms],state,pos [°],M [Nm]\n0,RUN,0,0\n1,RUN,1.5,0.25\n2,HOLD,3.0,0.5\n", "utf-8"),
    ("t;pos;M\nms;deg;Nm\n" + ROWS, "utf-8"),
    ('"t [ms]"\t"pos [deg]"\t"M [Nm]"\n' + ROWS.replace(";", "\t"), "utf-8"),
    ("t [ms],pos [deg],M [Nm]\n" + ROWS.replace(",", ".").replace(";", ","), "utf-8"),
    ("  t[ms]  pos[deg]  M[Nm]\n" + ROWS.replace(";", "   "), "utf-8"),
])  # fmt: skip
def test_dialects_of_one_table_are_one_record(tmp_path: Path, text: str, encoding: str) -> None:
    (r,) = read_data(_folder(tmp_path, text, COLUMNS, encoding), AXIS).records
    np.testing.assert_allclose(r.position, np.radians([0.0, 1.5, 3.0]))
    np.testing.assert_allclose(r.force, [0.0, 0.25, 0.5])
    assert r.time_s is not None
    np.testing.assert_allclose(r.time_s, [0.0, 1e-3, 2e-3])


def test_columns_without_names_are_numbered(tmp_path: Path) -> None:
    columns = (
        '[columns]\ntime = { name = "column 1", unit = "ms" }\nposition = { name = "column 2", unit = "deg" }\n'
        'force = { name = "column 3" }\n'
    )
    (r,) = read_data(_folder(tmp_path, ROWS, columns), AXIS).records
    np.testing.assert_allclose(r.position, np.radians([0.0, 1.5, 3.0]))
    np.testing.assert_allclose(r.force, [0.0, 0.25, 0.5])


@pytest.mark.parametrize("text", [
    " Sample   Time     Encoder 1 Pos   Control Effort\n\n[  0   0.000  0   0.0;\n   1   0.009   1500  -0.25;\n];\n",
    "Sample\tTime\tEncoder 1 Pos\tControl Effort\nA = [\n0\t0.000\t0\t0.0;\n1\t0.009\t1500\t-0.25]\n",
    "Sample,Time,Encoder 1 Pos,Control Effort\n[0,0.000,0,0.0\n1,0.009,1500,-0.25]\n",
])  # fmt: skip
def test_a_matrix_as_matlab_prints_it_is_a_table(tmp_path: Path, text: str) -> None:
    table = load_table(_folder(tmp_path, text, "") / "run.csv")
    assert list(table.columns) == ["Sample", "Time", "Encoder 1 Pos", "Control Effort"]
    np.testing.assert_array_equal(table.columns["Control Effort"], [0.0, -0.25])
    np.testing.assert_array_equal(table.columns["Encoder 1 Pos"], [0.0, 1500.0])


@pytest.mark.parametrize("day", ["2024-02-01 ", "01.02.2024 ", "2024-02-01T", ""])
def test_a_time_of_day_is_seconds(tmp_path: Path, day: str) -> None:
    rows = "".join(f"{day}12:30:{9.999 + 1e-3 * i:06.3f};{i};0,5\n".replace(".", ",") for i in range(3))
    (r,) = read_data(_folder(tmp_path, "t;pos [deg];M [Nm]\n" + rows), AXIS).records
    assert r.time_s is not None
    np.testing.assert_allclose(r.time_s, 45009.999 + 1e-3 * np.arange(3), atol=1e-9)


@pytest.mark.parametrize(("head", "columns", "said"), [
    ("t [ms];pos [rpm];M [Nm]", COLUMNS, "rpm is a unit of speed"),
    ("t [ms];pos [mm];M [Nm]", COLUMNS, "mm is a unit of length"),
    ("t [ms];pos [deg];M [A]", COLUMNS, "scale"),
    ("t [ms];pos [deg];M [Nm]", COLUMNS.replace('"pos"', '"pos", unit = "turn"'), "which is it"),
    ("t [ms];pos [deg];M [Nm]", COLUMNS.replace('"pos"', '"pos", unit = "furlong"'), "known are count"),
    ("t [ms];angle [deg];M [Nm]", COLUMNS, "no column 'pos'"),
    ("t [ms];pos [deg];M [Nm]", "sample_time_s = 0.01\n" + COLUMNS, "the model says 0.001"),
    ("t [ms];pos [deg];torque [Nm]", "", 'force = { name = "torque [Nm]", unit = "N m" }'),
    ("0;1;2", COLUMNS, "no column 't' for time; has column 1, column 2, column 3"),
    ("t [ms];pos [deg];M [Nm]\n0;x;3", COLUMNS, "line 2"),
])  # fmt: skip
def test_what_is_wrong_is_said(tmp_path: Path, head: str, columns: str, said: str) -> None:
    with pytest.raises(BadInputError) as e:
        read_data(_folder(tmp_path, f"{head}\n{ROWS}", columns), AXIS)
    assert said in str(e.value)


def test_counts_need_a_resolution(tmp_path: Path) -> None:
    table = load_table(_folder(tmp_path, "t [ms];pos [counts];M [Nm]\n" + ROWS) / "run.csv")
    assert table.units == {"t [ms]": "ms", "pos [counts]": "count", "M [Nm]": "N m"}
    (r,) = read_data(tmp_path, AXIS).records
    np.testing.assert_allclose(r.position, [0.0, 1.5e-4, 3e-4])


@pytest.mark.parametrize(("head", "name", "unit"), [
    ("pos_deg", "pos_deg", "deg"), ("pos_x", "pos_x", None), ("iq / A", "iq", "A"), ("a/b", "a/b", None), ("v [m/s]", "v", "m/s"),  # noqa: E501
])  # fmt: skip
def test_a_head_states_its_unit(head: str, name: str, unit: str | None) -> None:
    assert named(head) == (name, unit)


def test_a_test_signal_is_in_some_files_only(tmp_path: Path) -> None:
    more = COLUMNS + 'feedforward = { name = "extra", unit = "mN m" }\n'
    _folder(tmp_path, "t [ms];pos [deg];M [Nm]\n" + ROWS, more)
    with pytest.raises(BadInputError, match="no file has a column 'extra' for feedforward"):
        read_data(tmp_path, AXIS)
    (tmp_path / "second.csv").write_text("t [ms];pos [deg];M [Nm];extra\n0;0;0;0\n1;1,5;0,25;50\n2;3,0;0,5;100\n")
    first, second = read_data(tmp_path, AXIS).records
    assert first.feedforward is None
    np.testing.assert_allclose(second.feedforward, [0.0, 0.05, 0.1])


def test_a_recording_needs_no_description(tmp_path: Path) -> None:
    """What ``devin --record`` writes: names that say what they are, each with its unit, and one that is not needed."""
    head = "time [s]\tposition [rad]\tvelocity [rad/s]\tforce [N m]\tcommand [rad]\n"
    rows = "".join([f"5148.{i:03d}000001\t{i / 10}\t0\t{i}\t{i / 5}\n" for i in range(5)])
    (r,) = read_data(_folder(tmp_path, head + rows, ""), AXIS).records
    np.testing.assert_allclose(r.position, np.arange(5) / 10)
    np.testing.assert_allclose(r.force, np.arange(5))
    assert r.command is not None and r.time_s is not None
    np.testing.assert_allclose(np.diff(r.time_s), 1e-3, atol=1e-9)
    with pytest.raises(BadInputError, match="no column description"):  # without units they are only words
        read_data(_folder(tmp_path, head.replace(" [rad]", "") + rows, ""), AXIS)


def test_a_program_reads_and_analyses_without_tools_and_client() -> None:
    modules = (
        "sioms.reconcile.axis, sioms.reconcile.files.axis, sioms.reconcile.files.finger, sioms.reconcile.files.force"
    )
    script = (
        f"import sys, {modules}\nprint(*(n for n in sys.modules if n.startswith(('sioms.tools', 'sioms.client', "
        "'sioms.sdk'))))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert not done.stdout.strip()


@pytest.mark.parametrize(("text", "message"), [
    ("t [ms];pos [deg];pos [deg];M [Nm]\n0;0;0;0\n1;1;2;1\n2;2;3;2\n", "no column 'pos' .*, column 2, column 3"),
    ("t [ms];pos [deg];M [Nm]\n0;999;0,5\n1;1.000;0,25\n2;1.001;0,5\n", "both '1.000' and '0,5'"),
    ("t [ms];pos [deg];M [Nm]\n0;999;0.5\n1;1,000;0.25\n2;1,001;0.5\n", "both '0.5' and '1,000'"),
    ('t [ms],pos [deg],M [Nm]\n0,"1,5","0,5"\n1,"1,6","0,6"\n2,"1,7","0,7"\n', "no numbers in .* '1,5'"),
    ("t [ms];pos [deg];M [Nm]\n10:00 AM;0;0\n10:01 AM;1;1\n10:02 AM;2;2\n", "column 't .* is of text, .* '10:00 AM'"),
])  # fmt: skip
def test_what_is_read_in_two_ways_is_read_in_none(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(BadInputError, match=message):
        read_data(_folder(tmp_path, text), AXIS)


def test_quoted_commas_do_not_part_columns(tmp_path: Path) -> None:
    text = '"0,5","1,5","2,5"\n"0,6","1,6","2,6"\n"0,7","1,7","2,7"\n'
    with pytest.raises(BadInputError, match="no numbers"):
        load_table(_folder(tmp_path, text) / "run.csv")


def test_one_column_is_not_position_and_something_else(tmp_path: Path) -> None:
    columns = '[columns]\nposition = { name = "pos" }\nforce = { name = "pos" }\n'
    with pytest.raises(BadInputError, match="'pos' is said to be the position and the force"):
        read_data(_folder(tmp_path, "t;pos;M\n" + ROWS, columns), AXIS)
