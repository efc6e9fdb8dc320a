"""Rigs whose motion another machine imposes: the force that it takes, and no inertia."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sioms import reconcile
from sioms.reconcile.effects import library
from sioms.reconcile.errors import BadInputError
from sioms.reconcile.live.axis import Live, live
from sioms.reconcile.model import AxisModel
from sioms.reconcile.model_file import parse_model, write_model
from sioms.reconcile.records import Record, Session
from sioms.reconcile.report.page import page
from sioms.reconcile.report.words import headline
from sioms.reconcile.twin import from_files
from sioms.reconcile.verdict import Outcome

DT, STEP = 0.002, 1e-6
RIG = AxisModel(False, DT, 0.0, 0.0, STEP, 0.1, 10.0, 0.3, imposed=True)
Array = NDArray[np.float64]
Law = Callable[[Array, Array, Array], Array]


def moved(law: Law, seed: int) -> Session:
    """Impose sums of sines, whose speed and acceleration are known exactly, and measure the force with 2 % of noise."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(8000)
    records = []
    for i in range(2):
        w, phase = 2.0 * np.pi * rng.uniform(0.2, 1.5, 4), rng.uniform(0.0, 6.28, 4)
        size = rng.uniform(0.3, 1.0, 4)
        turn, size = np.outer(t, w) + phase, 0.05 * size / np.sum(size)
        x, v, a = np.sin(turn) @ size, np.cos(turn) @ (size * w), -np.sin(turn) @ (size * w**2)
        force = law(x, v, a)
        noise = rng.normal(scale=0.02 * np.std(force), size=len(t))
        records.append(Record(f"stroke {i}", STEP * np.round(x / STEP), force + noise, time_s=t))
    return Session(tuple(records))


@pytest.mark.parametrize(
    ("law", "expected"),
    [
        (lambda x, v, a: 30.0 * np.sign(v) * np.abs(v) ** 0.6, {"power_drag": {"c": 30.0, "n": 0.6}}),
        (lambda x, v, a: 0.8 * a + 3.0 * np.sign(v), {"coulomb": {"Fc": 3.0}, "payload": {"J_extra": 0.8}}),
        (lambda x, v, a: 3.0 * np.sign(v) + 20.0 * v, {"coulomb": {"Fc": 3.0}, "viscous": {"b_extra": 20.0}}),
        (
            lambda x, v, a: np.where(v > 0.0, 60.0, 25.0) * v,
            {"viscous": {"b_extra": 42.5}, "viscous_direction": {"b_dir": 17.5}},
        ),
    ],
    ids=["damper", "dry friction of a mass", "dry and viscous friction", "damper with a valve"],
)  # fmt: skip
def test_what_a_motion_takes_is_named(law: Law, expected: dict[str, dict[str, float]]) -> None:
    verdict = reconcile.analyse(moved(law, 11), RIG)
    assert verdict.outcome is Outcome.NAMED
    found = {e.name: {p.symbol: p.value for p in e.parameters} for e in verdict.effects}
    assert found == {name: pytest.approx(numbers, rel=5e-3) for name, numbers in expected.items()}
    assert verdict.model.inertia == 0.0 and all(g.unit == "N" for g in verdict.gaps)


def stroked(law: Law, seed: int) -> Session:
    """Strokes at constant speeds, turned round within 50 ms."""
    rng, fine = np.random.default_rng(seed), DT / 4
    records = []
    for i in range(2):
        speeds, sign = [], 1.0
        while len(speeds) < 32000:
            speed = rng.choice([0.02, 0.05, 0.1, 0.2])
            speeds += [sign * speed] * int(0.08 / speed / fine)
            sign = -sign
        turn = int(0.05 / fine)
        v = np.convolve(speeds[:32000], np.ones(turn) / turn, "same")
        x = np.cumsum(v) * fine
        force = law(x, v, np.gradient(v, fine))[::4]
        force = force + rng.normal(scale=0.02 * np.std(force), size=len(force))
        records.append(Record(f"strokes {i}", STEP * np.round(x[::4] / STEP), force, time_s=DT * np.arange(8000)))
    return Session(tuple(records))


