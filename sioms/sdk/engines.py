"""Engines: what a tick of the driver process does for each of the three kinds of driver."""

from __future__ import annotations

import errno
from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

from sioms.motion import DriveAction, DriveBank
from sioms.protocol.flags import PageState

from .blocks import AnyBlock, AxisBlock
from .connection import Connection
from .driver import LineDriver, LineUnit, Refusal, StreamDriver, TickDriver
from .exchange import DeviceError, LinkError, Steps
from .handles import LATER, Handle
from .line import Counters, Done, Line, Priority
from .side_connection import SideConnection

if TYPE_CHECKING:
    from .runtime import Runtime

HOUSEKEEPING_HZ = 200.0
FIRST_PAUSE_NS = 250_000_000
MAX_WRITES = 16
"""Writes of outputs that one handle may have waiting for the line."""
LONGEST_PAUSE_NS = 4_000_000_000


class Engine(Protocol):
    """What the runtime needs of an engine."""

    tick_hz: float

    def tick(self, now_ns: int) -> None:
        """Do the work of one tick and publish."""

    def write_outputs(
        self,
        handle: Handle | None,
        number: int,
        block: AnyBlock,
        channels: Sequence[int],
        values: Sequence[float],
    ) -> Any:
        """Set outputs for a client (handle) or for safety (None)."""

    def carry_out(self, handle: Handle, number: int, steps: Steps, what: str) -> Any:
        """Run the steps that answer a client's request."""

    def commands_written(self, block: AnyBlock) -> None:
        """A bank's buffers have changed between two ticks."""

    def stop(self, blocks: Sequence[AnyBlock]) -> None:
        """Stop the motion of blocks as fast as the device can (the banks have been told already)."""

    def recover(self, reason: str) -> None:
        """Give up what is under way, so that stops can go out: a hook has raised what it should not have."""

    def is_quiet(self) -> bool:
        """Whether everything that was asked of the device has been done."""

    def close(self) -> None:
        """Leave the device safe."""


class TickEngine:
    """Runs a TickDriver."""

    def __init__(self, runtime: Runtime, driver: TickDriver, tick_hz: float) -> None:
        self.tick_hz = tick_hz
        self._runtime = runtime
        self._driver = driver
        self._is_open = False
        self._retry_ns = 0
        self._pause_ns = FIRST_PAUSE_NS

    def tick(self, now_ns: int) -> None:
        """Tick the driver and publish all blocks."""
        if not self._is_open and not self._open(now_ns):
            return
        self._driver.tick(now_ns)

    def _open(self, now_ns: int) -> bool:
        if now_ns < self._retry_ns:
            return False
        try:
            self._driver.open()
        except (LinkError, OSError) as error:
            self._runtime.set_link(self._driver.blocks, PageState.LINK_LOST, str(error))
            self._retry_ns = now_ns + self._pause_ns
            self._pause_ns = min(2 * self._pause_ns, LONGEST_PAUSE_NS)
            return False
        self._is_open = True
        self._runtime.set_link(self._driver.blocks, PageState.GOOD, "")
        return True

    @property
    def publishes(self) -> bool:
        """Whether there are readings to publish."""
        return self._is_open

    def write_outputs(
        self,
        handle: Handle | None,
        number: int,
        block: AnyBlock,
        channels: Sequence[int],
        values: Sequence[float],
    ) -> Any:
        """Hand the values to the driver; they take effect in the next tick."""
        try:
            self._driver.write_outputs(block.spec, channels, values)
        except Refusal as error:
            raise OSError(error.errno, str(error)) from None
        for channel, value in zip(channels, values, strict=True):
            self._runtime.outputs[(id(block), channel)] = value
        return self._runtime.tick

    def carry_out(self, handle: Handle, number: int, steps: Steps, what: str) -> Any:
        """Refuse: a driver without a line has none to send steps on."""
        raise TypeError(f"{what}: {type(self._driver).__name__} has no line for steps")

    def slack(self, now_ns: int, until_ns: int) -> None:
        """Let the driver use the time that is left."""
        self._driver.slack(now_ns, until_ns)

    def commands_written(self, block: AnyBlock) -> None:
        """Nothing: the next tick sees it."""

    def stop(self, blocks: Sequence[AnyBlock]) -> None:
        """Nothing: the banks command the device in the next tick."""

    def recover(self, reason: str) -> None:
        """Nothing is under way between two ticks."""

    def is_quiet(self) -> bool:
        """A tick is all there is."""
        return True

    def close(self) -> None:
        """Leave the device safe."""
        if self._is_open:
            self._driver.close()


