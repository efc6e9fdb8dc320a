"""What is put to work is a model that explains its machine."""

from __future__ import annotations

import argparse
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sioms.reconcile.command import installed
from sioms.reconcile.command.subjects import SUBJECTS
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.verdict import Outcome


@pytest.mark.parametrize("outcome", Outcome)
def test_a_model_with_a_remainder_without_a_name_is_not_installed(outcome: Outcome) -> None:
    done: list[Any] = []

    def install(_args: argparse.Namespace, verdict: Any) -> str:
        done.append(verdict)
        return "model installed"

    subject: Any = SimpleNamespace(install=install)
    verdict = SimpleNamespace(outcome=outcome)
    said = installed(argparse.Namespace(install=Path("twin.toml"), out=Path("report")), subject, verdict)
    if outcome in (Outcome.NAMED, Outcome.NONE):
        assert (done, said) == ([verdict], "model installed")
    else:
        assert not done and f"not installed: the verdict is {outcome.value}" in said


def test_a_missing_file_is_told_by_its_own_name() -> None:
    args = argparse.Namespace(data=Path("nowhere.csv"), model=None)
    (axis,) = (subject for name, subject in SUBJECTS.items() if name == "axis")
    with pytest.raises(BadInputError, match=r"read nowhere\.csv: no such file or folder"):
        axis.analyse(args, print)
