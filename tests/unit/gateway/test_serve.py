"""A gateway that fails lets go of everything that it has opened."""

from __future__ import annotations

import errno
from collections.abc import Callable
from typing import Any, ClassVar

import pytest

from sioms.client.keys import Folder
from sioms.gateway import serve, zenoh, zeromq


class Part:
    """A transport that does nothing, and what is done with it."""

    about: ClassVar = {"address": "nowhere"}

    def __init__(self, said: list[str], name: str, fails: str) -> None:
        self._said, self._name, self._fails = said, name, fails
        self._do("open")

    def _do(self, what: str) -> None:
        self._said.append(f"{what} {self._name}")
        if f"{what} {self._name}" in self._fails:
            raise OSError(errno.EIO, what)

    def start(self) -> None:
        self._do("start")

    def close(self) -> None:
        self._do("close")


@pytest.mark.parametrize(
    ("fails", "all_that_happens"),
    [
        ("open zenoh", "open zmq, open zenoh, close zmq"),
        ("start zenoh", "open zmq, open zenoh, start zmq, start zenoh, close zenoh, close zmq"),
        ("start zmq, close zenoh", "open zmq, open zenoh, start zmq, close zenoh, close zmq"),
    ],
)
def test_what_was_opened_is_closed(
    fails: str, all_that_happens: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    said: list[str] = []

    def part(name: str) -> Callable[..., Part]:
        return lambda *_: Part(said, name, fails)

    monkeypatch.setattr(zeromq, "ZeroMq", part("zmq"))
    monkeypatch.setattr(zenoh, "Zenoh", part("zenoh"))
    monkeypatch.setattr(serve, "on_end", lambda _: None)
    with pytest.raises(OSError, match=r"open|start|close"):
        serve.serve("/nowhere", Folder(str(tmp_path)), zmq=("here", 1), zenoh=("here", 2))
    assert ", ".join(said) == all_that_happens
