"""Writes that steps serve are those that the loop takes at once, with the same answer; all others are left to it."""

import os
import random
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import served_writes_rig
from served_writes_rig import AXES, TICK, Served, packets, queue_of

from sioms.native.language import UNCOMPILED
from sioms.protocol import verbs
from sioms.protocol.messages import MalformedMessage, decode_reply, reply
from sioms.protocol.records import AXIS_WRITE
from sioms.sdk import attachments  # adds the decoders of a driver
from sioms.sdk.desk import GRACE_NS
from sioms.sdk.serve_step import MOST_KEPT, ROOM


@pytest.fixture
def request_file():
    fd = os.memfd_create("request")
    yield fd
    os.close(fd)


def passed(packet):
    """Return the instant that a packet tells, and the client's own in it, if it is a Passed; else 0, and the packet."""
    try:
        number, message = verbs.take(packet, verbs.ON_HANDLE)
    except MalformedMessage:
        return 0, packet
    if isinstance(message, verbs.Passed) and message.at_ns > 0 and not number:
        return message.at_ns, message.packet
    return 0, packet


def taken(queue, packet, waiting):
    """Return message number and count of records, if the loop takes a packet at once; else None."""
    try:
        number, message = verbs.take(packet, verbs.ON_HANDLE)
    except MalformedMessage:
        return None
    if not isinstance(message, verbs.Write):
        return None
    flags, _, data = message
    if not data or len(data) % AXIS_WRITE.size:
        return None
    records = list(AXIS_WRITE.iter_unpack(data))
    commands = queue.admit_plain(records, AXES, waiting, replace=bool(flags & 1))
    return None if commands is None else (number, len(records))


def heard(packet):
    """Return the instant that a packet tells, if it is a Heard; else 0."""
    try:
        number, message = verbs.take(packet, verbs.ON_HANDLE)
    except MalformedMessage:
        return 0
    return max(0, message.at_ns) if isinstance(message, verbs.Heard) and not number else 0


@pytest.mark.parametrize("seed", range(4))
def test_what_steps_serve_is_what_the_loop_takes_at_once(seed, request_file):
    chance = random.Random(seed)
    made, served_count, passed_count, heard_count, usual_left = packets(chance), 0, 0, 0, 0
    assert attachments.SHARES and verbs.ON_HANDLE.decoders
    for _ in range(400):
        queue = queue_of(chance)
        served, waiting, kept = Served(queue, request_file), 0, 0
        for _ in range(chance.randrange(1, MOST_KEPT + 3)):
            packet, is_usual = next(made)
            if not packet:
                continue
            said_ns, own = passed(packet)
            wanted, before = taken(queue, own, waiting), int(served.desk.heard[0])
            if told := heard(packet):
                now_ns = time.monotonic_ns()
                assert served.serve(packet) == (kept < MOST_KEPT) and not served.answer()
                assert served.left() == (packet if kept == MOST_KEPT else b"")
                least_ns = before if kept == MOST_KEPT else max(before, min(told, now_ns))
                assert least_ns <= served.desk.heard[0] <= max(least_ns, time.monotonic_ns())
                heard_count += 1
            elif served.serve(packet):
                assert wanted is not None and kept < MOST_KEPT
                answer = served.answer()
                desk = served.desk
                assert answer == reply(wanted[0], TICK, int(desk.effect[kept])) and decode_reply(answer)[1] == wanted[0]
                place = desk.start[kept]
                assert kept * ROOM <= place and place + desk.size[kept] <= kept * ROOM + ROOM
                assert bytes(desk.packets[place : place + desk.size[kept]]) == own and not served.left()
                assert desk.heard[0] == max(before, min(said_ns, int(desk.came[kept]))), "never later than it came"
                passed_count += said_ns > 0
                assert desk.came[kept] <= desk.effect[kept] and desk.took[kept] > 0 and desk.sent[kept]
                waiting, kept = waiting + wanted[1], kept + 1
                served_count += 1
            else:
                assert served.left() == packet and not served.answer(), "it is left to the loop as it came"
                assert served.desk.heard[0] == before
                if wanted is not None and is_usual and len(packet) <= ROOM:
                    assert kept == MOST_KEPT, "the usual write is served"
                    usual_left += 1
            assert (served.desk.waiting, served.desk.kept) == (waiting, kept)
        served.close()
    assert heard_count > 5 and passed_count > 10 and served_count > 100 and usual_left < served_count


