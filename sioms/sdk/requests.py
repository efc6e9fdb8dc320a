"""What clients may ask of a driver on a handle beside writes: the ioctl requests.

Every request either takes effect as a whole or is refused with an errno and one sentence that names
the node, the channel, the field, the value and what would be accepted.
"""

from __future__ import annotations

import errno
import math
import traceback
from collections.abc import Generator, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.motion import CommandError
from sioms.motion.queue import LIMIT_NAMES
from sioms.protocol.flags import OF_SOME_AXES, REQUESTS, Request
from sioms.protocol.text import shown

from .blocks import AnalogBlock, AxisBlock
from .driver import Awaited, Refusal
from .exchange import HookError
from .handles import LATER, Handle, Wait
from .parts import Service
from .stops import Reason, Stop
from .writing import Behind, check_link, end_writes

FEW_TICKS = 1000
"""Ticks that statistics are told of when nobody asks for more."""


def _refuse(errno_: int, text: str) -> OSError:
    return OSError(errno_, text)


def ioctl(
    service: Service, handle: Handle, number: int, request_number: int, argument: Any, timeout_s: float | None,
    sent_ns: int = 0,
) -> Any:  # fmt: skip
    """Carry out a request; see ``Request``. A RESET has to say when it was sent [ns, CLOCK_MONOTONIC].

    Returns:
        A msgpack-able value, or LATER.

    Raises:
        OSError: refused.
    """
    try:
        request = Request(request_number)
    except ValueError:
        raise _refuse(errno.ENOTTY, f"ioctl {request_number} on {handle.node}: no such request") from None
    what = f"{request.name} on {handle.node}"
    owns = handle.exclusive or not _writable(handle)
    right, owner, _, _ = REQUESTS[request]
    if owner and not owns:
        raise _refuse(errno.EBADF, f"{what}: needs the output node itself, not its read-only companion")
    if not handle.rights & right:
        raise _refuse(errno.EPERM, f"{what}: the user has no right to do that; ask for a [[grant]]")
    match request:
        case Request.EMERGENCY_STOP:
            source = f"{handle.who} on {handle.node}"
            note = partial(service.stops.note_node, handle, source, stop=True)  # before others are told
            service.stops.stop_node(handle.block, handle.channels, handle.bit, source, by=handle.number, note=note)
            return handle.begins_anew(handle.axes)
        case Request.RESET:
            if argument is not None and (type(argument) is not int or argument < 0):
                raise _refuse(errno.EINVAL, f"{what}: {shown(argument)} as instant; want a time in ns, or none for now")
            if argument is None and handle.passed_on:  # of a client that was told the time last then, by a gateway
                argument = handle.heard_ns
            return service.stops.reset_by(handle, what, sent_ns, argument, service.loop.heed)
        case Request.CANCEL_WAITS:
            ours = {int(c) for c in handle.channels}
            ended = service.waits.end_where(
                lambda w: (
                    w.handle.block is handle.block
                    and w.number != number
                    and not ours.isdisjoint(int(c) for c in w.handle.channels)
                ),
                errno.ECANCELED,
                f"cancelled by {handle.who}",
            )
            return len(ended)
        case Request.GET_STATISTICS:
            if argument is not None and (type(argument) is not int or argument < 1):
                raise _refuse(errno.EINVAL, f"{what}: {shown(argument)} ticks; want a number from 1, or none")
            return _statistics(service, handle, number, argument or FEW_TICKS, what)
        case Request.WAIT_UNTIL_EVENT:
            raise _refuse(errno.ENOTTY, f"{what}: is answered by the client library, from the page")
        case Request.ZERO_DEVICE if _corrected_here(handle):
            return _zero_analog(service, handle, number, argument, timeout_s, what)
        case Request.SET_GAINS | Request.GET_GAINS if _corrected_here(handle):
            return _gains(handle, request, argument, what)
    if isinstance(handle.block, AxisBlock):
        try:
            return _axis_request(service, handle, number, request, argument, timeout_s, what)
        except CommandError as error:
            raise _refuse(error.errno, f"{what}: {error}") from None
    try:
        answer = service.driver.ioctl(handle.block.spec, request, [int(c) for c in handle.channels], argument)
    except Refusal as error:
        raise _refuse(error.errno, f"{what}: {error}") from None
    except Exception as error:  # what a client asks for must not end what others do with the device
        trace = "".join(traceback.format_exception(error)[-3:])
        service.log("error", f"{what} with {shown(argument)}: the driver failed: {trace}")
        raise _refuse(errno.EIO, f"{what}: the driver failed: {shown(error)}") from None
    if isinstance(answer, Awaited):
        return _await(service, handle, number, answer, timeout_s, what)
    if not isinstance(answer, Generator):
        return answer
    check_link(service, handle, what)
    return service.engine.carry_out(handle, number, answer, what)


