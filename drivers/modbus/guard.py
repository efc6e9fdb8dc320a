"""Proves that a Modbus device is as its opening left it: its dead-man runs, and it was not off meanwhile. Pure.

A device that restarts answers again long before its link counts as lost: without its dead-man, with its limits and its
place as after switching on. So the opening sets the dead-man and reads it back, leaves a token in a register that
forgets at
power off, and the polls read both again. What is read otherwise is StateLost: the opening runs anew.

Concurrency: none; a :class:`Guard` belongs to one driver thread.
"""

from __future__ import annotations

import errno
import random
from collections.abc import Callable, Generator, Mapping
from typing import Any

from sioms.sdk.exchange import DeviceError, StateLost, Steps

from .regmap import Proof
from .unit import MappedUnit, Values

LOOK_NS = 250_000_000
"""How often the proofs are read; each time costs a message or two."""
TOLERANCE = 1e-6


class Guard:
    """The dead-man of one device, and the witnesses of its restarts.

    Args:
        mapped: the device and its map.
        timeout_s: of the dead-man that the driver sets [s]; 0: it sets none.
        log: takes a level and a sentence.
    """

    def __init__(
        self,
        mapped: MappedUnit,
        timeout_s: float = 0.0,
        log: Callable[[str, str], None] = lambda level, text: None,
    ) -> None:
        self._mapped, self._log = mapped, log
        self._quantities = {"timeout": timeout_s}
        rmap = mapped.rmap
        self._dead, self._restart = rmap.dead_man, rmap.restart
        self._sets = "watchdog" in rmap.commands and timeout_s > 0
        self._proofs = self._dead.proof if self._sets or "watchdog" not in rmap.commands else ()
        self._witnesses = [name for name in (self._restart.counter, self._restart.token) if name]
        self._missing: set[str] = set()
        self._said = False
        self._token: float | None = None
        self._counter: float | None = None
        self._due_ns = 0

    def clear(self) -> Steps:
        """End a dead-man that has acted where that cannot be read: the device refuses everything else until then."""
        if self._sets and self._dead.tripped is None and "watchdog_restart" in self._mapped.rmap.commands:
            yield from self._mapped.command("watchdog_restart")

    def open(self) -> Generator[Any, Any, bool]:
        """End a dead-man that has acted, set it, read it back, and leave a token; return whether the device was off
        meanwhile.

        Raises:
            DeviceError: EIO, the dead-man does not run as it was set.
        """
        was_off = yield from self._leave_token()
        was_off |= yield from self._look_at_counter()
        yield from self._clear_tripped()
        if self._sets:
            yield from self._mapped.command("watchdog", **self._quantities)
        if self._proofs:
            values = yield from self._read(*(proof.signal for proof in self._proofs))
            for proof in self._proofs:
                if wrong := self._fails(proof, values):
                    text = (
                        f"set the watchdog of {self._mapped.name}: {wrong}; its outputs would stay when the host dies"
                    )
                    raise DeviceError(errno.EIO, text)
        self._say_what_is_not_proved()
        self._due_ns = 0
        return was_off

    def _say_what_is_not_proved(self) -> None:
        """Tell once that nobody knows whether the device acts when the host dies."""
        if self._said or self._proofs or self._dead.by != "link":
            return
        self._said = True
        can_set = "watchdog" in self._mapped.rmap.commands
        why = "none is set (watchdog_s = 0)" if can_set else f"whether it is set cannot be read; {self._dead.note}"
        self._log("warning", f"{self._mapped.name}: its own watchdog: {why}")

    def look_soon(self) -> None:
        """Read the proofs in the next poll: something looks as if the device had restarted."""
        self._due_ns = 0

    def poll(self, now_ns: int) -> Steps:
        """Read the proofs again when it is time.

        Raises:
            StateLost: the dead-man does not run any more, has acted, or the device was off meanwhile.
        """
        if now_ns < self._due_ns:
            return
        self._due_ns = now_ns + LOOK_NS
        looks = [*self._proofs, *([self._dead.tripped] if self._dead.tripped else [])]
        names = [*(proof.signal for proof in looks), *self._witnesses]
        names = [name for name in names if name not in self._missing]
        values = (yield from self._read(*names)) if names else {}
        for proof in self._proofs:
            if wrong := self._fails(proof, values):
                raise StateLost(f"{self._mapped.name}: its watchdog is not as it was set: {wrong}")
        tripped = self._dead.tripped
        if tripped is not None and tripped.signal in values and not self._fails(tripped, values):
            raise StateLost(f"{self._mapped.name}: its own watchdog has acted")
        if wrong := self._restarted(values):
            raise StateLost(f"{self._mapped.name}: was switched off or restarted: {wrong}")

    # --- inside ----------------------------------------------------------------------------------

    def _read(self, *names: str) -> Generator[Any, Any, Values]:
        return (yield from self._mapped.read(self._mapped.plan(names)))

    def _reads(self, name: str) -> Generator[Any, Any, float | None]:
        """Return a signal that not every device of the family has, None where it is refused."""
        if name in self._missing:
            return None
        try:
            values = yield from self._read(name)
        except DeviceError as error:
            if error.errno not in (errno.ENXIO, errno.ENOTSUP, errno.EINVAL):
                raise
            self._missing.add(name)
            self._log("warning", f"{self._mapped.name}: has no {name}, so it proves nothing: {error}")
            return None
        return float(values[name])

    def _clear_tripped(self) -> Steps:
        """End a dead-man that says that it has acted."""
        tripped = self._dead.tripped
        value = None if tripped is None else (yield from self._reads(tripped.signal))
        if tripped is not None and value is not None and not self._fails(tripped, {tripped.signal: value}):
            self._log("warning", f"{self._mapped.name}: its own watchdog had acted; cleared")
            yield from self._mapped.command("watchdog_restart")

    def _look_at_counter(self) -> Generator[Any, Any, bool]:
        """Read the counter; return whether it has begun anew since it was read last."""
        if not self._restart.counter:
            return False
        before, self._counter = self._counter, (yield from self._reads(self._restart.counter))
        return before is not None and self._counter is not None and self._counter < before

    def _leave_token(self) -> Generator[Any, Any, bool]:
        """Write a fresh token; return whether the one before it had been forgotten."""
        name = self._restart.token
        if not name or (present := (yield from self._reads(name))) is None:
            return False
        forgotten = self._token is not None and present != self._token
        token = random.randint(self._restart.minimum, self._restart.maximum - 1)
        token += token >= present >= self._restart.minimum  # any but the present one
        yield from self._mapped.command("token", token=float(token))
        self._token = float(token)
        if (yield from self._read(name))[name] != token:
            self._missing.add(name)
            self._token = None
            self._log("warning", f"{self._mapped.name}: {name} does not keep what is written, so it proves nothing")
        return forgotten

    def _restarted(self, values: Mapping[str, Any]) -> str:
        """Return what tells that the device was off, '' when nothing does."""
        counter, token = values.get(self._restart.counter), values.get(self._restart.token)
        if counter is not None:
            if self._counter is not None and counter < self._counter:
                return f"{self._restart.counter} is {counter:g} after {self._counter:g}"
            self._counter = float(counter)
        if token is not None and self._token is not None and token != self._token:
            return f"{self._restart.token} is {token:g}; {self._token:g} was written"
        return ""

    def _fails(self, proof: Proof, values: Mapping[str, Any]) -> str:
        """Return what is wrong with a signal, '' when it reads as it should."""
        value = float(values[proof.signal])
        right = self._quantities[proof.source] if proof.source is not None else proof.equals
        if right is not None:
            # a time is set down to the next step of its register
            step = self._mapped.step(proof.signal) if proof.source is not None else 0.0
            wrong = not right - step - TOLERANCE <= value <= right + TOLERANCE
            return f"{proof.signal} is {value:g}; want {right:g}" if wrong else ""
        low = -float("inf") if proof.minimum is None else proof.minimum
        high = float("inf") if proof.maximum is None else proof.maximum
        return "" if low <= value <= high else f"{proof.signal} is {value:g}; want {low:g} to {high:g}"
