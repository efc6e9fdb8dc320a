"""The engine on a subject of four lines: columns of numbers, each an effect, one a richer form of another."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from sioms.reconcile import rules
from sioms.reconcile.blocks import heldout
from sioms.reconcile.engine.evidence import alternative, frequency, outcome, place, unseen
from sioms.reconcile.engine.fit import Fit, Free, fitted, get, put
from sioms.reconcile.engine.search import AND, Search, Start, Tried
from sioms.reconcile.selection import Found
from sioms.reconcile.thresholds import AXIS
from sioms.reconcile.verdict import Outcome

RNG = np.random.default_rng(7)
ROWS = 600
T = np.linspace(0.0, 1.0, ROWS)
BLOCKS = np.arange(ROWS) // 30
COLUMNS = {
    "slope": (T,),
    "bow": (T, T**2),
    "wave": (np.sin(40.0 * T),),
    "one": (np.where(T > 0.5, 1.0, 0.9),),
    "other": (np.where(T > 0.5, -0.9, -1.0),),
}
RICHER = {"bow": "slope"}


@dataclass(frozen=True)
class Line:
    """What is switched on: the numbers of each column."""

    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    level: float = 0.0

    @property
    def base(self) -> Line:
        return self

    def without_effect(self, name: str) -> Line:
        return replace(self, effects={n: v for n, v in self.effects.items() if n != name})

    def with_numbers(self, effects: Mapping[str, Mapping[str, float]], base: Mapping[str, float]) -> Line:
        return replace(self, effects=effects, **base)

    def says(self) -> np.ndarray:
        return self.level + sum(
            v * c for n in self.effects for v, c in zip(self.effects[n].values(), COLUMNS[n], strict=True)
        )


@dataclass
class Lines(Search[Line]):
    """Search over one row of numbers."""

    measured: np.ndarray
    names: tuple[str, ...] = tuple(COLUMNS)
    frozen: tuple[str, ...] = ()
    footing = AXIS

    def progress(self, text: str) -> None:
        """Tell nobody."""

    def fit(self, model: Line, iterations: int = 8, best: float = np.inf) -> Fit[Line]:
        free = [Free("base", "level", 1.0, -np.inf, np.inf)]
        free += [Free(n, s, 1.0, -np.inf, np.inf) for n, v in model.effects.items() for s in v]
        columns = [np.ones(ROWS), *(c for n in model.effects for c in COLUMNS[n])]
        slopes = np.stack(columns, axis=1)
        return fitted(
            model, tuple(free), lambda m: m.says() - self.measured, lambda x, r: slopes, iterations, 1e-9, damping=1e-9
        )

    def loss(self, fit: Fit[Line]) -> np.ndarray:
        return heldout(fit, BLOCKS)

    def levelled(self, model: Line) -> Fit[Line]:
        return self.fit(model)

    def done(self, fit: Fit[Line]) -> bool:
        return fit.ratio <= self.footing.floor

    def switched_on(self, fit: Fit[Line], start: Start) -> Line:
        bare = fit.model.without_effect(RICHER.get(start.effect, ""))
        return replace(bare, effects={**bare.effects, start.effect: start.values})

    def candidates(self, fit: Fit[Line]) -> list[Start]:
        out = []
        for n in (n for n in self.names if n not in fit.model.effects and n not in map(RICHER.get, fit.model.effects)):
            start = Start(n, 0.0, dict.fromkeys("ab"[: len(COLUMNS[n])], 0.0))
            out.append(replace(start, gain=1.0 - self.fit(self.switched_on(fit, start)).cost / fit.cost))
        return sorted(out, key=lambda s: -s.gain)[: self.footing.tries]

    def trials(self, fit: Fit[Line], losses: np.ndarray) -> dict[str, Tried[Line]]:
        out = {}
        for s in self.candidates(fit):
            new = self.fit(self.switched_on(fit, s))
            out[s.effect] = Tried(new, self.loss(new), self.saving(self.loss(new), losses))
        return out

    def good(self, tried: dict[str, Tried[Line]], fit: Fit[Line], losses: np.ndarray) -> dict[str, Tried[Line]]:
        return {n: t for n, t in tried.items() if self.surely(t.saved, 0.05, n)}

    def unspecific(self, name: str, tried: Mapping[str, Tried[Line]], fit: Fit[Line], losses: np.ndarray) -> bool:
        return False

    def order(self, name: str, tried: Tried[Line], best: Fit[Line]) -> tuple[int, float]:
        return sum(len(COLUMNS[n]) for n in name.split(AND)), -tried.saved.total

    def simpler(self, fit: Fit[Line], name: str) -> Iterator[tuple[str, str, Fit[Line]]]:
        if name in RICHER:
            plain = replace(fit.model.without_effect(name))
            yield name, RICHER[name], self.fit(replace(plain, effects={**plain.effects, RICHER[name]: {"a": 0.0}}))


def lines(**hidden: float) -> Lines:
    made = sum((v * COLUMNS[n][0] for n, v in hidden.items()), np.zeros(ROWS))
    return Lines(2.0 + made + np.random.default_rng(3).standard_normal(ROWS))


def test_the_search_names_what_is_hidden_by_its_simplest_form() -> None:
    found = lines(slope=9.0, wave=5.0).run(Line())
    assert set(found.fit.model.effects) == {"slope", "wave"}
    assert found.fit.model.effects["slope"]["a"] == pytest.approx(9.0, abs=0.6)
    assert found.path[0].action == "start"
    assert found.fit.ratio == pytest.approx(1.0, abs=0.1)


def test_nothing_is_named_where_nothing_is_hidden() -> None:
    assert not lines().run(Line()).fit.model.effects


def test_two_that_hide_each_other_are_found_at_once() -> None:
    search = lines(one=60.0, other=60.0)
    search.names = ("one", "other")
    assert set(search.run(Line()).fit.model.effects) == {"one", "other"}


def test_what_no_longer_saves_its_share_leaves_but_the_last_stays() -> None:
    search = lines(slope=9.0)
    fit = search.fit(Line({"slope": {"a": 0.0}, "wave": {"a": 0.0}}))
    steps: list = []
    fit, _ = search.eliminate(fit, search.loss(fit), steps)
    assert set(fit.model.effects) == {"slope"}
    assert [s.effect for s in steps] == ["wave"]


def test_a_confounder_is_open_only_where_it_misses_little() -> None:
    search = lines(slope=9.0)
    fit = search.fit(Line({"slope": {"a": 9.0}}))
    rivals = rules.weighed(
        Found(fit, search.loss(fit), ()),
        ["slope"],
        lambda name: search.fit(fit.model.without_effect(name)),
        lambda bare, name, contribution: [
            (n, search.fit(replace(bare.model, effects={n: dict.fromkeys("ab"[: len(COLUMNS[n])], 0.0)})), 0.015, None)
            for n in ("wave", "bow")
        ],
        search.loss,
    )
    assert [(r.rival, r.open) for r in rivals] == [("bow", True), ("wave", False)]
    assert alternative(rivals[0], ["slope"]) == ("bow",)
    assert alternative(rivals[0], ["slope", "wave"]) == ("bow",), "what the rival made needless is no part of it"


@pytest.mark.parametrize(
    ("missed", "errors", "excess", "is_open"),
    [
        (0.01, 9.0, 9.0, True),  # misses less than it may
        (0.5, 0.5, 0.1, True),  # a little worse, and not surely
        (0.5, 3.0, 0.1, False),  # a little worse, and surely
        (0.5, 0.5, 9.0, False),  # far worse, by a throw of dice or not
    ],
)
def test_a_rival_is_ruled_out_where_it_is_surely_or_far_worse(
    missed: float, errors: float, excess: float, is_open: bool
) -> None:
    fit = lines().fit(Line({}))
    assert rules.Rival("slope", "wave", missed, 0.015, errors, excess, fit).open is is_open


def test_a_loss_counts_for_nothing_where_it_is_small_or_neither_large_nor_sure() -> None:
    assert rules.negligible(0.5 * rules.GAIN, 9.0)
    assert rules.negligible(0.5 * rules.DOUBTFUL, 0.5)
    assert not rules.negligible(0.5 * rules.DOUBTFUL, 3.0)
    assert not rules.negligible(2.0 * rules.DOUBTFUL, 0.5)


def test_numbers_are_set_as_they_are_read_and_phases_wrap() -> None:
    free = (Free("a", "p", 1.0, -np.inf, np.inf, phase=True), Free("b", "q", 1.0, 0.0, 9.0, index=1, each=True))
    model = Line({"a": {"p": 0.0}, "b": {"q": np.zeros(3)}})
    moved = put(model, free, np.array([np.pi + 0.5, 4.0]))
    assert get(moved, free) == pytest.approx([0.5 - np.pi, 4.0])
    assert not model.effects["b"]["q"].any()


@pytest.mark.parametrize(
    ("named", "unexplained", "ambiguous", "said"),
    [
        (True, True, True, Outcome.UNEXPLAINED),
        (True, False, True, Outcome.AMBIGUOUS),
        (True, False, False, Outcome.NAMED),
        (False, False, False, Outcome.NONE),
    ],
)
def test_what_is_unexplained_goes_before_what_is_ambiguous(
    named: bool, unexplained: bool, ambiguous: bool, said: Outcome
) -> None:
    assert outcome(named, unexplained, ambiguous) is said


def test_a_regression_is_judged_on_blocks_that_it_has_not_seen() -> None:
    noise = np.random.default_rng(5).standard_normal(ROWS)
    columns = np.stack([T - 0.5, np.sin(40.0 * T)], axis=1)
    left = unseen(columns, 4.0 * columns[:, 1] + noise, BLOCKS % 5, (1e-6, 1e-2))
    assert float(left @ left) == pytest.approx(float(noise @ noise), rel=0.03)
    wild = np.random.default_rng(6).standard_normal((ROWS, 200))
    assert unseen(wild, noise, BLOCKS % 5, (1e-6,)) is noise


def test_a_variable_orders_a_residual_or_chance_does_as_well() -> None:
    bins = (T * 9.99).astype(np.int64)
    rng = np.random.default_rng(2)
    r = np.where(T > 0.5, 1.0, -1.0) + rng.standard_normal(ROWS)
    shown = place("time", "s", r, T, bins, (rng.permutation(r) for _ in range(99)), 2.0)
    assert shown.explained > 0.4
    assert shown.p == pytest.approx(0.01)
    assert shown.means[-1] == pytest.approx(2.0, abs=0.5)
    idle = rng.standard_normal(ROWS)
    chance = place("time", "s", idle, T, bins, (rng.permutation(idle) for _ in range(99)), 1.0)
    assert chance.p > 0.05 and shown.explained > 10.0 * chance.explained


def test_an_effect_that_always_saves_does_so_in_every_replicate() -> None:
    rng = np.random.default_rng(1)
    assert frequency(np.ones(20), np.full(20, 2.0), rng) == 1.0
    assert frequency(np.ones(20), np.ones(20), rng) == 0.0
