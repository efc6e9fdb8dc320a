"""Writes: records to the command buffers of axes, or to outputs.

A write takes effect as a whole or is refused with an errno and one sentence that names the node, the
channel, the field, the value and what would be accepted. A long array of commands is judged in pieces
between ticks, so that no write delays one.
"""

from __future__ import annotations

import errno
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.motion import CommandError, Judged, Judgement
from sioms.protocol import verbs
from sioms.protocol.flags import NodeClass, WriteFlag
from sioms.protocol.records import WRITE_STRUCT, numpy_dtype

from .blocks import AnyBlock, AxisBlock, BinaryBlock
from .handles import LATER, Handle, Wait, Writing
from .outputs import WHOLE, Change, safe_of
from .parts import Service

_DTYPE = {cls: np.dtype(numpy_dtype(cls)) for cls in NodeClass}
_REPLACE = int(WriteFlag.REPLACE)
_AT_ONCE = 16
"""Records that are judged and taken at once."""


def write(service: Service, handle: Handle, number: int, flags: int, timeout_s: float | None, data: bytes) -> Any:
    """Carry out a write of whole records.

    Args:
        service: what it works with.
        handle: who writes.
        number: message number, for an answer that comes later.
        flags: WriteFlag.
        timeout_s: how long to wait for room in the command buffers [s]; 0: not at all; None: for ever.
        data: the records, one after the other.

    Returns:
        The tick number, or LATER.

    Raises:
        OSError: refused; nothing was taken.
    """
    what = f"write {handle.node}"
    if not handle.writes:
        raise OSError(errno.EBADF, f"{what}: the handle is not open for writing")
    block = handle.block
    node_class = block.spec.node_class
    record = WRITE_STRUCT[node_class]
    size = record.size
    if not data or len(data) % size:
        raise OSError(errno.EINVAL, f"{what}: {len(data)} bytes; want whole records of {size} bytes")
    if isinstance(block, AxisBlock) and service.stops.stopped:
        raise OSError(errno.EPERM, f"{what}: stopped by emergency stop ({service.stops.source}); reset first")
    check_link(service, handle, what)
    if isinstance(block, AxisBlock):
        if handle.cut_short:
            handle.begins_anew([handle.axes[r[0]] for r in record.iter_unpack(data) if 0 <= r[0] < len(handle.axes)])
        if block.admits is not None:
            try:
                block.admits(list(record.iter_unpack(data)), handle.axes)
            except CommandError as error:
                raise OSError(error.errno, f"{what}: {error}") from None
        # One or a few records need no array; behind an earlier write that is not taken yet they wait their turn.
        is_short = len(data) <= _AT_ONCE * size and not handle.writing
        if is_short and _offer(service, handle, flags, data, service.loop.now_ns()):
            return service.loop.tick
        return _write_axes(service, handle, number, flags, timeout_s, np.frombuffer(data, _DTYPE[node_class]))
    records = np.frombuffer(data, _DTYPE[node_class])
    changes = _changes(handle, records, what)
    _take_responsibility(service, block, changes, what)
    return service.engine.write_outputs(handle, number, block, changes)


def masks_of(handle: Handle, records: NDArray[Any]) -> dict[int, int]:
    """Return which channels of the block records are for, and which bits of each (-1: all); wrong ones are left out."""
    masks: dict[int, int] = {}
    names = records.dtype.names or ()
    of_channels = records[names[0]]
    if "mask" in names and handle.bit < 0:
        asked = [*zip(of_channels.tolist(), records["mask"].tolist(), strict=True)]
    else:
        asked = [(index, 1 << handle.bit if handle.bit >= 0 else -1) for index in np.unique(of_channels).tolist()]
    for index, mask in asked:
        if 0 <= index < len(handle.axes):
            masks[handle.axes[index]] = masks.get(handle.axes[index], 0) | (mask or -1)
    return masks


def concerned(handle: Handle, message: verbs.Message, ahead: bytes = b"") -> dict[int, int]:
    """Return what a message is for, as ``masks_of``; ``ahead`` are records that have come ahead of it."""
    if isinstance(message, verbs.Write):
        dtype, records = _DTYPE[handle.block.spec.node_class], ahead + message.records
        if not len(records) % dtype.itemsize:
            return masks_of(handle, np.frombuffer(records, dtype))
    return dict.fromkeys(handle.axes, 1 << handle.bit if handle.bit >= 0 else -1)


def take_plain(service: Service, handle: Handle, flags: int, data: bytes, now_ns: int) -> None:
    """Take records that steps have found plain and good, and have acknowledged.

    Raises:
        ValueError: they are not; the client has been told what is not true.
    """
    if not _offer(service, handle, flags, data, now_ns):
        raise ValueError(f"write {handle.node}: acknowledged by steps and not taken by the bank")


