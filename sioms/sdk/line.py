"""The line: runs drivers' steps on a connection, one exchange at a time.

Keeps what every half-duplex line needs: the silence before a request, the exact length of a reply,
time-outs, silence and draining after a bad reply (so that a late reply is never taken for the next),
repetition of what may be repeated, and counters.

Concurrency: owned by the driver process's one thread; driven by ``receive`` and ``advance_time``.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum, IntEnum, auto
from heapq import heappop, heappush
from itertools import count
from typing import Any

from msgspec import Struct, field

from .connection import Connection
from .exchange import DeviceError, Exchange, HookError, LinkError, Pause, Send, SideExchange, Step, Steps
from .side_connection import SideConnection

ATTEMPTS = 2
"""Times a repeatable request is sent before its exchange counts as failed."""
SIDE_POLL_NS = 1_000_000
"""How often the connection beside the line is looked at while something is asked there, which is at opening."""
STRAY = 8
"""Bytes in front of a reply that may be skipped where a checksum says that the rest is one: an adapter that switches
its direction puts a 0x00 or 0xFF there."""
PAUSE_NS = 20_000_000
"""Longest pause within a reply that begins with stray bytes, or is damaged; a USB adapter hands on what it has every 16
ms.
"""
BABBLE_NS = 500_000_000
"""How much longer than the silence it owes a line may go on after a bad reply; then the exchange has failed."""


class Priority(IntEnum):
    """Order of jobs that are ready at the same time."""

    STOP = 0
    ACT = 1
    POLL = 2
    OUTPUT = 2
    """In turn with polls: a client that writes without pause must not keep the state from being read."""


Done = Callable[[Any, Exception | None], None]
"""Called with a job's return value, or with the LinkError or DeviceError that ended it."""


class Job(Struct, eq=False):
    """One run of a hook."""

    steps: Steps
    priority: Priority
    done: Done


class Counters(Struct):
    """What the line has been through."""

    requests: int = 0
    replies: int = 0
    repeats: int = 0
    timeouts: int = 0
    garbled: int = 0
    refused: int = 0
    noise_bytes: int = 0
    strangers: int = 0
    reconnects: int = 0
    sent_bytes: int = 0
    received_bytes: int = 0


class _State(Enum):
    IDLE = auto()
    RESTING = auto()
    """Waiting until ``_until_ns``: silence before a request, or a Pause."""
    EXPECTING = auto()
    RECOVERING = auto()
    SIDE_LINE = auto()


class _Running(Struct):
    job: Job
    step: Step | None = None
    attempts: int = 0
    reply: bytearray = field(default_factory=bytearray)
    damage: str = ""
    """What is wrong with the reply so far, if nothing comes behind it that would make its beginning stray bytes."""


