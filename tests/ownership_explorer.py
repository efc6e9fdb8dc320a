"""Goes through all states of ``ownership_model`` up to a depth, and takes every step between them on the real objects.

python tests/ownership_explorer.py --depth 6 --limit-s 600     # as far as that goes
"""

from __future__ import annotations

import argparse
import random
import sys
from collections import deque
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import NamedTuple

from ownership_cell import Cell, cells
from ownership_model import follow
from ownership_promises import Broken, check_rest, trace
from ownership_state import (
    CLIENTS,
    GUEST,
    Action,
    State,
    renamed,
)
from ownership_steps import BY_ITSELF, actions

BEGINNINGS: dict[str, list[Action]] = {
    "nobody owns anything": [],
    "two own, one waits": [("open", 0, 0), ("open", 1, 1), ("open", 2, 0)],
    "all moves": [("open", 0, 0), ("open", 2, 1), ("hear", 0), ("hear", 1), ("move", 0, 0), ("move", 2, 1)],
    "all is stopped": [("open", 0, 0), ("open", 1, 1), ("stop_node", 2, 1), ("stop", 2)],
}
"""Where exploring begins: steps after a start at which all have connected and come to rest."""


MOST_STEPS_TO_REST = 100


class Explored(NamedTuple):
    """How far it went: states, steps between them, depth to which they are complete, steps that the real objects
    took.
    """

    states: int
    steps: int
    depth: int
    taken: int


def begin(name: str) -> list[Action]:
    """Return the steps from nothing to a beginning."""
    state, way = State(), []

    def take(action: Action) -> None:
        nonlocal state
        state, _ = follow(state, action)
        way.append(action)

    take(("boot",))
    more = settle(state)[1]
    for action in [*more, *[("connect", c) for c in range(CLIENTS)], *BEGINNINGS[name]]:
        take(action)
    return way


def settle(state: State) -> tuple[State, list[Action]]:
    """Let all happen that happens by itself; return the rest state, and the way there."""
    way: list[Action] = []
    while step := next((a for a in actions(state) if a[0] in BY_ITSELF), None):
        state, _ = follow(state, step)
        way.append(step)
    return state, way


def first_of(way: Iterable[Action]) -> State:
    """Return where a way leads, names apart."""
    state = State()
    for action in way:
        state, _ = follow(state, action)
    return typical(state)


Graph = dict[State, list[tuple[Action, State, str]]]


def explore(way: Iterable[Action], depth: int, goes_on: Callable[[], bool] = lambda: True) -> tuple[Graph, State, int]:
    """Return all states up to a depth (each for those that differ by names) with the steps that leave them, and where
    it began.

    Raises:
        Broken: a promise does not hold; with the steps that lead there.
    """
    first = first_of(way)
    graph: Graph = {}
    came: dict[State, tuple[State, Action] | None] = {first: None}
    rests: set[State] = set()
    front, reached = [first], 0
    while front and reached < depth and goes_on():
        new: list[State] = []
        for state in front:
            steps = graph[state] = []
            for action in actions(state):
                after, answer = _after(state, action, came)
                steps.append((action, after, answer))
                alike = typical(after)
                if alike not in came:
                    _see_rest(alike, rests)
                    came[alike] = (state, action)
                    new.append(alike)
        front, reached = new, reached + 1
    return graph, first, reached


DEATHS = frozenset(["die", "kill", "crash"])
"""Ends of a client, of a driver, of the daemon."""


def explore_all(way: Iterable[Action], requests: int, deaths: int = 0) -> tuple[int, int]:
    """Go through all states that can come about with so many requests, deaths and other events, and so many deaths
    more, in whatever order they and what happens by itself come; return how many these are, and the steps between them.

    What happens by itself comes to rest without a request, so that there is an end.

    Raises:
        Broken: a promise does not hold; with the steps that lead there.
    """
    first = first_of(way)
    came: dict[State, tuple[State, Action] | None] = {first: None}
    fronts = {(used, died): list[State]() for used in range(requests + 1) for died in range(deaths + 1)}
    fronts[0, 0].append(first)
    done: dict[State, list[tuple[int, int]]] = {}
    rests: set[State] = set()
    count = 0
    for (used, died), front in sorted(fronts.items(), key=lambda item: (sum(item[0]), item[0])):
        while front:
            state = front.pop()
            before = done.setdefault(state, [])
            if any(u <= used and d <= died for u, d in before):
                continue  # it was reached with less
            before.append((used, died))
            for action in actions(state):
                cost = _cost(action, used, died, deaths)
                if cost[0] > requests:
                    continue
                after, _ = _after(state, action, came)
                count += 1
                alike = typical(after)
                if alike not in came:
                    _see_rest(alike, rests)
                    came[alike] = (state, action)
                if not any(u <= cost[0] and d <= cost[1] for u, d in done.get(alike, ())):
                    fronts[cost].append(alike)
    return len(done), count


