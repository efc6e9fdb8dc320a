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

from sioms.motion import EventKind
from sioms.protocol.driver_verbs import Stopped
from sioms.protocol.flags import PageState, Reaction
from sioms.protocol.journal import JournalWriter, Note
from sioms.protocol.latch import Latch
from sioms.protocol.stopfile import StopRequest
from sioms.protocol.stopjournal import StopJournal, channels_and_bits, node_entry, workcell_entry
from sioms.protocol.verbs import Message

from .alarm_watch import Rule
from .blocks import AnyBlock, AxisBlock, BinaryBlock
from .effects import Effects
from .handles import Handle, Wait, Waits
from .outputs import Outputs, safe_of
from .pages import Pages
from .resets import Resets

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


class Stops(Resets):
    """Stops what is to be stopped, and knows by whom.

    Args:
        device, blocks, effects, handles, log, tell, latch, request, journal, events: as of ``Resets``.
        outputs, waits, pages: of the driver process.
        resets: how often the workcell had been reset when the daemon told what is stopped: one that comes while this
            process is being forked is one for that, too.
        sources: inputs of this device that stop the workcell, each (block, channel, bit, active level).
    """

    def __init__(
        self, device: str, blocks: Sequence[AnyBlock], outputs: Outputs, effects: Effects, waits: Waits, pages: Pages,
        handles: Mapping[int, Handle], log: Callable[[str, str], None], tell: Callable[[Message], None],
        latch: Latch, resets: int, request: StopRequest, journal: StopJournal, sources: Iterable[Sequence[int]],
        events: JournalWriter,
    ) -> None:  # fmt: skip
        super().__init__(device, blocks, effects, handles, log, tell, latch, request, journal, events)
        self._unsafe: dict[int, tuple[int, int]] = {}
        """Blocks with safe values that could not be set: when that was logged, and failures since."""
        self._outputs, self._waits, self._pages = outputs, waits, pages
        self._sources = [tuple(source) for source in sources]
        self._seen = (0, resets, (0, 0))
        self._taken = 0, (0, 0)
        """The last request that was noted, and after how many resets."""
        self._orders = latch.orders

    # --- the workcell ----------------------------------------------------------------------------

    def stop_workcell(self, source: str) -> None:
        """Stop the whole workcell, whether it is stopped or not: a reset that is under way does not end this stop."""
        try:
            self._request.request(time.monotonic_ns(), 0, source)  # wakes the other drivers
        except OSError as error:
            self._stop_here(source)
            self._log("error", f"a stop reaches other drivers by the daemon alone: {error.strerror}")
            self._tell(Stopped(source))
        self.look()

    @property
    def is_up_to_date(self) -> bool:
        """Whether all that latch, request page and daemon ask for has been seen."""
        return not self._is_news and self._latch.orders == self._orders

    @property
    def _is_news(self) -> bool:
        """Whether latch or request file say something else than at the last look."""
        latch = self._latch
        return (latch.stopped_ns, latch.resets, self._request.mark) != self._seen or self._has_missed

    @property
    def _has_missed(self) -> bool:
        """Whether a stop has come and gone since the last look, its reset maybe not being there in whole."""
        return not self.stopped and self._latch.ended_stop_ns != self._ended_ns

    @property
    def seen(self) -> tuple[int, int, int, int]:
        """What has been seen: the time of the latch's stop [ns], how often it was reset, the last stop that a reset has
        ended, orders of the daemon.
        """
        return (*self._seen[:2], self._ended_ns, self._orders)

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
        if self._is_news:
            self.look()

    def look(self) -> None:
        """Do what the latch and the request file say.

        Who is stopped stays so until a reset is seen: what a reset that is under way has written so far counts as
        nothing, and what it has not answered is a stop.
        """
        latch, (_, seen_resets, seen_mark) = self._latch, self._seen
        resets = -1
        while latch.resets != resets:
            resets = latch.resets
            self._seen = stopped_ns, _, mark = latch.stopped_ns, resets, self._request.mark
            is_asked = mark != latch.answered_request
        is_stopped, is_reset = stopped_ns != 0 or is_asked, resets != seen_resets
        is_missed = self._has_missed
        if is_reset:
            self._note_workcell_reset()
        if (is_stopped and (is_reset or not self.stopped)) or is_missed:
            self._stop_here(self.source)
        if is_asked or mark != seen_mark:
            self._take_request()
        if is_reset:
            self._effects.note()
            self.stopped = is_stopped  # again, since then: of its nodes the reset is one all the same
            if not is_stopped:
                self._events.note(Note.RESET, time.monotonic_ns(), "", [])
            for block in self._blocks:
                self._reset_seen(block, range(block.n), -1, latch.reset_sent_ns, "the reset of the workcell")

    def _stop_here(self, source: str) -> None:
        self.stopped = True
        self.safe_stop(_emergency_stop_by(source))

    def _take_request(self) -> None:
        """Note the stop that somebody asks for by the file, once, and say that it has been obeyed; look again behind
        that, as others may have obeyed a later one meanwhile.
        """
        latch = self._latch
        while True:
            resets, mark, answered = latch.resets, self._request.mark, latch.answered_request
            if (resets, mark) == self._taken:
                return
            if mark != answered:
                request = self._request
                entry = workcell_entry(request.source, stop=True, resets=resets, requests=[mark], inode=request.inode)
                self._note(entry)
            self._request.take(mark)
            self._taken = resets, mark

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

    def safe_stop(
        self, reason: Reason, parts: Sequence[Part] | None = None, note: Callable[[], None] | None = None
    ) -> None:  # fmt: skip
        """Stop axes and make outputs safe; every stop of this process is this one.

        The order, which docs/decisions/0176-one-safe-stop.md explains: banks, what is under way after a failure, the
        stops of the device, the writes on their way to its outputs, the outputs, the note of it, the requests that
        wait, the events of the banks. Each is done whatever became of those before.

        Args:
            reason: how and why.
            parts: what stops; None: the whole device.
            note: notes it where it outlives this process, before anybody is told.

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
        if note is not None:
            steps.append(note)
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
                    block.bank.emergency_stop(axes, now_ns, reason.text)
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
        self, block: AnyBlock, channels: Any, bit: int, source: str, at_ns: int | None = None, by: int = 0,
        note: Callable[[], None] | None = None,
    ) -> None:  # fmt: skip
        """Emergency stop of some channels, or of one bit of them: latched until reset.

        Args:
            block, channels, bit: what is stopped.
            source: who asks for it, and why.
            at_ns: when that was asked for [ns, CLOCK_MONOTONIC]; None: now.
            by: number of the handle that asks for it; 0: none.
            note: as of ``safe_stop``.
        """
        parts = self._parts(block, channels, bit)
        self.asked.note(id(block), parts, time.monotonic_ns() if at_ns is None else at_ns, by)
        if not isinstance(block, AxisBlock):
            self.latched_outputs |= {(id(block), *part): source for part in parts}
        self.safe_stop(_emergency_stop_by(source), [(block, channels, bit)], note)

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
            note = partial(self._note_unshown, each, self._parts(each, channels, bit), name, source)
            self.stop_node(each, channels, bit, source, note=note)
            self._log("warning", f"emergency stop of {name} by {source}")

    def _note_unshown(self, block: AnyBlock, parts: list[tuple[int, int]], name: str, source: str) -> None:
        """Note the stop of a node that nobody has asked for, and nobody can have seen yet."""
        at_ns = time.monotonic_ns() + SHOWN_NS
        self._unshown.append((block, parts, at_ns))
        entry = node_entry(
            name, self._device, block.spec.name, parts, source, stop=True, pid=os.getpid(), at_ns=at_ns
        )  # fmt: skip
        self._note(entry)

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


def _emergency_stop_by(source: str) -> Reason:
    return Reason(Stop.EMERGENCY, f"emergency stop by {source}", errno.ECANCELED)
