"""Compiled ticks leave to the loop whatever is more than a tick; run as Python where nothing is compiled."""

import ctypes
import os
import random
import select
import time
from types import SimpleNamespace

import numpy as np
import pytest
from served_writes_rig import Served, queue_of

from sioms.descriptors import is_readable
from sioms.native.language import library
from sioms.protocol.flags import ControlMode, NodeClass
from sioms.protocol.messages import decode_reply
from sioms.protocol.records import AXIS_WRITE, WRITE
from sioms.protocol.verbs import Write
from sioms.sdk import quiet_step
from sioms.sdk.quiet import QuietRun
from sioms.sdk.quiet_step import (
    DAEMON_ALIVE,
    DONE,
    ENDED,
    HALTS,
    HEARD,
    LEFT,
    ORDERS,
    RESETS,
    RESTED,
    RING,
    STIRS,
    STOPPED,
    STOPS,
    Many,
    Page,
    Quiet,
    begin_halt,
    begin_stop,
    heed,
    heed_one,
    one_tick,
    run,
    run_many,
    wait_turn,
)
from sioms.sdk.rt import TimerFd
from sioms.sdk.serve_step import Desk, StopFile

PERIOD_NS, LEASE_NS = 1_000_000, 60_000_000_000
STEP = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_int64)
"""Of a function of Python that compiled steps can call."""


class Device:
    """A driver whose steps write down that they were called, and its process between two events."""

    def __init__(self, lead_ns=0, **fields):
        self.ticks, self.slacks, self.answer, self.slackens, self.rests, self.stops = [], 0, 0, 0, 0, 1
        self.latched, self.ticks_next = [], False
        self.timer, self.other, self.control = (os.eventfd(0, os.EFD_NONBLOCK) for _ in range(3))
        self.line = TimerFd()
        self.poll = select.epoll()
        for fd in (self.timer, self.other, self.control, self.line.fd):
            self.poll.register(fd, select.EPOLLIN)
        self.latch = np.zeros(8, dtype=np.int64)
        self.latch[DAEMON_ALIVE] = time.monotonic_ns()
        self.ready, self.ring = np.zeros(64, dtype=np.int64), np.zeros(7 * RING, dtype=np.int64)
        given = {
            "poll": self.poll.fileno(), "timer": self.timer, "line_timer": self.line.fd, "ready": self.ready,
            "latch": self.latch, "is_stopped": 0, "stopped": 0, "resets": 0, "ended": 0, "orders": 0,
            "daemon_lease_ns": LEASE_NS, "until_ns": 2**62, "period_ns": PERIOD_NS, "periods": 1, "lead_ns": lead_ns,
            "announced": 0, "worked_ns": 0, "watched": 1, "rest_ns": 0, "restless_ns": 0, "told": 0,
            "device": Page.empty(), "instants": np.zeros(2, dtype=np.int64), "scheduled_ns": 0, "began_ns": 0,
            "number": 7, "waiting": 0, "left": 0, "early_ns": 0, "heeded_ns": 0, "ticked_ns": 0, "brakes": 0,
            "braked_ns": 0, "patient": 0, "known": 0, "called": 0, "control": self.control,
            "desk": Desk.empty(), "request": StopFile.empty(),
            "spare": np.zeros(64, dtype=np.int64), "done": 0, "expired": 1, "slackens": 0,
            "ring": self.ring, "ticks": 0, "skipped": 0, "longest_ns": 0,
        }  # fmt: skip
        for name, function in (
            ("tick", self._tick),
            ("slack", self._slack),
            ("rest", self._rest),
            ("stop", self._stop),
        ):
            given[name] = function if library is None else STEP(function)
        self.quiet = Quiet(**{**given, **fields})

    def _tick(self, _device, scheduled_ns, as_of_ns, number):
        self.ticks.append((scheduled_ns, number))
        self.shown_ns = as_of_ns
        return self.answer

    def _slack(self, _device, _now_ns, _due_ns, _):
        self.slacks += 1
        return self.slackens

    def _rest(self, *_):
        return self.rests

    def _stop(self, _device, _now_ns, latches, since_ns):
        self.latched.append(latches)
        self.since_ns = since_ns
        if self.ticks_next:
            os.eventfd_write(self.timer, 1)
        return self.stops

    def close(self):
        for fd in (self.timer, self.other, self.control):
            os.close(fd)
        self.line.close()
        self.poll.close()