def _cost(action: Action, used: int, died: int, deaths: int) -> tuple[int, int]:
    """Return how many events, and deaths beside them, there have been after an action."""
    if action[0] in BY_ITSELF:
        return used, died
    return (used, died + 1) if action[0] in DEATHS and died < deaths else (used + 1, died)


def _after(state: State, action: Action, came: dict[State, tuple[State, Action] | None]) -> tuple[State, str]:
    """Take a step; of a promise that it breaks, tell how one comes there."""
    try:
        return follow(state, action)
    except Broken as error:
        raise Broken(f"{error}, after {trace(came, state)} and then {action}") from None


def _see_rest(state: State, rests: set[State]) -> None:
    """See that nothing is left of who has gone when all comes to rest; ``rests``: states of which that is known."""
    passed = []
    while state not in rests and (step := next((a for a in actions(state) if a[0] in BY_ITSELF), None)):
        passed.append(state)
        if len(passed) > MOST_STEPS_TO_REST:
            raise Broken("all comes to rest")
        state, _ = follow(state, step)
    if state not in rests:
        check_rest(state)
    rests.update(passed, [state])


def follow_all(
    make: Callable[[], Cell], way: list[Action], graph: Graph, goes_on: Callable[[], bool] = lambda: True
) -> int:
    """Take every step of a graph on the real objects, in walks as long as possible; return how many that was.

    Raises:
        AssertionError: the real objects went elsewhere than the model.
    """
    left = {state: list(range(len(steps))) for state, steps in graph.items()}
    walk: Walk | None = None
    taken = 0
    while goes_on():
        if walk is None:
            walk = Walk(make(), way)
        route = _route(graph, left, typical(walk.state))
        if route is None:
            more = _way_back(graph, walk.state)
            if more:
                for action in more:
                    walk.take(action)
                continue
            taken += walk.length
            if walk.length == len(way):
                return taken
            walk = None
            continue
        for state, index in route:
            if index in left[state]:
                left[state].remove(index)
            walk.go(graph[state][index][0], state)
    return taken + (walk.length if walk else 0)


def _route(graph: Graph, left: dict[State, list[int]], start: State) -> list[tuple[State, int]] | None:
    """Return the shortest way to, and along, a step that has not been taken; None when there is none."""
    if start not in graph:
        return None
    came: dict[State, tuple[State, int] | None] = {start: None}
    queue = deque([start])
    while queue:
        state = queue.popleft()
        if left[state]:
            route = [(state, left[state][0])]
            while (before := came[state]) is not None:
                route.append(before)
                state = before[0]
            return route[::-1]
        for index, (_, after, _) in enumerate(graph[state]):
            alike = typical(after)
            if alike in graph and alike not in came:
                came[alike] = (state, index)
                queue.append(alike)
    return None


def _way_back(graph: Graph, state: State) -> list[Action]:
    """Return steps that happen by themselves and lead from outside of a graph into it; none when there are none."""
    steps: list[Action] = []
    while typical(state) not in graph:
        step = next((a for a in actions(state) if a[0] in BY_ITSELF), None)
        if step is None:
            return []
        steps.append(step)
        state, _ = follow(state, step)
    return steps


class Walk:
    """A walk of model and real objects together."""

    def __init__(self, cell: Cell, way: Iterable[Action]) -> None:
        self.cell, self.state, self.length = cell, State(), 0
        self.steps: list[Action] = []
        for action in way:
            self.take(action)

    def go(self, action: Action, alike: State) -> None:
        """Take the step that an action is in a state that differs from the present one by names only."""
        for clients, devices in ALIKE:
            if renamed(alike, clients, devices) == self.state:
                self.take(_named(action, clients, devices))
                return
        raise AssertionError("not alike")

    def take(self, action: Action) -> None:
        """Take a step on both sides and compare."""
        after, answer = follow(self.state, action)
        self.steps.append(action)
        self.length += 1
        try:
            told = self.cell.take(action)
            assert told == answer, f"answered {told!r}; want {answer!r}"
            seen = self.cell.view(after)
            assert seen == after, _difference(seen, after)
        except Exception as error:
            raise AssertionError(f"{error!r}; at the end of {self.steps[-40:]}") from error
        self.state = after


OFTEN = {"move": 8.0, "open": 2.0, "connect": 4.0, "crash": 0.2, "suspend": 0.5, "give_up": 0.5}
"""How likely some steps of a random walk are, against 1 for the others: so that something moves when others happen."""


