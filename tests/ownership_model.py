"""A model of who owns what and of what is stopped: clients, the daemon and two drivers, and the messages between them.

It says what each step of one process does to all that anybody could tell apart, step by step as the processes take
them: a message lies in its queue until its receiver takes it, and anybody may die in between. It is written from the
documents (docs/decisions/0012, 0140, 0152), not from the code; ``ownership_cell.Cell`` takes the same steps on the real
objects.

Not in it: time (leases and pauses run out as steps of their own), values, and what lies within one step of a process.

Pure.
"""

from __future__ import annotations

from ownership_promises import check, promise
from ownership_state import (
    ATTACH,
    CLIENTS,
    CLOSING,
    DEAD,
    DETACH,
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
    ORPHAN,
    OUT,
    PAUSING,
    READY,
    RESET,
    STARTING,
    STOP,
    TOLD,
    UP,
    VOID,
    Action,
    Device,
    Driver,
    State,
    owns,
)


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
        if not self._may_write(c):
            self.answer = "refused"
            return
        for d in range(len(self.devices)):
            self._listen_first(d)
        if self._hear_request() == 1:
            self.answer = "refused"
            return
        self.answer = "done"
        self.stopped, self.node_stops = False, [False] * len(self.devices)
        for d in range(len(self.devices)):
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

    def _listen_first(self, d: int) -> None:
        """Who judges a reset hears first what drivers have told: of faults, which are not in the model."""
        if self._driver(d) is not None and self.devices[d].phase != ENDING:
            self.listen(d)

    def reset_node(self, c: int, d: int) -> None:
        if self._may_write(c):
            self._listen_first(d)
        there = self.devices[d].phase in (STARTING, UP, ENDING)
        if self._may_write(c) and self.devices[d].phase == FAULT:
            self.answer = "done"  # another try, for the device; what is stopped stays so
            self.start(d)
            return
        if self._may_write(c):
            self._hear_request()
        if not self._may_write(c) or self.stopped or (there and not self._send(d, RESET)):
            self.answer = "refused"
            return
        self.node_stops[d] = False
        self.answer = "done"

    def request_stop(self, c: int) -> None:
        self.request = 1
        for d in range(len(self.devices)):
            if self._driver(d) is not None:
                self._drive(d, asked=True)

    def suspend(self, c: int) -> None:
        for d in range(len(self.devices)):
            if self.devices[d].claim == (c, OPEN) and self.devices[d].phase == UP:
                self._send(d, DETACH)
                self._set(d, claim=(c, TOLD))

    def die(self, c: int, words: int) -> None:
        if self.clients[c][0] == IN:
            self.clients[c] = (DEAD, LAST_WORDS[words])
        for d in range(len(self.devices)):
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
        for d in range(len(self.devices)):
            if owns(self.devices[d], c):
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
            d, phase=STARTING, driver=(Driver(outbox=(READY,), node_stop=self.node_stops[d], asked=self.request > 0),)
        )
        self._heed(d)

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
        for d in range(len(self.devices)):
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
        for d in range(len(self.devices)):
            driver = self._driver(d)
            kept = (driver._replace(outbox=(), cut=True),) if driver is not None and driver.alive else ()
            self.devices[d] = Device(driver=kept)

    def boot(self) -> None:
        self.daemon, self.guest = True, True
        self._hear_request() if self.request == 1 else None
        self.request = 0
        for d in range(len(self.devices)):
            self.start(d)


def follow(state: State, action: Action) -> tuple[State, str]:
    """Take a step; return the state after it, and what who acted was answered.

    Raises:
        Broken: a promise does not hold after it.
    """
    after, answer = taken(state, action)
    check(after)
    return after, answer


def taken(state: State, action: Action) -> tuple[State, str]:
    """Take a step, and look at no more than what it takes."""
    step = Step(state)
    getattr(step, str(action[0]))(*action[1:])
    after = step.state()
    if action[0] == "move" and step.answer == "done":
        promise(not after.stopped and not after.node_stops[int(action[2])], "what is stopped takes no motion")
    return after, step.answer
