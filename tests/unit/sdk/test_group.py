"""Several devices in one process: what one of them raises, wherever, ends that one, and the others tick on."""

import os
import socket
from types import SimpleNamespace

import pytest

from sioms.descriptors import is_readable
from sioms.sdk.group import CALLED, CAN_WAIT, STANDS, STOPS, Group, Member


class Runtime:
    """A device's part of the process that raises where a test says so."""

    def __init__(self, fails_in=""):
        self.poll_fd, self._fails_in = os.eventfd(1, os.EFD_NONBLOCK), fails_in
        self.running, self.pause_s, self.did = True, None, []
        self.record, self.timers = SimpleNamespace(address=0, left=0, is_stopped=0, stopped=0, called=0), ()
        self.ready, self.lost, self.lost_with, self.process = [], [], [], 0
        self.stopped_ns = 0

    def _do(self, what):
        self.did.append(what)
        if what == self._fails_in:
            raise ZeroDivisionError(what)

    def start(self):
        self._do("start")

    def lend(self):
        self._do("lend")
        return self

    def losses(self, ready):
        return self.lost

    def exiting(self, ready):
        return self.process

    def losses_of(self, pid):
        assert pid == 7
        return self.lost_with

    def take_back(self, quiet):
        self._do("take back")
        return [7]

    def ready_but(self, known):
        return []

    def serve(self, ready):
        self._do("serve")

    def heed_requests(self):
        self._do("heed requests")

    def fail(self, error):
        self.did.append(f"stopped: {error}")

    def release(self):
        self.did.append("released")
        os.close(self.poll_fd)


@pytest.fixture
def group(monkeypatch):
    monkeypatch.setattr(Group, "_settle", lambda self, member: None)
    monkeypatch.setattr("sioms.sdk.group.begin_asked_stop", lambda record, now_ns: record.stopped)
    monkeypatch.setattr("sioms.sdk.group.begin_halt", lambda record, now_ns: record.stopped)
    monkeypatch.setattr("sioms.sdk.group.wait_turn", lambda record: record.left)
    ours, theirs = socket.socketpair()
    with ours, theirs:
        yield Group(ours)


def start(group, *fails_in):
    members = [Member(Runtime(each), [], 0, "") for each in fails_in]
    for member in members:
        group._start(member)
    return members


@pytest.mark.parametrize("where", ["start", "lend", "take back", "serve", "heed requests"])
def test_what_a_device_raises_ends_it_alone(group, where):
    bad, good = start(group, where, "")
    for member in (bad, good):
        if member.runtime.running:
            group._serve(member.runtime.poll_fd, member)
    group._heed_requests()
    while group._due:
        group._serve_next()
    assert bad.runtime.did[-2:] == [f"stopped: {where}", "released"], "stopped first, and once"
    assert bad.runtime.did.count("released") == 1 and not bad.runtime.running
    assert good.runtime.did == [
        "start",
        "lend",
        "take back",
        "serve",
        "lend",
        "take back",
        "heed requests",
        "serve",
        "lend",
    ]
    assert list(group._members.values()) == [good]


def test_one_that_has_ended_is_waited_for_no_more(group):
    (member,) = start(group, "")
    assert group._wait() == [member.runtime.poll_fd]
    member.runtime.running = False
    group._serve(member.runtime.poll_fd, member)
    assert member.runtime.did[-1] == "released"
    assert not group._members and not is_readable(group._epoll.fileno())


def test_what_is_left_of_one_that_has_ended_is_cleared_away_when_another_comes(group, monkeypatch):
    cleared = []
    monkeypatch.setattr("sioms.sdk.group.gc.collect", lambda: cleared.append(1))
    (member,) = start(group, "")
    member.runtime.running = False
    group._serve(member.runtime.poll_fd, member)
    assert not cleared, "others tick on first"
    start(group, "", "")
    assert len(cleared) == 1


def test_what_has_more_to_do_is_served_without_an_event(group):
    (member,) = start(group, "")
    os.eventfd_read(member.runtime.poll_fd)
    member.runtime.pause_s = 0.0
    group._serve(member.runtime.poll_fd, member)
    assert group._wait() == [member.runtime.poll_fd]


def put(group, members, **record):
    for member in members:
        vars(member.runtime.record).update(record)
        group._put(member.runtime.poll_fd)


def waiting(group, rank):
    return [fd for fd, its in group._due.items() if its == rank]


