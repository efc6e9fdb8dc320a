"""What a program imports from ``sioms.reconcile``."""

import subprocess
import sys
from pathlib import Path

import pytest

from sioms import reconcile

AXES = Path(__file__).resolve().parents[2] / "physics" / "reconcile_axes"


@pytest.mark.parametrize("name", reconcile.__all__)
def test_every_name_of_the_face_is_there_and_says_what_it_is(name: str) -> None:
    assert getattr(reconcile, name).__doc__
    assert name in dir(reconcile)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'analyze'"):
        _ = reconcile.analyze


def test_the_face_loads_nothing_heavy() -> None:
    code = "import sys, sioms.reconcile; print(*{'numpy', 'scipy', 'numba'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == ""


def test_records_are_read_and_bad_input_is_told() -> None:
    folder = AXES / "s18"
    model = reconcile.read_model(folder / "nominal.json")
    session = reconcile.read_data(folder, model)
    assert {len(r) for r in session.records} == {len(session.records[0])}
    short = reconcile.Session(tuple(r.cut(0, 40) for r in session.records))
    with pytest.raises(reconcile.BadInputError, match="samples"):
        reconcile.analyse(short, model)
    assert reconcile.write_model(model).startswith("[axis]")
