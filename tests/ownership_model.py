"""A model of who owns what and of what is stopped: clients, the daemon and two drivers, and the messages between them.

It says what each step of one process does to all that anybody could tell apart, step by step as the processes take
them: a message lies in its queue until its receiver takes it, and anybody may die in between. It is written from the
documents (docs/decisions/0012, 0140, 0152), not from the code; ``ownership_cell.Cell`` takes the same steps on the real
objects.

Not in it: time (leases and pauses run out as steps of their own), values, and what lies within one step of a process.

Pure.
"""

from __future__ import annotations

from collections.abc import Iterator
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


class Broken(AssertionError):
    """A promise does not hold."""


class Step:
    """One step from a state: a state that can be written, and what the one who acted was answered.

    Attributes:
        answer: "" when there is none to wait for or it comes later, "done" or "refused".
    """

    def __init__(self, state: State) -> None:
        self.answer = ""
        self.daemon, self.stopped, self.request, self.guest = (
            state.daemon, state.stopped, state.request, state.guest,
        )  # fmt: skip
        self.node_stops = list(state.node_stops)
        self.clients = list(state.clients)
        self.waiting = list(state.waiting)
        self.devices = list(state.devices)

    def state(self) -> State:
        """Return the state as it is now."""
        return State(
            self.daemon, self.stopped, tuple(self.node_stops), self.request, self.guest, tuple(self.clients),
            tuple(self.waiting), tuple(self.devices),
        )  # fmt: skip

    # --- small things ----------------------------------------------------------------------------

    def _driver(self, d: int) -> Driver | None:
        return self.devices[d].driver[0] if self.devices[d].driver else None

    def _set(self, d: int, **changes: object) -> None:
        self.devices[d] = self.devices[d]._replace(**changes)

    def _drive(self, d: int, **changes: object) -> None:
        (driver,) = self.devices[d].driver
        self._set(d, driver=(driver._replace(**changes),))

    def _send(self, d: int, verb: str, client: int = -1, mark: str = "") -> bool:
        """Put a message into a driver's inbox; return whether there is anybody to take it."""
        driver = self._driver(d)
        if driver is None or not driver.alive:
            return False
        if verb != DETACH or DETACH not in [message[0] for message in driver.inbox]:
            self._drive(d, inbox=(*driver.inbox, (verb, client, mark)))
        return True

    def _may_write(self, c: int) -> bool:
        return c != GUEST or self.guest

    # --- clients, and what the daemon does at once when it serves them ---------------------------------

    def connect(self, c: int) -> None:
        self.clients[c] = (IN, "")

    def open(self, c: int, d: int) -> None:
        if not self._may_write(c):
            self.answer = "refused"
        elif self.devices[d].claim or self.devices[d].phase != UP:
            self.waiting.append((c, d))
        else:
            self._grant(c, d)

    def _grant(self, c: int, d: int) -> None:
        granted = self._may_write(c) and self._send(d, ATTACH, c, "dead" if self.clients[c][0] == DEAD else "")
        self.answer = "done" if granted else "refused"
        if granted:
            self._set(d, claim=(c, OPEN))
        self._tell(c)

    def _tell(self, c: int) -> None:
        """Answer a client: the session of one that has died ends with that."""
        if self.clients[c][0] == DEAD:
            self._end_session(c)

    def _retry(self) -> None:
        answer = self.answer
        for c, d in list(self.waiting):
            if (c, d) in self.waiting and not self.devices[d].claim and self.devices[d].phase == UP:
                self.waiting.remove((c, d))
                self._grant(c, d)
        self.answer = answer

    def give_up(self, c: int, d: int) -> None:
        self.waiting.remove((c, d))

    def close(self, c: int, d: int) -> None:
        if self.devices[d].phase == UP:
            self._send(d, DETACH)
            self._set(d, claim=(c, CLOSING))
            return
        self.answer = "done"
        self._set(d, claim=(c, OPEN))
        self._free(d)
        self._retry()

    def stop(self, c: int) -> None:
        self._hear_request()
        self.stopped = True
        self.answer = "done"

    def reset(self, c: int) -> None:
        if not self._may_write(c) or self._hear_request() == 1:
            self.answer = "refused"
            return
        self.answer = "done"
        self.stopped, self.node_stops = False, [False] * DEVICES
        for d in range(DEVICES):
            if self._driver(d) is not None:
                inbox = [(VOID if v in (STOP, RESET) else v, n, m) for v, n, m in self.devices[d].driver[0].inbox]
                self._drive(d, missed=True, asked=False, inbox=tuple(inbox))
            elif self.devices[d].phase == FAULT:
                self.start(d)

    def _hear_request(self) -> int:
        request, self.request = self.request, 0
        self.stopped = self.stopped or request > 0
        return request

    def stop_node(self, c: int, d: int) -> None:
        self.node_stops[d] = True
        self.answer = "done"
        if self.devices[d].phase in (STARTING, UP, ENDING) and not self._send(d, STOP):
            self.answer = "refused"  # it holds; but the driver, which has just died, could not be told

    def reset_node(self, c: int, d: int) -> None:
        there = self.devices[d].phase in (STARTING, UP, ENDING)
        if self._may_write(c) and self.devices[d].phase == FAULT:
            self.answer = "done"  # another try, for the device; what is stopped stays so
            self.start(d)
            return
        if not self._may_write(c) or self.stopped or (there and not self._send(d, RESET)):
            self.answer = "refused"
            return
        self.node_stops[d] = False
        self.answer = "done"

    def request_stop(self, c: int) -> None:
        self.request = 1
        for d in range(DEVICES):
            if self._driver(d) is not None:
                self._drive(d, asked=True)

    def suspend(self, c: int) -> None:
        for d in range(DEVICES):
            if self.devices[d].claim == (c, OPEN) and self.devices[d].phase == UP:
                self._send(d, DETACH)
                self._set(d, claim=(c, TOLD))

    def die(self, c: int, words: int) -> None:
        if self.clients[c][0] == IN:
            self.clients[c] = (DEAD, LAST_WORDS[words])
        for d in range(DEVICES):
            driver = self._driver(d)
            if driver is None:
                continue
            inbox = tuple((v, n, "dead" if v == ATTACH and n == c else m) for v, n, m in driver.inbox)
            handle = (c, "dead") if driver.handle[:1] == (c,) else driver.handle
            self._drive(d, inbox=inbox, handle=handle)

    # --- clients and the driver, without the daemon ---------------------------------------------------

    def move(self, c: int, d: int) -> None:
        if self._serve(c, d):
            driver = self.devices[d].driver[0]
            refused = driver.stopped or driver.node_stop
            self.answer = "refused" if refused else "done"
            self._drive(d, moves=not refused)

    def stop_by_handle(self, c: int, d: int) -> None:
        if self._serve(c, d):
            self.answer = "done"
            self.node_stops[d] = True
            self._drive(d, node_stop=True, moves=False)

    def reset_by_handle(self, c: int, d: int) -> None:
        if self._serve(c, d):
            if self.devices[d].driver[0].stopped:
                self.answer = "refused"
                return
            self.answer = "done"
            self.node_stops[d] = False
            self._drive(d, node_stop=False)

    def _serve(self, c: int, d: int) -> bool:
        """Heed what was said before; return whether the handle is still there."""
        self.tick(d)
        return self.devices[d].driver[0].handle == (c, "")

    # --- drivers ---------------------------------------------------------------------------------

    def hear(self, d: int) -> None:
        driver = self.devices[d].driver[0]
        self._drive(d, inbox=())
        self._obey(d, driver.inbox)
        if driver.cut:
            self._end_driver(d)
        self._heed(d)

    def _obey(self, d: int, messages: tuple[tuple[str, int, str], ...]) -> None:
        for verb, client, mark in messages:
            if verb in (STOP, RESET):
                self._heed(d)
            match verb:
                case "attach":
                    self._drive(d, handle=(client, mark))
                case "detach":
                    self._let_go(d)
                case "end":
                    self._end_driver(d)
                case "stop":
                    self._drive(d, node_stop=True, moves=False)
                case "reset":
                    if not self.devices[d].driver[0].stopped:
                        self._drive(d, node_stop=False)

    def tick(self, d: int) -> None:
        """Heed orders, which overtake all else that is in the inbox, and what is said in pages."""
        inbox = self.devices[d].driver[0].inbox
        self._drive(d, inbox=tuple(message for message in inbox if message[0] not in ORDERS))
        self._obey(d, tuple(message for message in inbox if message[0] in ORDERS))
        self._heed(d)

    def _heed(self, d: int) -> None:
        driver = self.devices[d].driver[0]
        if driver.asked:
            self.stopped = True
            self.request = 2 if self.request else 0
        if driver.missed or (self.stopped and not driver.stopped):
            self._drive(d, moves=False)
        node_stop = driver.node_stop and (self.stopped or not (driver.stopped or driver.missed))
        self._drive(d, stopped=self.stopped, missed=False, asked=False, node_stop=node_stop)

    def _let_go(self, d: int) -> None:
        driver = self.devices[d].driver[0]
        said = (*driver.outbox, DETACHED) if DETACHED not in driver.outbox else driver.outbox
        self._drive(d, handle=NOBODY, moves=False, outbox=() if driver.cut else said)

    def _end_driver(self, d: int) -> None:
        if self.devices[d].driver[0].handle:
            self._let_go(d)
        self._drive(d, ending=True)

    def see_death(self, d: int, how: str) -> None:
        self._let_go(d)

    def expire(self, c: int, d: int) -> None:
        self.tick(d)
        if self.devices[d].driver[0].handle == (c, ""):
            self._let_go(d)

    def lapse(self, d: int) -> None:
        """See that the daemon has been silent for longer than its lease."""
        self.tick(d)
        if self.devices[d].driver[0].handle:
            self._let_go(d)

    def leave(self, d: int) -> None:
        self.tick(d)  # until its axes rest
        self.kill(d)

    def kill(self, d: int) -> None:
        if self.daemon:
            self._drive(d, alive=False, inbox=(), handle=NOBODY, moves=False)
        else:
            self._set(d, driver=())

    # --- the daemon ------------------------------------------------------------------------------

    def notice(self, c: int, how: str) -> None:
        """See that a client has died: by its socket, after its last words, or by its process."""
        words = self.clients[c][1] if how == "socket" else ""
        if words == "stop":
            self.stop(c)
        elif words:
            self.open(c, int(words[-1]))
        if self.clients[c][0] == DEAD:
            self._end_session(c)
        self.answer = ""

    def _end_session(self, c: int) -> None:
        self.clients[c] = (OUT, "")
        self.waiting = [wait for wait in self.waiting if wait[0] != c]
        for d in range(DEVICES):
            if _owns(self.devices[d], c):
                if self.devices[d].phase == UP:
                    self._send(d, DETACH)
                    self._set(d, claim=(c, ORPHAN))
                else:
                    self._free(d)
        self._retry()

    def _free(self, d: int) -> None:
        """Take a handle away; who closes it is answered."""
        claim, driver = self.devices[d].claim, self._driver(d)
        self._set(d, claim=NOBODY)
        if driver is not None:  # what is still said of it concerns nobody
            inbox = tuple(message for message in driver.inbox if message[0] != DETACH)
            self._drive(d, inbox=inbox, outbox=tuple(said for said in driver.outbox if said != DETACHED))
        if claim[1:] == (CLOSING,):
            self._tell(claim[0])

    def listen(self, d: int) -> None:
        driver = self.devices[d].driver[0]
        self._drive(d, outbox=())
        for said in driver.outbox:
            if said == READY and self.devices[d].phase == STARTING:
                self._set(d, phase=UP)
            elif said == DETACHED:
                self._free(d)
            self._retry()

    def bury(self, d: int, how: str) -> None:
        """See that a driver has died, after its last words."""
        self.listen(d)
        again = self.devices[d].phase == ENDING
        self._set(d, phase=PAUSING, driver=())
        self._free(d)
        self._retry()
        if again:
            self.start(d)

    def fail(self, d: int) -> None:
        """See that a driver has died too often."""
        self.bury(d, "process")
        self._set(d, phase=FAULT)

    def start(self, d: int) -> None:
        self._set(
            d, phase=STARTING, driver=(Driver(outbox=(READY,), node_stop=self.node_stops[d], stopped=self.stopped),)
        )

    def beat(self) -> None:
        self._hear_request()

    def replace(self, d: int) -> None:
        """Take up a configuration in which a device has changed."""
        if self.devices[d].phase in (PAUSING, FAULT):
            self.start(d)
        elif self.devices[d].phase in (STARTING, UP):
            self._send(d, END)
            self._set(d, phase=ENDING)

    def regrant(self) -> None:
        """Take up a configuration in which the guest's right to write has come or gone."""
        self.guest = not self.guest
        if self.guest:
            return
        for d in range(DEVICES):
            claim = self.devices[d].claim
            if claim[:1] == (GUEST,) and self.devices[d].phase == UP:
                self._send(d, DETACH)
                self._set(d, claim=(GUEST, TOLD if claim[1] == OPEN else claim[1]))
        for wait in [wait for wait in self.waiting if wait[0] == GUEST]:
            if wait in self.waiting:
                self.waiting.remove(wait)
                self._tell(GUEST)

    def crash(self) -> None:
        self.daemon = False
        self.clients = [(OUT, "")] * CLIENTS
        self.waiting = []
        for d in range(DEVICES):
            driver = self._driver(d)
            kept = (driver._replace(outbox=(), cut=True),) if driver is not None and driver.alive else ()
            self.devices[d] = Device(driver=kept)

    def boot(self) -> None:
        self.daemon, self.guest = True, True
        self._hear_request() if self.request == 1 else None
        self.request = 0
        for d in range(DEVICES):
            self.start(d)


def _owns(device: Device, c: int) -> bool:
    """Tell whether a client has a device open, and not only one that had its name before."""
    return device.claim[:1] == (c,) and device.claim[1] != ORPHAN


def follow(state: State, action: Action) -> tuple[State, str]:
    """Take a step; return the state after it, and what who acted was answered.

    Raises:
        Broken: a promise does not hold after it.
    """
    step = Step(state)
    getattr(step, str(action[0]))(*action[1:])
    after = step.state()
    if action[0] == "move" and step.answer == "done":
        promise(not after.stopped and not after.node_stops[int(action[2])], "what is stopped takes no motion")
    check(after)
    return after, step.answer


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


def _of_client(s: State, c: int, connected: bool) -> Iterator[Action]:
    holds = [d for d in range(DEVICES) if s.devices[d].driver and s.devices[d].driver[0].handle == (c, "")]
    if connected:
        for words in range(len(LAST_WORDS)):
            d = (words - 1) % DEVICES
            if words in (0, 3) or ((c, d) not in s.waiting and not _owns(s.devices[d], c)):
                yield ("die", c, words)
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
            mine = _owns(device, c)
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


# --- promises -------------------------------------------------------------------------------------


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
