"""Steps are the same in Python and compiled, and what is no step is refused."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sioms.native import language
from sioms.native.language import Floats, Integers, Record
from sioms.native.translate import Untranslatable, translate

SCENARIO = Path(__file__).with_name("scenario.py")


def run(**more):
    environment = {key: value for key, value in os.environ.items() if key != language.UNCOMPILED} | more
    done = subprocess.run([sys.executable, SCENARIO], env=environment, capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_compiled_steps_give_the_same_numbers_bit_for_bit():
    compiled, plain = run(), run(**{language.UNCOMPILED: "1"})
    assert compiled[0] == "compiled", "./dev setup compiles the steps"
    assert plain[0] == "python"
    assert compiled[1:] == plain[1:]
    assert {"STARTED", "ENDED", "DROPPED", "FAULT", "IDLE"} <= set(plain[3:])


@pytest.mark.parametrize(
    "body, what",
    [
        ("return x // 2", "x // 2"),
        ("y = 1\n    y = 1.5\n    return y", "y is int and is given float"),
        ("for i in range(0, 4, 2):\n        x += i\n    return x", "stride"),
        ("return [x][0]", r"\[x\]"),
        ("return unknown(x)", "cannot call unknown"),
        ("try:\n        return x\n    finally:\n        pass", "Try"),
        ("r.n = 1.5\n    return 0", "r.n is an int and is given a float"),
        ("return r.missing", "no such field"),
    ],
)
def test_what_would_mean_something_else_in_c_is_refused(tmp_path, monkeypatch, body, what):
    (tmp_path / "odd_step.py").write_text(
        "from sioms.native.language import Record, step\n"
        f"class R(Record):\n    n: int\n\ndef f(r: R, x: int) -> int:\n    {body}\n".replace("def f", "@step\ndef f")
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(language, "library", None)
    monkeypatch.delitem(sys.modules, "odd_step", raising=False)
    with pytest.raises(Untranslatable, match=what):
        translate(("odd_step",))


class Pair(Record):
    n: int
    share: float
    values: Floats
    counts: Integers


def pair(**other):
    return Pair(**({"n": 2, "share": 0.5, "values": np.zeros(2), "counts": np.zeros(2, dtype=np.int64)} | other))


def test_a_record_uses_the_arrays_it_is_given():
    values = np.array([1.0, 2.0])
    record = pair(values=values)
    record.n, record.share = 7, 0.25
    values[1] = 3.0
    assert (record.n, record.share, record.values[1]) == (7, 0.25, 3.0)


WRONG = [{"values": np.zeros(2, np.float32)}, {"counts": np.zeros(2)}, {"values": np.zeros(4)[::2]}, {"x": 1}]


@pytest.mark.parametrize("wrong", WRONG)
def test_a_record_refuses_what_it_cannot_use(wrong):
    with pytest.raises(TypeError, match="make Pair"):
        pair(**wrong)


def test_a_library_of_other_sources_is_not_used(monkeypatch):
    monkeypatch.setattr(language, "checksum", lambda: 1)
    assert language._load() is None


def test_what_steps_take_is_laid_out_where_they_are_loaded():
    """Drivers are forked after that, and share it: laid out in each, it takes half a megabyte of each."""
    program = (
        "from sioms.motion.plan_step import Plans; from sioms.sdk.quiet_step import Quiet, Page\n"
        "print(all('_fields_' in each.__dict__ for each in (Plans, Quiet, Page)))"
    )
    done = subprocess.run([sys.executable, "-P", "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "True"