class Line:
    """Runs jobs on a connection.

    Args:
        connection: the open connection.
        gap_s: silence before each request [s].
        recovery_s: silence after a bad or missing reply [s].
        counters: kept over reconnections.
        unsolicited: takes bytes that no exchange waits for; None counts them as noise.
        side_line: the connection beside the line, for a driver that has one.
        told: takes what is worth a line in the log.
    """

    def __init__(
        self, connection: Connection, gap_s: float, recovery_s: float, counters: Counters,
        unsolicited: Callable[[bytes, int], None] | None = None, side_line: SideConnection | None = None,
        told: Callable[[str], None] = lambda text: None,
    ) -> None:  # fmt: skip
        self.connection = connection
        self.counters = counters
        settings = connection.settings
        self._character_ns = int(settings.bits_per_character / settings.baud * 1e9) if settings.serial else 0
        self._gap_ns = int(gap_s * 1e9)
        self._recovery_ns = int(recovery_s * 1e9)
        self._unsolicited = unsolicited
        self._side_line = side_line
        self._queue: list[tuple[int, int, Job]] = []
        self._order = count()
        self._running: _Running | None = None
        self._suspended: list[tuple[_Running, Any]] = []
        self._state = _State.IDLE
        self._until_ns = 0
        self._babble_ns = 0
        self._failure = LinkError("")
        self._quiet_since_ns = 0
        self._told = told
        self._is_serial = settings.serial is not None
        self._has_echo = False
        self._echo = b""
        """What has been sent and has not come back yet, on a line that returns what is sent."""

    @property
    def deadline_ns(self) -> int | None:
        """When ``advance_time`` has something to do, None when only bytes or jobs matter."""
        return None if self._state is _State.IDLE else self._until_ns

    @property
    def is_free(self) -> bool:
        """Whether nothing runs and nothing waits."""
        return self._running is None and not self._queue

    def submit(self, steps: Steps, priority: Priority, done: Done, now_ns: int) -> None:
        """Run a hook as soon as the line is free for it; a stop goes in after the present exchange."""
        heappush(self._queue, (priority, next(self._order), Job(steps, priority, done)))
        if self._running is None:
            self._next_job(now_ns)

    def close(self) -> None:
        """Release the connections."""
        self.connection.close()
        if self._side_line is not None:
            self._side_line.close()

    def abandon(self, reason: str) -> None:
        """End all jobs with a LinkError; the connection is gone."""
        running = [self._running] if self._running else []
        jobs = [r.job for r in running] + [r.job for r, _ in self._suspended] + [job for _, _, job in self._queue]
        self._running, self._suspended, self._queue, self._state = None, [], [], _State.IDLE
        for job in jobs:
            job.steps.close()
            job.done(None, LinkError(reason))

    def receive(self, now_ns: int) -> None:
        """Take what has come; raises OSError when the connection is gone."""
        data = self.connection.read()
        if not data:
            return
        self.counters.received_bytes += len(data)
        self._quiet_since_ns = now_ns
        data = self._without_echo(data)
        if not data:
            return
        if self._state is not _State.EXPECTING or self._running is None:
            if self._unsolicited is not None and self._state is not _State.RECOVERING:
                self._unsolicited(data, now_ns)
            else:
                self.counters.noise_bytes += len(data)
            return
        running = self._running
        exchange = running.step
        if not isinstance(exchange, Exchange):
            return
        running.reply += data
        try:
            running.damage = ""
            found = self._reply_in(exchange, running.reply)
            if found is None:
                if running.damage:
                    self._until_ns = min(self._until_ns, now_ns + PAUSE_NS)
                return
            length, value = found
        except LinkError as error:
            self.counters.garbled += 1
            self._recover(str(error), now_ns, heard=True)
        except DeviceError as error:
            self.counters.replies += 1
            self.counters.refused += 1
            self._resume(error, now_ns)
        else:
            self.counters.replies += 1
            rest = bytes(running.reply[length:])
            if rest and self._unsolicited is None:
                self.counters.noise_bytes += len(rest)
            self._resume(value, now_ns)
            if rest and self._unsolicited is not None:
                self._unsolicited(rest, now_ns)

    def _reply_in(self, exchange: Exchange, reply: bytearray) -> tuple[int, Any] | None:
        """Return the length of the reply, with what is in front of it, and its value; None while more must come.

        Raises:
            LinkError: this is not a reply, nor the beginning of one.
            DeviceError: the device refuses.
        """
        data = bytes(reply)
        try:
            return _whole_reply(exchange, data, 0)
        except LinkError as error:
            if self._is_serial and not self._has_echo:
                if len(data) < len(exchange.data) and exchange.data.startswith(data):
                    return None  # it may become the echo of the request
                if data.startswith(exchange.data):
                    self._has_echo = True
                    self._told("the line returns what is sent to it; that is dropped (local echo of the adapter)")
                    del reply[: len(exchange.data)]
                    return self._reply_in(exchange, reply) if reply else None
            found, waits = _behind_stray(exchange, data) if exchange.has_checksum else (None, False)
            if found is not None:
                self.counters.noise_bytes += 1
            elif not waits:
                raise
            elif self._running is not None:
                self._running.damage = str(error)
            return found

    def _without_echo(self, data: bytes) -> bytes:
        """Return what has come without what was sent, on a line that returns it."""
        if not self._has_echo or not self._echo:
            return data
        count = min(len(data), len(self._echo))
        if data[:count] != self._echo[:count]:
            self._echo = b""
            return data
        self._echo = self._echo[count:]
        return data[count:]

    def advance_time(self, now_ns: int) -> None:
        """Do what is due: the end of a silence, a time-out."""
        if self._state is _State.IDLE or now_ns < self._until_ns:
            return
        running = self._running
        if running is None:
            self._state = _State.IDLE
            return
        match self._state:
            case _State.RESTING:
                if isinstance(running.step, Pause):
                    self._resume(None, now_ns)
                else:
                    self._transmit(now_ns)
            case _State.EXPECTING if running.damage:
                self.counters.garbled += 1
                self._recover(running.damage, now_ns, heard=True)
            case _State.EXPECTING:
                self.counters.timeouts += 1
                step = running.step
                what = step.what if isinstance(step, Exchange) else "exchange"
                heard = len(running.reply)
                got = f"{heard} bytes and no whole reply" if heard else "no reply"
                if heard and self._unsolicited is not None:  # what it has said unasked, instead of a reply
                    self._unsolicited(bytes(running.reply), now_ns)
                self._recover(f"{what}: {got} within its time-out", now_ns, heard=heard > 0)
            case _State.RECOVERING:
                quiet_ns = self._quiet_since_ns + self._recovery_ns
                if now_ns < quiet_ns and now_ns < self._babble_ns:
                    self._until_ns = min(quiet_ns, self._babble_ns)
                    return
                self._after_recovery(now_ns)
            case _State.SIDE_LINE:
                self._poll_side_line(now_ns)

    # --- inside ----------------------------------------------------------------------------------

    def _next_job(self, now_ns: int) -> None:
        if self._queue and (not self._suspended or self._queue[0][0] == Priority.STOP):
            job = heappop(self._queue)[2]
            self._running = _Running(job)
            self._resume(None, now_ns)
        elif self._suspended:
            self._running, value = self._suspended.pop()
            self._resume(value, now_ns)

    def _resume(self, value: Any, now_ns: int) -> None:
        """Give a step's result to the hook and begin its next step."""
        running = self._running
        if running is None:
            return
        self._state = _State.IDLE
        if self._queue and self._queue[0][0] == Priority.STOP and running.job.priority != Priority.STOP:
            self._suspended.append((running, value))
            self._running = None
            self._next_job(now_ns)
            return
        try:
            step = running.job.steps.throw(value) if isinstance(value, Exception) else running.job.steps.send(value)
        except StopIteration as end:
            self._finish(running.job, end.value, None, now_ns)
        except (LinkError, DeviceError) as error:
            self._finish(running.job, None, error, now_ns)
        except Exception as error:  # never to be taken for something that the line or a client has done
            failure = HookError(getattr(running.job.steps, "__qualname__", "a hook"))
            failure.__cause__ = error
            self._running = None
            try:
                self._next_job(now_ns)  # what waits may be a stop
            finally:
                raise failure
        else:
            running.step, running.attempts = step, 0
            self._begin(step, now_ns)

    def _finish(self, job: Job, value: Any, error: Exception | None, now_ns: int) -> None:
        self._running = None
        job.done(value, error)
        if self._running is None:
            self._next_job(now_ns)

    def _begin(self, step: Step, now_ns: int) -> None:
        if isinstance(step, Pause):
            self._rest_until(now_ns + int(step.duration_s * 1e9))
        elif isinstance(step, SideExchange):
            self._ask_side_line(step, now_ns)
        elif now_ns < self._quiet_since_ns + self._gap_ns:
            self._rest_until(self._quiet_since_ns + self._gap_ns)
        else:
            self._transmit(now_ns)

    def _rest_until(self, until_ns: int) -> None:
        self._state, self._until_ns = _State.RESTING, until_ns

    def _transmit(self, now_ns: int) -> None:
        running = self._running
        if running is None or not isinstance(running.step, Exchange | Send):
            return
        step = running.step
        just_read = now_ns == self._quiet_since_ns and self.connection.settings.udp is None
        stale = b"" if just_read else self.connection.read()
        if stale and self._unsolicited is not None:
            self._unsolicited(stale, now_ns)
        else:
            self.counters.noise_bytes += len(stale)
        self.connection.write(step.data)
        self._echo = step.data if stale or isinstance(step, Exchange) else self._echo + step.data
        self.counters.requests += 1
        self.counters.sent_bytes += len(step.data)
        on_line_ns = len(step.data) * self._character_ns
        self._quiet_since_ns = now_ns + on_line_ns
        if isinstance(step, Send):
            if on_line_ns:
                running.step = Pause(0.0)  # resume when the last bit has left
                self._rest_until(now_ns + on_line_ns)
            else:
                self._resume(None, now_ns)
            return
        running.attempts += 1
        running.reply.clear()
        running.damage = ""
        self._state = _State.EXPECTING
        self._until_ns = now_ns + on_line_ns + int(step.timeout_s * 1e9)

    def _ask_side_line(self, step: SideExchange, now_ns: int) -> None:
        if self._side_line is None:
            raise RuntimeError(f"{step.exchange.what}: the driver has no side line")
        self.counters.requests += 1
        if step.anew:
            self._side_line.close()
        self._side_line.begin(step.exchange, now_ns)
        self._state, self._until_ns = _State.SIDE_LINE, now_ns

    def _poll_side_line(self, now_ns: int) -> None:
        if self._side_line is None:
            return
        try:
            found = self._side_line.advance(now_ns)
        except (LinkError, DeviceError) as error:
            self.counters.refused += isinstance(error, DeviceError)
            self._resume(error, now_ns)
            return
        if found is None:
            self._until_ns = now_ns + SIDE_POLL_NS
        else:
            self.counters.replies += 1
            self._resume(found[0], now_ns)

    def _recover(self, reason: str, now_ns: int, *, heard: bool) -> None:
        self._state = _State.RECOVERING
        self._failure = LinkError(reason)
        self._failure.heard = heard
        self._until_ns = max(now_ns, self._quiet_since_ns) + self._recovery_ns
        self._babble_ns = self._until_ns + BABBLE_NS

    def _after_recovery(self, now_ns: int) -> None:
        running = self._running
        if running is None:
            return
        step = running.step
        if isinstance(step, Exchange) and step.repeatable and running.attempts < ATTEMPTS:
            self.counters.repeats += 1
            self._transmit(now_ns)
        else:
            self._resume(self._failure, now_ns)


def _whole_reply(exchange: Exchange, data: bytes, start: int) -> tuple[int, Any] | None:
    """Return where the reply that begins at ``start`` ends, and its value; None while it is incomplete."""
    length = exchange.want(data[start:])
    if length is None or len(data) - start < length:
        return None
    return start + length, exchange.decode(data[start : start + length])


def _behind_stray(exchange: Exchange, data: bytes) -> tuple[tuple[int, Any] | None, bool]:
    """Return the reply behind a few stray bytes if it is there, and whether it may still come."""
    waits = False
    for start in range(1, min(STRAY, len(data) - 1) + 1):
        try:
            found = _whole_reply(exchange, data, start)
        except LinkError:
            continue
        if found is not None:
            return found, False
        waits = True
    return None, waits or len(data) <= STRAY