@pytest.fixture
def make():
    made = []

    def of(**fields):
        made.append(Device(**fields))
        return made[-1]

    yield of
    for device in made:
        device.close()


@pytest.mark.parametrize("word", [STOPPED, RESETS, ENDED, ORDERS])
def test_what_is_said_in_the_latch_is_the_loops(make, word):
    device = make()
    device.latch[word] += 1
    os.eventfd_write(device.control, 1)
    assert one_tick(device.quiet) == LEFT
    assert not device.ticks and device.quiet.expired == 1 and device.quiet.number == 7, "the tick is the loop's, too"


@pytest.mark.parametrize("what", ["the daemon is silent", "a lease ends", "the driver has something to tell"])
def test_what_ends_or_is_told_is_the_loops(make, what):
    device = make()
    match what:
        case "the daemon is silent":
            device.latch[DAEMON_ALIVE] -= LEASE_NS
        case "a lease ends":
            device.quiet.until_ns = time.monotonic_ns() - 1
        case _:
            device.answer = 1
    assert one_tick(device.quiet) == LEFT
    assert bool(device.ticks) == (device.answer == 1)
    assert device.quiet.expired == 1 and device.quiet.number == 7 and device.quiet.done == 0


def test_a_tick_is_counted_with_those_that_were_missed(make):
    device = make(expired=3, scheduled_ns=500)
    assert one_tick(device.quiet) == DONE
    assert device.ticks == [(500 + 3 * PERIOD_NS, 8)]
    quiet = device.quiet
    assert (quiet.number, quiet.done, quiet.skipped, quiet.expired) == (8, 1, 2, 0)
    assert (quiet.ticks, device.slacks) == (1, 1) and quiet.longest_ns > 0


def test_an_idle_device_misses_as_many_as_it_leaves_out(make):
    device = make(expired=2, periods=40)
    assert one_tick(device.quiet) == DONE
    assert device.ticks == [(80 * PERIOD_NS, 8)] and device.quiet.skipped == 40


@pytest.mark.parametrize("watched", [0, 1])
@pytest.mark.parametrize("slackens", [0, 1])
def test_whom_nobody_looks_at_comes_to_rest(make, watched, slackens):
    device = make(watched=watched, rest_ns=1_000)
    device.rests, device.slackens = 1, slackens
    found = one_tick(device.quiet)
    rests = not watched and not slackens
    assert device.quiet.told == (RESTED if rests else 0)
    assert found == (HEARD if rests or slackens else DONE)


@pytest.mark.parametrize("periods", [1, 40])
def test_what_moves_again_is_idle_no_more(make, periods):
    device = make(watched=0, periods=periods, rest_ns=1)
    assert one_tick(device.quiet) == (HEARD if periods > 1 else DONE)
    assert device.quiet.told == (STIRS if periods > 1 else 0) and device.quiet.restless_ns > 0


def test_ticks_go_on_until_something_else_is_ready(make):
    device = make(expired=0)
    device.answer = 0
    os.eventfd_write(device.timer, 2)
    assert heed(device.quiet, quiet_step.wait_for(device.poll.fileno(), device.ready, 0)) == DONE
    os.eventfd_write(device.timer, 1)
    os.eventfd_write(device.other, 1)
    assert run(device.quiet) == 1, "the other is the loop's"
    assert device.ready[0] == device.other and not device.quiet.left
    assert len(device.ticks) == 2 and not is_readable(device.timer)
    device.answer = 1
    os.eventfd_write(device.timer, 1)
    assert run(device.quiet) == 2, "both are the loop's"
    assert device.quiet.left and device.quiet.expired == 1