@pytest.mark.parametrize(
    ("law", "expected"),
    [
        (lambda x, v, a: 3.0 * np.sign(v) + 20.0 * v, {"coulomb": {"Fc": 3.0}, "viscous": {"b_extra": 20.0}}),
        (lambda x, v, a: 40.0 * v, {"viscous": {"b_extra": 40.0}}),
    ],
    ids=["dry and viscous friction", "damper"],
)
def test_constant_speeds_with_short_turns_are_enough(law: Law, expected: dict[str, dict[str, float]]) -> None:
    verdict = reconcile.analyse(stroked(law, 3), RIG)
    assert verdict.outcome is Outcome.NAMED
    found = {e.name: {p.symbol: p.value for p in e.parameters} for e in verdict.effects}
    assert found == {name: pytest.approx(numbers, rel=5e-3) for name, numbers in expected.items()}


def test_the_report_on_a_rig_has_the_words_of_a_rig(tmp_path: Path) -> None:
    verdict = reconcile.analyse(moved(lambda x, v, a: 40.0 * v, 12), RIG)
    page(verdict, 1.0, draw=False).write(tmp_path / "report.html")
    html = (tmp_path / "report.html").read_text()
    assert "What the model lacks has been identified" in html
    again = reconcile.analyse(moved(lambda x, v, a: 40.0 * v, 13), verdict.model)
    assert again.outcome is Outcome.NAMED and headline(again).startswith(
        "Nothing is missing beside what the model holds"
    )
    for foreign in ("closed loop", "controller", "pitch", "motor", "encoder zero", "drive"):
        assert foreign not in html, foreign
    assert "of the force that the motion takes" in html


def test_what_noise_hides_is_asked_for() -> None:
    rng = np.random.default_rng(5)
    quiet = moved(lambda x, v, a: 3.0 * np.sign(v) + 20.0 * v, 7)
    noisy = tuple(replace(r, force=r.force + 1.2 * rng.standard_normal(len(r))) for r in quiet.records)
    verdict = reconcile.analyse(Session(noisy), RIG)
    assert verdict.outcome is Outcome.AMBIGUOUS and verdict.alternatives == (("power_drag",),)
    assert any(
        "would be told from drag with a power of the speed by cruise at several speeds" in n for n in verdict.notes
    )


def test_a_damper_that_is_as_stated_lacks_nothing() -> None:
    verdict = reconcile.analyse(moved(lambda x, v, a: 40.0 * v, 12), replace(RIG, viscous=40.0))
    assert verdict.outcome is Outcome.NONE


def test_what_never_changes_is_refused() -> None:
    still = Record("still", np.zeros(2000), np.full(2000, 3.0))
    with pytest.raises(BadInputError, match="force never changes"):
        reconcile.analyse(Session((still,)), RIG)
    even = Record("even", STEP * np.round(0.02 * DT * np.arange(4000) / STEP), still_noise())
    with pytest.raises(BadInputError, match="speed never changes"):
        reconcile.analyse(Session((even,)), RIG)


def still_noise() -> Array:
    return 3.0 + 0.01 * np.random.default_rng(4).standard_normal(4000)


def swung(law: Law, step: float = STEP) -> Session:
    """One sine for each record, at which place and acceleration are one column."""
    t, w = DT * np.arange(6000), np.pi
    records = []
    for i, size in enumerate((0.05, 0.02)):
        x, v, a = size * np.sin(w * t), size * w * np.cos(w * t), -size * w**2 * np.sin(w * t)
        force = law(x, v, a)
        noise = np.random.default_rng(i).normal(scale=0.02 * np.std(force), size=len(t))
        records.append(Record(f"sine {i}", step * np.round(x / step), force + noise, time_s=t))
    return Session(tuple(records))


