"""Parts of ``ownership_model`` that are small enough to be gone through to their end.

All that is promised is promised of one device at a time, and either of who owns it or of whether it is stopped. So two
parts of a state are looked at, of each device by itself: who owns it, with all clients, and what stops it, whoever the
client is. A part forgets the rest, and may do whatever the whole may do: each step of the whole is some steps of a
part, or none (``foretold``). What holds in all states of both parts therefore holds in all states of the whole, with
as many requests, deaths, restarts and reloads as may be, and as many devices.

A part is a state of the model with one device, in which what it forgets is as at the beginning; and its steps are those
of the model, so that nothing is said twice.

Pure.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Container, Iterator
from functools import lru_cache
from typing import NamedTuple, TypeAlias, TypeVar

from ownership_model import Step, taken
from ownership_promises import Broken, check, check_rest, trace
from ownership_state import (
    CLIENTS,
    DETACHED,
    END,
    ENDING,
    FAULT,
    GUEST,
    IN,
    LAST_WORDS,
    NOBODY,
    OPEN,
    ORDERS,
    OUT,
    RESET,
    STARTING,
    STOP,
    UP,
    Action,
    Device,
    Driver,
    State,
    renamed,
)
from ownership_steps import BY_ITSELF, actions

T = TypeVar("T", str, tuple[str, int, str])

Steps: TypeAlias = Iterator[tuple[Action, State]]
Whole: TypeAlias = dict[State, dict[State, Action]]
"""All states of a part, each with the states that can come next and a step that leads there."""

OF_STOPS = frozenset(
    ["stop", "reset", "stop_node", "reset_node", "stop_by_handle", "reset_by_handle", "request_stop", "beat", "tick"]
)
"""Steps that change nothing of who owns a device, unless they start it or end a motion."""
OF_OWNERS = frozenset(
    ["connect", "open", "give_up", "close", "suspend", "die", "notice", "see_death", "expire", "lapse", "regrant"]
)
"""Steps that change nothing of what stops a device, unless they end a motion."""
BRAKE, RESTART, ELSEWHERE = "brake", "restart", "elsewhere"
"""Steps of a part alone: a stop, or a lost handle, ends a motion; a reset has a device in fault start again; another
driver has heard a stop-request.
"""
LAST_IS_STOP = LAST_WORDS.index("stop")


class Part(NamedTuple):
    """What is looked at.

    Attributes:
        of: returns it, of a device of a state of the model.
        steps: returns what can come next, and where that leads.
        alike: returns the one that stands for all that differ by names only.
    """

    of: Callable[[State, int], State]
    steps: Callable[[State], Steps]
    alike: Callable[[State], State]


# --- who owns a device ------------------------------------------------------------------------------


def owners(s: State, d: int) -> State:
    """Return who owns a device, wants it, or has left it."""
    drivers = tuple(
        Driver(r.alive, _without(r.inbox, ORDERS), r.outbox, r.handle, r.moves, ending=r.ending, cut=r.cut)
        for r in s.devices[d].driver
    )
    clients = tuple((at, "open 0" if words == f"open {d}" else "") for at, words in s.clients)
    waiting = tuple((c, 0) for c, other in s.waiting if other == d)
    return State(s.daemon, False, (False,), 0, s.guest, clients, waiting, (s.devices[d]._replace(driver=drivers),))


def _without(messages: tuple[T, ...], verbs: Container[object]) -> tuple[T, ...]:
    return tuple(m for m in messages if (m if isinstance(m, str) else m[0]) not in verbs)


def owners_steps(s: State) -> Steps:
    """Return what may change who owns a device: all but stops, and what these bring about."""
    for action in actions(s):
        last_is_stop = action[0] == "die" and action[2] == LAST_IS_STOP
        if action[0] not in OF_STOPS and not last_is_stop and not _is_again(action):
            yield action, taken(s, action)[0]
    yield from _brakes(s)
    if s.devices[0].phase == FAULT:
        step = Step(s)
        step.start(0)
        yield (RESTART,), step.state()


def _is_again(action: Action) -> bool:
    """Tell whether a step does what another one does: a death is seen by a socket or by a process."""
    return action[0] in ("bury", "see_death") and action[2] == "process"


def _brakes(s: State) -> Steps:
    for driver in s.devices[0].driver:
        if driver.moves:
            device = s.devices[0]._replace(driver=(driver._replace(moves=False),))
            yield (BRAKE,), s._replace(devices=(device,))


@lru_cache(maxsize=1 << 19)
def owners_alike(s: State) -> State:
    """Return the one of two states that differ by the names of the clients who have all rights."""
    return min(s, renamed(s, (1, 0, GUEST), (0,)))


# --- what stops a device ----------------------------------------------------------------------------


def stops(s: State, d: int) -> State:
    """Return what stops a device, as if one client had it who may do everything."""
    phase, _, drivers = s.devices[d]
    held = (0, "") if phase != STARTING else NOBODY
    seen = tuple(
        r._replace(inbox=_folded(r), outbox=_without(r.outbox, (DETACHED,)), handle=held if r.alive else NOBODY)
        for r in drivers
    )
    claim = (0, OPEN) if phase in (UP, ENDING) else NOBODY
    clients = ((IN if s.daemon else OUT, ""),) * CLIENTS
    return State(s.daemon, s.stopped, (s.node_stops[d],), s.request, True, clients, (), (Device(phase, claim, seen),))


def _folded(driver: Driver) -> tuple[tuple[str, int, str], ...]:
    """Return a driver's inbox without handles, and with two orders at most that do what all of them do."""
    orders = [verb for verb, *_ in driver.inbox if verb in (STOP, RESET)]
    kept = [STOP, RESET] if STOP in orders and orders[-1] == RESET else orders[-1:]
    kept += [END] * any(verb == END for verb, *_ in driver.inbox)
    return tuple((verb, -1, "") for verb in kept)


