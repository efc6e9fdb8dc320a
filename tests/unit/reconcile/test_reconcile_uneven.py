"""The numbers of what is named are the same everywhere: where they are not, its law is another one."""

from __future__ import annotations

import numpy as np
import pytest

from sioms.reconcile.axis import analyse
from sioms.reconcile.effects import library
from sioms.reconcile.fit import Problem, refit
from sioms.reconcile.model import AxisModel, Controller
from sioms.reconcile.noise import drive_noise, observer, sensor_noise
from sioms.reconcile.prepare import Options
from sioms.reconcile.records import Record, Session
from sioms.reconcile.refusals import another_law
from sioms.reconcile.simulate import simulate
from sioms.reconcile.uneven import Uneven, uneven
from sioms.reconcile.verdict import NamedEffect, Outcome

AXIS = AxisModel(
    True, 1e-3, 2e-3, 1e-3, 2e-4, 2 * np.pi, 0.7, 20.0, Controller(20.0, -0.985, -0.7, 0.0, 0.0, 1.8, 100.0)
)
T = np.arange(6000) * 1e-3
COMMAND = 3.5 * np.sin(2 * np.pi * 0.5 * T) + 0.4 * np.sin(2 * np.pi * 3.1 * T)
DRY = AXIS.with_effect("coulomb", {"Fc": 0.05})


def recorded(world: AxisModel) -> Session:
    """Record a world with the small noises of a good axis."""
    rng = np.random.default_rng(4)
    run = simulate(world, COMMAND)
    measured = run.applied + 2e-3 * rng.standard_normal(len(T))
    return Session((Record("made", run.position, run.force, COMMAND, measured),))


def problem(world: AxisModel) -> Problem:
    s = recorded(world)
    return Problem(s, observer(AXIS, sensor_noise(s, AXIS.resolution), drive_noise(s, AXIS.rated_force)))


def changing(world: AxisModel, named: AxisModel) -> dict[str, str]:
    """Fit a model to a world; of the effects whose numbers are not the same everywhere, the variables."""
    made = problem(world)
    return {u.effect: u.variable for u in uneven(made, refit(made, named), list(named.effects))}


@pytest.mark.parametrize(
    ("hidden", "named", "over"),
    [
        (("warming_friction", {"g": 0.01, "tau": 8.0}), ("coulomb", {"Fc": 0.05}), {"time", "heat"}),
        (("load_square_friction", {"g": 0.2}), ("load_friction", {"mu": 0.1}), {"motor force", "acceleration"}),
        (("quadratic_drag", {"c": 4e-5}), ("viscous", {"b_extra": 1e-4}), {"speed"}),
        (("hardening_spring", {"k3": 5e-3}), ("spring", {"k": 0.01}), {"position"}),
    ],
    ids=["friction that comes up", "square of the load", "square of the speed", "cube of the place"],
)  # fmt: skip
def test_a_number_of_another_law_changes_with_its_variable(
    hidden: tuple[str, dict[str, float]], named: tuple[str, dict[str, float]], over: set[str]
) -> None:
    found = changing(AXIS.with_effect(*hidden), AXIS.with_effect(*named))
    assert found.keys() == {named[0]}
    assert found[named[0]] in over


@pytest.mark.parametrize(
    "world",
    [
        DRY,
        DRY.with_effect("warming_friction", {"g": 0.01, "tau": 8.0}),
        DRY.with_effect("load_square_friction", {"g": 0.2}).with_effect("quadratic_drag", {"c": 4e-5}),
        AXIS.with_effect("stribeck", {"Fc": 0.05, "Fs": 0.09, "vs": 0.6}),
        AXIS.with_effect("hardening_spring", {"k3": 5e-3}).with_effect("viscous", {"b_extra": 1e-3}),
    ],
    ids=["dry", "coming up", "load and speed", "drop", "spring and damper"],
)
def test_the_numbers_of_a_right_name_are_the_same_everywhere(world: AxisModel) -> None:
    assert not changing(world, world)


@pytest.mark.parametrize(("g", "outcome"), [(0.0, Outcome.NAMED), (1.6e-3, Outcome.UNEXPLAINED)])
def test_a_name_of_another_law_is_none_though_little_remains(g: float, outcome: Outcome) -> None:
    """Friction that comes up by a tenth, from a solver that knows constant friction alone: 1.26 times the noise remain,
    in no shape that a smoother finds.
    """
    world = DRY.with_effect("warming_friction", {"g": g, "tau": 8.0}) if g else DRY
    alone = Options(pictures=False, without=tuple(n for n in library() if n != "coulomb"))
    verdict = analyse(recorded(world), AXIS, alone)
    assert verdict.outcome is outcome
    assert [e.name for e in verdict.effects] == ([] if g else ["coulomb"])
    assert [c.name for c in verdict.candidates] == (["coulomb"] if g else [])
    assert any("1.3 times what noise would leave" in note for note in verdict.notes) == bool(g)


def test_what_looks_like_a_wrong_name_is_refused_with_it() -> None:
    """Friction that is said to change as the axis runs in may be what another law of dry friction lacks."""
    named = [NamedEffect(n, n, "", "", (), 0.5, 9.0, None, ()) for n in ("coulomb", "warming_friction", "payload")]
    refused = {c.name: c.why for c in another_law(named, [Uneven("coulomb", "time", 0.13, 3.2)])}
    assert refused.keys() == {"coulomb", "warming_friction"}
    assert "change with time" in refused["coulomb"]
    assert another_law(named, []) == ()