def test_a_missed_tick_makes_both_timers_ready_and_is_made_up_for(make):
    begin_ns = time.monotonic_ns() - 10 * PERIOD_NS
    device = make(lead_ns=200_000, expired=0, scheduled_ns=begin_ns, announced=1)
    os.eventfd_write(device.timer, 2)
    quiet_step.set_timer(device.line.fd, begin_ns + PERIOD_NS)
    is_readable(device.line.fd, 10.0)
    assert heed(device.quiet, quiet_step.wait_for(device.poll.fileno(), device.ready, 0)) == DONE
    if device.quiet.announced:  # the slack of the later ones came after the tick
        is_readable(device.line.fd, 10.0)
        assert heed(device.quiet, quiet_step.wait_for(device.poll.fileno(), device.ready, 0)) == DONE
    assert device.ticks[-1][0] == begin_ns + 3 * PERIOD_NS and device.quiet.scheduled_ns == begin_ns + 3 * PERIOD_NS


def test_a_stop_is_begun_by_steps_and_told_to_the_loop(make):
    device = make(began_ns=77)
    device.latch[STOPPED], device.latch[ORDERS] = 5, 1
    os.eventfd_write(device.control, 1)
    assert one_tick(device.quiet) == LEFT and not device.ticks, "the device has refused"
    device.stops = 0
    assert one_tick(device.quiet) == HEARD and len(device.ticks) == 1
    assert (device.quiet.stopped, device.quiet.heeded_ns) == (5, 77)
    device.quiet.expired = 1
    assert one_tick(device.quiet) == HEARD, "it ticks on until the loop has heard of it"
    device.quiet.expired = 1
    device.latch[STOPPED], device.latch[RESETS] = 0, 1
    assert one_tick(device.quiet) == LEFT, "but not behind a reset"


def test_a_halt_is_begun_by_steps_and_latches_nothing(make):
    device = make(began_ns=77)
    assert begin_halt(device.quiet, time.monotonic_ns()) == 1, "the device has refused"
    assert not device.quiet.heeded_ns and not device.quiet.brakes
    device.stops = 0
    assert begin_halt(device.quiet, time.monotonic_ns()) == 0
    assert (device.quiet.heeded_ns, device.quiet.brakes, device.quiet.stopped) == (77, HALTS, 0)
    assert begin_halt(device.quiet, time.monotonic_ns()) == 0 and device.latched == [0, 0], "once"
    device.latch[STOPPED] = 5
    assert one_tick(device.quiet) == HEARD and device.latched == [0, 0, 1], "a stop is one that is latched"


def test_a_stop_begins_when_it_was_latched(make):
    device = make(began_ns=77)
    device.stops, device.latch[STOPPED] = 0, 5
    assert one_tick(device.quiet) == HEARD and device.since_ns == 5


class Requests:
    """A stop-request file, and what a device that is asked by it has seen."""

    def __init__(self, device):
        self.fd, seen = os.memfd_create("request"), device.quiet.request
        seen.there, seen.file, seen.word, seen.changed = 1, self.fd, 0, os.fstat(self.fd).st_mtime_ns

    def ask(self):
        """Ask for a stop; return what a reset answers by."""
        os.pwrite(self.fd, (7).to_bytes(8, "little"), 0)
        return 7, os.fstat(self.fd).st_mtime_ns


