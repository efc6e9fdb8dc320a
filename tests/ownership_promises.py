"""What holds in every state of the model of ownership."""

from __future__ import annotations

from ownership_state import (
    ATTACH,
    ENDING,
    OUT,
    STOP,
    UP,
    State,
)


class Broken(AssertionError):
    """A promise does not hold."""


def promise(holds: object, what: str) -> None:
    if not holds:
        raise Broken(what)


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
            held = driver.node_stop or driver.stopped or STOP in [m[0] for m in driver.inbox] or s.stopped
            promise(not s.node_stops[d] or not driver.alive or driver.ending or held,
                     "a stop of a node is not lost")  # fmt: skip
        promise(not device.claim or device.phase in (UP, ENDING), "nobody owns what is not there")
    for c, d in s.waiting:
        promise(s.clients[c][0] != OUT, "nobody waits who has gone")
        promise(s.devices[d].claim or s.devices[d].phase != UP, "what is free is granted")
