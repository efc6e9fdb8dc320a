"""Who has left a group, and what no answer of the name service changes."""

from __future__ import annotations

import os
import pwd
import threading

import pytest

from sioms.daemon.users import Users

ROOT = pwd.getpwuid(0)
HIS = frozenset({0, 20, 30})


@pytest.fixture
def listed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The groups that root is listed in; they may be changed."""
    groups = [0, 20]
    monkeypatch.setattr(os, "getgrouplist", lambda name, gid: list(groups))
    return groups


def test_a_group_that_a_user_has_left_counts_no_more_until_it_is_joined_again(listed: list[int]) -> None:
    users = Users(answer_s=10.0)
    assert users.name(0) == "root" and users.remaining(0, HIS) == HIS
    assert users.look_again() and users.remaining(0, HIS) == HIS, "30 was given to the process, not left"
    listed.remove(20)
    assert users.remaining(0, HIS) == HIS, "until it is looked again"
    assert users.look_again() and users.remaining(0, HIS) == {0, 30}
    assert users.look_again() and users.remaining(0, HIS) == {0, 30}, "also after further looks"
    listed.append(20)
    assert users.look_again() and users.remaining(0, HIS) == HIS


def test_a_user_who_is_no_more_has_left_all_groups(listed: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    users = Users(answer_s=10.0)
    users.name(0)

    def nobody(uid: int) -> pwd.struct_passwd:
        raise KeyError(uid)

    monkeypatch.setattr(pwd, "getpwuid", nobody)
    assert users.look_again() and users.remaining(0, HIS) == {30}


def test_no_answer_changes_nothing(listed: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    users, gate = Users(answer_s=0.02), threading.Event()
    while users.uid("root") is None or users.name(0) != "root":
        pass  # a loaded machine may be late
    listed.clear()
    monkeypatch.setattr(pwd, "getpwuid", lambda uid: gate.wait(10.0) and ROOT)
    monkeypatch.setattr(pwd, "getpwnam", lambda name: gate.wait(10.0) and ROOT)
    assert not users.look_again()
    assert users.remaining(0, HIS) == HIS and users.uid("root") == 0
    gate.set()
