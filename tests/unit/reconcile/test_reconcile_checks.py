"""Bad input gives an error that says what is wrong, never a confident name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sioms.reconcile.axis import analyse
from sioms.reconcile.checks import check
from sioms.reconcile.floor import lap, lap_floor
from sioms.reconcile.model import AxisModel, Controller
from sioms.reconcile.prepare import Options
from sioms.reconcile.records import Record, Session
from sioms.reconcile.simulate import simulate
from sioms.reconcile.verdict import BadInputError, Outcome

AXIS = AxisModel(
    True, 1e-3, 2e-3, 1e-3, 2e-4, 2 * np.pi, 0.7, 20.0, Controller(20.0, -0.985, -0.7, 0.0, 0.0, 1.8, 100.0)
)


def recorded(model: AxisModel = AXIS, seconds: float = 3.0) -> Record:
    t = np.arange(int(seconds * 1000)) * 1e-3
    command = 1.5 * np.sin(2 * np.pi * 0.7 * t) + 0.5 * np.sin(2 * np.pi * 2.3 * t)
    run = simulate(model, command)
    rng = np.random.default_rng(1)
    return Record("run", run.position, run.force, command, run.force + 2e-3 * rng.standard_normal(len(t)), None, t)


GOOD = recorded()


def test_good_data_pass() -> None:
    assert any("index" in n for n in check(Session((GOOD,)), AXIS))


def test_a_force_that_is_no_feedback_is_told_until_it_is_named() -> None:
    pulses = np.where(np.arange(len(GOOD)) % 500 < 30, 0.4, 0.0)
    driven = replace(GOOD, force=GOOD.force + pulses)
    for record, said in ((GOOD, False), (driven, True), (replace(driven, feedforward=pulses), False)):
        assert any("name its column feedforward" in n for n in check(Session((record,)), AXIS)) == said


def _jump(r: Record) -> Record:
    t = r.time_s.copy()  # type: ignore[union-attr]
    t[1000:] += 0.01
    return replace(r, time_s=t)


def _polled(r: Record) -> Record:
    """Take some rows, as a program does that asks over a line beside other work."""
    rows = np.cumsum(np.random.default_rng(2).choice([1, 1, 1, 1, 6], len(r) // 3))
    return r.only(rows[rows < len(r)])


BAD = {
    "polled": (_polled, "polled at no fixed rate"),
    "too short": (lambda r: r.cut(0, 200), "too few"),
    "no motion": (lambda r: replace(r, position=np.zeros(len(r)), command=None), "no motion"),
    "constant force": (lambda r: replace(r, force=np.ones(len(r))), "force is constant"),
    "constant command": (lambda r: replace(r, command=np.zeros(len(r))), "command is constant"),
    "constant current": (lambda r: replace(r, force_measured=np.ones(len(r))), "force_measured is constant"),
    "hardly a number": (
        lambda r: replace(r, force_measured=np.where(np.arange(len(r)) % 10 > 0, np.nan, r.force_measured)),
        "2700 of 3000 values that are no numbers",
    ),
    "no motion beside a command": (lambda r: replace(r, position=np.full(len(r), 0.3)), "no motion"),
    "force in milliamperes beside its limit": (lambda r: replace(r, force=r.force * 1000), "factor of 1000"),
    "current in other units": (
        lambda r: replace(r, force_measured=r.force_measured * 1e-3),
        "0.001 times .* factor of 1000",
    ),
    "current of half the size": (
        lambda r: replace(r, force_measured=r.force_measured * 0.5),
        "times the commanded",
    ),
    "current of the other sign": (lambda r: replace(r, force_measured=-r.force_measured), "-1 times"),
    "jumping time": (_jump, "time jumps"),
    "milliseconds as seconds": (lambda r: replace(r, time_s=r.time_s * 1000), "another unit"),
    "saturated throughout": (lambda r: replace(r, force=np.where(r.force > 0, 1.8, -1.8)), "at its limit"),
    "position in other units than the command": (
        lambda r: replace(r, position=r.position * 1000),
        "factor of 1000",
    ),
    "channel of another length": (lambda r: replace(r, force=r.force[:-1]), "same number"),
}


@pytest.mark.parametrize("case", sorted(BAD))
def test_bad_records_are_refused(case: str) -> None:
    change, says = BAD[case]
    with pytest.raises(BadInputError, match=says):
        check(Session((change(GOOD),)), AXIS)


def test_a_saturated_or_late_drive_is_no_other_scale() -> None:
    limited = np.clip(GOOD.force, -0.4, 0.4) * np.where(np.abs(GOOD.force) > 0.8, 0.99, 1.0)
    for measured in (limited, np.concatenate([np.zeros(15), GOOD.force[:-15]])):
        check(Session((replace(GOOD, force_measured=measured),)), AXIS)


@pytest.mark.parametrize(
    ("factor", "says"),
    [(1000.0, "1000"), (1e-3, "1000"), (-1.0, "sign"), (180.0 / np.pi, "degrees"), (1 / 9.81, "kgf")],
)
def test_force_in_wrong_units_is_recognised(factor: float, says: str) -> None:
    limit = replace(AXIS.controller, limit=1e9)  # type: ignore[type-var]
    bad = replace(GOOD, force=GOOD.force * factor, force_measured=GOOD.force_measured * factor)  # type: ignore[operator]
    with pytest.raises(BadInputError, match=says):
        analyse(Session((bad,)), replace(AXIS, controller=limit), Options(pictures=False))


def test_data_of_another_axis_get_no_name() -> None:
    """Position of one motion, force of another: no library can explain that, and none is claimed to."""
    rng = np.random.default_rng(5)
    t = GOOD.time_s if GOOD.time_s is not None else np.zeros(0)
    force = 0.3 * np.sin(2 * np.pi * 3.7 * t + 1.0) * np.sign(np.sin(2 * np.pi * 1.1 * t)) + 2e-3 * rng.standard_normal(
        len(t)
    )
    other = replace(GOOD, force=force, force_measured=force + 2e-3 * rng.standard_normal(len(t)))
    try:
        verdict = analyse(Session((other,)), AXIS, Options(pictures=False))
    except BadInputError as error:
        assert "inertia" in str(error)  # either answer is right
        return
    assert verdict.outcome is Outcome.UNEXPLAINED
    assert not verdict.effects
    assert any("does not match" in note for note in verdict.notes)


def test_no_records_is_bad_input() -> None:
    with pytest.raises(BadInputError, match="none"):
        check(Session(()), AXIS)


def test_laps_are_found_and_give_the_noise() -> None:
    rng = np.random.default_rng(2)
    t = np.arange(12000) * 1e-3
    command = np.sin(2 * np.pi * t / 2.5) + 0.3 * np.sin(4 * np.pi * t / 2.5)
    force = 3.0 * np.cos(2 * np.pi * t / 2.5) + 0.1 * rng.standard_normal(len(t))
    r = Record("laps", command, force, command)
    assert lap(r, 1e-3) == 2500
    assert lap_floor(r, 2500)[0] == pytest.approx(0.1, rel=0.05)
    wander = replace(r, command=command + 0.2 * t)
    assert lap(wander, 1e-3) == 0
