"""Stops in a driver process: the workcell's emergency stop, that of a node, and what outputs do when their writer goes.

Concurrency: the one thread of the driver process.
"""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import Enum, auto
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from sioms.motion import CommandError, EventKind
from sioms.part_times import PartTimes
from sioms.protocol.driver_verbs import AlarmChanged, Stopped
from sioms.protocol.flags import PageState, Reaction, Severity
from sioms.protocol.journal import JournalWriter, Note
from sioms.protocol.latch import Latch
from sioms.protocol.stopfile import StopRequest
from sioms.protocol.stopjournal import StopJournal, channels_and_bits, node_entry, parts_of, workcell_entry
from sioms.protocol.verbs import Message

from .alarm_watch import Rule
from .blocks import AnyBlock, AxisBlock, BinaryBlock
from .effects import Effects
from .engine import Engine
from .handles import Handle, Wait, Waits
from .outputs import WHOLE, Outputs, safe_of
from .pages import Pages

SHOWN_NS = 1_000_000
"""A stop by an alarm is shown within so long, by a tick that follows it or by the list of what is stopped [ns]."""
TOLD_NS = 10_000_000_000
"""How often it is logged that safe outputs could not be set."""


class Stop(Enum):
    """How axes are stopped; what outputs do is the same."""

    CONTROLLED = auto()
    """They brake and may be commanded anew."""
    EMERGENCY = auto()
    """As fast as the device can, latched until reset."""
    FAILURE = auto()
    """As EMERGENCY, after a hook has raised what it should not have: what is under way is given up first."""
    LOSS = auto()
    """The device does not answer: a fault; outputs are made safe when it is back."""


class Reason(NamedTuple):
    """Why something stops.

    Args:
        stop: how.
        text: for those whose requests end.
        errno: of these requests; 0: they go on.
    """

    stop: Stop
    text: str
    errno: int = 0


Mark = tuple[int, int]
"""Of a request to stop, see ``StopRequest.mark``."""
Part = tuple[AnyBlock, Sequence[int], int]
"""A block, channels of it, and one bit of them (-1: all)."""