def _statistics(service: Service, handle: Handle, number: int, last: int, what: str) -> Any:
    """Tell the statistics: what was worked out just now, else when a tick is done and leaves time."""

    def report(fresh: bool) -> tuple[Any] | None:
        found = service.statistics(handle.uid, last, fresh=fresh)
        return None if found is None else (found,)

    known = report(False)
    if known is not None:
        return known[0]
    service.waits.add(Wait(handle, number, what, None, lambda: report(True), looks=True))
    return LATER


def _corrected_here(handle: Handle) -> bool:
    return isinstance(handle.block, AnalogBlock) and not handle.block.corrected_by_driver


def _writable(handle: Handle) -> bool:
    return handle.block.spec.writable or isinstance(handle.block, AxisBlock)


def _axis_request(
    service: Service, handle: Handle, number: int, request: Request, argument: Any,
    timeout_s: float | None, what: str,
) -> Any:  # fmt: skip
    bank, now_ns = handle.block.bank, service.loop.now_ns()  # type: ignore[union-attr]
    axes = handle.channels
    if request in OF_SOME_AXES:
        try:
            axes = _meant(handle, argument, what)
        except OSError:
            if request is Request.STOP:  # rather all than none
                _axis_request(service, handle, number, request, None, timeout_s, what)
            raise
    match request:
        case Request.WAIT_UNTIL_IDLE:
            block, channels = handle.block, frozenset(axes.tolist())
            if ended := [handle.cut_short.pop(axis) for axis in axes.tolist() if axis in handle.cut_short]:
                errno_, text = ended[0]
                raise _refuse(errno_, f"{what}: {text}")

            def is_written() -> bool:
                return all(channels.isdisjoint(write.axes) for write in handle.writing)

            if bank.is_idle(axes) and is_written():
                if not service.engine.publishes:  # it may have learned so since the last publication
                    service.effects.note()
                return None
            service.waits.add(
                Wait(
                    handle, number, what, service.loop.deadline(timeout_s),
                    lambda: (None,) if is_written() and service.waits.is_idle(block, channels) else None,
                    channels, looks=True, on_events=is_written(),
                )
            )  # fmt: skip
            return LATER
        case Request.SEND_EXTERNAL_SYNCH:
            return _synch(service, handle, number, argument, timeout_s, what)
        case Request.CALIBRATE_DEVICE:
            _calibrate(handle, argument, what)
        case Request.ZERO_DEVICE:
            bank.zero(axes)
        case Request.STOP:
            reason = Reason(Stop.CONTROLLED, f"stopped by {handle.who}", errno.ECANCELED)
            service.stops.safe_stop(reason, [(handle.block, axes.tolist(), -1)])
            handle.begins_anew(axes.tolist())
        case Request.FLUSH:
            end_writes(service, handle.writing, "flushed")
            bank.flush(axes)
        case Request.HOME:
            check_link(service, handle, what)
            handle.begins_anew(axes.tolist())
            bank.home(axes, now_ns)
        case Request.SET_LIMITS:
            bank.set_limits(axes, **_limits(argument, what))
        case Request.GET_LIMITS:
            return bank.get_limits(axes)
        case Request.GET_DIAGNOSTICS:
            return bank.diagnostics(axes)
        case _:
            raise _refuse(errno.ENOTTY, f"{what}: not a request of an axis")
    service.engine.commands_written(handle.block)
    return None


def _meant(handle: Handle, argument: Any, what: str) -> NDArray[np.int64]:
    """Return the axes that are asked for by their indices in the node: one, several, or all for None."""
    if argument is None:
        return handle.channels
    asked = argument if isinstance(argument, list) else [argument]
    want = f"want indices from 0 to {len(handle.channels) - 1}, or none for all axes"
    for index in asked or [None]:
        if type(index) is not int or not 0 <= index < len(handle.channels):
            raise _refuse(errno.EINVAL, f"{what}: axis {shown(index)}; {want}")
    return handle.channels[sorted(set(asked))]


def _calibrate(handle: Handle, argument: Any, what: str) -> None:
    """Give axes the positions that they are to have; those with None keep theirs."""
    asked = argument if isinstance(argument, list) else [argument]
    rows = [row for row, position in enumerate(asked) if position is not None]
    count = len(handle.channels)
    if argument is None or len(asked) != count:
        given = 0 if argument is None else len(asked)
        raise _refuse(errno.EINVAL, f"{what}: {given} values of position; want {count}, none to keep one")
    positions = _numbers([asked[row] for row in rows], len(rows), what, "position")
    if rows:
        handle.block.bank.calibrate(handle.channels[rows], np.array(positions))  # type: ignore[union-attr]