def _offer(service: Service, handle: Handle, flags: int, data: bytes, now_ns: int) -> bool:
    """Take a short write at once, if it is plain."""
    block = handle.block
    short = list(WRITE_STRUCT[NodeClass.AXIS].iter_unpack(data))
    taken: bool = block.bank.offer(short, handle.axes, now_ns, replace=bool(flags & _REPLACE))  # type: ignore[union-attr]
    if taken:
        service.engine.commands_written(block)
    return taken


def check_link(service: Service, handle: Handle, what: str) -> None:
    """Refuse what would wait for a lost device and begin by itself when that is back."""
    reason = service.pages.why_not(handle.block)
    if reason:
        raise OSError(errno.EIO, f"{what}: its device does not answer ({reason}); write again when it is back")


# --- axes ----------------------------------------------------------------------------------------


class AxesWrite:
    """A write of axis records on its way into the buffers.

    It waits for the earlier writes of its handle, is judged in pieces, and waits for room if its writer
    is patient. One that replaces the buffer overtakes the earlier ones, and ends them when it is taken.

    Attributes:
        lacks_room: whether it has been found to need more room than there is.
        replaces: whether it replaces the buffer.
        axes: of the block.
    """

    __slots__ = ("_handle", "_judgement", "_patient", "_records", "_service", "axes", "lacks_room", "replaces")

    def __init__(self, service: Service, handle: Handle, records: NDArray[Any], replace: bool, patient: bool) -> None:
        self.lacks_room = False
        self._service = service
        self._handle = handle
        self._records = records
        self.replaces = replace
        self._patient = patient
        self._judgement: Judgement | None = None
        self.axes = frozenset(masks_of(handle, records))

    def ready(self) -> tuple[int] | None:
        """Go on while the tick leaves time; return (tick,) when all is in the buffers.

        Raises:
            OSError: refused; nothing was taken.
        """
        if not self.has_turn():
            return None
        while self._service.loop.has_time():
            if self.step():
                return (self._service.loop.tick,)
            if self.lacks_room:
                return None
        return None

    def has_turn(self) -> bool:
        """Tell whether no earlier write of the handle stands before it.

        Raises:
            OSError: EAGAIN, one waits for room and this writer does not want to wait.
        """
        writing = self._handle.writing
        if self.replaces or not writing or writing[0] is self:
            return True
        if writing[0].lacks_room and not self._patient:
            raise self._refusal(errno.EAGAIN, "an earlier write still waits for room")
        return False

    def step(self) -> bool:
        """Judge a piece, or take what has been judged; return whether it is taken.

        Raises:
            OSError: refused; nothing was taken.
        """
        bank, axes = self._handle.block.bank, self._handle.channels  # type: ignore[union-attr]
        now_ns = self._service.loop.now_ns()
        self.lacks_room = False
        try:
            if len(self._records) <= _AT_ONCE:
                bank.append(self._records, axes, now_ns, replace=self.replaces)
            else:
                if self._judgement is None:
                    self._judgement = bank.judge(self._records, axes, now_ns, replace=self.replaces)
                judged = _next(self._judgement)
                if judged is None:
                    return False
                self._judgement = None
                if not bank.take(judged, now_ns):
                    return False  # its axes have changed since: judge it again
        except CommandError as error:
            self._judgement = None
            if error.errno != errno.EAGAIN or not self._patient:
                raise self._refusal(error.errno, str(error)) from None
            self.lacks_room = True
            return False
        self._end_older()
        self.leave()
        self._service.engine.commands_written(self._handle.block)
        return True

    def leave(self) -> None:
        """Let the later writes of the handle have their turn."""
        if self in self._handle.writing:
            self._handle.writing.remove(self)

    def _end_older(self) -> None:
        """What replaces the buffer also replaces what is on its way into it."""
        writing = self._handle.writing
        older = writing[: writing.index(self)] if self in writing else writing
        replaced = [write for write in older if not self.axes.isdisjoint(write.axes)]
        end_writes(self._service, replaced, "replaced by a later write")

    def _refusal(self, errno_: int, text: str) -> OSError:
        return OSError(errno_, f"write {self._handle.node}: {text}")