class Stops:
    """What is stopped, and by whom.

    Args:
        device: its name.
        blocks: its blocks.
        outputs, effects, waits, pages: of the driver process.
        handles: of the clients, by number.
        log: writes a line of a level to the daemon's log.
        tell: sends the daemon a message.
        latch: the workcell's emergency-stop latch.
        request: file in which any client asks for an emergency stop.
        journal: where stops are noted before they are acknowledged, so that they outlive this process.
        resets: how often the workcell had been reset when the daemon told what is stopped: one that comes while this
            process is being forked is one for that, too.
        sources: inputs of this device that stop the workcell, each (block, channel, bit, active level).
        events: where stops, faults and resets are told to recorders.

    Attributes:
        engine: of the device; set before the first tick.
        stopped: whether the workcell is stopped.
        resets: when what was stopped was reset.
        asked: when somebody asked for the stop of a node, stopped already or not.
        faults: when axes came into fault, as far as anybody can have seen it.
        latched_outputs: parts of outputs (block, channel, bit) under an emergency stop of their node, and by whom; bit
            0 for channels without bits.
    """

    engine: Engine

    def __init__(
        self, device: str, blocks: Sequence[AnyBlock], outputs: Outputs, effects: Effects, waits: Waits, pages: Pages,
        handles: Mapping[int, Handle], log: Callable[[str, str], None], tell: Callable[[Message], None],
        latch: Latch, resets: int, request: StopRequest, journal: StopJournal, sources: Iterable[Sequence[int]],
        events: JournalWriter,
    ) -> None:  # fmt: skip
        self.stopped = False
        self.resets, self.asked, self.faults = PartTimes(), PartTimes(), PartTimes()
        self.latched_outputs: dict[tuple[int, int, int], str] = {}
        self._faulty: set[tuple[int, int]] = set()
        self._unshown: list[tuple[AnyBlock, list[tuple[int, int]], int]] = []
        """What alarms have stopped since the last publication: for who resets it, that counts from when it is shown, or
        from when the daemon has been told that it is [ns, CLOCK_MONOTONIC]."""
        self._unsafe: dict[int, tuple[int, int]] = {}
        """Blocks with safe values that could not be set: when that was logged, and failures since."""
        self._device, self._blocks = device, blocks
        self._axes = [block for block in blocks if isinstance(block, AxisBlock)]
        self._outputs, self._effects, self._waits, self._pages = outputs, effects, waits, pages
        self._handles = handles
        self._log, self._tell = log, tell
        self._latch = latch
        self._request = request
        self._journal = journal
        self._events = events
        self._sources = [tuple(source) for source in sources]
        self._seen = (0, resets, request.mark)
        self._ended_ns = latch.ended_stop_ns
        self._orders = latch.orders

    @property
    def source(self) -> str:
        """Who has stopped the workcell, and why."""
        return self._latch.source

    # --- the workcell ----------------------------------------------------------------------------

    def stop_workcell(self, source: str) -> None:
        """Stop the whole workcell."""
        now_ns = time.monotonic_ns()
        fresh = self._latch.stop(now_ns, source)
        self.look()
        if fresh:
            self._note(workcell_entry(source, stop=True, latched_ns=now_ns))
            self._request.request(now_ns, os.getpid(), source)  # wakes the other drivers
            self._tell(Stopped(source))

    @property
    def is_up_to_date(self) -> bool:
        """Whether all that latch, request page and daemon ask for has been seen."""
        latch = self._latch
        return (
            latch.stopped_ns, latch.resets, self._request.mark
        ) == self._seen and latch.orders == self._orders  # fmt: skip

    @property
    def seen(self) -> tuple[int, int, int]:
        """What has been seen: the time of the workcell's stop [ns], how often it was reset, orders of the daemon."""
        return (*self._seen[:2], self._orders)

    @property
    def seen_request(self) -> Mark:
        """The mark of the stop-request file that has been seen."""
        return self._seen[2]

    def heed_orders(self) -> bool:
        """Return whether the daemon has sent orders since the last look; cheap."""
        orders = self._latch.orders
        if orders == self._orders:
            return False
        self._orders = orders
        return True

    def heed(self) -> None:
        """Look whether the emergency stop, or its reset, has come since the last look; cheap."""
        latch = self._latch
        if (latch.stopped_ns, latch.resets, self._request.mark) != self._seen:
            self.look()

    def latch_request(self) -> tuple[Mark, bool]:
        """Latch the stop that somebody asks for, and do no more; return what was looked at, and whether it is news."""
        latch, mark = self._latch, self._request.mark
        fresh = mark not in (self.seen_request, latch.answered_request)
        if fresh:
            source = self._request.source
            # A reset may have answered it since: a stop that is over must not be latched again.
            if mark != latch.answered_request and latch.stop(time.monotonic_ns(), source):
                self._tell(Stopped(latch.source))
        return mark, fresh

    def look(self) -> None:
        """Do what the latch and the request file say."""
        latch, (seen_stop, seen_resets, _) = self._latch, self._seen
        mark, fresh = self.latch_request()
        stopped_ns, resets = latch.stopped_ns, latch.resets
        self._seen = (stopped_ns, resets, mark)
        is_reset, is_missed = resets != seen_resets, False
        if is_reset:
            is_missed = self._note_workcell_reset(seen_stop)
        if is_missed or (stopped_ns and stopped_ns != seen_stop):
            self.stopped = True
            self.safe_stop(_emergency_stop_by(self.source))
        if fresh:
            if stopped_ns:  # also by another driver, which may not have come to note it
                self._note(workcell_entry(latch.source, stop=True, latched_ns=stopped_ns))
            self._request.take(mark)
        if is_reset or (self.stopped and not stopped_ns):
            self._effects.note()
            self.stopped = stopped_ns != 0  # again, since then: of its nodes the reset is one all the same
            if not stopped_ns:
                self._events.note(Note.RESET, time.monotonic_ns(), "", [])
            for block in self._blocks:
                self._reset_seen(block, range(block.n), -1, latch.reset_sent_ns, "the reset of the workcell")

    def _reset_seen(self, block: AnyBlock, channels: Iterable[int], bit: int, sent_ns: int, what: str) -> None:
        """Clear stops and faults of parts of a block, but for those that came after the reset was sent. Of these nobody
        knew yet when the daemon judged it: for who reads its answer they came after that.
        """
        parts = self._parts(block, channels, bit)
        younger = self.asked.since(id(block), sent_ns)
        kept = [part for part in parts if part in younger and self._is_stopped(block, part)]
        if kept:
            self._note_still(block, kept, f"a stop that came during {what}")
        if not isinstance(block, AxisBlock):
            self._clear(block, [part for part in parts if part not in kept])
            return
        axes = [axis for axis, _ in parts]
        unseen = self._unseen_faults(block, axes, sent_ns)
        if unseen:
            self._log("warning", f"{self._name(block)} stays in fault: it came during {what}")
            block.bank.end_stop(unseen)
        self._clear(block, [part for part in parts if part[0] not in unseen])
        still = axes if self.stopped else [axis for axis, _ in kept]
        if still:
            block.bank.emergency_stop(np.asarray(still, dtype=np.intp), time.monotonic_ns())

    def _is_stopped(self, block: AnyBlock, part: tuple[int, int]) -> bool:
        """Tell whether a part of a block is under an emergency stop."""
        if isinstance(block, AxisBlock):
            return block.bank.is_stopped(part[0])
        return (id(block), *part) in self.latched_outputs

    @staticmethod
    def _parts(block: AnyBlock, channels: Iterable[int], bit: int) -> list[tuple[int, int]]:
        return [part for c in channels for part in parts_of(int(c), bit, block.spec.channels[c].width)]

    def note_faults(self) -> None:
        """Note that axes have come into fault, and tell the daemon, before anybody can see it; and what alarms have
        stopped. Cheap where there is none.
        """
        if self._unshown:
            unshown, self._unshown = self._unshown, []
            for block, parts, at_ns in unshown:
                self.asked.note(id(block), parts, min(at_ns, time.monotonic_ns()))
        for block in self._axes:
            fresh = block.bank.take_faults()
            if not fresh:
                continue
            now_ns = time.monotonic_ns()
            self.faults.note(id(block), [(axis, 0) for axis in fresh], now_ns)
            for axis in fresh:
                if block.bank.is_in_fault(axis):
                    self._tell_fault(block, axis, Severity.MAJOR, block.bank.fault_text(axis), now_ns)

    def _unseen_faults(self, block: AxisBlock, channels: Iterable[int], sent_ns: int) -> list[int]:
        """Return the axes whose faults nobody can have seen who sent something at an instant [ns, CLOCK_MONOTONIC]."""
        self.note_faults()
        later = self.faults.since(id(block), sent_ns)
        return [int(axis) for axis in channels if (int(axis), 0) in later and block.bank.is_in_fault(int(axis))]

    def _note_workcell_reset(self, seen_stop_ns: int) -> bool:
        """Note that the workcell has been reset; return whether that has ended a stop that was not seen."""
        latch, before_ns = self._latch, self._ended_ns
        self._ended_ns = ended_ns = latch.ended_stop_ns
        if ended_ns != before_ns:
            self.resets.note_all(latch.ended_ns)
            for handle in self._handles.values():
                handle.note_reset(latch.ended_ns)
        else:  # the workcell was not stopped: of what its nodes are
            for block in self._blocks:
                self._note_reset(block, self._stopped_of(block, range(block.n), -1), latch.reset_ns)
        return ended_ns not in (before_ns, seen_stop_ns)

    def _note_reset(self, block: AnyBlock, stopped: Sequence[tuple[int, int]], at_ns: int, by: int = 0) -> None:
        """Note when parts of a block, that are stopped or in fault, were reset; see ``PartTimes.note``."""
        if not stopped:
            return
        self.resets.note(id(block), stopped, at_ns, by)
        reset = {channel for channel, _ in stopped}
        for handle in self._handles.values():
            if handle.block is block and not reset.isdisjoint(handle.axes) and handle.number != by:
                handle.note_reset(at_ns)

    def _stopped_of(self, block: AnyBlock, channels: Iterable[int], bit: int) -> list[tuple[int, int]]:
        """Return which parts of some channels are stopped or in fault, by themselves."""
        if isinstance(block, AxisBlock):
            return [(int(axis), 0) for axis in channels if block.bank.is_latched(int(axis))]
        return [part for part in self._parts(block, channels, bit) if self._is_stopped(block, part)]

    def look_at_inputs(self) -> None:
        """Stop the workcell when an input that is to stop it reads so."""
        for block, channel, bit, active in self._sources:
            port = self._blocks[block]
            if (
                isinstance(port, BinaryBlock)
                and self._pages.number(port)  # before the first reading there is nothing to judge
                and (int(port.data[channel]) >> bit & 1) == active
                and not self.stopped
            ):
                name = f"{self._device} {port.spec.name} {port.spec.channels[channel].name}".replace("  ", " ")
                self.stop_workcell(f"input {name} bit {bit} reads {active}")

    # --- the one stop ----------------------------------------------------------------------------

    def safe_stop(self, reason: Reason, parts: Sequence[Part] | None = None) -> None:
        """Stop axes and make outputs safe; every stop of this process is this one.

        The order, which docs/decisions/0176-one-safe-stop.md explains: banks, what is under way after a failure, the
        stops of the device, the writes on their way to its outputs, the outputs, the requests that wait, the events of
        the banks. Each is done whatever became of those before.

        Args:
            reason: how and why.
            parts: what stops; None: the whole device.

        Raises:
            Exception: the first that one of them has raised, when all have been done.
        """
        engine = self.engine
        whole = [(block, range(block.n), -1) for block in self._blocks] if parts is None else parts
        axes = [block for block, _, _ in whole if isinstance(block, AxisBlock)]
        self._effects.note()
        told: list[Wait] = []
        steps: list[Callable[[], None]] = [partial(self._stop_axes, reason, whole)]
        if reason.stop is Stop.FAILURE:
            steps.append(partial(engine.recover, reason.text))
        if reason.stop is Stop.LOSS:
            steps.append(partial(self._outputs.forget, [block for block, _, _ in whole]))
        else:
            if axes:
                steps.append(partial(engine.stop, axes))
            steps += [partial(self._drop_writes, *part) for part in whole]
            steps += [partial(self.make_safe, *part) for part in whole]
        if reason.errno:  # before the events of the banks would: these know who stopped
            steps.append(partial(self._end_waits, reason, whole, told))
        steps.append(partial(self.take_events, reason.text, told))
        failures = []
        for step in steps:
            try:
                step()
            except Exception as error:  # nothing may keep the others from being stopped
                failures.append(error)
        what = [] if parts is None else [[b.spec.name, [int(c) for c in channels], bit] for b, channels, bit in parts]
        self._events.note(Note.STOP, time.monotonic_ns(), reason.stop.name, reason.text, what)
        if failures:
            raise failures[0]

    def lose(self, blocks: Sequence[AnyBlock], why: str) -> None:
        """The device behind some blocks is lost: nothing queued will run, waits end, readers are told."""
        self._pages.set_link(blocks, PageState.LINK_LOST, why)
        whole = [(block, range(block.n), -1) for block in blocks]
        self.safe_stop(Reason(Stop.LOSS, why, errno.EIO), whole)

    def take_events(self, why: str = "", told: Sequence[Wait] = ()) -> None:
        """End the waits that events of the axes end, and report faults.

        Args:
            why: what has stopped axes just now, if anything has; told: waits that have been told so.
        """
        self.note_faults()
        for block in self._axes:
            for event in block.bank.take_events():
                if event.kind in (EventKind.DROPPED, EventKind.FAULT):
                    self._effects.note()
                    errno_ = event.errno or errno.EIO
                    ended = self._waits.end_axes(block, event.axes, errno_, event.text)
                    if event.kind is EventKind.DROPPED:
                        self._cut_short(block, event.axes, (errno_, why or event.text), [*told, *ended])
                    if event.kind is EventKind.FAULT:
                        names = ", ".join(block.spec.channels[a].name for a in event.axes[:4])
                        self._events.note(Note.FAULT, time.monotonic_ns(), names, event.text)
                        self._log("error", f"fault of {names}: {event.text}")

    def _cut_short(self, block: AxisBlock, axes: Iterable[int], why: tuple[int, str], told: Sequence[Wait]) -> None:
        """Keep for the next wait of their writers how motions have ended, but for who has been told."""
        for handle in self._handles.values():
            if handle.block is not block or not handle.writes:
                continue
            known = {axis for wait in told if wait.handle is handle for axis in wait.channels}
            handle.cut_short |= {int(axis): why for axis in axes if axis in handle.axes and axis not in known}

    def _tell_fault(self, block: AxisBlock, axis: int, severity: Severity, text: str, at_ns: int = 0) -> None:
        """Tell the daemon that an axis is in fault, or is not any more."""
        if severity:
            self._faulty.add((id(block), axis))
        elif (id(block), axis) not in self._faulty:
            return
        else:
            self._faulty.discard((id(block), axis))
        number = next(i for i, each in enumerate(self._blocks) if each is block)
        self._tell(AlarmChanged(number, axis, -1, "fault", severity, text, at_ns))

    def _stop_axes(self, reason: Reason, parts: Iterable[Part]) -> None:
        now_ns = time.monotonic_ns()
        for block, channels, _ in parts:
            if not isinstance(block, AxisBlock):
                continue
            axes = np.asarray(channels, dtype=np.intp)
            match reason.stop:
                case Stop.CONTROLLED:
                    block.bank.stop(axes, now_ns)
                case Stop.EMERGENCY | Stop.FAILURE:
                    block.bank.emergency_stop(axes, now_ns)
                case Stop.LOSS:
                    block.bank.fault(axes, reason.text, now_ns)

    def _end_waits(self, reason: Reason, parts: Iterable[Part], told: list[Wait]) -> None:
        """End the waits for what is stopped; those for motion are added to ``told``."""
        for block, channels, _ in parts:
            if reason.stop is Stop.LOSS:
                self._waits.end_block(block, reason.errno, reason.text)
            elif isinstance(block, AxisBlock):
                told += self._waits.end_axes(block, channels, reason.errno, reason.text)

    # --- nodes -----------------------------------------------------------------------------------

    def stop_node(
        self, block: AnyBlock, channels: Any, bit: int, source: str, at_ns: int | None = None, by: int = 0
    ) -> None:  # fmt: skip
        """Emergency stop of some channels, or of one bit of them: latched until reset.

        Args:
            block, channels, bit: what is stopped.
            source: who asks for it, and why.
            at_ns: when that was asked for [ns, CLOCK_MONOTONIC]; None: now.
            by: number of the handle that asks for it; 0: none.
        """
        parts = self._parts(block, channels, bit)
        self.asked.note(id(block), parts, time.monotonic_ns() if at_ns is None else at_ns, by)
        if not isinstance(block, AxisBlock):
            self.latched_outputs |= {(id(block), *part): source for part in parts}
        self.safe_stop(_emergency_stop_by(source), [(block, channels, bit)])

    def stop_in_passing(self, block: AnyBlock, channels: Any, bit: int, source: str, at_ns: int) -> None:
        """Carry out an emergency stop, as ``stop_node``, that a reset of the workcell has ended before it was heard of:
        what moves stops, what was sent before is not taken, and nothing stays latched that was not before.
        """
        fresh = [part for part in self._parts(block, channels, bit) if not self._is_stopped(block, part)]
        self.stop_node(block, channels, bit, source, at_ns)
        self._note_reset(block, fresh, self._latch.reset_ns)
        faulty: list[tuple[int, int]] = []
        if isinstance(block, AxisBlock):
            faulty = [part for part in fresh if block.bank.is_in_fault(part[0])]
            block.bank.end_stop([axis for axis, _ in faulty])
        self._clear(block, [part for part in fresh if part not in faulty])

    def reset_for_daemon(self, block: AnyBlock, channels: Any, bit: int, source: str, at_ns: int, sent_ns: int) -> None:
        """Reset some channels, or one bit of them, as the daemon has acknowledged to somebody.

        Args:
            block, channels, bit: what is reset.
            source: who asks for it.
            at_ns: when it is done: what was sent before is not taken after it [ns, CLOCK_MONOTONIC].
            sent_ns: when that was sent, or before [ns, CLOCK_MONOTONIC].
        """
        stopped = self._begin_reset(block, channels, bit)
        self._reset_seen(block, channels, bit, sent_ns, f"a reset by {source}")
        kept = self._stopped_of(block, channels, bit)
        self._note_reset(block, [part for part in stopped if part not in kept], at_ns)

    def reset_node(
        self, block: AnyBlock, channels: Any, bit: int, what: str, at_ns: int, sent_ns: int, until_ns: int | None,
        by: int,
    ) -> None:  # fmt: skip
        """Clear the latched stop and faults of some channels, or the stop of one bit of them.

        Args:
            block, channels, bit: what is reset.
            what: in words.
            at_ns: when it is done: what was sent before is not taken after it [ns, CLOCK_MONOTONIC].
            sent_ns, until_ns, by: as of ``check_reset``.

        Raises:
            OSError: as ``check_reset``; of what is stopped it is noted that it is so still.
        """
        parts = self._parts(block, channels, bit)
        try:
            self.check_reset(block, channels, bit, what, sent_ns, until_ns, by)
        except OSError:
            # A fault is no stop that outlives this process.
            still = [part for part in parts if self._is_stopped(block, part)]
            if still:
                self._note_still(block, still, "a stop or fault that came during a reset")
            raise
        self._note_reset(block, self._begin_reset(block, channels, bit), at_ns, by)
        self._clear(block, parts)

    def _begin_reset(self, block: AnyBlock, channels: Any, bit: int) -> list[tuple[int, int]]:
        """Tell recorders of a reset; return which parts were stopped or in fault."""
        self._effects.note()
        self._events.note(Note.RESET, time.monotonic_ns(), block.spec.name, [int(c) for c in channels])
        return self._stopped_of(block, channels, bit)

    def _clear(self, block: AnyBlock, parts: Iterable[tuple[int, int]]) -> None:
        """Clear the stop and the faults of parts of a block."""
        if isinstance(block, AxisBlock):
            self._reset_axes(block, [axis for axis, _ in parts])
            return
        for part in parts:
            self.latched_outputs.pop((id(block), *part), None)

    def check_reset(
        self, block: AnyBlock, channels: Any, bit: int, what: str, sent_ns: int, until_ns: int | None = None,
        by: int = 0,
    ) -> None:  # fmt: skip
        """Refuse a reset of some channels, or of one bit of them, that cannot be.

        Args:
            block, channels, bit: what is to be reset.
            what: in words.
            sent_ns: when that was sent, or before [ns, CLOCK_MONOTONIC].
            until_ns: see ``Bank.check_reset``; None: whatever there is now is reset.
            by: number of the handle that asks for it; 0: none.

        Raises:
            OSError: EPERM, the whole workcell is stopped; EAGAIN, somebody else has stopped one of them since it was
                sent, or it has come into fault since, or either was so at until_ns or later.
        """
        if self.stopped:
            raise OSError(errno.EPERM, f"{what}: the whole workcell is stopped ({self.source}); reset that")
        masks = dict.fromkeys(map(int, channels), 1 << bit if bit >= 0 else -1)
        if sent_ns < self.asked.latest_ns(id(block), masks, by):
            raise OSError(errno.EAGAIN, f"{what}: stopped after this was sent; see why, and reset again")
        if not isinstance(block, AxisBlock):
            return
        for axis in self._unseen_faults(block, channels, sent_ns):
            name, why = block.spec.channels[axis].name, block.bank.fault_text(axis)
            text = f"{what}: {name} has come into fault after this was sent ({why}); see why, and reset again"
            raise OSError(errno.EAGAIN, text)
        if until_ns is not None:
            try:
                block.bank.check_reset(channels, until_ns)
            except CommandError as error:
                raise OSError(error.errno, f"{what}: {error}") from None

    def reset_by(
        self, handle: Handle, what: str, sent_ns: int, until_ns: int | None, heed: Callable[[], None]
    ) -> None:  # fmt: skip
        """Reset, on behalf of a client, the node that it holds or watches.

        The reset is noted before it is done: a stop that the daemon sends at the same time is either heard before it is
        done, or noted behind it. What is refused after all stays stopped over the end of this process, too.

        Args:
            handle: of the client.
            what: in words.
            sent_ns, until_ns: as of ``check_reset``.
            heed: obeys what the daemon has sent.

        Raises:
            OSError: as ``check_reset``.
        """
        node = handle.block, handle.axes, handle.bit
        self.check_reset(*node, what, sent_ns, until_ns, handle.number)
        self.note_node(handle, handle.who, stop=False)
        heed()
        self.reset_node(*node, what, time.monotonic_ns(), sent_ns, until_ns, handle.number)

    def note_node(self, handle: Handle, source: str, *, stop: bool) -> None:
        """Note that a client has stopped or reset the node that it holds or watches."""
        spec = handle.block.spec
        parts = self._parts(handle.block, handle.channels.tolist(), handle.bit)
        what = f"emergency stop of {handle.node}" if stop else f"reset of {handle.node}"
        self._log("warning", f"{what} by {handle.who}")
        at_ns = time.monotonic_ns() if stop else 0
        entry = node_entry(handle.node, self._device, spec.name, parts, source, stop=stop, pid=os.getpid(), at_ns=at_ns)
        self._note(entry)

    def _note_still(self, block: AnyBlock, parts: Iterable[tuple[int, int]], source: str) -> None:
        """Note that parts of a block are stopped still: somebody has noted their reset, which has not been done."""
        name, spec = self._name(block), block.spec
        self._log("warning", f"{name} stays stopped: {source}")
        self._note(node_entry(name, self._device, spec.name, parts, source, stop=True, pid=os.getpid()))

    def stop_by_alarm(self, reaction: Reaction, block: AnyBlock, rule: Rule, why: str) -> None:
        """Stop what an alarm is to stop: the node that it watches, the whole device, or the workcell."""
        source = f"alarm of {rule.node}: {why}"
        if reaction is Reaction.STOP_WORKCELL:
            self.stop_workcell(source)
            return
        whole = [(each, range(each.n), -1, self._name(each)) for each in self._blocks]
        node = [(block, rule.stops, rule.bit, rule.node)]
        for each, channels, bit, name in node if reaction is Reaction.STOP_NODE else whole:
            if not isinstance(each, AxisBlock) and not each.spec.writable:
                continue
            self.stop_node(each, channels, bit, source)
            spec = each.spec
            parts = self._parts(each, channels, bit)
            at_ns = time.monotonic_ns() + SHOWN_NS  # the daemon takes it for now, if it hears of it before
            self._unshown.append((each, parts, at_ns))
            self._log("warning", f"emergency stop of {name} by {source}")
            self._note(
                node_entry(name, self._device, spec.name, parts, source, stop=True, pid=os.getpid(), at_ns=at_ns)
            )

    def restore(self, stopped: Iterable[tuple[str, list[list[int]], str, str]]) -> None:
        """Stop what was stopped when the process before this one ended, before anything can move.

        Args:
            stopped: as Stopped.of_device.
        """
        blocks = {block.spec.name: block for block in self._blocks}
        for name, runs, source, _ in stopped:
            block = blocks.get(name)
            if block is None:
                continue
            for channel, bit in channels_and_bits(runs):
                if channel < block.n:
                    part = bit if block.spec.channels[channel].width else -1
                    self.stop_node(block, [channel], part, source, at_ns=0)  # when is known to the daemon

    def release(self) -> None:
        """Close the stop-request file, when the process goes on without this device."""
        self._request.close()

    def _note(self, entry: dict[str, Any]) -> None:
        try:
            self._journal.append(entry, time.time())
        except OSError as error:
            self._log("error", f"a stop or reset is not kept beyond this process: {error.strerror}")

    # --- outputs ---------------------------------------------------------------------------------

    def _drop_writes(self, block: AnyBlock, channels: Any, bit: int) -> None:
        if not isinstance(block, AxisBlock):
            self.engine.drop_writes(block, dict.fromkeys(map(int, channels), 1 << bit if bit >= 0 else -1))

    def make_safe(self, block: AnyBlock, channels: Any, bit: int = -1) -> None:
        """Want the safe values of output channels, or of one bit, until the device has them; those without one keep the
        last.
        """
        if isinstance(block, AxisBlock):
            return
        wanted = {int(c): safe for c in channels if (safe := safe_of(block.spec, int(c), bit)) is not None}
        for channel, safe in wanted.items():
            self._outputs.want(block, channel, safe)
        if wanted:
            self.engine.make_safe(block)

    def make_unowned_safe(self, block: AnyBlock) -> None:
        """Make outputs safe that no client holds, after the device was opened; a stopped workcell holds none."""
        holders = [] if self.stopped else self._handles.values()
        for channel in range(block.n):
            held = [h for h in holders if h.exclusive and h.block is block and channel in h.axes]
            if not held:
                self.make_safe(block, [channel])
            elif all(h.bit >= 0 for h in held):
                width = block.spec.channels[channel].width
                for bit in {*range(width)} - {h.bit for h in held}:
                    self.make_safe(block, [channel], bit)

    def look_at_outputs(self, block: AnyBlock, mark: int) -> None:
        """Compare outputs that were read with the safe values that are wanted, and send what the device does not have.

        Args:
            block: as it was read.
            mark: of Outputs, from before the reading.
        """
        outputs, key = self._outputs, id(block)
        outputs.read(block, mark, lambda channel: self.held(block, channel)[0] != 0)
        if outputs.unsent(block):
            self.engine.make_safe(block)
        elif key in self._unsafe and not outputs.unconfirmed(block):
            del self._unsafe[key]
            self._pages.set_link([block], PageState.GOOD, "")
            self._log("info", f"{self._name(block)}: safe outputs are confirmed")

    def tell_unsafe(self, block: AnyBlock, why: str) -> None:
        """Tell clients and log that safe outputs are wanted and could not be set; they are tried again."""
        now_ns = time.monotonic_ns()
        told_ns, count = self._unsafe.get(id(block), (0, 0))
        if now_ns - told_ns < TOLD_NS:
            self._unsafe[id(block)] = (told_ns, count + 1)
            return
        self._unsafe[id(block)] = (now_ns, 0)
        text = f"safe outputs not confirmed: {why}"
        if self._pages.is_good([block]):
            self._pages.set_link([block], PageState.GOOD, text)
        tries = f" ({count} more tries since)" if count else ""
        self._log("error", f"{self._name(block)}: {text}; they are sent until the device confirms them{tries}")

    def held(self, block: AnyBlock, channel: int) -> tuple[int, str]:
        """Return which bits of an output channel are stopped (WHOLE: all), and by whom."""
        if self.stopped:
            return WHOLE, self.source
        latched = self.latched_outputs
        if not latched:
            return 0, ""
        width = block.spec.channels[channel].width
        sources = {
            bit: latched[id(block), channel, bit] for bit in range(width or 1) if (id(block), channel, bit) in latched
        }
        if not sources:
            return 0, ""
        return (sum(1 << bit for bit in sources) if width else WHOLE), next(iter(sources.values()))

    def _name(self, block: AnyBlock) -> str:
        return ".".join(part for part in (self._device, block.spec.name) if part)

    def _reset_axes(self, block: AxisBlock, channels: Any) -> None:
        for axis in channels:
            self._tell_fault(block, int(axis), Severity.NONE, "it has been reset")
        block.bank.reset(channels)
        self.engine.commands_written(block)


def _emergency_stop_by(source: str) -> Reason:
    return Reason(Stop.EMERGENCY, f"emergency stop by {source}", errno.ECANCELED)
