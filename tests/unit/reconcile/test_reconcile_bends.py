"""The exponents of what is named are those of its law: else the law is another one, and no number hangs on it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from sioms.reconcile.axis import analyse
from sioms.reconcile.bends import DROP, Bend, bent, built_along, loosened
from sioms.reconcile.conclude import hangs
from sioms.reconcile.dry import built_up
from sioms.reconcile.effects import library
from sioms.reconcile.evidence import spans_of
from sioms.reconcile.fit import Fit, Problem, refit
from sioms.reconcile.model import AxisModel
from sioms.reconcile.prepare import Options, prepare
from sioms.reconcile.records import Record, Session
from sioms.reconcile.refusals import another_law
from sioms.reconcile.verdict import NamedEffect, Outcome

DT, STEP = 0.002, 1e-6
RIG = AxisModel(False, DT, 0.0, 0.0, STEP, 0.1, 10.0, 0.3, imposed=True)
Array = NDArray[np.float64]
Law = Callable[[Array, Array], Array]
START = {
    "coulomb": {"Fc": 3.0},
    "viscous": {"b_extra": 10.0},
    "quadratic_drag": {"c": 5.0},
    "stribeck": {"Fc": 3.0, "Fs": 5.0, "vs": 0.05},
    "coulomb_position": {"Fc": 3.0, "Fm": 1.0, "phase": 0.1, "n": 2.0},
    "spring": {"k": 20.0},
    "presliding": {"Fc": 3.0, "xs": 2e-4},
}


def moved(law: Law, seed: int = 11) -> Session:
    """Impose sums of sines, whose speed is known exactly, and measure the force with 2 % of noise."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(8000)
    records = []
    for i in range(2):
        w, phase, size = (rng.uniform(low, high, 4) for low, high in ((1.3, 9.4), (0.0, 6.28), (0.3, 1.0)))
        turn, size = np.outer(t, w) + phase, 0.05 * size / np.sum(size)
        x, v = np.sin(turn) @ size, np.cos(turn) @ (size * w)
        force = law(x, v)
        noise = rng.normal(scale=0.02 * np.std(force), size=len(t))
        records.append(Record(f"stroke {i}", STEP * np.round(x / STEP), force + noise, time_s=t))
    return Session(tuple(records))


def named(law: Law, *names: str) -> tuple[Problem, Fit]:
    """Fit those names to what a law takes."""
    ready = prepare(moved(law), RIG, Options(pictures=False))
    model = ready.model
    for name in names:
        model = model.with_effect(name, START[name])
    return ready.problem, refit(ready.problem, model, (), 12)


def bends_of(law: Law, *names: str) -> dict[str, tuple[str, ...]]:
    """Return the laws of those names that are bent, each with what hangs on it."""
    problem, fit = named(law, *names)
    return {b.effect: b.hangs for b in bent(problem, fit, names)}


def drop(v: Array, v0: float, power: float) -> Array:
    return (3.0 + 2.0 * np.exp(-((np.abs(v) / v0) ** power))) * np.sign(v)


def triangle(x: Array) -> Array:
    return np.asarray(2.0 / np.pi * np.arcsin(np.sin(2.0 * 2.0 * np.pi / 0.1 * x + 0.1)))


def cut_off(x: Array) -> Array:
    """Of all such waves the nearest to a sine: its third harmonic is none, its fifth a twenty-fifth."""
    return np.clip(1.5 * triangle(x), -1.0, 1.0)


@pytest.mark.parametrize(
    ("law", "names"),
    [
        (lambda x, v: drop(v, 0.1, 1.0) + 10.0 * v, ("stribeck", "viscous")),
        (lambda x, v: drop(v, 0.1, 1.0) + 10.0 * v, ("stribeck", "viscous", "quadratic_drag")),
        (lambda x, v: drop(v, 0.03, 1.0) + 10.0 * v, ("stribeck", "viscous")),
        (lambda x, v: 3.0 * np.sign(v) + 4.0 * np.tanh(v / 0.2), ("coulomb", "viscous")),
        (lambda x, v: (3.0 + triangle(x)) * np.sign(v) + 10.0 * v, ("coulomb_position", "viscous")),
        (lambda x, v: (3.0 + cut_off(x)) * np.sign(v) + 10.0 * v, ("coulomb_position", "viscous")),
        (lambda x, v: 0.5 * np.sinh(x / 0.03) + 3.0 * np.sign(v), ("spring", "coulomb")),
    ],
    ids=[
        "slow drop",
        "slow drop and two drags",
        "drop",
        "drag that levels off",
        "triangle",
        "triangle cut off",
        "spring that hardens",
    ],
)  # fmt: skip
def test_a_law_near_the_named_one_is_told_by_its_exponent(law: Law, names: tuple[str, ...]) -> None:
    assert bends_of(law, *names)


