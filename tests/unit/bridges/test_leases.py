"""Nodes that a bridge holds for clients: who may, and for how long without being heard."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from sioms.bridges import leases

UNDATED: Any = SimpleNamespace(date=lambda node, asked_before: node)


class Node:
    """A node, and the session that it belongs to."""

    def __init__(self) -> None:
        self.moves: list[Any] = []
        self.beats, self.closed, self.gone = 0, 0, False

    def open(self, name: str, mode: str, lease: float) -> Node:
        assert (name, mode, lease) == ("mod0", "rw", 0.5)
        return self

    def keepalive(self) -> None:
        if self.gone:
            raise OSError(32, "keep mod0: its handle has ended")
        self.beats += 1

    def read(self) -> None:
        pass

    def move(self, position: float, axis: str, *, replace: bool) -> None:
        self.moves.append((position, axis, replace))

    def close(self) -> None:
        self.closed += 1


def test_a_client_moves_a_node_for_as_long_as_it_renews_its_lease(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, node, names = [100.0], Node(), list[str]()
    monkeypatch.setattr(leases, "monotonic", lambda: now_s[0])
    held = leases.Leases(UNDATED, lambda name: names.append(name) or node)  # type: ignore[func-returns-value]

    with pytest.raises(OSError, match="mod0 is not held by you"):
        held.move("mod0", "ann", "xaxis", 0.1)
    for bad in (0.1, 11.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(OSError, match=r"want 0\.2 to 10 s, or 0 to let go"):
            held.put("mod0", "ann", bad)
    held.put("mod0", "ann", 0.5)
    assert (names, held.shown("mod0")) == (["sioms epics for ann"], (0.5, 0, "held by ann"))
    for _ in range(3):
        now_s[0] += 0.4
        held.sweep()
        held.put("mod0", "ann", 0.5)
        held.move("mod0", "ann", "xaxis", 0.1)
    assert (node.moves, node.beats, node.closed) == ([(0.1, "xaxis", True)] * 3, 3, 0)
    others = (
        lambda: held.put("mod0", "bob", 0.5),
        lambda: held.put("mod0", "bob", 0),
        lambda: held.move("mod0", "bob", "xaxis", 0.0),
    )
    for put in others:
        with pytest.raises(OSError, match="mod0 is held by ann, until that client lets go or is silent"):
            put()
    with pytest.raises(OSError, match=r"it was taken for 0\.5 s"):
        held.put("mod0", "ann", 1.0)

    now_s[0] += 0.6
    held.sweep()
    assert (node.closed, held.shown("mod0")) == (1, (0.0, 0, "")), "silent for too long"
    held.put("mod0", "bob", 0.5)
    now_s[0] += 0.6
    with pytest.raises(OSError, match="or your lease has run out"):
        held.move("mod0", "bob", "xaxis", 0.1)
    assert node.closed == 2, "also where nobody has looked in between"
    held.put("mod0", "bob", 0.5)
    held.put("mod0", "bob", 0)
    assert node.closed == 3
    held.put("mod0", "ann", 0.5)
    node.gone = True
    with pytest.raises(OSError, match="its handle has ended"):
        held.put("mod0", "ann", 0.5)
    assert node.closed == 4
