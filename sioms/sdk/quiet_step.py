"""Ticks in which nothing happens but motion: from one wait of the process to the next event that is more than that.

Plain writes of clients are served, too (serve_step.py); the tick that carries them out is the loop's. ``run`` waits as
the loop does. What is due is done here as long as the timer is all that is ready, nobody has asked for
a stop, no lease runs out, and the driver's own step has nothing to tell. Everything else is the loop's (runtime.py),
which finds a state as if it had done the ticks itself.
"""

from __future__ import annotations

from typing import Final

from sioms.native.language import Call, Context, Integers, Record, step
from sioms.native.system import (
    MOST_EVENTS,
    changed_ns,
    clock_ns,
    expirations,
    fence,
    first_word_of,
    record_at,
    set_timer,
    wait_for,
    wait_for_one,
    wake,
)

from .serve_step import Desk, StopFile, is_requested, is_unread, serve_packet, writer_of

STOPPED: Final = 0
RESETS: Final = 1
DAEMON_ALIVE: Final = 2
ANSWERED: Final = 3
ANSWERED_AT: Final = 4
ORDERS: Final = 5
ENDED: Final = 7
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

DONE: Final = 0
LEFT: Final = 1
HEARD: Final = 2
"""Of a descriptor that was ready: all is done; it is the loop's; all is done, and the loop has to hear of it."""
HALTS: Final = 1
STOPS: Final = 2
"""How axes brake: as those whose owner has gone, or latched."""
MOMENT_NS: Final = 4_000_000
"""How long the loop leaves the processor to devices that have yet to show that they brake, and to the daemon and the
client, who have the answer by then.
"""
RESTED: Final = 1
STIRS: Final = 2
"""What the loop has to hear: the device has been at rest for long; it has been idle and is at rest no more."""


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

    ``poll``, ``timer``, ``line_timer`` and ``ready``: descriptors. ``latch`` page, and what of it has been seen;
    ``is_stopped``, whether the workcell is known to be stopped, maybe before the latch is. After ``until_ns``
    a lease or a wait may end. ``device`` has the steps ``tick``, ``slack``, ``rest`` and ``stop``.

    A tick comes every ``period_ns`` times ``periods``. ``lead_ns`` before it, where that is not 0 and periods are 1, is
    its slack: ``announced`` until the tick, after ``worked_ns`` of work. ``watched``: somebody looks at the device;
    else it is idle when it has been at rest for ``rest_ns`` since ``restless_ns``, and ``told`` is RESTED or STIRS.

    ``desk`` serves writes. By the file ``request`` clients ask for a stop.

    ``early_ns``: an early tick, off the grid, is due by the second timer; 0: none. ``heeded_ns``: the loop has yet to
    see to a stop, a reset or an order; what was asked for before this instant has been heeded. ``brakes``: steps have
    begun a stop, STOPS, or a halt, HALTS; ``braked_ns``: when something was stopped last. ``patient``: the device waits
    for its turn in a process of several, and ticks on meanwhile; ``known``: of how many descriptors the loop knows.

    ``control``: descriptor of the daemon's socket. ``called``: it is among those that are ready. ``spare``: as many
    numbers as ``ready``.

    ``scheduled_ns``, ``began_ns`` and ``number`` of the last tick, ``ticked_ns`` also of an early one. Since the loop
    has waited: ``done`` ticks; ``waiting``, how many descriptors are ``ready`` for the loop, ``left``: a timer is one
    of them; ``expired``: the timer has been read, and the tick is the loop's; ``slackens``: the loop has to do the
    slack of the last tick. ``ring`` of the statistics.
    """

    poll: int
    timer: int
    line_timer: int
    ready: Integers
    latch: Integers
    is_stopped: int
    stopped: int
    resets: int
    ended: int
    orders: int
    daemon_lease_ns: int
    until_ns: int
    period_ns: int
    periods: int
    lead_ns: int
    announced: int
    worked_ns: int
    watched: int
    rest_ns: int
    restless_ns: int
    told: int
    device: Context
    tick: Call
    slack: Call
    rest: Call
    stop: Call
    desk: Desk
    request: StopFile
    early_ns: int
    heeded_ns: int
    brakes: int
    braked_ns: int
    patient: int
    known: int
    control: int
    called: int
    spare: Integers
    instants: Integers
    scheduled_ns: int
    ticked_ns: int
    began_ns: int
    number: int
    waiting: int
    left: int
    done: int
    expired: int
    slackens: int
    ring: Integers
    ticks: int
    skipped: int
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
def shown_as_of(p: Page) -> int:
    """Return up to which instant everything shows in the newest snapshot [ns]."""
    return p.words[FIRST + (p.number & p.mask) * p.slot + 3]


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
def owe(q: Quiet) -> int:
    """Note that the loop has yet to see to what is asked for now."""
    if not q.heeded_ns:
        q.heeded_ns = q.began_ns
    return 0


@step
def begin_stop(q: Quiet, now_ns: int) -> int:
    """Begin to stop as the latch wants it, as from when it was latched, with a tick soon. Returns 1, and nothing is
    done, where the loop has to.
    """
    if not q.latch[STOPPED] or q.latch[STOPPED] == q.stopped or q.latch[RESETS] != q.resets:
        return 1
    if not q.is_stopped and q.brakes != STOPS and begin_to_brake(q, now_ns, 1, q.latch[STOPPED]):
        return 1
    q.stopped = q.latch[STOPPED]
    return 0


@step
def begin_asked_stop(q: Quiet, now_ns: int) -> int:
    """Begin to stop where somebody asks for it, of whom the daemon may not have heard yet; return whether all axes
    brake for a stop. What a reset has answered is no stop any more.
    """
    f = q.request
    if q.latch[STOPPED]:
        begin_stop(q, now_ns)
    elif not (q.brakes == STOPS or q.is_stopped or q.latch[RESETS] != q.resets) and is_requested(f):
        word = first_word_of(f.file)
        answered = word == q.latch[ANSWERED] and changed_ns(f.file) == q.latch[ANSWERED_AT]
        if word >= 0 and not answered:
            begin_to_brake(q, now_ns, 1, now_ns)
    return q.brakes == STOPS


@step
def begin_halt(q: Quiet, now_ns: int) -> int:
    """Begin to halt all axes, whose owner has gone, with a tick soon. Returns 1, and nothing is done, where the loop
    has to.
    """
    return 0 if q.brakes else begin_to_brake(q, now_ns, 0, now_ns)


@step
def begin_to_brake(q: Quiet, now_ns: int, latches: int, since_ns: int) -> int:
    """Have the device begin to stop, as from an instant since its last tick, with a tick soon; return whether it has
    refused. Where writes have been served they come before the stop, and the loop works them in.
    """
    if q.desk.kept or q.stop(q.device, now_ns, latches, since_ns):
        return 1
    q.brakes = STOPS if latches else HALTS
    q.braked_ns = now_ns
    owe(q)
    if not q.announced:
        tick_soon(q, now_ns)
    return 0


@step
def tick_soon(q: Quiet, now_ns: int) -> int:
    """Have a tick off the grid, unless the next one comes as soon: ticks are a quarter of a period apart at least."""
    if not q.lead_ns or q.periods > 1:
        return 0
    early_ns = max(now_ns, q.ticked_ns + int(q.period_ns / 4))
    if early_ns <= last_early_of(q, q.scheduled_ns):
        q.early_ns = early_ns
        set_timer(q.line_timer, early_ns)
    return 0


@step
def last_early_of(q: Quiet, scheduled_ns: int) -> int:
    """Return when a tick off the grid may be at the latest, after an instant of the grid [ns]."""
    return scheduled_ns + q.period_ns - int(q.period_ns / 4)


@step
def is_called(q: Quiet) -> int:
    """Return whether the daemon's last order may be for this device: its message comes before the order is counted."""
    orders = q.latch[ORDERS]
    fence()
    count = wait_for(q.poll, q.spare, 0)
    if count == MOST_EVENTS:
        return 1
    for i in range(count):
        if q.spare[i] == q.control:
            return 1
    q.orders = orders
    return 0