class _Connected:
    """What line and stream drivers share: a connection that is opened again after every loss."""

    tick_hz = HOUSEKEEPING_HZ

    def __init__(
        self, runtime: Runtime, driver: LineDriver | StreamDriver, gap_s: float, recovery_s: float
    ) -> None:
        self.counters = Counters()
        self.line: Line | None = None
        self._runtime = runtime
        self._base = driver
        self._gap_s = gap_s
        self._recovery_s = recovery_s
        self._connecting: Connection | None = None
        self._retry_ns = 0
        self._pause_ns = FIRST_PAUSE_NS
        runtime.line_due = self._line_due

    def connect(self, now_ns: int) -> bool:
        """Get the line up, a little at every tick; return whether it is."""
        if self.line is not None:
            return True
        try:
            if self._connecting is None:
                if now_ns < self._retry_ns:
                    return False
                self._connecting = Connection(self._base.line, self._count_stranger)
                self._limit_ns = now_ns + int(self._base.line.connect_timeout_s * 1e9)
            if not self._connecting.is_connected():
                if now_ns > self._limit_ns:
                    raise OSError(
                        errno.ETIMEDOUT,
                        f"connect to {self._base.line}: no answer within {self._base.line.connect_timeout_s:g} s",
                    )
                return False
        except OSError as error:
            if self._connecting is not None:
                self._connecting.close()
                self._connecting = None
            self._runtime.set_link(self._base.blocks, PageState.LINK_LOST, error.strerror or str(error))
            self._retry_ns = now_ns + self._pause_ns
            self._pause_ns = min(2 * self._pause_ns, LONGEST_PAUSE_NS)
            return False
        connection, self._connecting = self._connecting, None
        aside = self._base.aside
        self.line = Line(
            connection, self._gap_s, self._recovery_s, self.counters, self.unsolicited(),
            None if aside is None else SideConnection(aside),
        )  # fmt: skip
        self._runtime.watch(connection.fd, self._readable)
        self.connected(now_ns)
        return True

    def _count_stranger(self) -> None:
        self.counters.strangers += 1

    def unsolicited(self) -> Any:
        """Return what takes bytes that no exchange waits for."""
        return None

    def connected(self, now_ns: int) -> None:
        """Begin: the line is up."""
        raise NotImplementedError

    def line_lost(self, reason: str, now_ns: int) -> None:
        """Close the line and try again later."""
        line, self.line = self.line, None
        if line is None:
            return
        self.counters.reconnects += 1
        self._runtime.unwatch(line.connection.fd)
        line.close()
        self._retry_ns = now_ns + self._pause_ns
        self._pause_ns = min(2 * self._pause_ns, LONGEST_PAUSE_NS)
        self._runtime.lose(self._base.blocks, reason)
        line.abandon(reason)

    def guarded(self, action: Any, now_ns: int) -> None:
        """Do something on the line; when it is gone, say so and start again."""
        try:
            action()
        except OSError as error:
            self.line_lost(error.strerror or str(error), now_ns)
        self._arm()

    def carry_out(self, handle: Handle, number: int, steps: Steps, what: str) -> Any:
        """Run the steps that a client's request takes; its answer comes when they end."""
        line, now_ns = self.line, self._runtime.now_ns()
        if line is None:
            raise OSError(errno.EIO, f"{what}: there is no connection to {self._base.line}")

        def done(value: Any, error: Exception | None) -> None:
            if error is None:
                handle.answer(number, value)
            else:
                errno_ = error.errno if isinstance(error, DeviceError) else errno.EIO
                handle.refuse(number, errno_, f"{what}: {error}")

        self.guarded(lambda: line.submit(steps, Priority.ACT, done, now_ns), now_ns)
        return LATER

    def _readable(self) -> None:
        now_ns = self._runtime.now_ns()
        if self.line is not None:
            line = self.line
            self.guarded(lambda: line.receive(now_ns), now_ns)

    def _line_due(self) -> None:
        now_ns = self._runtime.now_ns()
        if self.line is not None:
            line = self.line
            self.guarded(lambda: line.advance_time(now_ns), now_ns)

    def _arm(self) -> None:
        self._runtime.set_line_timer(self.line.deadline_ns if self.line is not None else None)

    def recover(self, reason: str) -> None:
        """Give up the jobs of the line."""
        if self.line is not None:
            self.line.abandon(reason)

    def close_line(self) -> None:
        """Release the line for good."""
        if self.line is not None:
            self._runtime.unwatch(self.line.connection.fd)
            self.line.close()
            self.line = None


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


