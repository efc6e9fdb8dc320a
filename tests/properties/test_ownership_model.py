"""The protocol of ownership and stops, explored: every step of the model, taken by the real daemon and drivers, leads where it should."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import pytest
from ownership_cell import cells
from ownership_explorer import BEGINNINGS, begin, explore, run, wander

from sioms.protocol.messages import ClientVerb

DEPTH = int(os.environ.get("SIOMS_EXPLORE_DEPTH", "1"))
"""Steps from each beginning; a deeper exploration takes hours, see tests/ownership_explorer.py."""
WALKS = 12


@pytest.mark.parametrize("name", BEGINNINGS)
def test_no_promise_is_broken_in_any_state_of_the_model(name: str) -> None:
    """Three clients, two devices, a death at every step."""
    graph, _, reached = explore(begin(name), DEPTH + 2)
    assert reached == DEPTH + 2 and len(graph) > 100


@pytest.mark.parametrize("name", BEGINNINGS)
def test_the_real_objects_go_where_the_model_goes(name: str) -> None:
    found = run(name, DEPTH)
    assert found.depth == DEPTH and found.taken > found.steps > 30


def test_a_stop_that_is_asked_for_in_the_middle_of_a_reset_is_heard() -> None:
    with cells() as make:
        cell = make()
        for action in begin("nobody owns anything"):
            cell.take(action)
        server = cell.server
        assert server is not None
        note = server.shared.record.note

        def interrupted(entry: Mapping[str, Any]) -> None:
            note(entry)
            cell.request_stop(1)

        server.shared.record.note = interrupted  # type: ignore[method-assign]
        assert cell.take(("reset", 0)) == "done"
        server.shared.record.note = note  # type: ignore[method-assign]
        cell.take(("tick", 0))
        assert server.shared.latch.stopped_ns, "by a driver that looks"


def test_nothing_of_a_dead_client_is_left() -> None:
    with cells() as make:
        cell = make()
        for action in begin("two own, one waits"):
            cell.take(action)
        server, client = cell.server, cell.clients[0]
        assert server is not None
        client.ask(ClientVerb.RESERVE_MARKER, 3, False)
        session = next(s for s in server.clients.sessions if s.peer.pid == client.pid)
        server.loop._selector.get_map()[session.sock.fileno()].data()
        assert server.clients.markers.count(session) == 3
        for action in (
            ("die", 0, 0),
            ("hear", 0),
            ("see_death", 0, "process"),
            ("notice", 0, "socket"),
            ("listen", 0),
        ):
            cell.take(action)
        assert server.clients.markers.count(session) == 0
        assert not session.waits and not session.handles
        assert {h.session.peer.user for h in server.clients.nodes.holders()} == {"client1", "client2"}


def test_the_real_objects_go_with_the_model_for_long() -> None:
    with cells() as make:
        assert sum(wander(make, 250, seed) for seed in range(WALKS)) > 200 * WALKS