@step
def has_missed(q: Quiet) -> int:
    """Return whether a stop has come and gone since the last look, its reset maybe not being there in whole."""
    return not q.is_stopped and q.latch[ENDED] != q.ended


@step
def is_asked(q: Quiet) -> int:
    """Return whether something has been asked for that comes before the writes of clients."""
    is_said = q.latch[STOPPED] or q.latch[RESETS] != q.resets or q.latch[ORDERS] != q.orders
    return q.heeded_ns or is_said or has_missed(q)


@step
def may_wait(q: Quiet, now_ns: int) -> int:
    """Return whether a tick may come before writes that have been served a moment ago: the loop, which works them in,
    takes long, and their client has yet to get its answer, which may be on this processor.
    """
    if is_asked(q):
        return 0
    waited_ns = now_ns - q.desk.came[0]
    return waited_ns < q.desk.grace_ns or (waited_ns < q.desk.patience_ns and is_unread(q.desk))


@step
def may_tick(q: Quiet, now_ns: int) -> int:
    """Return whether there is nothing that the loop has to see to before a tick.

    A stop is begun; orders that come behind it have time. Who waits for its turn ticks on before an order, and before a
    reset as one who is stopped, by steps or before; one who has missed a stop and its reset does not. Writes that have
    been served are worked in by the loop, where they may not wait.
    """
    if q.desk.kept and not may_wait(q, now_ns):
        return 0
    if q.latch[RESETS] != q.resets:
        if not q.patient or not (q.is_stopped or q.brakes == STOPS):
            return 0
        owe(q)
    elif (q.latch[STOPPED] != q.stopped and begin_stop(q, now_ns)) or has_missed(q):
        return 0
    if q.latch[ORDERS] != q.orders and not q.heeded_ns and is_called(q):
        if not q.patient:
            return 0
        owe(q)
    return now_ns - q.latch[DAEMON_ALIVE] <= q.daemon_lease_ns and now_ns < q.until_ns


