"""The engine of a LineDriver: units on a line, asked in turn."""

from __future__ import annotations

import errno
from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from sioms.motion import DriveAction, DriveBank
from sioms.protocol.flags import PageState

from .blocks import AnyBlock, AxisBlock
from .connected import FIRST_PAUSE_NS, LONGEST_PAUSE_NS, Connected
from .driver import LineDriver, LineUnit
from .exchange import DeviceError, LinkError, StateLost, Steps, while_wanted
from .handles import LATER, Handle
from .line import Done, Priority

if TYPE_CHECKING:
    from .runtime import Runtime

MAX_WRITES = 16
"""Writes of outputs that one handle may have waiting for the line."""


class _UnitState:
    """A unit on the line, and how it is doing."""

    def __init__(self, unit: LineUnit) -> None:
        self.unit = unit
        self.is_up = False
        self.busy = False
        self.misses = 0
        self.due_ns = 0
        self.pause_ns = FIRST_PAUSE_NS
        self.fresh = False
        self.as_of_ns = 0


class LineEngine(Connected):
    """Runs a LineDriver: opens and polls its units in turn, and carries out actions and outputs."""

    def __init__(self, runtime: Runtime, driver: LineDriver, poll_hz: float) -> None:
        super().__init__(runtime, driver, driver.gap_s, driver.recovery_s)
        self._driver = driver
        self._period_ns = int(1e9 / poll_hz)
        self._units = [_UnitState(unit) for unit in driver.units]
        self._by_block = {id(block): state for state in self._units for block in state.unit.blocks}
        self._voids: Counter[tuple[int, int]] = Counter()
        self._closed = False
        self.publishes = False

    def unsolicited(self) -> Any:
        """Return the driver's ear, if it has one."""
        return self._driver.overheard

    def connected(self, now_ns: int) -> None:
        """Open all units."""
        self._pause_ns = FIRST_PAUSE_NS
        for state in self._units:
            state.is_up = state.busy = False
            state.due_ns = now_ns
            state.pause_ns = FIRST_PAUSE_NS

    def tick(self, now_ns: int) -> None:
        """Start the polls and opens that are due."""
        if self._closed or not self.connect(now_ns):
            return
        for state in self._units:
            if state.is_up:
                for block in state.unit.blocks:
                    self.commands_written(block)  # time and markers may have released commands
            if not state.busy and now_ns >= state.due_ns:
                self._start(state, now_ns)

    def _start(self, state: _UnitState, now_ns: int) -> None:
        line = self.line
        if line is None or self._closed:
            return
        state.busy = True
        if state.is_up:
            state.due_ns = max(state.due_ns + self._period_ns, now_ns)
            steps, done = self._poll(state), self._polled
        else:
            steps, done = state.unit.open(), self._opened
        self.guarded(
            lambda: line.submit(steps, Priority.POLL, lambda v, e: done(state, v, e), now_ns), now_ns
        )

    def _poll(self, state: _UnitState) -> Steps:
        """Poll a unit, and note when that began: what it was told until then shows in the readings."""
        state.as_of_ns = self._runtime.as_of_ns()
        yield from state.unit.poll()

    def _opened(self, state: _UnitState, _: Any, error: Exception | None) -> None:
        state.busy = False
        now_ns = self._runtime.now_ns()
        if error is None:
            state.is_up, state.misses, state.due_ns = True, 0, now_ns
            state.pause_ns = FIRST_PAUSE_NS
            state.fresh = True
            return
        kind = PageState.FAULT if isinstance(error, DeviceError) else PageState.LINK_LOST
        self._runtime.set_link(state.unit.blocks, kind, self._told(state.unit, error))
        state.due_ns = now_ns + state.pause_ns
        state.pause_ns = min(max(2 * state.pause_ns, FIRST_PAUSE_NS), LONGEST_PAUSE_NS)

    def _polled(self, state: _UnitState, _: Any, error: Exception | None) -> None:
        state.busy = False
        now_ns = self._runtime.now_ns()
        if error is not None:
            state.misses += 1
            if isinstance(error, StateLost):
                state.pause_ns = 0
            if state.misses >= state.unit.misses or isinstance(error, StateLost):
                self._lose_unit(state, self._told(state.unit, error), now_ns)
            return
        state.misses, as_of_ns = 0, state.as_of_ns
        if state.fresh:
            state.fresh = False
            self._runtime.set_link(state.unit.blocks, PageState.GOOD, "")
            for block in state.unit.blocks:
                # who wrote them may have gone meanwhile
                self._runtime.stops.make_safe(block, self._unowned(block))
        for block in state.unit.blocks:
            if isinstance(block, AxisBlock):
                self._take_actions(state, block, now_ns)
        # the line is slower than the rate asked for: poll back to back, and publish while the request is on the line
        if state.due_ns <= now_ns and self.line is not None and not state.busy and self._runtime.running:
            self._start(state, now_ns)
        for block in state.unit.blocks:
            self._runtime.pages.publish(block, block.stamp_ns or now_ns, self._runtime.tick, as_of_ns)
        self._runtime.after_publication(now_ns, state.unit.blocks)

    def _told(self, unit: LineUnit, error: Exception) -> str:
        """Return what failed of which unit, and what to look at unless the driver has said so."""
        text, line = str(error), self._driver.line
        text = text if unit.name in text else f"{unit.name}: {text}"
        if not isinstance(error, LinkError) or "look at" in text:
            return text
        if line.serial is None:
            where = "what answers there" if error.heard else "the device, and who else is connected to it"
            return f"{text}; look at {where}"
        if error.heard:
            return (
                f"{text}; look at wiring and speed ({line.speed}), and whether two devices have one address"
            )
        return f"{text}; look at power, wiring, address and speed ({line.speed})"

    def _lose_unit(self, state: _UnitState, reason: str, now_ns: int) -> None:
        state.is_up = False
        state.due_ns = now_ns + state.pause_ns
        self._runtime.lose(state.unit.blocks, reason)

    def _take_actions(self, state: _UnitState, block: AxisBlock, now_ns: int) -> None:
        """Send what the bank wants sent, stops ahead of everything."""
        bank = block.bank
        if not isinstance(bank, DriveBank):
            return
        for action in bank.take_actions():
            line = self.line  # an action before this one may have lost it
            if line is None:
                bank.action_failed(action, "the line is down", now_ns)
                continue
            priority = Priority.STOP if action.is_stop else Priority.ACT
            done = partial(self._acted, state, block, bank, action)
            self.guarded(partial(line.submit, state.unit.act(action), priority, done, now_ns), now_ns)

    def _acted(
        self,
        state: _UnitState,
        block: AxisBlock,
        bank: DriveBank,
        action: DriveAction,
        _: Any,
        error: Exception | None,
    ) -> None:
        now_ns = self._runtime.now_ns()
        if error is None:
            bank.action_done(action, now_ns)
        else:
            bank.action_failed(action, f"{state.unit.name}: {error}", now_ns)
            self._take_actions(state, block, now_ns)
        state.due_ns = min(state.due_ns, now_ns)  # look at once what it did

    def as_of_ns(self, block: AnyBlock, stamp_ns: int) -> int:
        """Return when the present poll of the block's unit began."""
        return self._by_block[id(block)].as_of_ns

    def write_outputs(
        self,
        handle: Handle | None,
        number: int,
        block: AnyBlock,
        channels: Sequence[int],
        values: Sequence[float],
    ) -> Any:
        """Send the values; the client's answer comes when the device has confirmed them."""
        state, line, now_ns = self._by_block[id(block)], self.line, self._runtime.now_ns()
        if line is None or not state.is_up:
            raise OSError(errno.EIO, f"write {block.spec.name}: {state.unit.name} does not answer")
        if handle is not None and handle.writes_under_way >= MAX_WRITES:
            raise OSError(
                errno.EAGAIN,
                f"write {handle.node}: {MAX_WRITES} writes wait for the line already; wait for their answers",
            )
        outputs, wanted = (
            self._runtime.outputs,
            {(id(block), c): v for c, v in zip(channels, values, strict=True)},
        )
        steps = state.unit.write_outputs(block.spec, channels, values)
        if handle is None:
            self._voids.update(wanted.keys())
        else:
            steps = self._unless_void(steps, {key: self._voids[key] for key in wanted})
        if handle is not None:
            handle.writes_under_way += 1
        outputs.update(wanted)  # at once: writes of single bits begin from what is on its way already

        def done(_: Any, error: Exception | None) -> None:
            if handle is not None:
                handle.writes_under_way -= 1
            if error is not None:
                for key in [k for k, v in wanted.items() if outputs.get(k) == v]:
                    del outputs[key]  # what it is now, the device tells
            if handle is None:
                if error is not None:
                    self._runtime.log("error", f"{state.unit.name}: safe outputs could not be set: {error}")
            elif error is None:
                self._runtime.effects.note()
                self.acted(block)
                handle.answer(number, self._runtime.tick)
            else:
                errno_ = error.errno if isinstance(error, DeviceError) else errno.EIO
                handle.refuse(number, errno_, f"write {handle.node}: {state.unit.name}: {error}")

        priority = Priority.STOP if handle is None else Priority.OUTPUT
        self.guarded(lambda: line.submit(steps, priority, done, now_ns), now_ns)
        return LATER

    def acted(self, block: AnyBlock) -> None:
        """Look at once what it did: who reads waits for the poll."""
        state = self._by_block[id(block)]
        state.due_ns = min(state.due_ns, self._runtime.now_ns())

    def commands_written(self, block: AnyBlock) -> None:
        """Send at once what the bank has to send."""
        state, now_ns = self._by_block[id(block)], self._runtime.now_ns()
        if isinstance(block, AxisBlock) and isinstance(block.bank, DriveBank) and state.is_up:
            block.bank.advance(now_ns)
            self._take_actions(state, block, now_ns)

    def _unless_void(self, steps: Steps, marks: dict[tuple[int, int], int]) -> Steps:
        """Carry out a write of outputs, and no further once a stop or a safe value has overtaken it."""
        done = yield from while_wanted(
            steps, lambda: all(self._voids[key] == mark for key, mark in marks.items())
        )
        if not done:
            raise DeviceError(errno.ECANCELED, "overtaken by a stop or a safe value")

    def _unowned(self, block: AnyBlock) -> list[int]:
        """Return the channels whose outputs no client holds; a stopped workcell holds none."""
        holders = [] if self._runtime.stops.stopped else self._runtime.clients.handles.values()
        held = {int(c) for h in holders if h.exclusive and h.block is block for c in h.channels}
        return [c for c in range(block.n) if c not in held]

    def stop(self, blocks: Sequence[AnyBlock]) -> None:
        """Send what the banks have been told: their stops overtake everything else on the line."""
        for block in blocks:
            self._voids.update((id(block), c) for c in range(block.n))
            self.commands_written(block)

    def is_quiet(self) -> bool:
        """Whether the line has nothing left to do."""
        return self.line is None or self.line.is_free

    def close(self) -> None:
        """Let every unit leave its device safe; the runtime runs the loop until it is quiet, so no poll begins any more."""
        self._closed = True
        line, now_ns = self.line, self._runtime.now_ns()
        if line is None:
            return
        for state in self._units:
            if state.is_up:
                done: Done = lambda _value, _error: None  # noqa: E731
                self.guarded(partial(line.submit, state.unit.close(), Priority.ACT, done, now_ns), now_ns)
