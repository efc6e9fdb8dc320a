"""What a refused model is made of is told as tried, not as found: in words, on the page, in JSON and in model.toml."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

from sioms.reconcile.axis import analyse
from sioms.reconcile.axis_verdict import AxisVerdict
from sioms.reconcile.files.axis import read_data, read_model
from sioms.reconcile.model_file import parse_model, write_model
from sioms.reconcile.prepare import Options
from sioms.reconcile.records import Session
from sioms.reconcile.refusals import REFUSED_BEYOND, REFUSED_BOUND, REFUSED_FREE, as_stated, doubted, formulas, refused
from sioms.reconcile.report.page import page
from sioms.reconcile.report.words import as_json, summary
from sioms.reconcile.verdict import Candidate, Estimate, NamedEffect, Outcome

AXES = Path(__file__).parents[2] / "physics" / "reconcile_axes"
WEAK = Candidate("stribeck", "Stribeck friction (low-speed drop)", REFUSED_FREE)


def effect(name: str) -> NamedEffect:
    return NamedEffect(name, name.title(), "", "", (), 0.5, 9.0, None, ())


@pytest.mark.parametrize(
    ("freely", "beyond", "names", "why"),
    [
        (True, False, ["coulomb", "spring"], REFUSED_FREE),
        (False, True, ["coulomb", "spring"], REFUSED_BEYOND),
        (False, False, ["spring"], REFUSED_BOUND),
    ],
)
def test_a_refused_model_makes_candidates_of_all_its_effects(
    freely: bool, beyond: bool, names: list[str], why: str
) -> None:
    named = [effect("coulomb"), effect("spring")]
    found = refused(named, named[1:], freely, beyond)
    assert [c.name for c in found] == names
    assert {c.why for c in found} == {why}
    assert refused(named, [], False, False) == ()


@pytest.mark.parametrize(
    ("ratio", "saved", "doubt"), [(1.23, 0.09, True), (1.23, 0.6, False), (1.04, 0.03, False), (2.0, 0.4, True)]
)
def test_what_explains_less_than_remains_may_be_a_part_of_it(ratio: float, saved: float, doubt: bool) -> None:
    """Squares in units of the noise: 1.23^2 leave 0.51 above it, of which an effect that saves 9 % takes 0.15."""
    assert doubted(replace(effect("coulomb"), saved=saved), ratio) is doubt


def test_a_refused_model_has_the_stated_numbers_where_they_were_refined() -> None:
    nominal = replace(read_model(AXES / "s05" / "nominal.json"), refine=("inertia",))
    tried = replace(nominal, inertia=3.0 * nominal.inertia, viscous=0.1)
    assert as_stated(tried, nominal) == replace(nominal, viscous=0.1)


def test_beside_a_nameless_term_of_the_same_variable_nothing_has_a_name() -> None:
    """Of a force that bends over the place, a spring is whatever part of it was taken for one."""
    named = [effect("coulomb"), effect("spring"), effect("viscous")]
    found, terms = formulas(named, [effect("term_stop_below")])
    assert [e.name for e in found] == ["coulomb", "viscous"]
    assert [e.name for e in terms] == ["term_stop_below", "spring"]
    assert [e.name for e in formulas(named, [effect("term_falling_drag")])[0]] == ["coulomb", "spring"]
    assert formulas(named, []) == (named, [])


def test_a_constant_beside_a_nameless_law_has_no_name() -> None:
    """A law of the place is zero at a place of nobody's choice: the offset beside it is the rest of it."""
    named = [effect("offset"), effect("viscous"), effect("payload")]
    for term, left in (
        ("term_stop_above", ["viscous", "payload"]),
        ("term_law_of_place", ["viscous", "payload"]),
        ("term_xv", ["offset", "payload"]),
        ("term_drag_by_place", ["offset", "payload"]),
        ("term_falling_drag", ["offset", "payload"]),
    ):
        assert [e.name for e in formulas(named, [effect(term)])[0]] == left, term


def periodic(name: str, periods: float) -> NamedEffect:
    return replace(effect(name), parameters=(Estimate("n", periods, periods, periods, "1/pitch", ""),))


@pytest.mark.parametrize("name", ["cogging", "torque_ripple", "friction_variation", "coulomb_position"])
@pytest.mark.parametrize("term", ["term_law_of_place", "term_wave", "term_stop_above"])
def test_what_repeats_too_seldom_has_no_name_beside_a_nameless_force_of_the_place(name: str, term: str) -> None:
    """On two turns a force of two periods a turn may be a part of what bends once; one of fourteen may not."""
    seldom, often = periodic(name, 2.0), periodic(name, 14.0)
    assert formulas([seldom], [effect(term)], 2.0)[0] == []
    assert formulas([often], [effect(term)], 2.0)[0] == [often]
    assert formulas([seldom], [effect("term_law_of_speed")], 2.0)[0] == [seldom]
    assert formulas([seldom], [], 2.0)[0] == [seldom]


@cache
def verdict() -> AxisVerdict:
    """Return the verdict on a model that has been refused though the search came to friction."""
    model = read_model(AXES / "s05" / "nominal.json")
    session = read_data(AXES / "s05", model)
    short = Session(tuple(r.cut(0, 1500) for r in session.records[:2]))
    found = analyse(short, model, Options(pictures=False))
    level = model.rated_force
    tried = model.with_effect("stribeck", {"Fc": 0.1 * level, "Fs": 0.2 * level, "vs": 0.01})
    return replace(found, outcome=Outcome.UNEXPLAINED, model=tried, effects=(), symbolic=(), candidates=(WEAK,))


def test_the_terminal_names_nothing_and_says_what_was_refused() -> None:
    lines = summary(verdict(), "report.html")
    assert lines[0].endswith("Something is missing, and no model that was tried holds: nothing is named.")
    assert "tried and refused: Stribeck friction (low-speed drop)" in lines
    assert any(line.startswith("model error on held-out data, refused model") for line in lines)
    assert not any("Fc" in line for line in lines)


def test_the_page_has_no_numbers_of_what_was_refused(tmp_path: Path) -> None:
    page(verdict(), 1.0).write(tmp_path / "report.html")
    text = re.sub(r"data:image[^'\"]*", "", (tmp_path / "report.html").read_text())
    assert "What was tried and refused" in text
    assert "These are not findings" in text
    assert "What was missing" not in text
    assert "Fc" not in text


def test_programs_find_no_effect_and_the_model_has_it_off() -> None:
    told = json.loads(as_json(verdict(), 1.0))
    assert told["effects"] == []
    assert told["parameters"] == {}
    assert [c["name"] for c in told["refused_candidates"]] == ["stribeck"]
    written = write_model(verdict().model, {c.name for c in verdict().candidates})
    assert "on = false" in written
    assert parse_model(written, "model.toml").effects == {}
    assert parse_model(write_model(verdict().model), "model.toml").effects != {}