@step
def early_tick(q: Quiet) -> int:
    """Do a tick off the grid, after a stop; return what has become of what announced it.

    One that comes too late is left out: the next one of the grid, which may be due already, is for an instant before.
    """
    now_ns = clock_ns()
    if now_ns > last_early_of(q, q.scheduled_ns):
        q.early_ns = 0
        return DONE
    if q.desk.kept or not may_tick(q, now_ns):
        return LEFT
    if q.tick(q.device, now_ns, q.heeded_ns if q.heeded_ns else now_ns, q.number + 1):
        return LEFT
    q.began_ns = now_ns
    q.number += 1
    q.done += 1
    have_ticked(q, now_ns)
    return HEARD if q.heeded_ns else DONE


@step
def have_ticked(q: Quiet, instant_ns: int) -> int:
    """Note for which instant a tick was; one that has begun to brake since then has another soon, which shows it."""
    q.early_ns = 0
    q.ticked_ns = instant_ns
    if q.braked_ns >= instant_ns:
        tick_soon(q, clock_ns())
    return 0


@step
def one_tick(q: Quiet) -> int:
    """Do a tick; return what has become of what announced it."""
    began_ns = clock_ns()
    if not may_tick(q, began_ns):
        return LEFT
    count = q.announced if q.announced else q.expired
    scheduled_ns = q.scheduled_ns + count * q.period_ns * q.periods
    instant_ns = scheduled_ns
    if q.braked_ns > scheduled_ns and q.braked_ns < began_ns and began_ns <= last_early_of(q, scheduled_ns):
        instant_ns = began_ns  # it is late, and would show an axis that has begun to brake meanwhile as it was before
    as_of_ns = q.heeded_ns if q.heeded_ns else began_ns
    if q.desk.kept:
        as_of_ns = q.desk.came[0]
    if q.tick(q.device, instant_ns, as_of_ns, q.number + 1):
        return LEFT
    q.expired = 0
    q.announced = 0
    q.skipped += (count - 1) * q.periods
    q.scheduled_ns = scheduled_ns
    q.began_ns = began_ns
    q.number += 1
    q.done += 1
    have_ticked(q, instant_ns)
    ended_ns = clock_ns()
    if not q.lead_ns:
        q.slackens = q.slack(q.device, ended_ns, scheduled_ns + q.period_ns, 0)
        q.worked_ns = clock_ns() - ended_ns
    record(q, ended_ns, q.worked_ns)
    if not q.watched and not q.slackens:
        look_at_rest(q, ended_ns)
    return HEARD if q.slackens or q.told or q.heeded_ns else DONE


@step
def look_at_rest(q: Quiet, now_ns: int) -> int:
    """Look whether a device that nobody looks at has come to rest, or moves again."""
    if not q.rest(q.device, 0, 0, 0):
        q.restless_ns = now_ns
        if q.periods > 1:
            q.told = STIRS
    elif q.periods == 1 and now_ns - q.restless_ns >= q.rest_ns:
        q.told = RESTED
    return 0


@step
def announce(q: Quiet) -> int:
    """Do the slack of a tick before it, and have the other timer begin it; return what has become of this one.

    A tick that was announced and has yet to come is waited for, not put off: it comes before the next announcement.
    """
    due_ns = q.scheduled_ns + (q.announced + q.expired) * q.period_ns
    began_ns = clock_ns()
    if q.announced and due_ns - q.expired * q.period_ns > began_ns:
        q.expired = 0
        return DONE
    if q.desk.kept:
        return LEFT
    if q.slack(q.device, began_ns, due_ns, 0):
        return LEFT
    q.announced += q.expired
    q.expired = 0
    q.worked_ns = clock_ns() - began_ns
    set_timer(q.line_timer, due_ns)
    return DONE


@step
def heed_timer(q: Quiet, fd: int) -> int:
    """Do what a timer asks for; return what has become of a descriptor that is ready."""
    if fd == q.timer:
        q.expired = expirations(q.timer)
        if q.expired == 0:
            return DONE
        return announce(q) if q.lead_ns and q.periods == 1 else one_tick(q)
    if fd == q.line_timer:
        if not expirations(q.line_timer):
            return DONE
        if q.announced:
            return one_tick(q)
        return early_tick(q) if q.early_ns else DONE  # what it was set for has come with another tick
    return LEFT