@pytest.mark.parametrize(
    ("law", "names"),
    [
        (lambda x, v: drop(v, 0.03, 2.0) + 10.0 * v, ("stribeck", "viscous")),
        (lambda x, v: drop(v, 0.1, 2.0) + 10.0 * v + 20.0 * v * np.abs(v), ("stribeck", "viscous", "quadratic_drag")),
        (lambda x, v: 3.0 * np.sign(v) + 10.0 * v, ("coulomb", "viscous")),
        (lambda x, v: (3.0 + np.sin(40.0 * np.pi * x + 0.1)) * np.sign(v) + 10.0 * v, ("coulomb_position", "viscous")),
        (lambda x, v: 20.0 * x + 3.0 * np.sign(v), ("spring", "coulomb")),
    ],
    ids=["drop", "drop and two drags", "dry and viscous", "wave", "spring"],
)  # fmt: skip
def test_a_right_name_has_the_exponent_of_its_law(law: Law, names: tuple[str, ...]) -> None:
    assert not bends_of(law, *names)


def test_what_shares_a_force_of_the_speed_hangs_on_its_laws() -> None:
    """Friction that drops with exp(-v/v0) beside viscous friction: told as the library has it, 4.4 N of 3 are dry."""
    found = bends_of(lambda x, v: drop(v, 0.1, 1.0) + 10.0 * v, "stribeck", "viscous")
    assert {*found, *(name for names in found.values() for name in names)} == {"stribeck", "viscous"}


def test_intervals_have_room_for_exponents_that_are_not_told() -> None:
    """Of a slow drop beside two drags the level at speed is an extrapolation; at rest friction is what is measured."""
    law = lambda x, v: drop(v, 0.1, 2.0) + 10.0 * v + 20.0 * v * np.abs(v)  # noqa: E731
    problem, fit = named(law, "stribeck", "viscous", "quadratic_drag")
    room, noise = loosened(problem, fit, tuple(fit.model.effects)), spans_of(problem, fit)
    low, high = noise["stribeck", "Fc"]
    assert room["stribeck", "Fc"] > 3.0 * (high - low)
    assert room["stribeck", "Fs"] < 0.05
    problem, fit = named(lambda x, v: 3.0 * np.sign(v), "coulomb")
    assert loosened(problem, fit, ("coulomb",))["coulomb", "Fc"] < 1e-3


def test_what_builds_up_along_an_exponent_near_one_is_what_the_model_has() -> None:
    x, level = 1e-3 * np.sin(np.linspace(0.0, 20.0, 4000)), np.full(4000, 3.0)
    assert built_along(x, level, 3.0 / 2e-4, 1.0 + 1e-6) == pytest.approx(built_up(x, level, 3.0 / 2e-4), abs=1e-4)


@pytest.mark.parametrize(("power", "outcome"), [(2.0, Outcome.NAMED), (1.0, Outcome.UNEXPLAINED)])
def test_a_drop_of_another_form_has_no_name_though_nothing_remains(power: float, outcome: Outcome) -> None:
    """With exp(-v/v0) it was named with 4.4 N at speed, of 3 N, and two drags: all that remained was noise."""
    alone = tuple(n for n in library() if n not in ("coulomb", "viscous", "quadratic_drag", "stribeck"))
    session = moved(lambda x, v: drop(v, 0.1, power) + 10.0 * v)
    verdict = analyse(session, RIG, Options(pictures=False, without=alone))
    assert verdict.outcome is outcome
    assert verdict.ratio < 1.1
    assert {e.name for e in verdict.effects} == ({"stribeck", "viscous"} if power == 2.0 else set())
    assert any("another one" in c.why for c in verdict.candidates) == (power == 1.0)
    assert any("than that of the law" in note for note in verdict.notes) == (power == 1.0)


def test_what_hangs_on_a_law_that_is_another_one_is_refused_with_it() -> None:
    found = [NamedEffect(n, n, "", "", (), 0.5, 9.0, None, ()) for n in ("stribeck", "viscous", "payload")]
    refused = {c.name: c.why for c in another_law(found, [], [Bend("stribeck", DROP, -1.2, 0.2, 0.1, ("viscous",))])}
    assert refused.keys() == {"stribeck", "viscous"}
    assert "exponent of the drop" in refused["stribeck"] and "hangs" in refused["viscous"]


def test_an_effect_is_doubted_where_exponents_alone_let_it_be_none() -> None:
    key, noise = ("quadratic_drag", "c"), {("quadratic_drag", "c"): (2.0, 4.0)}
    assert hangs("quadratic_drag", noise, {key: (-1.0, 7.0)})
    assert not hangs("quadratic_drag", noise, {key: (1.0, 5.0)})
    assert not hangs("quadratic_drag", {key: (-1.0, 3.0)}, {key: (-2.0, 4.0)}), "noise alone does, which is told"
