"""Who renews the leases of a mount: what goes wrong with one file halts that one, and users may come at any time."""

from __future__ import annotations

import threading
from typing import Any

import pytest

pytest.importorskip("mfusepy")

from sioms.bridges.mount.opened import NodeFile
from sioms.bridges.mount.watching import Keeper


class File:
    """An open file whose lease is renewed, or cannot be."""

    def __init__(self, *, fails: bool = False, is_output: bool = True) -> None:
        self.is_output, self.fails, self.beats, self.why = is_output, fails, 0, ""

    def beat(self) -> None:
        if self.fails:
            raise RuntimeError("dictionary changed size during iteration")
        self.beats += 1

    def end(self, why: str) -> None:
        self.why = why


def test_a_file_whose_lease_cannot_be_renewed_ends_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading.Thread, "start", lambda _: None)
    files: list[Any] = [File(), File(fails=True), File(is_output=False), File()]
    keeper = Keeper(lambda: files, 1.0)
    for _ in range(3):
        keeper.beat()
    assert [file.beats for file in files] == [3, 0, 0, 3]
    assert "could not be renewed" in files[1].why and not files[0].why


class Process:
    """A process that uses a file; while its state is looked at, another one comes, or it comes back."""

    def __init__(self, state: str, file: Any = None, tid: int = 0) -> None:
        self._state, self._file, self._tid = state, file, tid

    @property
    def state(self) -> str:
        if self._file is not None:
            self._file._users[self._tid] = Process("runs")
        return self._state


@pytest.mark.parametrize("tid", [1, 2])
def test_a_user_that_comes_while_the_others_are_looked_at_is_not_forgotten(tid: int) -> None:
    file: Any = object.__new__(NodeFile)
    renewed: list[bool] = []
    file._why, file.node = "", type("Node", (), {"keepalive": lambda self: renewed.append(True)})()
    file._users = {}
    file._users[1] = Process("gone", file, tid)
    file.beat()
    assert list(file._users) == [tid] and not renewed
    file.beat()
    assert renewed == [True]
