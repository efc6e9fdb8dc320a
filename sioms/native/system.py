"""What steps may ask the system for: time, events, packets, memory in order. Each is here in Python and, in ``C``,
in C."""

from __future__ import annotations

import ctypes
import os
import select
import socket
import time

from .language import Bytes, Context, Integers, record_of

MOST_EVENTS = 256

C = """
static inline int64_t sioms_clock_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

static inline int64_t sioms_wait_for(int64_t poll, int64_t *ready, int64_t timeout_ms)
{
    struct epoll_event events[256];
    int count = epoll_wait((int)poll, events, 256, (int)timeout_ms);
    for (int i = 0; i < count; i++)
        ready[i] = events[i].data.fd;
    return count < 0 ? 0 : count;
}

static inline int64_t sioms_wait_for_one(int64_t fd, int64_t until_ns)
{
    struct pollfd one = {.fd = (int)fd, .events = POLLIN};
    int64_t left = until_ns - sioms_clock_ns();
    if (left < 0)
        left = 0;
    struct timespec most = {left / 1000000000, left % 1000000000};
    return ppoll(&one, 1, &most, NULL) > 0;
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

static inline int64_t sioms_look_at_packet(int64_t sock, uint8_t *to, int64_t at, int64_t most)
{
    return recv((int)sock, to + at, (size_t)most, MSG_PEEK | MSG_DONTWAIT | MSG_TRUNC);
}

static inline int64_t sioms_drop_packet(int64_t sock)
{
    char first;
    return recv((int)sock, &first, 1, MSG_DONTWAIT);
}

static inline int64_t sioms_send_packet(int64_t sock, uint8_t *packet, int64_t size)
{
    return send((int)sock, packet, (size_t)size, MSG_DONTWAIT | MSG_NOSIGNAL);
}

static inline int64_t sioms_unread(int64_t sock)
{
    int count = 0;
    return ioctl((int)sock, TIOCOUTQ, &count) ? 0 : count;
}

static inline int64_t sioms_first_word_of(int64_t file)
{
    int64_t word = 0;
    return pread((int)file, &word, sizeof word, 0) < 0 ? -1 : word;
}

static inline int64_t sioms_changed_ns(int64_t file)
{
    struct stat found;
    return fstat((int)file, &found) ? -1 : (int64_t)found.st_mtim.tv_sec * 1000000000 + found.st_mtim.tv_nsec;
}

static inline int64_t sioms_give_way(void) { return sched_yield(); }
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


def wait_for_one(fd: int, until_ns: int) -> int:
    """Wait until a descriptor is readable, at most until a time [ns, CLOCK_MONOTONIC]; return whether it is. A signal
    ends the wait, too.
    """
    one = select.poll()
    one.register(fd, select.POLLIN)
    return int(bool(one.poll(max(until_ns - time.monotonic_ns(), 0) * 1e-6)))


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


def look_at_packet(sock: int, to: Bytes, at: int, most: int) -> int:
    """Copy the beginning of the packet that is next on a socket, which stays there; return its whole length.

    Below 0: there is none. Descriptors that came with it are not opened.
    """
    memory = memoryview(to)[at : at + most]  # type: ignore[arg-type]
    with socket.fromfd(sock, socket.AF_UNIX, socket.SOCK_SEQPACKET) as peer:
        try:
            return peer.recv_into(memory, most, socket.MSG_PEEK | socket.MSG_DONTWAIT | socket.MSG_TRUNC)
        except OSError:
            return -1


def drop_packet(sock: int) -> int:
    """Take the next packet off a socket."""
    with socket.fromfd(sock, socket.AF_UNIX, socket.SOCK_SEQPACKET) as peer:
        return len(peer.recv(1, socket.MSG_DONTWAIT))


def send_packet(sock: int, packet: Bytes, size: int) -> int:
    """Send the first bytes of an array as a packet; below 0: it could not be sent at once."""
    with socket.fromfd(sock, socket.AF_UNIX, socket.SOCK_SEQPACKET) as peer:
        try:
            return peer.send(memoryview(packet)[:size], socket.MSG_DONTWAIT)  # type: ignore[arg-type]
        except OSError:
            return -1


def unread(sock: int) -> int:
    """Return how much memory is taken by what has been sent on a socket and its other end has yet to read [bytes]."""
    import fcntl  # not where steps are compiled: every driver would load them at its start
    import termios

    try:
        return int.from_bytes(fcntl.ioctl(sock, termios.TIOCOUTQ, bytes(4)), "little")
    except OSError:
        return 0


def first_word_of(file: int) -> int:
    """Return the first 8 bytes of a file as an int, as many of them as there are; -1: it cannot be read."""
    try:
        word = int.from_bytes(os.pread(file, 8, 0), "little")
    except OSError:
        return -1
    return word - (word >> 63 << 64)


def changed_ns(file: int) -> int:
    """Return when a file was last changed [ns, wall clock]; -1: it is not known."""
    try:
        return os.fstat(file).st_mtime_ns
    except OSError:
        return -1


def give_way() -> int:
    """Let processes of the same real-time priority run."""
    os.sched_yield()
    return 0