@pytest.mark.parametrize("by", ["latch", "file"])
def test_who_is_told_of_a_stop_brakes_and_ticks_before_the_loop_hears_of_it(make, by):
    device = make(began_ns=77, expired=0)
    device.stops, device.ticks_next = 0, True
    if by == "latch":
        device.latch[STOPPED] = 5
    else:
        Requests(device).ask()
    os.eventfd_write(device.other, 1)
    assert run(device.quiet) == 1 and device.ready[0] == device.other, "the loop has yet to do the rest"
    assert device.latched == [1] and device.quiet.brakes == STOPS
    assert len(device.ticks) == 1 and device.shown_ns == 77, "it shows what was asked for before the stop"
    device.latch[STOPPED] = 5
    begin_stop(device.quiet, time.monotonic_ns())
    assert device.quiet.stopped == 5 and device.latched == [1], "it is the same stop"


@pytest.mark.parametrize("why", ["answered", "seen", "stopped already", "reset", "refused", "kept", "left", "seldom"])
def test_what_is_no_stop_for_steps_is_left_to_the_loop_at_once(make, why):
    device = make(expired=0, lead_ns=100 * (why == "seldom"), is_stopped=int(why == "stopped already"))
    device.stops, device.ticks_next = why == "refused", True
    requests = Requests(device)
    mark = requests.ask() if why != "seen" else (0, 0)
    if why == "answered":
        device.latch[3], device.latch[4] = mark
    device.latch[RESETS] = why == "reset"
    device.quiet.desk.kept = why == "kept"
    device.quiet.left = why == "left"
    os.eventfd_write(device.other, 1)
    assert run(device.quiet) == 1
    assert not device.ticks and not device.quiet.brakes
    assert device.latched == [1] * (why == "refused")


def test_who_is_stopped_by_a_request_ticks_on_when_the_daemon_latches_it(make):
    device = make(is_stopped=1)
    device.latch[STOPPED] = 5
    assert one_tick(device.quiet) == DONE and not device.latched
    assert (device.quiet.stopped, device.quiet.heeded_ns) == (5, 0)


def test_a_tick_behind_a_stop_that_is_the_loops_is_handed_over(make):
    device = make(expired=0)
    device.stops, device.answer, device.latch[STOPPED], device.ticks_next = 0, 1, 5, True
    os.eventfd_write(device.other, 1)
    assert run(device.quiet) == 2
    assert set(device.ready[:2]) == {device.other, device.timer}
    assert device.quiet.left and device.quiet.expired, "its timer has been read"


def test_an_order_to_another_device_is_not_looked_at_by_the_loop(make):
    device = make()
    device.latch[ORDERS] = 3
    os.eventfd_write(device.other, 1)
    assert one_tick(device.quiet) == DONE
    assert (len(device.ticks), device.quiet.orders, device.quiet.heeded_ns) == (1, 3, 0)


@pytest.mark.parametrize("what", ["an order", "a reset of who is stopped", "a reset of who is stopped by steps"])
def test_who_waits_for_its_turn_ticks_on_and_shows_what_it_had_heeded(make, what):
    brakes = STOPS if what.endswith("by steps") else 0
    device = make(began_ns=77, is_stopped=int(what == "a reset of who is stopped"), brakes=brakes)
    if what == "an order":
        device.latch[ORDERS] = 1
        os.eventfd_write(device.control, 1)
    else:
        device.latch[RESETS] = 1
    os.eventfd_write(device.timer, 1)
    assert run(device.quiet) >= 1 and device.quiet.left and not device.ticks
    assert wait_turn(device.quiet) == 0 and len(device.ticks) == 1
    assert (device.quiet.heeded_ns, device.quiet.brakes, device.quiet.expired, device.quiet.left) == (77, brakes, 0, 0)
    assert device.quiet.called == (what == "an order")
    assert device.timer not in device.ready[: device.quiet.waiting], "that tick is done"
    os.eventfd_write(device.timer, 1)
    run(device.quiet)
    assert len(device.ticks) == 2 and device.quiet.heeded_ns == 77