@pytest.mark.parametrize(
    ("law", "expected"),
    [
        (lambda x, v, a: 3.0 * np.sign(v) + 20.0 * v, {"coulomb": {"Fc": 3.0}, "viscous": {"b_extra": 20.0}}),
        (lambda x, v, a: 200.0 * x, {"spring": {"k": 200.0}}),
    ],
    ids=["friction", "spring"],
)
def test_one_sine_is_enough(law: Law, expected: dict[str, dict[str, float]]) -> None:
    verdict = reconcile.analyse(swung(law), RIG)
    assert verdict.outcome is Outcome.NAMED
    found = {e.name: {p.symbol: p.value for p in e.parameters} for e in verdict.effects}
    assert found == {name: pytest.approx(numbers, rel=5e-3) for name, numbers in expected.items()}


def test_steps_of_a_coarse_encoder_are_no_friction_at_low_speed() -> None:
    session = moved(lambda x, v, a: 3.0 * np.sign(v) + 20.0 * v, 34)
    coarse = tuple(replace(r, position=1e-3 * np.round(r.position / 1e-3)) for r in session.records)
    with pytest.raises(BadInputError, match="finer sensor of position"):
        reconcile.analyse(Session(coarse), RIG)


def test_a_force_of_the_other_sign_is_refused() -> None:
    for law in (lambda x, v, a: -40.0 * v - 3.0 * np.sign(v), lambda x, v, a: -40.0 * v - 200.0 * x):
        with pytest.raises(BadInputError, match="drives the motion"):
            reconcile.analyse(moved(law, 21), RIG)


def test_records_that_are_none_are_told_as_such() -> None:
    good, other = moved(lambda x, v, a: 40.0 * v, 5).records
    damaged = {
        "no numbers": replace(other, position=np.where(np.arange(8000) % 3 == 1, np.nan, other.position), time_s=None),
        "samples are too few": replace(other.cut(0, 2), time_s=None),
        "force has 7999 samples": replace(other, force=other.force[1:]),
    }
    for said, bad in damaged.items():
        with pytest.raises(BadInputError, match=said):
            reconcile.analyse(Session((good, bad)), RIG)
    with pytest.raises(BadInputError, match="there are none"):
        reconcile.analyse(Session(()), RIG)


def test_effects_of_a_drive_do_not_apply_to_a_rig() -> None:
    apply = {name for name, effect in library().items() if RIG.applicable(effect)}
    assert {"coulomb", "stribeck", "power_drag", "hardening_spring", "presliding", "payload"} <= apply
    assert not apply & {"elastic", "swinging_load", "backlash", "load_friction", "load_square_friction", "dead_band",
                        "saturation", "delay", "thermal_gain", "encoder_scale", "torque_ripple"}  # fmt: skip


def test_a_model_file_of_a_rig_needs_no_inertia() -> None:
    text = write_model(RIG)
    assert parse_model(text, "model.toml") == replace(RIG, name="axis")
    short = "\n".join(line for line in text.splitlines() if not line.startswith("inertia"))
    assert parse_model(short, "model.toml").imposed
    with pytest.raises(BadInputError, match="inertia is 0"):
        parse_model(text.replace("imposed = true", "imposed = false"), "model.toml")
    with pytest.raises(BadInputError, match=r"driven = false.*beside imposed"):
        parse_model(text.replace("imposed = true", "imposed = true\ndriven = false"), "model.toml")
    with pytest.raises(BadInputError, match=r"refine.*inertia.*beside imposed"):
        parse_model(text.replace("refine = []", 'refine = ["inertia"]'), "model.toml")
    with pytest.raises(BadInputError, match=r"effects.load_friction.*beside imposed"):
        parse_model(text + "[effects.load_friction]\nmu = 0.1\n", "model.toml")


def test_a_rig_is_neither_moved_nor_a_twin(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"measure mod0.*imposed = true"):
        live("mod0", RIG, Live(), tmp_path, print)
    with pytest.raises(ValueError, match=r"model_file rig.toml: imposed"):
        from_files({0: ("rig.toml", write_model(RIG))}, [], [("x", "m")], 0.001)