class LineEngine(_Connected):
    """Runs a LineDriver: opens and polls its units in turn, and carries out actions and outputs."""

    def __init__(self, runtime: Runtime, driver: LineDriver, poll_hz: float) -> None:
        super().__init__(runtime, driver, driver.gap_s, driver.recovery_s)
        self._driver = driver
        self._period_ns = int(1e9 / poll_hz)
        self._units = [_UnitState(unit) for unit in driver.units]
        self._by_block = {id(block): state for state in self._units for block in state.unit.blocks}
        self._voids: Counter[tuple[int, int]] = Counter()
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
        if not self.connect(now_ns):
            return
        for state in self._units:
            if state.is_up:
                for block in state.unit.blocks:
                    self.commands_written(block)  # time and markers may have released commands
            if not state.busy and now_ns >= state.due_ns:
                self._start(state, now_ns)

    def _start(self, state: _UnitState, now_ns: int) -> None:
        line = self.line
        if line is None:
            return
        state.busy = True
        if state.is_up:
            state.due_ns = max(state.due_ns + self._period_ns, now_ns)
            steps, done = state.unit.poll(), self._polled
        else:
            steps, done = state.unit.open(), self._opened
        self.guarded(
            lambda: line.submit(steps, Priority.POLL, lambda v, e: done(state, v, e), now_ns), now_ns
        )

    def _opened(self, state: _UnitState, _: Any, error: Exception | None) -> None:
        state.busy = False
        now_ns = self._runtime.now_ns()
        if error is None:
            state.is_up, state.misses, state.due_ns = True, 0, now_ns
            state.pause_ns = FIRST_PAUSE_NS
            state.fresh = True
            return
        kind = PageState.FAULT if isinstance(error, DeviceError) else PageState.LINK_LOST
        self._runtime.set_link(state.unit.blocks, kind, f"{state.unit.name}: {error}")
        state.due_ns = now_ns + state.pause_ns
        state.pause_ns = min(2 * state.pause_ns, LONGEST_PAUSE_NS)

    def _polled(self, state: _UnitState, _: Any, error: Exception | None) -> None:
        state.busy = False
        now_ns = self._runtime.now_ns()
        if error is not None:
            state.misses += 1
            if state.misses >= state.unit.misses:
                self._lose_unit(state, f"{state.unit.name}: {error}", now_ns)
            return
        state.misses = 0
        if state.fresh:
            state.fresh = False
            self._runtime.set_link(state.unit.blocks, PageState.GOOD, "")
            for block in state.unit.blocks:
                self._runtime.make_safe(block, self._unowned(block))  # who wrote them may have gone meanwhile
        for block in state.unit.blocks:
            self._runtime.publish(block, block.stamp_ns or now_ns)
            if isinstance(block, AxisBlock):
                self._take_actions(state, block, now_ns)
        self._runtime.after_publication(now_ns)
        if state.due_ns <= now_ns and self.line is not None and not state.busy and self._runtime.running:
            self._start(state, now_ns)  # the line is slower than the rate asked for: poll back to back

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
                handle.answer(number, self._runtime.tick)
            else:
                errno_ = error.errno if isinstance(error, DeviceError) else errno.EIO
                handle.refuse(number, errno_, f"write {handle.node}: {state.unit.name}: {error}")

        priority = Priority.STOP if handle is None else Priority.OUTPUT
        self.guarded(lambda: line.submit(steps, priority, done, now_ns), now_ns)
        return LATER

    def commands_written(self, block: AnyBlock) -> None:
        """Send at once what the bank has to send."""
        state, now_ns = self._by_block[id(block)], self._runtime.now_ns()
        if isinstance(block, AxisBlock) and isinstance(block.bank, DriveBank) and state.is_up:
            block.bank.advance(now_ns)
            self._take_actions(state, block, now_ns)

    def _unless_void(self, steps: Steps, marks: dict[tuple[int, int], int]) -> Steps:
        """Carry out a write of outputs, and no further once a stop or a safe value has overtaken it."""
        value: Any = None
        failure: Exception | None = None
        while all(self._voids[key] == mark for key, mark in marks.items()):
            try:
                step = steps.throw(failure) if failure else steps.send(value)
            except StopIteration:
                return
            value, failure = None, None
            try:
                value = yield step
            except (LinkError, DeviceError) as error:
                failure = error
        raise DeviceError(errno.ECANCELED, "overtaken by a stop or a safe value")

    def _unowned(self, block: AnyBlock) -> list[int]:
        """Return the channels whose outputs no client holds; a stopped workcell holds none."""
        holders = [] if self._runtime.stopped else self._runtime.clients.handles.values()
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
        """Let every unit leave its device safe; the runtime runs the loop until it is quiet."""
        line, now_ns = self.line, self._runtime.now_ns()
        if line is None:
            return
        for state in self._units:
            if state.is_up:
                done: Done = lambda _value, _error: None  # noqa: E731
                self.guarded(partial(line.submit, state.unit.close(), Priority.ACT, done, now_ns), now_ns)


