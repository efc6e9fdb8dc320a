"""Ticks in which nothing happens but motion: from one wait of the process to the next event that is more than that.

``run`` waits as the loop does. What is due is done here as long as the timer is all that is ready, nobody has asked for
a stop, no lease runs out, and the driver's own step has nothing to tell. Everything else is the loop's (runtime.py),
which finds a state as if it had done the ticks itself.
"""

from __future__ import annotations

from typing import Final

from sioms.native.language import Call, Context, Integers, Record, step
from sioms.native.system import clock_ns, expirations, fence, wait_for, wake

STOPPED: Final = 0
RESETS: Final = 1
DAEMON_ALIVE: Final = 2
ORDERS: Final = 5
"""Words of the latch page."""
HEAD: Final = 9
ALIVE: Final = 10
FIRST: Final = 32
SLOT: Final = 4
"""Words of a page: number of the newest snapshot, stamp of life, begin of the slots; and of a slot's header."""

INPUTS: Final = 0
OUTPUTS: Final = 1
"""Instants of a tick that its step notes: readings are there, outputs are set [ns, CLOCK_MONOTONIC]."""
RING: Final = 8192
PHASES: Final = 7
"""Ticks whose times are kept, and how many of each; see statistics.py."""
MOST_SUBSCRIBERS: Final = 32


class Page(Record):
    """The page of a block: ``words`` of its memory, ``payload`` in words of 8 bytes, ``slot`` words of a snapshot,
    ``number`` of the newest. ``pipes`` of who subscribed, every how many publications each is woken, and after how many
    more.
    """

    words: Integers
    payload: Integers
    count: int
    slot: int
    mask: int
    number: int
    subscribers: int
    pipes: Integers
    every: Integers
    countdown: Integers


class Quiet(Record):
    """A driver process between two events.

    ``poll``, ``timer`` and ``ready``: descriptors. ``latch`` page, and what of it has been seen. After ``until_ns`` a
    lease or a wait may end. ``device`` has the steps ``tick`` and ``slack``. ``scheduled_ns``, ``began_ns`` and
    ``number`` of the last tick; ``done`` ticks of this run; ``expired``: the timer has been read, and the tick is the
    loop's; ``slackens``: the loop has to do the slack of the last tick. ``ring`` of the statistics.
    """

    poll: int
    timer: int
    ready: Integers
    latch: Integers
    stopped: int
    resets: int
    orders: int
    daemon_lease_ns: int
    until_ns: int
    period_ns: int
    device: Context
    tick: Call
    slack: Call
    instants: Integers
    scheduled_ns: int
    began_ns: int
    number: int
    done: int
    expired: int
    slackens: int
    ring: Integers
    ticks: int
    longest_ns: int


@step
def publish(p: Page, stamp_ns: int, tick: int, as_of_ns: int) -> int:
    """Publish a snapshot, as ``PageWriter.publish`` does, and wake whose turn it is."""
    number = p.number + 1
    at = FIRST + (number & p.mask) * p.slot
    p.words[at] = 0
    fence()
    p.words[at + 1] = stamp_ns
    p.words[at + 2] = tick
    p.words[at + 3] = as_of_ns
    for i in range(p.count):
        p.words[at + SLOT + i] = p.payload[i]
    fence()
    p.words[at] = number
    p.words[HEAD] = number
    p.number = number
    for i in range(p.subscribers):
        if p.every[i] > 0:
            p.countdown[i] -= 1
            if p.countdown[i] <= 0:
                p.countdown[i] = p.every[i]
                wake(p.pipes[i])
    return 0


@step
def record(q: Quiet, ended_ns: int, slack_ns: int) -> int:
    """Note the times of the last tick, as ``TickStatistics.record`` does."""
    i = q.ticks & (RING - 1)
    total_ns = ended_ns - q.scheduled_ns
    q.ring[i] = q.began_ns - q.scheduled_ns
    q.ring[RING + i] = q.instants[INPUTS] - q.began_ns
    q.ring[2 * RING + i] = q.instants[OUTPUTS] - q.instants[INPUTS]
    q.ring[3 * RING + i] = ended_ns - q.instants[OUTPUTS]
    q.ring[4 * RING + i] = ended_ns - q.began_ns
    q.ring[5 * RING + i] = total_ns
    q.ring[6 * RING + i] = ended_ns - q.began_ns + slack_ns
    q.ticks += 1
    q.longest_ns = max(q.longest_ns, total_ns)
    return 0


@step
def one_tick(q: Quiet) -> int:
    """Do a tick. Returns 0 when the loop has to do it, or its slack."""
    began_ns = clock_ns()
    if q.latch[STOPPED] != q.stopped or q.latch[RESETS] != q.resets or q.latch[ORDERS] != q.orders:
        return 0
    if began_ns - q.latch[DAEMON_ALIVE] > q.daemon_lease_ns or began_ns >= q.until_ns:
        return 0
    scheduled_ns = q.scheduled_ns + q.period_ns
    if q.tick(q.device, scheduled_ns, began_ns, q.number + 1):
        return 0
    q.expired = 0
    q.scheduled_ns = scheduled_ns
    q.began_ns = began_ns
    q.number += 1
    q.done += 1
    ended_ns = clock_ns()
    q.slackens = q.slack(q.device, ended_ns, scheduled_ns + q.period_ns, 0)
    record(q, ended_ns, clock_ns() - ended_ns)
    return 0 if q.slackens else 1


@step
def run(q: Quiet) -> int:
    """Wait and tick; return how many descriptors are ready for the loop."""
    q.done = 0
    q.expired = 0
    q.slackens = 0
    while True:
        count = wait_for(q.poll, q.ready)
        if count != 1 or q.ready[0] != q.timer:
            return count
        q.expired = expirations(q.timer)
        if q.expired != 0 and (q.expired != 1 or not one_tick(q)):
            return 1 if q.expired else 0