def test_whose_tick_is_the_loops_does_not_tick_while_it_waits(make):
    device = make(patient=1)
    device.latch[RESETS] = 1
    os.eventfd_write(device.timer, 1)
    assert run(device.quiet) == 1 and device.quiet.left, "it has missed a stop"
    assert wait_turn(device.quiet) == 1 and not device.ticks
    refused = make()
    refused.answer = 1
    os.eventfd_write(refused.timer, 1)
    assert run(refused.quiet) == 1 and wait_turn(refused.quiet) == 1
    assert refused.quiet.expired == 1 and refused.quiet.left and refused.quiet.waiting == 1
    slackens = make()
    slackens.slackens = 1
    os.eventfd_write(slackens.timer, 1)
    assert run(slackens.quiet) == 0 and slackens.quiet.slackens
    assert wait_turn(slackens.quiet) == 1


def test_a_stop_has_a_tick_soon_but_not_sooner_than_a_quarter_of_a_period(make):
    period_ns, last_ns = 1_000_000_000, time.monotonic_ns()
    device = make(lead_ns=1, expired=0, period_ns=period_ns, scheduled_ns=last_ns, ticked_ns=last_ns, began_ns=77)
    device.stops, device.latch[STOPPED] = 0, 5
    assert begin_stop(device.quiet, last_ns + 1000) == 0
    assert device.quiet.early_ns == last_ns + period_ns // 4
    device.quiet.stopped = device.quiet.early_ns = 0
    assert begin_stop(device.quiet, last_ns + 8 * period_ns // 10) == 0
    assert not device.quiet.early_ns, "the next one comes as soon"
    device.quiet.early_ns = 1
    quiet_step.set_timer(device.line.fd, 1)
    is_readable(device.line.fd, 10.0)
    device.ready[0] = device.line.fd
    assert heed(device.quiet, 1) and not device.quiet.waiting
    assert len(device.ticks) == 1 and device.quiet.scheduled_ns == last_ns and device.quiet.ticked_ns > last_ns


def test_a_late_tick_is_for_now_where_somebody_has_stopped_since(make):
    """For the instant at which it was due it would show an axis as it was before it braked."""
    period_ns, now_ns = 10_000_000_000, time.monotonic_ns()
    last_ns = now_ns - 12 * period_ns // 10
    device = make(
        lead_ns=1, period_ns=period_ns, scheduled_ns=last_ns, ticked_ns=last_ns, announced=1, began_ns=77
    )  # fmt: skip
    device.stops, device.latch[STOPPED] = 0, 5
    assert begin_stop(device.quiet, now_ns) == 0 and not device.quiet.early_ns, "a tick is due"
    assert one_tick(device.quiet) == HEARD
    assert device.ticks[-1][0] > now_ns and device.quiet.ticked_ns > now_ns and not device.quiet.early_ns
    assert device.quiet.scheduled_ns == last_ns + period_ns, "the grid stays"


def test_a_stop_that_a_tick_heeds_shows_in_another_a_quarter_of_a_period_later(make):
    period_ns, last_ns = 10_000_000_000, time.monotonic_ns() - 10_000_000_000
    device = make(
        lead_ns=1, period_ns=period_ns, scheduled_ns=last_ns, ticked_ns=last_ns, announced=1, began_ns=77
    )  # fmt: skip
    device.stops, device.latch[STOPPED] = 0, 5
    assert one_tick(device.quiet) == HEARD and device.ticks[-1][0] == last_ns + period_ns
    assert device.quiet.early_ns == last_ns + period_ns + period_ns // 4


def test_a_tick_that_is_announced_is_never_put_off(make):
    """A device whose count of ticks ran ahead put its tick off at every period, and never ticked again."""
    device = make(lead_ns=200_000, expired=0, scheduled_ns=time.monotonic_ns() + 300 * PERIOD_NS, announced=1)
    device.line.set(due_ns := device.quiet.scheduled_ns + PERIOD_NS)
    for _ in range(3):
        os.eventfd_write(device.timer, 1)
        assert heed(device.quiet, quiet_step.wait_for(device.poll.fileno(), device.ready, 0)) == DONE
    assert (device.slacks, device.quiet.announced, device.quiet.expired) == (0, 1, 0)
    is_readable(device.line.fd, 10.0)
    assert time.monotonic_ns() >= due_ns
    assert heed(device.quiet, quiet_step.wait_for(device.poll.fileno(), device.ready, 0)) == DONE
    assert len(device.ticks) == 1 and device.quiet.announced == 0


def test_a_slack_before_the_tick_announces_it(make):
    device = make(lead_ns=200_000, expired=0, scheduled_ns=time.monotonic_ns() - 3 * PERIOD_NS)
    os.eventfd_write(device.timer, 1)
    assert heed(device.quiet, quiet_step.wait_for(device.poll.fileno(), device.ready, 0)) == DONE
    assert (device.slacks, device.ticks, device.quiet.announced) == (1, [], 1)
    is_readable(device.line.fd, 10.0)
    device.ready[0] = device.line.fd
    assert heed(device.quiet, 1) == DONE
    assert len(device.ticks) == 1 and device.quiet.announced == 0 and device.slacks == 1


def test_of_many_devices_only_those_with_more_to_do_are_the_loops(make):
    devices = [make(expired=0) for _ in range(3)]
    devices[1].answer = 1
    with select.epoll() as poll:
        of = np.zeros(1024, dtype=np.int64)
        for device in devices:
            poll.register(device.poll.fileno(), select.EPOLLIN)
            os.eventfd_write(device.timer, 1)
        for device in devices[:2]:  # the loop has the third
            of[device.poll.fileno()] = device.quiet.address
        ready = np.zeros(64, dtype=np.int64)
        many = Many(poll=poll.fileno(), ready=ready, timeout_ms=0, of=of, size=len(of), heed=heed_one)
        count = run_many(many)
        assert set(ready[:count].tolist()) == {device.poll.fileno() for device in devices[1:]}
    assert [len(device.ticks) for device in devices] == [1, 1, 0]


def test_who_waits_for_its_turn_is_the_loops_again_when_something_else_is_ready(make):
    device = make(expired=0)
    with select.epoll() as poll:
        poll.register(device.poll.fileno(), select.EPOLLIN)
        of = np.zeros(1024, dtype=np.int64)
        of[device.poll.fileno()] = device.quiet.address
        many = Many(
            poll=poll.fileno(), ready=np.zeros(64, dtype=np.int64), timeout_ms=0, of=of, size=len(of), heed=heed_one
        )

        def waits():
            return [run_many(many), wait_turn(device.quiet)]

        os.eventfd_write(device.other, 1)
        assert waits() == [1, 0] and run_many(many) == run_many(many) == 0, "it is known, and is not waited for"
        os.eventfd_write(device.timer, 1)
        assert run_many(many) == 0 and len(device.ticks) == 1
        os.eventfd_write(device.control, 1)
        assert waits() == [1, 0] and device.quiet.called and run_many(many) == 0
        device.answer = 1
        os.eventfd_write(device.timer, 1)
        assert waits() == [1, 1], "its tick is the loop's"


def test_what_steps_have_served_meanwhile_hides_nothing_that_comes_after_it(make):
    """A write that had to wait for two others, and then its owner's end."""
    device = make(expired=0)
    os.eventfd_write(device.other, 1)
    assert heed_one(device.quiet, 0, 0, 0) and not wait_turn(device.quiet) and device.quiet.known == 1
    os.eventfd_read(device.other)
    os.eventfd_write(device.timer, 1)
    assert not heed_one(device.quiet, 0, 0, 0), "nothing but a tick is left"
    os.eventfd_write(device.control, 1)
    assert heed_one(device.quiet, 0, 0, 0)
    wait_turn(device.quiet)
    os.eventfd_read(device.control)
    assert not heed_one(device.quiet, 0, 0, 0), "nothing at all"
    os.eventfd_write(device.control, 1)
    assert heed_one(device.quiet, 0, 0, 0)


def plain_write(served):
    """Return a packet that steps serve: a position of an axis at rest, in its limits."""
    record = dict.fromkeys(WRITE[NodeClass.AXIS], 0) | {"control_mode": int(ControlMode.POSITION), "position": 0.1}
    packet = Write(1, 0.0, AXIS_WRITE.pack(*record.values())).packed(7)
    assert served.desk.count == 1
    return packet


@pytest.fixture
def writing(make):
    """A device with a writer, whose socket the loop waits for."""
    request, queue = os.memfd_create("request"), queue_of(random.Random(0))
    for latched in (queue.latched, queue.home_required, queue.waiting):
        latched[:] = 0
    served = Served(queue, request)
    device = make(desk=served.desk, expired=0)
    device.poll.register(served.theirs.fileno(), select.EPOLLIN)
    yield device, served
    served.close()
    os.close(request)


def test_a_write_is_served_and_the_tick_that_carries_it_out_is_the_loops(writing):
    device, served = writing
    os.eventfd_write(device.timer, 1)
    served.ours.send(plain_write(served))
    assert heed(device.quiet, quiet_step.wait_for(device.poll.fileno(), device.ready, 0)) == 0, (
        "the tick, then the write"
    )
    assert len(device.ticks) == 1 and served.desk.kept == 1 and decode_reply(served.answer())[1:4] == [7, 0, 8]
    os.eventfd_write(device.timer, 1)
    assert heed(device.quiet, quiet_step.wait_for(device.poll.fileno(), device.ready, 0))
    assert device.quiet.left and device.quiet.expired == 1
    assert len(device.ticks) == 1, "it has to work in what was written first"


def test_a_tick_that_follows_at_once_leaves_the_client_its_turn_and_shows_what_was_before_the_write(writing):
    device, served = writing
    served.desk.grace_ns = 10_000_000_000
    served.ours.send(plain_write(served))
    assert heed(device.quiet, quiet_step.wait_for(device.poll.fileno(), device.ready, 0)) == 0
    os.eventfd_write(device.timer, 1)
    assert heed(device.quiet, quiet_step.wait_for(device.poll.fileno(), device.ready, 0)) == 0
    assert len(device.ticks) == 1 and served.desk.kept == 1, "it is still to be worked in"
    assert device.shown_ns == served.desk.came[0] < served.desk.effect[0]
    served.desk.grace_ns = 0
    os.eventfd_write(device.timer, 1)
    assert heed(device.quiet, quiet_step.wait_for(device.poll.fileno(), device.ready, 0)) and len(device.ticks) == 1


@pytest.mark.parametrize("why", ["the answer is read", "it takes too long"])
def test_ticks_come_before_a_write_until_its_client_has_the_answer(writing, why):
    device, served = writing
    served.desk.patience_ns = 10_000_000_000
    served.ours.send(plain_write(served))
    assert heed(device.quiet, quiet_step.wait_for(device.poll.fileno(), device.ready, 0)) == 0
    for count in (1, 2):
        os.eventfd_write(device.timer, 1)
        assert heed(device.quiet, quiet_step.wait_for(device.poll.fileno(), device.ready, 0)) == 0
        assert len(device.ticks) == count and device.shown_ns == served.desk.came[0]
    if why == "the answer is read":
        served.answer()
    else:
        served.desk.patience_ns = 0
    os.eventfd_write(device.timer, 1)
    assert heed(device.quiet, quiet_step.wait_for(device.poll.fileno(), device.ready, 0)) and len(device.ticks) == 2


@pytest.mark.parametrize("what", [STOPPED, RESETS, ORDERS, "heeded"])
def test_no_tick_comes_before_a_write_when_something_was_asked_for_behind_it(writing, what):
    device, served = writing
    served.desk.grace_ns = 10_000_000_000
    served.ours.send(plain_write(served))
    assert heed(device.quiet, quiet_step.wait_for(device.poll.fileno(), device.ready, 0)) == 0
    if what == "heeded":
        device.quiet.heeded_ns = 1
    else:
        device.latch[what] += 1
    os.eventfd_write(device.timer, 1)
    assert heed(device.quiet, quiet_step.wait_for(device.poll.fileno(), device.ready, 0))
    assert not device.ticks and not device.latched and device.quiet.expired == 1


def test_the_work_before_a_rare_tick_is_the_loops_when_something_was_written(make, writing):
    device, served = writing
    device.quiet.lead_ns = 200_000
    served.ours.send(plain_write(served))
    assert heed(device.quiet, quiet_step.wait_for(device.poll.fileno(), device.ready, 0)) == 0
    os.eventfd_write(device.timer, 1)
    assert heed(device.quiet, quiet_step.wait_for(device.poll.fileno(), device.ready, 0))
    assert not device.slacks and device.quiet.expired == 1


@pytest.mark.parametrize("what", [STOPPED, RESETS, ORDERS, "heeded", "two"])
def test_a_write_waits_for_what_comes_before_it(writing, what):
    device, served = writing
    if what == "heeded":
        device.quiet.heeded_ns = 5
    elif what == "two":
        os.eventfd_write(device.other, 1)
    else:
        device.latch[what] += 1
    packet = plain_write(served)
    served.ours.send(packet)
    assert heed(device.quiet, quiet_step.wait_for(device.poll.fileno(), device.ready, 0))
    assert served.theirs.fileno() in device.ready[: device.quiet.waiting]
    assert not served.desk.kept and served.left() == packet


@pytest.mark.parametrize(("waits_ns", "clients_ns", "until_ns"), [(500, 900, 500), (900, 500, 500), (2**62, 7, 7)])
def test_steps_last_no_longer_than_waits_and_the_leases_of_clients(waits_ns, clients_ns, until_ns):
    quiet = quiet_run(waits_ns, clients_ns)
    assert quiet.lend(1_000, 4, True)
    assert quiet.record.until_ns == until_ns
    record = quiet.record
    assert (record.is_stopped, record.stopped, record.resets, record.ended, record.orders) == (1, 3, 2, 4, 1)


@pytest.mark.parametrize("why", ["a wait needs the loop", "the driver is not ready", "its pages cannot be lent"])
def test_steps_do_not_begin_where_the_loop_has_to_go_on(why):
    quiet = quiet_run(0 if why.startswith("a wait") else 5, 5, "driver" not in why, "pages" not in why)
    assert not quiet.lend(1_000, 4, True)


def quiet_run(waits_ns, clients_ns, is_ready=True, lends=True):
    """Return what ticks by steps for a process whose parts are as told."""
    record = Device()
    steps = SimpleNamespace(
        tick=record.quiet.tick, slack=record.quiet.slack, rest=record.quiet.rest, stop=record.quiet.stop,
        record=Page.empty(),
        is_ready=lambda watched, awaited: is_ready, resume=lambda: None,
    )  # fmt: skip
    statistics = SimpleNamespace(ring=record.ring.reshape(7, RING), ticks=0, longest_ns=0, skipped=0)
    quiet = QuietRun(
        steps, record.poll.fileno(), record.timer, record.line.fd, record.control, record.latch, PERIOD_NS, 0, LEASE_NS,
        SimpleNamespace(rest_ns=1, periods=1, restless_ns=0), np.zeros(2, dtype=np.int64),
        SimpleNamespace(lend=lambda: lends), SimpleNamespace(stopped=True, seen=(3, 2, 4, 1)),
        SimpleNamespace(until_ns=lambda: waits_ns, any=waits_ns < 2**62), SimpleNamespace(until_ns=lambda: clients_ns),
        statistics, SimpleNamespace(record=Desk.empty(), request=StopFile.empty(), lend=lambda: None),
    )  # fmt: skip
    record.close()
    return quiet
