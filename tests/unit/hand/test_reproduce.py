"""What the source's experiments tell: the quick ones carried out, and a name that is none."""

from __future__ import annotations

import argparse
import math

import pytest

from sioms.hand.command import add_parser, run
from sioms.hand.command.reproduce import NAMES
from sioms.hand.experiments.reproduce import EXPERIMENTS, resolutions, stiffnesses

MM, DEG = 1e-3, math.pi / 180


def _words(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_parser(parser.add_subparsers(dest="command"))
    return parser.parse_args(["hand", *words])


def test_deflections_under_load_are_those_of_the_springs() -> None:
    along, turn, across = stiffnesses()
    assert along == pytest.approx(17e3, rel=0.01)
    assert turn == pytest.approx(0.275, rel=0.02)
    assert across * MM == pytest.approx(0.014, rel=0.02)  # N/mm


def test_readings_step_by_the_resolution() -> None:
    x, th = resolutions()
    assert (x, th) == pytest.approx((0.030 * MM, 0.006 * DEG), rel=1e-6)


def test_every_experiment_of_the_command_is_there() -> None:
    assert tuple(EXPERIMENTS) == NAMES


def test_an_experiment_that_is_none_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(_words("reproduce", "E10")) == 1
    assert "there are E1" in capsys.readouterr().err
