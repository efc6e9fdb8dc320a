"""Names of users and groups: for grants, and for messages that say who.

A name service may ask a server, and hang. The daemon's loop waits for it at most ANSWER_S; credentials
themselves are numbers and come from the kernel.

Concurrency: the daemon's loop; each question that is not answered at once has a thread of its own.
"""

from __future__ import annotations

import grp
import pwd
import threading
from collections.abc import Callable
from typing import TypeVar

_T = TypeVar("_T")

ANSWER_S = 0.05
"""Longest that a question may keep the loop [s]."""


class Users:
    """Looks names and numbers up, and remembers what it found.

    Args:
        answer_s: longest that a question may take [s].
    """

    def __init__(self, answer_s: float = ANSWER_S) -> None:
        self._answer_s = answer_s
        self._names: dict[int, str] = {}

    def name(self, uid: int) -> str:
        """Return the name of a user, ``uid N`` while it is not known."""
        if uid not in self._names:
            self._ask(lambda: self._names.setdefault(uid, pwd.getpwuid(uid).pw_name))
        return self._names.get(uid, f"uid {uid}")

    def uid(self, name: str) -> int | None:
        """Return the number of a user, None when there is no such user or no answer."""
        return self._ask(lambda: pwd.getpwnam(name).pw_uid)

    def gid(self, name: str) -> int | None:
        """Return the number of a group, None when there is no such group or no answer."""
        return self._ask(lambda: grp.getgrnam(name).gr_gid)

    def _ask(self, question: Callable[[], _T]) -> _T | None:
        answers: list[_T] = []

        def ask() -> None:
            try:
                answers.append(question())
            except KeyError:
                return

        thread = threading.Thread(target=ask, name="name service", daemon=True)
        thread.start()
        thread.join(self._answer_s)
        return answers[0] if answers else None