class Behind:
    """What is to be done after the writes that a handle has sent before it.

    It waits for those that are judged, not for those that wait for room: what makes room may be what it starts.

    Args:
        handle: of the client.
        act: does it.
    """

    __slots__ = ("_act", "_handle", "axes", "lacks_room", "replaces")

    def __init__(self, handle: Handle, act: Callable[[], int]) -> None:
        self.lacks_room = self.replaces = False
        self.axes = frozenset(handle.axes)
        self._handle, self._act = handle, act

    def has_turn(self) -> bool:
        """Tell whether no write before it is about to come into the buffers."""
        lacks_room = False
        for write in self._handle.writing:
            if write is self:
                break
            lacks_room |= write.lacks_room
            if not lacks_room or (write.replaces and not write.lacks_room):
                return False
        return True

    def ready(self) -> tuple[int] | None:
        """Do it when it has its turn.

        Raises:
            OSError: refused.
        """
        if not self.has_turn():
            return None
        done = self._act()
        self.leave()
        return (done,)

    def leave(self) -> None:
        """Let the later writes of the handle have their turn."""
        if self in self._handle.writing:
            self._handle.writing.remove(self)


def end_writes(service: Service, writes: Sequence[Writing], text: str) -> None:
    """Refuse writes that are on their way into the buffers."""
    if writes:
        leaving = [write.leave for write in writes]
        service.waits.end_where(lambda w: w.cancelled in leaving, errno.ECANCELED, text)


def _next(judgement: Judgement) -> Judged | None:
    """Judge one piece more; return the outcome at the end."""
    try:
        next(judgement)
    except StopIteration as end:
        judged: Judged = end.value
        return judged
    return None


def _write_axes(
    service: Service, handle: Handle, number: int, flags: int, timeout_s: float | None, records: NDArray[Any]
) -> Any:
    patient = timeout_s is None or timeout_s > 0
    write = AxesWrite(service, handle, records, bool(flags & _REPLACE), patient)
    # A piece of a long one takes as long as a tick has to spare; it is begun after one.
    if write.has_turn() and (len(records) <= _AT_ONCE or service.loop.has_time()) and write.step():
        return service.loop.tick
    limit_ns = service.loop.deadline(timeout_s) if patient else None
    what = f"write {handle.node}"
    service.waits.add(Wait(handle, number, what, limit_ns, write.ready, write.axes, write.leave))
    handle.writing.append(write)
    return LATER


# --- outputs -------------------------------------------------------------------------------------


def _take_responsibility(service: Service, block: AnyBlock, changes: Mapping[int, Change], what: str) -> None:
    """Let a client say what outputs shall be; under a stop that may only be their safe values.

    Raises:
        OSError: EPERM, an output is stopped and this is not its safe value.
    """
    stops, stopped = service.stops, []
    for channel, change in changes.items():
        held, source = stops.held(block, channel)
        if not held & change.mask:
            continue
        safe, part = safe_of(block.spec, channel), held & change.mask
        if safe is None or Change(part, safe.value).over(0) != Change(part, change.value).over(0):
            first = "reset first" if stops.stopped else "reset the node first"
            but = "" if safe is None else ", or write its safe value"
            raise OSError(errno.EPERM, f"{what}: stopped by emergency stop ({source}); {first}{but}")
        stopped.append((channel, Change(part, safe.value)))
    service.outputs.release(block, changes)
    for channel, safe_part in stopped:
        service.outputs.want(block, channel, safe_part)


def _changes(handle: Handle, records: NDArray[Any], what: str) -> dict[int, Change]:
    """Check the records of an output and turn them into one change of each channel."""
    block = handle.block
    changes: dict[int, Change] = {}
    for record in records:
        index = int(record["channel"])
        if not 0 <= index < len(handle.channels):
            raise OSError(errno.EINVAL, f"{what}: channel {index}; want 0 to {len(handle.channels) - 1}")
        channel = int(handle.channels[index])
        info = block.spec.channels[channel]
        if isinstance(block, BinaryBlock):
            value, width = int(record["data"]), info.width
            mask = int(record["mask"]) or (1 << width) - 1
            if handle.bit >= 0:
                if value not in (0, 1):
                    raise OSError(errno.EINVAL, f"{what}: data {value}; want 0 or 1")
                value, mask = value << handle.bit, 1 << handle.bit
            elif not 0 <= value < 1 << width:
                raise OSError(errno.EINVAL, f"{what}: channel {info.name}: data {value}; want 0 to {(1 << width) - 1}")
            mask &= (1 << width) - 1
            before = changes.get(channel, Change(0, 0))
            changes[channel] = Change(before.mask | mask, Change(mask, value).over(before.value))
        else:
            number = float(record["data"])
            low = -math.inf if info.minimum is None else info.minimum
            high = math.inf if info.maximum is None else info.maximum
            if not math.isfinite(number):
                raise OSError(errno.EINVAL, f"{what}: channel {info.name}: data {number}; want a finite number")
            if not low <= number <= high:
                raise OSError(
                    errno.ERANGE,
                    f"{what}: channel {info.name}: data {number:g} {info.unit}; want {low:g} to {high:g} {info.unit}",
                )
            changes[channel] = Change(WHOLE, number)
    return changes
