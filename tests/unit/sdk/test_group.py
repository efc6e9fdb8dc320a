"""Several devices in one process: what one of them raises, wherever, ends that one, and the others tick on."""

import os
import select
import socket
from types import SimpleNamespace

import pytest

from sioms.sdk.group import Group, Member


class Runtime:
    """A device's part of the process that raises where a test says so."""

    def __init__(self, fails_in=""):
        self.poll_fd, self._fails_in = os.eventfd(1, os.EFD_NONBLOCK), fails_in
        self.running, self.pause_s, self.did = True, None, []
        self.record, self.timers = SimpleNamespace(address=0, left=0, stopped=0, called=0), ()

    def _do(self, what):
        self.did.append(what)
        if what == self._fails_in:
            raise ZeroDivisionError(what)

    def start(self):
        self._do("start")

    def lend(self):
        self._do("lend")
        return self

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
    monkeypatch.setattr("sioms.sdk.group.begin_stop", lambda record, now_ns: 1)
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
    while group._due or group._urgent:
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
    assert not group._members and not select.select([group._epoll.fileno()], [], [], 0)[0]


def test_what_has_more_to_do_is_served_without_an_event(group):
    (member,) = start(group, "")
    os.eventfd_read(member.runtime.poll_fd)
    member.runtime.pause_s = 0.0
    group._serve(member.runtime.poll_fd, member)
    assert group._wait() == [member.runtime.poll_fd]


@pytest.mark.parametrize("why", ["left", "called"])
def test_whose_tick_is_the_loops_and_whom_the_daemon_calls_go_first(group, why):
    members = start(group, *[""] * 8)
    fds = [member.runtime.poll_fd for member in members]
    for fd in fds:
        group._put(fd)
    for member in members[4:]:
        setattr(member.runtime.record, why, 1)
        group._put(member.runtime.poll_fd)
    served = []
    for member in members:
        member.runtime.serve = lambda ready, fd=member.runtime.poll_fd: served.append(fd)
    for _ in members:
        group._serve_next()
    assert served == [*fds[4:7], fds[0], fds[7], *fds[1:4]], "but one turn in four is of those that can wait"


def test_who_is_stopped_already_does_not_go_first_when_somebody_stops(group):
    first, stopped, moving = start(group, "", "", "")
    stopped.runtime.record.stopped = 5
    group._heed_requests()
    assert list(group._urgent) == [moving.runtime.poll_fd] and list(group._due) == [stopped.runtime.poll_fd]
    assert first.runtime.did[-3:-1] == ["heed requests", "serve"]
