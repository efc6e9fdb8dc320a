"""What steps may ask the system for: time, events, memory in order. Each is here in Python and, in ``C``, in C."""

from __future__ import annotations

import ctypes
import os
import select
import time

from .language import Context, Integers, record_of

MOST_EVENTS = 64

C = """
static inline int64_t sioms_clock_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

static inline int64_t sioms_wait_for(int64_t poll, int64_t *ready, int64_t timeout_ms)
{
    struct epoll_event events[64];
    int count = epoll_wait((int)poll, events, 64, (int)timeout_ms);
    for (int i = 0; i < count; i++)
        ready[i] = events[i].data.fd;
    return count < 0 ? 0 : count;
}

static inline void *sioms_record_at(int64_t address) { return (void *)address; }

static inline int64_t sioms_expirations(int64_t timer)
{
    uint64_t count;
    return read((int)timer, &count, 8) == 8 ? (int64_t)count : 0;
}

static inline int64_t sioms_set_timer(int64_t timer, int64_t when_ns)
{
    struct itimerspec when = {.it_value = {when_ns / 1000000000, when_ns % 1000000000}};
    return timerfd_settime((int)timer, TFD_TIMER_ABSTIME, &when, 0);
}

static inline int64_t sioms_wake(int64_t pipe) { return write((int)pipe, "\\1", 1); }

static inline int64_t sioms_fence(void)
{
    __atomic_thread_fence(__ATOMIC_SEQ_CST);
    return 0;
}
"""

_libc = ctypes.CDLL(None, use_errno=True)
_ABSOLUTE = 1
_polls: dict[int, select.epoll] = {}


def clock_ns() -> int:
    """Return the time [ns, CLOCK_MONOTONIC]."""
    return time.monotonic_ns()


def wait_for(poll: int, ready: Integers, timeout_ms: int) -> int:
    """Wait for events of an epoll, at most so long [ms], below 0 for ever; write the descriptors that are ready into an
    array, return how many.

    A signal ends the wait, too: none is ready then.
    """
    found = _polls.setdefault(poll, select.epoll.fromfd(poll)) if poll not in _polls else _polls[poll]
    events = found.poll(timeout_ms * 1e-3 if timeout_ms >= 0 else None, maxevents=MOST_EVENTS)
    for i, (fd, _) in enumerate(events):
        ready[i] = fd
    return len(events)


def record_at(address: int) -> Context:
    """Return the record that has an address, see ``Record.address``."""
    return record_of(address)  # type: ignore[return-value]  # any record is


def expirations(timer: int) -> int:
    """Return how often a timer has expired since the last call."""
    try:
        return int.from_bytes(os.read(timer, 8), "little")
    except BlockingIOError:
        return 0


def set_timer(timer: int, when_ns: int) -> int:
    """Have a timer expire once at a time [ns, CLOCK_MONOTONIC]."""
    when = (ctypes.c_long * 4)(0, 0, *divmod(when_ns, 1_000_000_000))
    return int(_libc.timerfd_settime(timer, _ABSOLUTE, when, None))


def wake(pipe: int) -> int:
    """Make the other end of a pipe readable; one that is full has been readable for long."""
    try:
        return os.write(pipe, b"\1")
    except OSError:
        return -1


def fence() -> int:
    """Keep the order of stores before and after for whoever reads the memory."""
    return 0
