"""What is stopped in a driver process, and how that is reset: what a reset clears, leaves and refuses.

Concurrency: the one thread of the driver process.
"""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from sioms.motion import CommandError
from sioms.part_times import PartTimes
from sioms.protocol.driver_verbs import AlarmChanged, StopsShown
from sioms.protocol.flags import Severity
from sioms.protocol.journal import JournalWriter, Note
from sioms.protocol.latch import Latch
from sioms.protocol.stopfile import StopRequest
from sioms.protocol.stopjournal import StopJournal, node_entry, parts_of
from sioms.protocol.verbs import Message

from .blocks import AnyBlock, AxisBlock
from .effects import Effects
from .engine import Engine
from .handles import Handle
from .outputs import WHOLE


class Resets:
    """What is stopped, and its resets; ``Stops`` stops.

    Args:
        device: its name.
        blocks: its blocks.
        effects: of the driver process.
        handles: of the clients, by number.
        log: writes a line of a level to the daemon's log.
        tell: sends the daemon a message.
        latch: the workcell's emergency-stop latch.
        request: file in which any client asks for an emergency stop.
        journal: where stops are noted before they are acknowledged, so that they outlive this process.
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
        self, device: str, blocks: Sequence[AnyBlock], effects: Effects, handles: Mapping[int, Handle],
        log: Callable[[str, str], None], tell: Callable[[Message], None], latch: Latch, request: StopRequest,
        journal: StopJournal, events: JournalWriter,
    ) -> None:  # fmt: skip
        self.stopped = False
        self.resets, self.asked, self.faults = PartTimes(), PartTimes(), PartTimes()
        self.latched_outputs: dict[tuple[int, int, int], str] = {}
        self._faulty: set[tuple[int, int]] = set()
        self._unshown: list[tuple[AnyBlock, list[tuple[int, int]], int]] = []
        """What alarms have stopped since the last publication: for who resets it, that counts from when it is shown, at
        the latest from a time when the daemon lists it [ns, CLOCK_MONOTONIC]."""
        self._device, self._blocks = device, blocks
        self._axes = [block for block in blocks if isinstance(block, AxisBlock)]
        self._effects, self._handles, self._log, self._tell = effects, handles, log, tell
        self._latch, self._request, self._journal, self._events = latch, request, journal, events
        self._ended_ns = latch.ended_stop_ns

    @property
    def source(self) -> str:
        """Who has stopped the workcell, and why."""
        latch, request = self._latch, self._request
        is_asked = not latch.stopped_ns and request.mark != latch.answered_request
        return request.source if is_asked else latch.source

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

    @staticmethod
    def _parts(block: AnyBlock, channels: Iterable[int], bit: int) -> list[tuple[int, int]]:
        return [part for c in channels for part in parts_of(int(c), bit, block.spec.channels[c].width)]

    def _is_stopped(self, block: AnyBlock, part: tuple[int, int]) -> bool:
        """Tell whether a part of a block is under an emergency stop."""
        if isinstance(block, AxisBlock):
            return block.bank.is_stopped(part[0])
        return (id(block), *part) in self.latched_outputs

    def _stopped_of(self, block: AnyBlock, channels: Iterable[int], bit: int) -> list[tuple[int, int]]:
        """Return which parts of some channels are stopped or in fault, by themselves."""
        if isinstance(block, AxisBlock):
            return [(int(axis), 0) for axis in channels if block.bank.is_latched(int(axis))]
        return [part for part in self._parts(block, channels, bit) if self._is_stopped(block, part)]

    def _name(self, block: AnyBlock) -> str:
        return ".".join(part for part in (self._device, block.spec.name) if part)

    def before_telling(self) -> None:
        """Note what anybody may see from now on, and tell the daemon first. Cheap where there is nothing."""
        if self._unshown:
            unshown, self._unshown = self._unshown, []
            now_ns = time.monotonic_ns()
            for block, parts, at_ns in unshown:
                self.asked.note(id(block), parts, min(at_ns, now_ns))
            self._tell(StopsShown(now_ns))
        self.note_faults()

    def note_faults(self) -> None:
        """Note that axes have come into fault, and tell the daemon, before anybody can see it. Cheap where there is
        none.
        """
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

    def _note(self, entry: dict[str, Any]) -> None:
        try:
            self._journal.append(entry, time.time())
        except OSError as error:
            self._log("error", f"a stop or reset is not kept beyond this process: {error.strerror}")

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

    def _begin_reset(self, block: AnyBlock, channels: Any, bit: int) -> list[tuple[int, int]]:
        """Tell recorders of a reset; return which parts were stopped or in fault."""
        self._effects.note()
        self._events.note(Note.RESET, time.monotonic_ns(), block.spec.name, [int(c) for c in channels])
        return self._stopped_of(block, channels, bit)

    def _note_reset(self, block: AnyBlock, stopped: Sequence[tuple[int, int]], at_ns: int, by: int = 0) -> None:
        """Note when parts of a block, that are stopped or in fault, were reset; see ``PartTimes.note``."""
        if not stopped:
            return
        self.resets.note(id(block), stopped, at_ns, by)
        reset = {channel for channel, _ in stopped}
        for handle in self._handles.values():
            if handle.block is block and not reset.isdisjoint(handle.axes) and handle.number != by:
                handle.note_reset(at_ns)

    def _note_workcell_reset(self) -> None:
        """Note that the workcell has been reset."""
        latch, before_ns = self._latch, self._ended_ns
        self._ended_ns = ended_ns = latch.ended_stop_ns
        if ended_ns != before_ns:
            self.resets.note_all(latch.ended_ns)
            for handle in self._handles.values():
                handle.note_reset(latch.ended_ns)
        else:  # the workcell was not stopped: of what its nodes are
            for block in self._blocks:
                self._note_reset(block, self._stopped_of(block, range(block.n), -1), latch.reset_ns)

    def _clear(self, block: AnyBlock, parts: Iterable[tuple[int, int]]) -> None:
        """Clear the stop and the faults of parts of a block."""
        if isinstance(block, AxisBlock):
            self._reset_axes(block, [axis for axis, _ in parts])
            return
        for part in parts:
            self.latched_outputs.pop((id(block), *part), None)

    def _reset_axes(self, block: AxisBlock, channels: Any) -> None:
        for axis in channels:
            self._tell_fault(block, int(axis), Severity.NONE, "it has been reset")
        block.bank.reset(channels)
        self.engine.commands_written(block)
