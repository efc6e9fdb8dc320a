"""No thread is in Zenoh, or on its way out of it, when the interpreter ends."""

from __future__ import annotations

import errno
import threading
from types import SimpleNamespace
from typing import Any

import pytest

from sioms.client import zenoh_link


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Sessions that open when they are let, and what has been closed."""
    found = SimpleNamespace(asked=threading.Event(), let=threading.Event(), closed=0)

    def close() -> None:
        found.closed += 1

    def opens(_: object) -> Any:
        found.asked.set()
        assert found.let.wait(20.0)
        return SimpleNamespace(close=close)

    monkeypatch.setattr(zenoh_link.zenoh, "open", opens)
    return found


def test_the_end_of_a_program_waits_for_who_opens_a_session_and_has_it_closed(slow: SimpleNamespace) -> None:
    opening, said = zenoh_link.Opening(), list[object]()
    how: Any = None

    def opens() -> None:
        try:
            opening.open(how)
        except OSError as error:
            said.append(error.errno)

    def ends() -> None:
        opening.end()
        said.append("ended")

    one, end = threading.Thread(target=opens), threading.Thread(target=ends)
    one.start()
    assert slow.asked.wait(20.0)
    end.start()
    end.join(0.05)
    assert not said, "somebody is in Zenoh"
    slow.let.set()
    for thread in (one, end):
        thread.join(20.0)
    assert sorted(map(str, said)) == [str(errno.ESHUTDOWN), "ended"] and slow.closed == 1
    with pytest.raises(OSError, match="the program is ending"):
        opening.open(how)


def test_sessions_are_opened_side_by_side(slow: SimpleNamespace) -> None:
    opening, opened = zenoh_link.Opening(), list[object]()
    how: Any = None
    threads = [threading.Thread(target=lambda: opened.append(opening.open(how))) for _ in range(3)]
    for thread in threads:
        thread.start()
    slow.let.set()
    for thread in threads:
        thread.join(20.0)
    opening.end()
    assert len(opened) == 3 and not slow.closed


def test_a_link_takes_back_what_it_has_declared_before_its_session_ends() -> None:
    said: list[str] = []

    def part(name: str) -> Any:
        def undeclare() -> None:
            said.append(name)
            if name == "token":
                raise zenoh_link.zenoh.ZError("the connection has ended")

        return SimpleNamespace(undeclare=undeclare)

    session: Any = SimpleNamespace(is_closed=lambda: "session" in said, close=lambda: said.append("session"))
    for _ in range(2):
        zenoh_link.end_session(session, [part(name) for name in ("subscriber", "token", "publisher")])
    assert said == ["subscriber", "token", "publisher", "session"]