@step
def serve_writer(q: Quiet, who: int) -> int:
    """Serve the next packet of a writer, unless something has been asked for that comes before it; return what has
    become of it.
    """
    if is_asked(q):
        return LEFT
    return LEFT if serve_packet(q.desk, who, q.number) else DONE


@step
def heed(q: Quiet, count: int) -> int:
    """Do what some descriptors that are ready ask for, as far as it is ticks, or a write where nothing else is left;
    return whether the loop has to go on.

    Both timers are ready when a tick was missed.
    """
    left = 0
    heard = 0
    for i in range(count):
        found = LEFT if heard else heed_timer(q, q.ready[i])
        if found == LEFT and not heard and (q.ready[i] == q.timer or q.ready[i] == q.line_timer):
            q.left = 1
        if q.ready[i] == q.control:
            q.called = 1
        if found == LEFT:
            q.ready[left] = q.ready[i]
            left += 1
        elif found == HEARD:
            heard = 1
    if left == 1 and not heard and not q.left and not q.told and not q.slackens:
        who = writer_of(q.desk, q.ready[0])
        if who >= 0 and serve_writer(q, who) == DONE:
            left = 0
    q.waiting = left
    return left or heard


@step
def stop_first(q: Quiet) -> int:
    """Where a stop is what the loop is to hear of, begin it, and tick on for a moment: the loop takes longer than a
    period for what else there is to be done, and all devices shall brake before that of any has the processor.
    """
    if q.waiting == MOST_EVENTS or q.left or q.slackens or q.told or q.desk.kept or q.lead_ns or q.periods > 1:
        return 0
    until_ns = clock_ns() + MOMENT_NS
    if not begin_asked_stop(q, until_ns - MOMENT_NS):
        return 0
    while clock_ns() < until_ns and wait_for_one(q.timer, until_ns):
        q.expired = expirations(q.timer)
        if q.expired and one_tick(q) == LEFT:
            q.ready[q.waiting] = q.timer
            q.waiting += 1
            q.left = 1
            return 0
    return 0


@step
def run(q: Quiet) -> int:
    """Wait and tick until the loop has to go on."""
    while True:
        count = wait_for(q.poll, q.ready, -1)
        if not count or heed(q, count):  # none are after a signal
            stop_first(q)
            return q.waiting


@step
def wait_turn(q: Quiet) -> int:
    """Have a device tick on until its turn comes, also with a tick that was left; return whether the loop has to."""
    q.patient = 1
    q.known = q.waiting
    if not q.left:
        return q.slackens
    if q.expired:
        found = announce(q) if q.lead_ns and q.periods == 1 else one_tick(q)
    elif not q.announced:
        found = early_tick(q)
    elif q.scheduled_ns + q.announced * q.period_ns <= clock_ns():
        found = one_tick(q)
    else:
        found = DONE  # it has been announced together with the one after it since it was left
    if found == LEFT:
        return 1
    q.left = 0
    others = 0
    for i in range(q.waiting):
        if q.ready[i] != q.timer and q.ready[i] != q.line_timer:
            q.ready[others] = q.ready[i]
            others += 1
    q.waiting = others
    q.known = others
    return q.slackens


class Many(Record):
    """Several devices in one process: ``poll`` of their polls, how long to wait for one, and, by the descriptor of
    each, the address ``of`` its Quiet, 0 where the loop has it; below ``size``. ``heed`` is the step ``heed_one``.
    """

    poll: int
    ready: Integers
    timeout_ms: int
    of: Integers
    size: int
    heed: Call


@step
def heed_one(q: Quiet, a: int, b: int, c: int) -> int:
    """Do what is ready of one device; return whether its loop has to go on, of which it does not know yet."""
    count = wait_for(q.poll, q.ready, 0)
    if not count:
        q.known = 0
        return 0
    found = heed(q, count)
    news = not q.patient or q.left or q.slackens or q.waiting > q.known
    q.known = min(q.known, q.waiting)
    return found and news


@step
def run_many(m: Many) -> int:
    """Wait, and tick the devices, until the loops of some have to go on; return of how many, which are ``ready``.

    None is when a time-out is over in which nothing else was due, after a signal, or where those that have to wait are
    known, and are not waited for.
    """
    while True:
        count = wait_for(m.poll, m.ready, m.timeout_ms)
        left = 0
        for i in range(count):
            fd = m.ready[i]
            lent = m.of[fd] if fd < m.size else 0
            if not lent or m.heed(record_at(lent), 0, 0, 0):
                m.ready[left] = fd
                left += 1
        if left or not count or not m.timeout_ms:
            return left
