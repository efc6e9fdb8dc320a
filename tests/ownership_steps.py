"""Which steps can come next in the model of ownership."""

from __future__ import annotations

from collections.abc import Iterator

from ownership_state import (
    DEAD,
    FAULT,
    IN,
    LAST_WORDS,
    OPEN,
    OUT,
    PAUSING,
    STARTING,
    TOLD,
    UP,
    Action,
    Device,
    State,
    owns,
)

BY_ITSELF = frozenset(
    ["notice", "listen", "bury", "start", "beat", "hear", "tick", "see_death", "leave", "boot"]
)  # fmt: skip
"""What happens by itself, if nobody asks for anything."""


def actions(s: State) -> Iterator[Action]:
    """Return all steps that can come next and change something, or are refused."""
    if not s.daemon and not any(device.driver for device in s.devices):
        yield ("boot",)
    for c, (at, _) in enumerate(s.clients):
        if s.daemon and at == OUT:
            yield ("connect", c)
        if at == DEAD:
            yield ("notice", c, "socket")
            yield ("notice", c, "process")
            continue
        yield from _of_client(s, c, at == IN)
    for d, device in enumerate(s.devices):
        yield from _of_driver(s, d, device)
    if s.daemon:
        yield ("crash",)
        yield ("regrant",)
        if s.request:
            yield ("beat",)


def _may_say(s: State, c: int, words: str) -> bool:
    """Tell whether a client may end with these words: it asks for what is there and what it has not asked for."""
    if not words.startswith("open"):
        return True
    d = int(words[-1])
    return d < len(s.devices) and (c, d) not in s.waiting and not owns(s.devices[d], c)


def _of_client(s: State, c: int, connected: bool) -> Iterator[Action]:
    holds = [d for d in range(len(s.devices)) if s.devices[d].driver and s.devices[d].driver[0].handle == (c, "")]
    if connected:
        yield from (("die", c, words) for words, said in enumerate(LAST_WORDS) if _may_say(s, c, said))
        if any(device.claim == (c, OPEN) and device.phase == UP for device in s.devices):
            yield ("suspend", c)
        if not s.stopped:
            yield ("stop", c)
        yield ("reset", c)
    elif holds:
        yield ("die", c, 0)
    if s.request != 1 and (connected or not s.daemon):
        yield ("request_stop", c)
    for d, device in enumerate(s.devices):
        if connected:
            mine = owns(device, c)
            if (c, d) in s.waiting:
                yield ("give_up", c, d)
            elif not mine:
                yield ("open", c, d)
            elif device.claim[1] in (OPEN, TOLD):
                yield ("close", c, d)
            if not s.node_stops[d]:
                yield ("stop_node", c, d)
            else:
                yield ("reset_node", c, d)
        if d in holds:
            if not device.driver[0].moves:
                yield ("move", c, d)
            if not s.node_stops[d]:
                yield ("stop_by_handle", c, d)
            else:
                yield ("reset_by_handle", c, d)
            yield ("expire", c, d)


def _of_driver(s: State, d: int, device: Device) -> Iterator[Action]:
    for driver in device.driver:
        if driver.outbox:
            yield ("listen", d)
        if not driver.alive:
            yield ("bury", d, "socket")
            yield ("bury", d, "process")
            if device.phase in (STARTING, UP):
                yield ("fail", d)
            continue
        yield ("kill", d)
        heeds = driver.missed or driver.asked or driver.stopped != s.stopped
        if driver.inbox or (driver.cut and not driver.ending):
            yield ("hear", d)
        if heeds:
            yield ("tick", d)
        if driver.handle[1:] == ("dead",):
            yield ("see_death", d, "socket")
            yield ("see_death", d, "process")
        if s.daemon and driver.handle and not driver.ending:
            yield ("lapse", d)
        if driver.ending:
            yield ("leave", d)
    if device.phase == PAUSING:
        yield ("start", d)
    if s.daemon and device.phase in (STARTING, UP, PAUSING, FAULT):
        yield ("replace", d)