def test_both_forms_of_the_steps_do_the_same():
    def run(**more):
        environment = {key: value for key, value in os.environ.items() if key != UNCOMPILED} | more
        command = [sys.executable, str(Path(served_writes_rig.__file__)), "7", "150"]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.split("\n")

    compiled, plain = run(), run(**{UNCOMPILED: "1"})
    assert (compiled[0], plain[0]) == ("compiled", "python"), "./dev setup compiles the steps"
    assert compiled[1:] == plain[1:] and sum(line.startswith("True") for line in plain) > 30


def test_a_dozen_writes_in_a_row_is_served_and_before_a_tick_may_not_wait_any_more(request_file):
    """Each takes client and steps some 18 us, and a tick comes on time until GRACE_NS behind the first of them."""
    queue = queue_of(random.Random(1))
    queue.latched[:] = 0
    queue.home_required[:] = False
    queue.capacity = 64
    packet = next(p for p, _ in packets(random.Random(1)) if (taken(queue, p, 0) or (0, 0))[1] == 1)
    served = Served(queue, request_file)
    assert [served.serve(packet) for _ in range(13)] == [*[True] * 12, False] and served.left() == packet
    assert GRACE_NS > 12 * 18_000
    served.close()


def test_two_devices_of_a_process_have_writes_that_are_kept_and_no_third(request_file):
    chance = random.Random(1)
    queue = queue_of(chance)
    queue.latched[:] = 0
    queue.home_required[:] = False
    packet = next(p for p, _ in packets(chance) if (taken(queue, p, 0) or (0, 0))[1] == 1)
    busy = np.zeros(1, dtype=np.int64)
    first, second, third = devices = [Served(queue, request_file, busy) for _ in range(3)]
    assert first.serve(packet) and second.serve(packet) and second.serve(packet) and busy[0] == 2
    assert not third.serve(packet) and third.left() == packet, "it waits for the loop, and its device ticks on"
    assert third.serve(verbs.Heard(5).packed()), "leases do not wait"
    busy[0] = 1
    assert third.serve(packet) and busy[0] == 2
    for device in devices:
        device.close()


def test_a_stop_that_is_asked_for_comes_before_the_next_write(request_file):
    chance = random.Random(1)
    queue = queue_of(chance)
    queue.latched[:] = 0
    queue.home_required[:] = False
    packet = next(p for p, _ in packets(chance) if taken(queue, p, 0) is not None and len(p) < 200)
    served = Served(queue, request_file)
    assert served.serve(packet)
    os.pwrite(request_file, b"\1", 0)
    assert not served.serve(packet) and served.left() == packet
    served.close()


def test_a_client_that_does_not_read_its_answers_is_the_loops(request_file):
    queue = queue_of(random.Random(0))
    queue.latched[:] = 0
    queue.home_required[:] = False
    packet = next(p for p, _ in packets(random.Random(2)) if taken(queue, p, 0) is not None and len(p) < 200)
    served = Served(queue, request_file)
    with pytest.raises(BlockingIOError):
        while True:
            served.theirs.send(bytes(1000))
    assert not served.serve(packet)
    assert served.desk.kept == 1 and not served.desk.sent[0] and not served.left(), "it is taken, and not answered"
    served.close()


def test_the_word_of_a_gateway_is_taken_and_nothing_later_than_now(request_file):
    served = Served(queue_of(random.Random(0)), request_file)
    heard, now_ns = served.desk.heard, time.monotonic_ns()
    for at_ns in (now_ns - 2_000_000, now_ns - 9_000_000, 5, now_ns + 10**15):
        before = int(heard[0])
        assert served.serve(verbs.Heard(at_ns).packed()) and not served.left() and not served.answer()
        assert heard[0] >= before and before <= max(before, min(at_ns, now_ns)) <= heard[0] <= time.monotonic_ns()
    assert served.desk.kept == 0, "a tick need not wait for it"
    for at_ns in (0, -5):
        packet = verbs.Heard(at_ns).packed()
        assert not served.serve(packet) and served.left() == packet, "the loop judges it"
    packet = verbs.Heard(now_ns).packed() + b"\0"
    assert not served.serve(packet) and served.left() == packet
    served.close()