def _synch(service: Service, handle: Handle, number: int, argument: Any, timeout_s: float | None, what: str) -> Any:
    """Start what waits for the synch, after the writes that the handle has sent before it."""
    if argument is not None and type(argument) is not int:
        raise _refuse(errno.EINVAL, f"{what}: {shown(argument)} as start; want a time in ns, or none for now")

    def start() -> int:
        now_ns = service.loop.now_ns()
        start_ns = argument or now_ns
        if start_ns < now_ns - service.loop.period_ns:
            late_ms = (now_ns - start_ns) / 1e6
            raise _refuse(errno.ETIME, f"{what}: its start time passed {late_ms:.2f} ms ago; give it more lead")
        if start_ns > now_ns + 60_000_000_000:
            raise _refuse(errno.EINVAL, f"{what}: starts in {(start_ns - now_ns) / 1e9:.0f} s; want at most 60 s")
        handle.block.bank.synch(handle.channels, start_ns, now_ns)  # type: ignore[union-attr]
        service.engine.commands_written(handle.block)
        return start_ns

    behind = Behind(handle, start)
    if behind.has_turn():
        return start()
    deadline_ns = service.loop.deadline(timeout_s)
    service.waits.add(Wait(handle, number, what, deadline_ns, behind.ready, behind.axes, behind.leave))
    handle.writing.append(behind)
    return LATER


def _zero_analog(
    service: Service, handle: Handle, number: int, argument: Any, timeout_s: float | None, what: str
) -> Any:
    """Take the mean of the next good readings as offset; as many bad ones as good ones are asked for refuse it."""
    block, channels = handle.block, handle.channels
    assert isinstance(block, AnalogBlock)
    samples = 1 if argument is None else argument
    if type(samples) is not int or not 1 <= samples <= 1_000_000:
        raise _refuse(errno.EINVAL, f"{what}: {shown(samples)} samples; want 1 to 1000000")
    check_link(service, handle, what)
    total = np.zeros(len(channels))
    good = bad = 0
    last, asked_ns = service.pages.number(block), service.loop.now_ns()

    def ready() -> tuple[Any] | None:
        nonlocal good, bad, last
        now = service.pages.number(block)
        if now == last or service.pages.as_of_ns(block) < asked_ns:
            return None  # nothing new, or something measured before
        last = now
        unfit = block.unfit()[channels]
        if unfit.any():
            bad += 1
            if bad < samples:
                return None
            names = ", ".join(block.spec.channels[channel].name for channel in channels[unfit])
            raise _refuse(
                errno.EIO,
                f"{what}: {bad} readings of {good + bad} were not measurements (last {names}: INVALID, SATURATED or "
                "not finite); the offset stays as it was",
            )
        total[:] += block.data[channels]
        good += 1
        if good < samples:
            return None
        mean = total / samples
        block.set_offset(channels, mean)
        return (mean.tolist(),)

    service.waits.add(Wait(handle, number, what, service.loop.deadline(timeout_s), ready))
    return LATER


def _await(service: Service, handle: Handle, number: int, answer: Awaited, timeout_s: float | None, what: str) -> Any:
    """Answer when the driver has seen done what was asked."""
    check_link(service, handle, what)

    def ready() -> tuple[Any] | None:
        try:
            return answer.ready()
        except Refusal as error:
            raise _refuse(error.errno, f"{what}: {error}") from None
        except Exception as error:
            raise HookError(f"what {what} is waited for by") from error

    service.waits.add(Wait(handle, number, what, service.loop.deadline(timeout_s), ready))
    return LATER


def _gains(handle: Handle, request: Request, argument: Any, what: str) -> list[float] | None:
    block = handle.block
    n = len(handle.channels)
    if n != block.n:
        raise _refuse(errno.EINVAL, f"{what}: the gain matrix belongs to the whole array of {block.n} channels")
    if request is Request.GET_GAINS:
        gains = np.eye(n) if block.gains is None else block.gains  # type: ignore[union-attr]
        values: list[float] = gains.ravel().tolist()
        return values
    numbers = argument if isinstance(argument, list) else [argument]
    if len(numbers) == n:  # the diagonal alone
        block.gains = np.diag(_numbers(numbers, n, what, "gain"))  # type: ignore[union-attr]
    else:
        block.gains = np.array(_numbers(numbers, n * n, what, "gain")).reshape(n, n)  # type: ignore[union-attr]
    return None


def _limits(argument: Any, what: str) -> dict[str, Any]:
    """Check limits by name: a number, None for the configured one, or one of them an axis."""
    if not isinstance(argument, dict):
        raise _refuse(errno.EINVAL, f"{what}: want limits by name, e.g. {{position_max: 0.2}}")
    for name, given in argument.items():
        if name not in LIMIT_NAMES:
            raise _refuse(errno.EINVAL, f"{what}: no limit {shown(name)}; want one of {', '.join(LIMIT_NAMES)}")
        for value in given if isinstance(given, list) else [given]:
            if value is not None and (type(value) not in (int, float) or value != value):
                raise _refuse(errno.EINVAL, f"{what}: {name} {shown(value)}; want a number, or none")
    return argument


def _numbers(argument: Any, count: int, what: str, name: str) -> Sequence[float]:
    values = argument if isinstance(argument, list) else [argument]
    if len(values) != count:
        raise _refuse(errno.EINVAL, f"{what}: {len(values)} values of {name}; want {count}")
    for value in values:
        if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
            raise _refuse(errno.EINVAL, f"{what}: {name} {shown(value)}; want a finite number")
    return [float(value) for value in values]