class StreamEngine(_Connected):
    """Runs a StreamDriver: opens the stream, feeds the driver, watches that good frames come."""

    publishes = False

    def __init__(self, runtime: Runtime, driver: StreamDriver) -> None:
        super().__init__(runtime, driver, driver.gap_s, driver.recovery_s)
        self._driver = driver
        self._is_up = False
        self._busy = False
        self._closed = False
        self._due_ns = 0
        self._good_ns = 0
        self._heard = False
        self._heartbeat_ns = 0

    def unsolicited(self) -> Any:
        """Samples are what nobody asked for, one by one."""
        return self._feed

    def connected(self, now_ns: int) -> None:
        """Open the stream."""
        self._is_up = self._busy = False
        self._due_ns = now_ns

    def tick(self, now_ns: int) -> None:
        """Open, keep alive, and watch the stream."""
        if self._closed or not self.connect(now_ns) or self.line is None or self._busy:
            return
        line = self.line
        if not self._is_up:
            if now_ns >= self._due_ns:
                self._busy = True
                self.guarded(
                    lambda: line.submit(self._driver.open(), Priority.POLL, self._opened, now_ns), now_ns
                )
        elif now_ns - self._good_ns > self._driver.silence_s * 1e9:
            self._stalled(now_ns)
        elif self._driver.heartbeat_s and now_ns >= self._heartbeat_ns and line.is_free:
            self._heartbeat_ns = now_ns + int(self._driver.heartbeat_s * 1e9)
            self.guarded(
                lambda: line.submit(self._driver.heartbeat(), Priority.POLL, lambda v, e: None, now_ns),
                now_ns,
            )

    def _stalled(self, now_ns: int) -> None:
        """Begin anew: at once when the stream ran, else after a pause that grows."""
        self._is_up = False
        reason = f"no good frame for {(now_ns - self._good_ns) / 1e9:.3f} s"
        if not self._heard:
            reason += f" after the start of the stream{self._driver.advice and '; ' + self._driver.advice}"
            self._due_ns = now_ns + self._pause_ns
            self._pause_ns = min(2 * self._pause_ns, LONGEST_PAUSE_NS)
        else:
            self._due_ns = now_ns
        self._runtime.lose(self._driver.blocks, reason)

    def _opened(self, _: Any, error: Exception | None) -> None:
        self._busy = False
        now_ns = self._runtime.now_ns()
        if error is None:
            self._is_up, self._good_ns, self._heard = True, now_ns, False
            self._heartbeat_ns = now_ns + int(self._driver.heartbeat_s * 1e9)
            return
        kind = PageState.FAULT if isinstance(error, DeviceError) else PageState.LINK_LOST
        self._runtime.set_link(self._driver.blocks, kind, str(error))
        self._due_ns = now_ns + self._pause_ns
        self._pause_ns = min(2 * self._pause_ns, LONGEST_PAUSE_NS)

    def _feed(self, data: bytes, now_ns: int) -> None:
        if not self._is_up:
            return
        if self._driver.feed(data, now_ns):
            if self._good_ns == 0 or not self._runtime.is_good(self._driver.blocks):
                self._runtime.set_link(self._driver.blocks, PageState.GOOD, "")
                self._pause_ns = FIRST_PAUSE_NS
            self._good_ns, self._heard = now_ns, True
            self._runtime.after_publication(now_ns)

    def write_outputs(
        self,
        handle: Handle | None,
        number: int,
        block: AnyBlock,
        channels: Sequence[int],
        values: Sequence[float],
    ) -> Any:
        """Refuse: a stream has no outputs."""
        raise OSError(errno.EBADF, f"write {block.spec.name}: this device only sends")

    def commands_written(self, block: AnyBlock) -> None:
        """Nothing: a stream has no axes."""

    def stop(self, blocks: Sequence[AnyBlock]) -> None:
        """Nothing moves."""

    def is_quiet(self) -> bool:
        """Whether the line has nothing left to do."""
        return self.line is None or self.line.is_free

    def close(self) -> None:
        """Stop the stream; no later tick may start it again."""
        self._closed = True
        line, now_ns = self.line, self._runtime.now_ns()
        if line is not None and self._is_up:
            self._is_up = False
            self.guarded(
                lambda: line.submit(self._driver.close(), Priority.ACT, lambda v, e: None, now_ns), now_ns
            )