def test_whose_tick_is_the_loops_and_whom_the_daemon_calls_go_first(group):
    members = start(group, *[""] * 9)
    patient, called, standing = members[:3], members[3:6], members[6:]
    put(group, members)
    put(group, called, called=1)
    put(group, standing, left=1, called=1)
    assert [waiting(group, rank) for rank in (STOPS, STANDS, CALLED, CAN_WAIT)] == [
        [], *([member.runtime.poll_fd for member in each] for each in (standing, called, patient)),
    ]  # fmt: skip
    served = []
    for member in members:
        member.runtime.serve = lambda ready, member=member: served.append(member)
    for _ in members:
        group._serve_next()
    expected = [*standing, patient[0], *called, *patient[1:]]
    assert [members.index(member) for member in served] == [members.index(member) for member in expected], (
        "but one turn in four goes to those that can wait"
    )


def test_one_whose_tick_was_the_loops_ticks_on_when_it_can(group):
    (member,) = start(group, "")
    fd, member.runtime.record.address = member.runtime.poll_fd, 5
    put(group, [member], left=1)
    assert group._of[fd] == 0 and group._due == {fd: STANDS}
    put(group, [member], left=0)
    assert group._of[fd] == 5 and group._due == {fd: CAN_WAIT}, "those that cannot go first"


def test_who_is_stopped_already_does_not_go_first_when_somebody_stops(group):
    first, stopped, braking, moving, standing = start(group, "", "", "", "", "")
    stopped.runtime.record.is_stopped, braking.runtime.record.stopped = 1, 5
    put(group, [standing], left=1, stopped=5)
    group._heed_requests()
    assert [waiting(group, rank) for rank in (STOPS, STANDS, CALLED, CAN_WAIT)] == [
        [first.runtime.poll_fd, moving.runtime.poll_fd], [standing.runtime.poll_fd], [], [braking.runtime.poll_fd],
    ]  # fmt: skip


def test_a_stop_is_begun_by_all_and_shown_before_one_is_served(group, monkeypatch):
    """The daemon tells one device of a process; the tick that shows the stop comes before what follows from it."""
    begun = []
    monkeypatch.setattr("sioms.sdk.group.begin_asked_stop", lambda record, now_ns: begun.append(record) or 1)
    members = start(group, "", "", "")
    assert not group._look_for_stops() and not begun
    for member in members:
        member.runtime.stopped_ns = 5
    assert group._look_for_stops() and [id(r) for r in begun] == [id(m.runtime.record) for m in members]
    assert all(member.owes for member in members) and not group._look_for_stops(), "once"
    group._heed_requests()
    assert group._look_for_stops() and not group._look_for_stops()
    for member in members:
        member.runtime.stopped_ns = 0
    assert not group._look_for_stops(), "a reset"


def test_all_whose_owner_is_about_to_end_halt_when_the_first_hears_of_it(group):
    first, halts, refuses, of_another = members = start(group, "", "", "", "")
    first.runtime.lost, first.runtime.process = [lambda: None], 7
    refuses.runtime.record.stopped = 1
    for member in (halts, refuses):
        member.runtime.lost_with = [lambda runtime=member.runtime: runtime.did.append("owner ended")]
    put(group, [first])
    assert not group._loses, "nobody is waited for"
    assert waiting(group, STOPS) == [refuses.runtime.poll_fd]
    assert waiting(group, CAN_WAIT) == [member.runtime.poll_fd for member in (halts, first)]
    for _ in members:
        group._serve_next()
    for member in (halts, refuses):
        assert member.runtime.did == ["start", "lend", "take back", "owner ended", "serve", "lend"]
    assert of_another.runtime.did == ["start", "lend"]


def test_whose_owner_has_gone_halts_by_steps_or_goes_first_and_is_ended_before_anything_else(group):
    patient, halts, refuses = members = start(group, "", "", "")
    for member in (halts, refuses):
        member.runtime.lost = [lambda runtime=member.runtime: runtime.did.append("owner ended")]
    put(group, members)
    assert group._loses, "others may go with them"
    put(group, [refuses], stopped=1)
    assert waiting(group, STOPS) == [refuses.runtime.poll_fd]
    assert waiting(group, CAN_WAIT) == [member.runtime.poll_fd for member in (patient, halts)]
    while group._due:
        group._serve_next()
    for member in (halts, refuses):
        assert member.runtime.did == ["start", "lend", "take back", "owner ended", "serve", "lend"]
    assert patient.runtime.did == ["start", "lend", "take back", "serve", "lend"] and not halts.losses