def wander(make: Callable[[], Cell], steps: int, seed: int) -> int:
    """Take steps at random, from where nothing has happened yet; what happens by itself is favoured, so that all goes
    on.

    Returns:
        How many different steps that were, names apart.

    Raises:
        AssertionError: the real objects went elsewhere than the model, or a promise does not hold.
    """
    chance, walk, seen = random.Random(seed), Walk(make(), begin("nobody owns anything")), set()
    for _ in range(steps):
        choice = list(actions(walk.state))
        by_itself = [action for action in choice if action[0] in BY_ITSELF]
        kinds = sorted({str(a[0]) for a in (by_itself if by_itself and chance.random() < 0.5 else choice)})
        kind = chance.choices(kinds, [OFTEN.get(kind, 1.0) for kind in kinds])[0]
        action = chance.choice([action for action in choice if action[0] == kind])
        seen.add((typical(walk.state), kind))
        walk.take(action)
    return len(seen)


CLIENT_FIRST = frozenset(
    [
        "connect",
        "open",
        "give_up",
        "close",
        "stop",
        "reset",
        "stop_node",
        "reset_node",
        "request_stop",
        "suspend",
        "die",
        "move",
        "stop_by_handle",
        "reset_by_handle",
        "expire",
        "notice",
    ]
)
DEVICE_SECOND = frozenset(
    [
        "open",
        "give_up",
        "close",
        "stop_node",
        "reset_node",
        "move",
        "stop_by_handle",
        "reset_by_handle",
        "expire",
    ]
)
DEVICE_FIRST = frozenset(["hear", "tick", "see_death", "kill", "leave", "listen", "bury", "fail", "start", "replace"])


def _named(action: Action, clients: tuple[int, ...], devices: tuple[int, ...]) -> Action:
    name, *rest = action
    if name in CLIENT_FIRST:
        rest[0] = clients[int(rest[0])]
    if name in DEVICE_SECOND:
        rest[1] = devices[int(rest[1])]
    if name in DEVICE_FIRST:
        rest[0] = devices[int(rest[0])]
    if name == "die" and rest[1] in (1, 2):
        rest[1] = 1 + devices[int(rest[1]) - 1]
    return (name, *rest)


def _difference(seen: State, wanted: State) -> str:
    return "; ".join(f"{n} is {a}; want {b}" for n, a, b in zip(State._fields, seen, wanted, strict=True) if a != b)


def run(name: str, depth: int, goes_on: Callable[[], bool] = lambda: True) -> Explored:
    """Explore from a beginning to a depth, and take all steps on the real objects."""
    way = begin(name)
    graph, _, reached = explore(way, depth, goes_on)
    with cells() as make:
        taken = follow_all(make, way, graph, goes_on)
    return Explored(len(graph), sum(map(len, graph.values())), reached, taken)


# --- what is alike --------------------------------------------------------------------------------


ALIKE = [((*clients, GUEST), devices) for clients in ((0, 1), (1, 0)) for devices in ((0, 1), (1, 0))]


@lru_cache(maxsize=1 << 18)
def typical(s: State) -> State:
    """Return the one that stands for all states that differ from this one by names only."""
    return min(renamed(s, *names) for names in ALIKE)


def main(arguments: list[str]) -> int:
    """Explore, walk, and tell how far it went."""
    parser = argparse.ArgumentParser(description="Explore the protocol of ownership and stops on the real objects.")
    parser.add_argument("--model-depth", type=int, default=0, help="steps from each beginning, in the model only")
    parser.add_argument("--requests", type=int, default=0, help="how many in all, to the end, in the model only")
    parser.add_argument("--deaths", type=int, default=0, help="how many beside the requests")
    parser.add_argument("--beginning", type=int, help="one of them; default all")
    parser.add_argument("--depth", type=int, default=0, help="steps from each beginning, taken by the real objects")
    parser.add_argument("--walks", type=int, default=0, help="random walks of 400 steps")
    parser.add_argument("--seed", type=int, default=0, help="of the first walk")
    options = parser.parse_args(arguments)
    chosen = list(BEGINNINGS) if options.beginning is None else [list(BEGINNINGS)[options.beginning]]
    for name in chosen:
        if options.model_depth:
            graph, _, reached = explore(begin(name), options.model_depth)
            steps = sum(map(len, graph.values()))
            print(f"model, {name}: depth {reached}: {len(graph)} states, {steps} steps between them", flush=True)
        if options.requests:
            states, steps = explore_all(begin(name), options.requests, options.deaths)
            what = f"{options.requests} requests and {options.deaths} deaths"
            print(f"model, {name}: all of {what}: {states} states, {steps} steps", flush=True)
        if options.depth:
            found = run(name, options.depth)
            print(
                f"real, {name}: depth {found.depth}: {found.states} states, {found.steps} steps between them; "
                f"{found.taken} taken",
                flush=True,
            )
    with cells() as make:
        seeds = range(options.seed, options.seed + options.walks)
        different = sum(wander(make, 400, seed) for seed in seeds)
    print(f"real, at random: {400 * options.walks} steps, {different} different ones")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