def stops_steps(s: State) -> Steps:
    """Return what may change what stops a device: all but who comes and goes, and what another driver has heard."""
    for action in actions(s):
        if action[0] not in OF_OWNERS and action[1:2] not in ((1,), (2,)) and not _is_again(action):  # whoever asks
            yield action, stops(taken(s, action)[0], 0)
    yield from _brakes(s)
    if s.request == 1:
        yield (ELSEWHERE,), s._replace(stopped=True, request=2)


PARTS = {"owners": Part(owners, owners_steps, owners_alike), "stops": Part(stops, stops_steps, lambda s: s)}


def go_through(part: Part) -> Whole:
    """Go through all states of a part.

    Raises:
        Broken: a promise does not hold; with the steps that lead there.
    """
    first = part.alike(part.of(State(), 0))
    whole: Whole = {}
    came: dict[State, tuple[State, Action] | None] = {first: None}
    queue = deque([first])
    while queue:
        state = queue.popleft()
        nexts = whole[state] = {}
        rests = True
        try:
            for action, after in part.steps(state):
                rests = rests and action[0] not in BY_ITSELF
                alike = part.alike(after)
                nexts.setdefault(alike, action)
                if alike not in came:
                    came[alike] = (state, action)
                    check(alike)
                    queue.append(alike)
            if rests:
                check_rest(state)
        except Broken as error:
            raise Broken(f"{error}, after {trace(came, state)}") from None
    return whole


# --- the parts foretell the whole -------------------------------------------------------------------

MOST_AT_ONCE = 4
"""Steps of a part that one of the whole may be: who is answered after its death goes, and another gets what it had."""


def foretold(part: Part, whole: Whole, before: State, after: State) -> bool:
    """Tell whether a part can go, in a few steps or none, from one state to another, for each device."""
    ends = [(part.alike(part.of(before, d)), part.alike(part.of(after, d))) for d in range(len(before.devices))]
    return all(_leads(whole, start, end) for start, end in ends)


def _leads(whole: Whole, start: State, end: State) -> bool:
    front = {start}
    for _ in range(MOST_AT_ONCE):
        if end in front:
            return True
        front = front.union(*(whole[state] for state in front))
    return end in front
