"""The report: what somebody reads who does not know the method."""

from __future__ import annotations

import html
import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from sioms.reconcile.axis_verdict import AxisVerdict
from sioms.reconcile.experiment import Experiment
from sioms.reconcile.files.axis import read_model
from sioms.reconcile.report.page import page
from sioms.reconcile.report.words import as_json, summary, sureness
from sioms.reconcile.rules import told_apart
from sioms.reconcile.selection import Step
from sioms.reconcile.verdict import Estimate, Gap, NamedEffect, Outcome, Place

AXES = Path(__file__).resolve().parents[2] / "physics" / "reconcile_axes"


@cache
def verdict() -> AxisVerdict:
    model = read_model(AXES / "s05" / "nominal.json")
    return AxisVerdict(
        outcome=Outcome.NONE, nominal=model, model=model, effects=(), alternatives=(), symbolic=(),
        gaps=(Gap("force, short windows", "N", 1.0, 1.0, 1.0), Gap("force, closed loop", "N", 2.0, 2.0, 1.9)),
        path=(), missing={}, pairs=(), places=(), ratio=1.0, smoother_share=0.0, burst_share=0.0,
        effective_samples=100.0, samples=1000, notes=(), rungs=(), findings=(), spectra=None, decisive=None, traces=(),
    )  # fmt: skip


def effect(name: str, **words: object) -> NamedEffect:
    numbers = (Estimate("F0", 0.0967, 0.0966, 0.0968, "N", "force"),)
    title = {"offset": "constant force", "gravity": "gravity"}.get(name, name)
    found = NamedEffect(name, title, "F = F0", "force", numbers, 0.9, 10.0, 1.0, ("explains 90 %",))
    return replace(found, **words)  # type: ignore[arg-type]


def text_of(v: AxisVerdict, folder: Path) -> str:
    page(v, 1.0, draw=False).write(folder / "report.html")
    return html.unescape(re.sub(r"<[^>]+>", "\n", (folder / "report.html").read_text()))


def test_nothing_missing_says_what_was_not_tested_and_shows_no_dependence_first(tmp_path: Path) -> None:
    place = Place("position", "m", 0.06, 0.01, *[np.zeros(1)] * 3)
    v = replace(verdict(), missing={"backlash": "reverse slowly"}, places=(place,))
    assert sureness(v).startswith("How sure: on held-out data only noise remains. Not tested, as these records do not")
    assert sureness(v).endswith(f"excite it: {v.title('backlash')}.")
    text = text_of(v, tmp_path)
    assert "the disagreement depends on" not in text.lower() and "too little for an effect" in text
    assert "no gap" in text and "0.0 %" not in text


@pytest.mark.parametrize(("after", "says"), [(2.4, "only noise remains"), (5.7, "3 times the noise remains")])
def test_a_name_says_what_remains_and_what_is_not_ruled_out(after: float, says: str) -> None:
    gaps = (verdict().gaps[0], Gap("force, closed loop", "N", 20.0, after, 1.9))
    named = replace(verdict(), outcome=Outcome.NAMED, effects=(effect("offset"),), gaps=gaps)
    assert sureness(named) == f"How sure: on held-out data {says}; what could stand in its place is ruled out."
    left = effect("offset", open={"gravity": "explains 97 % of the effect as well"})
    assert "not ruled out: " in sureness(replace(named, effects=(left,)))
    unknown = replace(named, gaps=(verdict().gaps[0], Gap("force, closed loop", "N", 20.0, after, float("nan"))))
    assert "how much of what remains is noise is not known" in sureness(unknown)


def test_candidates_stand_beside_each_other_with_their_numbers_and_the_experiment_comes_first(tmp_path: Path) -> None:
    v = replace(
        verdict(), outcome=Outcome.AMBIGUOUS, effects=(effect("gravity"),), alternatives=(("offset",),),
        others=({"offset": {"F": 0.0962}},),
        decisive=Experiment("turn", "slowly over one full turn", np.zeros(4), 40.0),
    )  # fmt: skip
    text = text_of(v, tmp_path)
    assert "Candidates" in text and "What was missing" not in text
    assert "constant force (F = 0.0962)" in text
    assert text.index("Next: slowly over one full turn") < text.index("Candidates")


def test_a_formula_is_no_finding(tmp_path: Path) -> None:
    v = replace(verdict(), outcome=Outcome.UNEXPLAINED, symbolic=(effect("term_wave"),))
    text = text_of(v, tmp_path)
    assert "What was missing" not in text and "A formula for the rest, without a name" in text
    assert "Do not rely on the numbers of a formula" in text


def test_pairs_that_do_not_touch_the_verdict_are_folded(tmp_path: Path) -> None:
    v = replace(
        verdict(), outcome=Outcome.NAMED, effects=(effect("offset", ruled_out={"gravity": "it leaves 40 %"}),),
        pairs=(("delay", "lag", 0.99), ("offset", "payload", 0.97), ("offset", "gravity", 0.96)),
    )  # fmt: skip
    text = text_of(v, tmp_path)
    shown, folded = text.split("effects that would show alike in these records")
    assert "payload" in shown and "delay" not in shown.split("Next")[1].split("Model error")[0]
    assert "96 %" not in shown and "99 %" in folded


def test_what_contains_an_effect_and_explains_as_much_is_said_to_add_nothing() -> None:
    step = Step("add", "coulomb", 1.0, 0.971, None, {"stribeck": 0.9711, "offset": 0.4})
    ruled, _ = told_apart("coulomb", ["stribeck", "offset"], [], [step], {"coulomb"}, {"stribeck"})
    assert ruled["stribeck"] == "contains this effect, and explains no more with more parameters"
    assert ruled["offset"] == "removed 40 % of the residual where this effect removed 97.1 %"
    far = Step("add", "coulomb", 1.0, 0.5, None, {"stribeck": 0.9})
    assert "removed 90 %" in told_apart("coulomb", ["stribeck"], [], [far], {"coulomb"}, {"stribeck"})[0]["stribeck"]


@pytest.mark.parametrize(("half", "told"), [(0.3, True), (2.0, False)])
def test_numbers_of_a_formula_that_make_up_for_each_other_are_not_told_one_by_one(
    half: float, told: bool, tmp_path: Path
) -> None:
    """Two motors on a carriage: the values of a law of speed were printed with intervals of twice their size."""
    law = effect("term_law_of_speed")
    values = tuple(Estimate(f"s{i}", 3.0, 3.0 * (1.0 - half), 3.0 * (1.0 + half), "N", "") for i in range(8))
    found = replace(verdict(), outcome=Outcome.UNEXPLAINED, symbolic=(replace(law, parameters=values),))
    page = text_of(found, tmp_path)
    said = "\n".join(summary(found, "report.html"))
    assert ("s0 = 3" in said) == told
    assert ("told together only" in said) == (not told) == ("told together only" in page)
    assert json.loads(as_json(found, 1.0))["symbolic"][0]["parameters"]["s7"]["value"] == 3.0
