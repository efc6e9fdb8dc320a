"""The faults of tests/mutants fit the code as it is; whether tests find them is seen by tests/mutants/run.py."""

from __future__ import annotations

import importlib.util
from pathlib import Path

_PATH = Path(__file__).resolve().parents[1] / "mutants" / "run.py"
_SPEC = importlib.util.spec_from_file_location("mutants_run", _PATH)
assert _SPEC is not None and _SPEC.loader is not None
RUN = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(RUN)


def test_each_mutant_changes_one_place() -> None:
    texts: dict[str, str] = {}
    for mutant in RUN.mutants():
        text = texts.setdefault(mutant.file, (RUN.TREE / mutant.file).read_text(encoding="utf-8"))
        assert text.count(mutant.old) == 1, f"{mutant.name}: change it with {mutant.file}"
        assert mutant.old != mutant.new
        compile(text.replace(mutant.old, mutant.new), mutant.file, "exec")
        assert all((RUN.TREE / test.partition("::")[0]).is_file() for test in mutant.tests), mutant.name


def test_no_fault_is_looked_for_where_it_is_not() -> None:
    assert [why for mutant in RUN.mutants() if (why := RUN.unseen(mutant))] == []
    one = RUN.Mutant("m", "daemon/stops.py", "a", "b", ["tests/process/test_stops.py", "tests/process/test_deaths.py"])
    assert "want a test that imports it" in RUN.unseen(one)
    assert not RUN.unseen(one._replace(file="sioms/client/channel.py"))
    assert not RUN.unseen(one._replace(tests=[*one.tests, "tests/unit/daemon/test_stops.py"]))


def test_there_are_fifty_of_them_and_no_two_alike() -> None:
    found = RUN.mutants()
    assert len(found) >= 50
    assert len({mutant.name for mutant in found}) == len(found)
