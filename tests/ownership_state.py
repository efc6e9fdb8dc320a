"""What a state of the model of ownership is made of: clients, devices as the daemon sees them, and their drivers."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

CLIENTS, DEVICES = 3, 2
GUEST = CLIENTS - 1
"""The client whose right to write comes and goes with reloads; the others have all rights."""
Action: TypeAlias = tuple[str | int, ...]
"""Name of a step, then its client, its device."""

OUT, IN, DEAD = "out", "in", "dead"
"""A client: without a session; with one; dead, and the daemon has not noticed."""
LAST_WORDS = ("", "open 0", "open 1", "stop")
"""What a dying client has sent, and the daemon has not read."""
ABSENT, STARTING, UP, ENDING, PAUSING, FAULT = "absent", "starting", "up", "ending", "pausing", "fault"
"""A device, as the daemon sees it; FAULT: its driver has died too often, and waits for a reset."""
OPEN, CLOSING, TOLD, ORPHAN = "open", "closing", "told", "orphan"
"""A handle, as the daemon sees it: its client closes it; its driver was told to end it; its session has ended."""
ATTACH, DETACH, END, STOP, RESET, VOID = "attach", "detach", "end", "stop", "reset", "void"
"""Messages to a driver; VOID: an order that a later reset of the workcell has overtaken."""
ORDERS = (STOP, RESET, VOID)
READY, DETACHED = "ready", "detached"
NOBODY: tuple[()] = ()
Held: TypeAlias = tuple[int, str] | tuple[()]


class Driver(NamedTuple):
    """A driver process.

    Attributes:
        alive: False: killed, and the daemon has not noticed.
        inbox, outbox: messages of the daemon to it, and from it to the daemon.
        handle: (client, "dead" when that has died unnoticed) or NOBODY.
        moves: whether what it owns moves on behalf of its client.
        node_stop, stopped: what it knows to be stopped.
        missed: the stop latch has been reset since it looked.
        asked: the stop-request file has changed since it looked.
        ending: it has been told to end, or has seen the daemon's end.
        cut: the daemon has died, which it will hear after all that is in its inbox.
    """

    alive: bool = True
    inbox: tuple[tuple[str, int, str], ...] = ()
    outbox: tuple[str, ...] = ()
    handle: Held = NOBODY
    moves: bool = False
    node_stop: bool = False
    stopped: bool = False
    missed: bool = False
    asked: bool = False
    ending: bool = False
    cut: bool = False


class Device(NamedTuple):
    """A device: its phase, the handle that owns it (client, state) or NOBODY, and its processes: at most one."""

    phase: str = ABSENT
    claim: Held = NOBODY
    driver: tuple[Driver, ...] = ()


class State(NamedTuple):
    """The whole workcell.

    Attributes:
        daemon: whether it lives.
        stopped, node_stops: what has been stopped and not been reset, as every answer said it.
        request: of the stop-request file: 0: none that the daemon does not know; 1: nobody has heard it; 2: a driver
            has.
        guest: whether GUEST may write.
        clients: each (OUT, IN or DEAD, last words).
        waiting: opens that wait, the oldest first.
    """

    daemon: bool = False
    stopped: bool = False
    node_stops: tuple[bool, ...] = (False,) * DEVICES
    request: int = 0
    guest: bool = True
    clients: tuple[tuple[str, str], ...] = ((OUT, ""),) * CLIENTS
    waiting: tuple[tuple[int, int], ...] = ()
    devices: tuple[Device, ...] = (Device(),) * DEVICES


def owns(device: Device, c: int) -> bool:
    """Tell whether a client has a device open, and not only one that had its name before."""
    return device.claim[:1] == (c,) and device.claim[1] != ORPHAN


def renamed(s: State, clients: tuple[int, ...], devices: tuple[int, ...]) -> State:
    """Return a state with clients and devices under other numbers."""

    def held(who: Held) -> Held:
        return (clients[who[0]], who[1]) if who else who

    def driver(of: Driver) -> Driver:
        inbox = tuple((v, clients[n] if n >= 0 else n, m) for v, n, m in of.inbox)
        return of._replace(inbox=inbox, handle=held(of.handle))

    new_clients, new_devices, stops = list(s.clients), list(s.devices), list(s.node_stops)
    for c, client in enumerate(s.clients):
        words = client[1]
        if words.startswith("open"):
            words = f"open {devices[int(words[-1])]}"
        new_clients[clients[c]] = (client[0], words)
    for d, device in enumerate(s.devices):
        stops[devices[d]] = s.node_stops[d]
        new_devices[devices[d]] = Device(device.phase, held(device.claim), tuple(map(driver, device.driver)))
    waiting = tuple((clients[c], devices[d]) for c, d in s.waiting)
    return s._replace(node_stops=tuple(stops), clients=tuple(new_clients), waiting=waiting, devices=tuple(new_devices))
