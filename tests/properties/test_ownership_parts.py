"""The protocol of ownership and stops to its end: any number of requests, deaths, restarts and reloads."""

from __future__ import annotations

import random

import pytest
from ownership_explorer import BEGINNINGS, begin, explore, first_of
from ownership_model import follow
from ownership_parts import PARTS, Whole, foretold, go_through
from ownership_promises import Broken, check
from ownership_state import DEVICES, STOP, UP, Driver, State
from ownership_steps import actions
from ownership_tour import tour

WALK = 3_000
TOUR = 300
"""Steps that the real objects take here of each part; all of them: tests/ownership_tour.py."""


@pytest.fixture(scope="module")
def wholes() -> dict[str, Whole]:
    """Return both parts, gone through to their end: no promise is broken in any state of them."""
    return {name: go_through(part) for name, part in PARTS.items()}


def test_no_promise_is_broken_in_any_state_of_the_parts(wholes: dict[str, Whole]) -> None:
    assert {name: (len(whole), sum(map(len, whole.values()))) for name, whole in wholes.items()} == {
        "owners": (28_320, 257_953),
        "stops": (1_956, 13_170),
    }, "as decision 0910 says"


@pytest.mark.parametrize("name", BEGINNINGS)
def test_what_the_whole_does_the_parts_do(wholes: dict[str, Whole], name: str) -> None:
    graph, _, _ = explore(begin(name), 2)
    assert len(graph) > 10
    for before, steps in graph.items():
        for action, after, _ in steps:
            _see_foretold(wholes, before, action, after)


def test_what_the_whole_does_far_away_the_parts_do(wholes: dict[str, Whole]) -> None:
    chance, state = random.Random(910), first_of(begin("nobody owns anything"))
    for _ in range(WALK):
        kinds = sorted({str(action[0]) for action in actions(state)})
        kind = chance.choice([k for k in kinds if k != "crash"] or kinds if chance.random() < 0.9 else kinds)
        action = chance.choice([a for a in actions(state) if a[0] == kind])
        after, _ = follow(state, action)
        _see_foretold(wholes, state, action, after)
        state = after


def _see_foretold(wholes: dict[str, Whole], before: State, action: object, after: State) -> None:
    for part, whole in wholes.items():
        assert foretold(PARTS[part], whole, before, after), f"{part}: {action} from {before} to {after}"


@pytest.mark.parametrize("d", range(DEVICES))
@pytest.mark.parametrize("part", PARTS)
def test_the_real_objects_go_where_the_parts_go(wholes: dict[str, Whole], part: str, d: int) -> None:
    found = tour(part, wholes[part], d, TOUR)
    assert found.taken > TOUR // 4


def test_a_stop_that_a_later_reset_would_undo_is_lost() -> None:
    """The promise looks at what the driver will be when it has heard all, not at whether a stop is among it."""
    state = first_of(begin("nobody owns anything"))
    device = state.devices[0]
    driver = Driver(inbox=((STOP, -1, ""), ("reset", -1, "")))
    broken = state._replace(
        node_stops=(True, False), devices=(device._replace(phase=UP, driver=(driver,)), *state.devices[1:])
    )
    with pytest.raises(Broken, match="a stop of a node is not lost"):
        check(broken)
