"""Names of users and groups: for grants, and for messages that say who; and who has left a group.

A name service may ask a server, and hang. The daemon's loop waits for it at most ANSWER_S; credentials
themselves are numbers and come from the kernel.

Concurrency: the daemon's loop; each question that is not answered at once has a thread of its own.
"""

from __future__ import annotations

import grp
import os
import pwd
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

from .realtime import end_promptly

_T = TypeVar("_T")

ANSWER_S = 0.05
"""Longest that a question may keep the loop [s]."""


class Users:
    """Looks names and numbers up, and remembers what it found: no answer changes nothing.

    Args:
        answer_s: longest that a question may take [s].
    """

    def __init__(self, answer_s: float = ANSWER_S) -> None:
        self._answer_s = answer_s
        self._names: dict[int, str] = {}
        self._numbers: dict[tuple[str, str], int | None] = {}
        self._groups: dict[int, frozenset[int]] = {}
        self._left: dict[int, frozenset[int]] = {}

    def name(self, uid: int) -> str:
        """Return the name of a user, ``uid N`` while it is not known."""
        if uid not in self._names:
            self._ask(lambda: self._meet(uid))
        return self._names.get(uid, f"uid {uid}")

    def uid(self, name: str) -> int | None:
        """Return the number of a user, None when there is no such user or there has never been an answer."""
        return self._number("user", name, lambda: pwd.getpwnam(name).pw_uid)

    def gid(self, name: str) -> int | None:
        """Return the number of a group, None when there is no such group or there has never been an answer."""
        return self._number("group", name, lambda: grp.getgrnam(name).gr_gid)

    def remaining(self, uid: int, gids: frozenset[int]) -> frozenset[int]:
        """Return the groups of a user's process without those that the user has left since it was first seen here."""
        return gids - self._left.get(uid, frozenset())

    def look_again(self) -> bool:
        """Ask which users have left groups, for all that have been seen; return whether there was an answer.

        A process has the groups of its start for as long as it lives, whatever the group database says since. One that
        was given a group without being listed in it, as a service manager does, keeps it.
        """
        found = self._ask(lambda: {uid: _groups_of(uid) for uid in list(self._groups)})
        for uid, now in (found or {}).items():
            self._left[uid] = (self._left.get(uid, frozenset()) | self._groups[uid]) - now
            self._groups[uid] = now
        return found is not None

    def _meet(self, uid: int) -> None:
        name = pwd.getpwuid(uid).pw_name
        self._groups.setdefault(uid, _groups_of(uid))
        self._names.setdefault(uid, name)

    def _number(self, kind: str, name: str, question: Callable[[], int]) -> int | None:
        def answer() -> tuple[int | None]:
            try:
                return (question(),)
            except KeyError:
                return (None,)

        answered = self._ask(answer)
        if answered is not None:
            self._numbers[kind, name] = answered[0]
        return self._numbers.get((kind, name))

    def _ask(self, question: Callable[[], _T]) -> _T | None:
        answers: list[_T] = []

        def ask() -> None:
            end_promptly()
            with suppress(KeyError):
                answers.append(question())

        thread = threading.Thread(target=ask, name="name service", daemon=True)
        try:
            thread.start()
        except RuntimeError:  # no memory, or no more threads: as a question that is not answered
            return None
        thread.join(self._answer_s)
        return answers[0] if answers else None


def _groups_of(uid: int) -> frozenset[int]:
    """Return the groups that a user is listed in, the first one included; none of a user who is no more."""
    try:
        entry = pwd.getpwuid(uid)
    except KeyError:
        return frozenset()
    return frozenset(os.getgrouplist(entry.pw_name, entry.pw_gid))
