"""The engine of a LineDriver: units on a line, asked in turn."""

from __future__ import annotations

import errno
import re
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from msgspec import Struct

from sioms.motion import DriveAction, DriveBank
from sioms.protocol.flags import PageState

from .blocks import AnyBlock, AxisBlock, BinaryBlock
from .connected import FIRST_PAUSE_NS, LONGEST_PAUSE_NS, Connected
from .driver import LineDriver, LineUnit
from .exchange import DeviceError, LinkError, Pause, StateLost, Steps, noting, while_wanted
from .handles import LATER, Handle
from .line import Done, Line, Priority
from .outputs import Change
from .parts import Parts

RETRY_S = 0.02
"""Pause before what must get through is sent again, where no poll does it."""
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
        self.mark = 0
        self.is_asked = False
        self.silent_ticks = self.usual_ticks = 0


class _Write(Struct, eq=False):
    """A client's write of outputs that is not done yet; one that a stop or a safe value has overtaken is void."""

    block: AnyBlock
    changes: Mapping[int, Change]
    is_void: bool = False


class LineEngine(Connected):
    """Runs a LineDriver: opens and polls its units in turn, and carries out actions and outputs."""

    def __init__(self, parts: Parts, driver: LineDriver, poll_hz: float) -> None:
        super().__init__(parts, driver, driver.gap_s, driver.recovery_s)
        self._driver = driver
        self._period_ns = int(1e9 / poll_hz)
        self._units = [_UnitState(unit) for unit in driver.units]
        self._by_block = {id(block): state for state in self._units for block in state.unit.blocks}
        self._writes: list[_Write] = []
        self._saving: set[int] = set()
        self._closed = False
        self.publishes = False

    def unsolicited(self) -> Any:
        """Return the driver's ear, if it has one."""
        return self._driver.overheard

    def connected(self, now_ns: int) -> None:
        """Open all units."""
        for state in self._units:
            state.is_up = state.busy = False
            state.due_ns = now_ns
            state.pause_ns = FIRST_PAUSE_NS

    def tick(self, now_ns: int) -> None:
        """Start the polls and opens that are due."""
        if self._closed or not self.connect(now_ns):
            return
        for state in self._units:
            if state.is_up and self._is_silent(state):
                error = LinkError(f"nothing for {state.unit.silence_s:g} s")
                self._lose_unit(state, self._told(state.unit, error), now_ns)
            if state.is_up:
                for block in state.unit.blocks:
                    self.commands_written(block)  # time and markers may have released commands
            if not state.busy and now_ns >= state.due_ns:
                self._start(state, now_ns)

    def _is_silent(self, state: _UnitState) -> bool:
        """Tell whether polls bring nothing, in ticks: time in which this process did not run is no silence."""
        state.silent_ticks += state.is_asked
        return state.silent_ticks > state.unit.silence_s * self.tick_hz + 2 * state.usual_ticks

    def _start(self, state: _UnitState, now_ns: int) -> None:
        line = self.line
        if line is None or self._closed:
            return
        state.busy = True
        for block in state.unit.blocks:
            if isinstance(block, AxisBlock):
                block.asked_ns = now_ns
        if state.is_up:
            state.due_ns = max(state.due_ns + self._period_ns, now_ns)
            steps, done = self._poll(state), self._polled
        else:
            steps, done = state.unit.open(), self._opened
        self.guarded(lambda: line.submit(steps, Priority.POLL, lambda v, e: done(state, v, e), now_ns), now_ns)

    def _poll(self, state: _UnitState) -> Steps:
        """Poll a unit, and note when that began: what it was told until then shows in the readings."""
        state.as_of_ns = self._loop.as_of_ns()
        state.mark = self._outputs.mark()
        state.is_asked = True
        yield from state.unit.poll()

    def _opened(self, state: _UnitState, _: Any, error: Exception | None) -> None:
        state.busy = False
        now_ns = self._loop.now_ns()
        if error is None:
            state.is_up, state.misses, state.due_ns = True, 0, now_ns
            state.is_asked, state.silent_ticks = False, 0
            state.fresh = True
            return
        kind = PageState.FAULT if isinstance(error, DeviceError) else PageState.LINK_LOST
        self._pages.set_link(state.unit.blocks, kind, self._told(state.unit, error))
        state.due_ns = now_ns + state.pause_ns
        state.pause_ns = min(max(2 * state.pause_ns, FIRST_PAUSE_NS), LONGEST_PAUSE_NS)

    def _polled(self, state: _UnitState, _: Any, error: Exception | None) -> None:
        state.busy = False
        now_ns = self._loop.now_ns()
        if not state.is_up:
            return  # it was silent for too long; whatever it says now, it is opened again
        if error is not None:
            state.misses += 1
            if isinstance(error, StateLost) and not state.fresh:
                state.pause_ns = 0
            if state.misses >= state.unit.misses or isinstance(error, StateLost):
                self._lose_unit(state, self._told(state.unit, error), now_ns)
            return
        state.misses, as_of_ns = 0, state.as_of_ns
        if not state.fresh:
            state.usual_ticks = state.silent_ticks
        state.is_asked, state.silent_ticks = False, 0
        if state.fresh:
            state.fresh = False
            # only now: a port that accepts and closes is not a device, nor is one that is opened and never read
            self._pause_ns = state.pause_ns = FIRST_PAUSE_NS
            self._pages.set_link(state.unit.blocks, PageState.GOOD, "")
            for block in state.unit.blocks:
                # who wrote them may have gone meanwhile
                self._stops.make_unowned_safe(block)
        for block in state.unit.blocks:
            if isinstance(block, AxisBlock):
                self._take_actions(state, block, now_ns)
            elif block.spec.writable:
                self._stops.look_at_outputs(block, state.mark)
        # the line is slower than the rate asked for: poll back to back, and publish while the request is on the line
        if state.due_ns <= now_ns and self.line is not None and not state.busy and self._loop.running:
            self._start(state, now_ns)
        for block in state.unit.blocks:
            self._pages.publish(block, block.stamp_ns or now_ns, self._loop.tick, as_of_ns)
        self._loop.after_publication(now_ns, state.unit.blocks)

    def _told(self, unit: LineUnit, error: Exception) -> str:
        """Return what failed of which unit, and what to check unless the driver has said so."""
        text, line = _named(unit, error), self._driver.line
        if not isinstance(error, LinkError) or "; check " in text:
            return text
        if line.serial is None:
            where = "what answers there" if error.heard else "the device, and who else is connected to it"
            return f"{text}; check {where}"
        if error.heard:
            return f"{text}; check wiring and speed ({line.speed}), and whether two devices have one address"
        return f"{text}; check power, wiring, address and speed ({line.speed})"

    def _lose_unit(self, state: _UnitState, reason: str, now_ns: int) -> None:
        state.is_up = False
        state.due_ns = now_ns + state.pause_ns
        state.pause_ns = min(max(2 * state.pause_ns, FIRST_PAUSE_NS), LONGEST_PAUSE_NS)
        self._stops.lose(state.unit.blocks, reason)

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
        now_ns = self._loop.now_ns()
        if error is None:
            bank.action_done(action, now_ns)
        else:
            bank.action_failed(action, _named(state.unit, error), now_ns)
            self._take_actions(state, block, now_ns)
            if self._closed and action.is_stop and self.line is not None:  # no poll has it sent again
                steps, done = _later(state.unit.act(action)), partial(self._acted, state, block, bank, action)
                self.guarded(partial(self.line.submit, steps, Priority.ACT, done, now_ns), now_ns)
        state.due_ns = min(state.due_ns, now_ns)  # look at once what it did

    def as_of_ns(self, block: AnyBlock, stamp_ns: int) -> int:
        """Return when the present poll of the block's unit began."""
        return self._by_block[id(block)].as_of_ns

    def write_outputs(self, handle: Handle, number: int, block: AnyBlock, changes: Mapping[int, Change]) -> Any:
        """Send the values; the client's answer comes when the device has confirmed them."""
        state, line, now_ns = self._by_block[id(block)], self.line, self._loop.now_ns()
        if line is None or not state.is_up:
            raise OSError(errno.EIO, f"write {block.spec.name}: {state.unit.name} does not answer")
        if handle.writes_under_way >= MAX_WRITES:
            raise OSError(
                errno.EAGAIN,
                f"write {handle.node}: {MAX_WRITES} writes wait for the line already; wait for their answers",
            )
        write = _Write(block, changes)
        self._writes.append(write)
        handle.writes_under_way += 1

        def done(_: Any, error: Exception | None) -> None:
            self._writes.remove(write)
            handle.writes_under_way -= 1
            if error is None:
                self._effects.note()
                self.acted(block)
                handle.answer(number, self._loop.tick)
            else:
                errno_ = error.errno if isinstance(error, DeviceError) else errno.EIO
                handle.refuse(number, errno_, f"write {handle.node}: {state.unit.name}: {error}")

        self.guarded(lambda: line.submit(self._write(state.unit, write), Priority.OUTPUT, done, now_ns), now_ns)
        return LATER

    def acted(self, block: AnyBlock) -> None:
        """Look at once what it did: who reads waits for the poll."""
        state = self._by_block[id(block)]
        state.due_ns = min(state.due_ns, self._loop.now_ns())

    def _write(self, unit: LineUnit, write: _Write) -> Steps:
        """Carry out a write of outputs, and no further once a stop or a safe value has overtaken it.

        What the port shall be is made up when its turn on the line has come: others may have written to it meanwhile.
        """
        outputs = self._outputs
        channels, values = outputs.merged(write.block, write.changes)
        steps = self._written(unit, write.block, channels, values)
        if not (yield from while_wanted(steps, lambda: not write.is_void)):
            raise DeviceError(errno.ECANCELED, "overtaken by a stop or a safe value")

    def _written(self, unit: LineUnit, block: AnyBlock, channels: Sequence[int], values: Sequence[float]) -> Steps:
        """Write outputs, and note that the device has them as soon as it says so: a stop may go out before this goes
        on.
        """
        note = partial(self._outputs.acknowledge, block, channels, values)
        steps = unit.write_outputs(block.spec, channels, values)
        yield from noting(steps, note) if isinstance(block, BinaryBlock) else steps
        note()

    def drop_writes(self, block: AnyBlock, masks: Mapping[int, int]) -> None:
        """Let no write go on that is on its way to these outputs: of each channel these bits, -1: all."""
        for write in self._writes:
            write.is_void |= write.block is block and any(
                change.mask & masks.get(channel, 0) for channel, change in write.changes.items()
            )

    def make_safe(self, block: AnyBlock) -> None:
        """Send the safe values that are wanted, ahead of everything but other stops; one message of each block is on
        its way.
        """
        wanted = self._outputs.unsent(block)
        for write in self._writes:
            write.is_void |= write.block is block and any(
                change.contradicts(wanted[channel]) for channel, change in write.changes.items() if channel in wanted
            )
        state, line, now_ns = self._by_block[id(block)], self.line, self._loop.now_ns()
        if not wanted or line is None or not state.is_up or id(block) in self._saving:
            return
        self._saving.add(id(block))
        self.guarded(partial(self._send_safe, line, state.unit, block, 0.0, now_ns), now_ns)

    def _send_safe(self, line: Line, unit: LineUnit, block: AnyBlock, pause_s: float, now_ns: int) -> None:
        priority = Priority.ACT if pause_s else Priority.STOP
        line.submit(self._safe(unit, block, pause_s), priority, partial(self._saved, line, unit, block), now_ns)

    def _safe(self, unit: LineUnit, block: AnyBlock, pause_s: float) -> Steps:
        if pause_s:
            yield Pause(pause_s)
        outputs = self._outputs
        channels, values = outputs.merged(block, outputs.unsent(block))
        if channels:
            yield from self._written(unit, block, channels, values)

    def _saved(self, line: Line, unit: LineUnit, block: AnyBlock, _: Any, error: Exception | None) -> None:
        self._saving.discard(id(block))
        if error is not None:
            self._stops.tell_unsafe(block, str(error))
        if line is not self.line:
            return
        if self._closed and error is not None:  # no poll comes any more: try for as long as the process lasts
            self._saving.add(id(block))
            now_ns = self._loop.now_ns()
            self.guarded(partial(self._send_safe, line, unit, block, RETRY_S, now_ns), now_ns)
        elif error is None:
            self._effects.note()
            self.acted(block)
            self.make_safe(block)  # something more may be wanted by now

    def commands_written(self, block: AnyBlock) -> None:
        """Send at once what the bank has to send."""
        state, now_ns = self._by_block[id(block)], self._loop.now_ns()
        if isinstance(block, AxisBlock) and isinstance(block.bank, DriveBank) and state.is_up:
            block.bank.advance(now_ns)
            self._take_actions(state, block, now_ns)

    def stop(self, blocks: Sequence[AnyBlock]) -> None:
        """Send what the banks have been told: their stops overtake everything else on the line."""
        for block in blocks:
            self.commands_written(block)

    def is_quiet(self) -> bool:
        """Whether the line has nothing left to do."""
        return self.line is None or self.line.is_free

    def close(self) -> None:
        """Let every unit leave its device safe; the loop runs until it is quiet, so no poll begins any more."""
        self._closed = True
        line, now_ns = self.line, self._loop.now_ns()
        if line is None:
            return
        for state in self._units:
            if state.is_up:
                for block in state.unit.blocks:
                    if block.spec.writable:
                        self.make_safe(block)
                done: Done = lambda _value, _error: None  # noqa: E731
                self.guarded(partial(line.submit, state.unit.close(), Priority.ACT, done, now_ns), now_ns)


def _later(steps: Steps) -> Steps:
    """Carry out steps after a pause in which the line serves nobody else for long."""
    yield Pause(RETRY_S)
    yield from steps


def _named(unit: LineUnit, error: Exception) -> str:
    """Return an error with the name of the unit that it is about, once."""
    text = str(error)
    return text if re.search(rf"(?<!\w){re.escape(unit.name)}(?!\w)", text) else f"{unit.name}: {text}"
