"""What holds in every state of the model of ownership."""

from __future__ import annotations

from ownership_state import (
    ATTACH,
    ENDING,
    FAULT,
    IN,
    OPEN,
    OUT,
    RESET,
    STOP,
    UP,
    Action,
    Driver,
    State,
)


class Broken(AssertionError):
    """A promise does not hold."""


def promise(holds: object, what: str) -> None:
    if not holds:
        raise Broken(what)


def _stays_stopped(driver: Driver) -> bool:
    """Tell whether a node is stopped once its driver has heard all that has been said, the workcell being reset."""
    orders = [verb for verb, *_ in driver.inbox if verb in (STOP, RESET)]
    return orders[-1] == STOP if orders else driver.node_stop and not (driver.stopped or driver.missed)


def check(s: State) -> None:
    """See that all promises hold in a state.

    Raises:
        Broken: one does not.
    """
    for d, device in enumerate(s.devices):
        for driver in device.driver:
            coming = [client for verb, client, _ in driver.inbox if verb == ATTACH]
            owners = {*driver.handle[:1], *coming}
            promise(len(owners) + len(coming) <= 2 and len(owners) <= 1, "an output has one owner")
            if device.phase == UP:
                promise(owners <= {*device.claim[:1]}, "who owns an output is known to the daemon")
            promise(not driver.moves or driver.handle, "what nobody owns does not move")
            promise(
                not driver.moves or (not driver.stopped and not driver.node_stop),
                "what is stopped does not move",
            )
            gone = not driver.alive or driver.ending
            promise(not s.node_stops[d] or s.stopped or gone or _stays_stopped(driver), "a stop of a node is not lost")
        promise(not device.claim or device.phase in (UP, ENDING), "nobody owns what is not there")
    for c, d in s.waiting:
        promise(s.clients[c][0] != OUT, "nobody waits who has gone")
        promise(s.devices[d].claim or s.devices[d].phase != UP, "what is free is granted")


def check_rest(s: State) -> None:
    """See that nothing is left of who has gone, when all has come to rest.

    Raises:
        Broken: something is.
    """
    for d, device in enumerate(s.devices):
        promise(device.phase in (UP, FAULT), "a device comes back")
        promise(device.phase == UP or not (device.claim or device.driver), "nothing is left of a device in fault")
        if device.phase == FAULT:
            continue
        (driver,) = device.driver
        promise(not device.claim or device.claim[1] == OPEN, "nothing is left of a handle that ends")
        promise(not device.claim or s.clients[device.claim[0]][0] == IN, "nothing is left of the dead")
        promise(driver.handle[:1] == device.claim[:1], "daemon and driver agree on who owns an output")
        promise((driver.stopped, driver.node_stop or s.stopped) == (s.stopped, s.node_stops[d] or s.stopped),
                 "daemon and driver agree on what is stopped")  # fmt: skip


def trace(came: dict[State, tuple[State, Action] | None], state: State) -> list[Action]:
    """Return the steps that lead to a state, up to names."""
    steps: list[Action] = []
    while (before := came[state]) is not None:
        state = before[0]
        steps.append(before[1])
    return steps[::-1]
