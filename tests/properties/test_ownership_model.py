"""The protocol of ownership and stops, explored: every step of the model, taken by the real daemon and drivers, leads
where it should.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from typing import Any

import pytest
from ownership_cell import Cell, cells
from ownership_explorer import (
    BEGINNINGS,
    Walk,
    begin,
    explore_all,
    run,
    settle,
    wander,
)
from ownership_fakes import ForkServer
from ownership_promises import check_rest

from sioms.daemon.devices import DriverProcess
from sioms.motion.queue import EMERGENCY_STOP
from sioms.protocol.latch import Latch
from sioms.protocol.messages import ClientVerb
from sioms.protocol.stopjournal import StopJournal, node_entry
from sioms.sdk.blocks import AxisBlock
from sioms.sdk.handles import Handle

DEPTH = int(os.environ.get("SIOMS_EXPLORE_DEPTH", "1"))
"""Steps from each beginning; a deeper exploration takes hours, see tests/ownership_explorer.py."""
WALKS = 6
SCHEDULES = [
    "open 0 0, hear 0, stop_node 1 0, move 0 0, reset_node 1 0, move 0 0",
    "open 0 0, hear 0, stop_node 1 0, hear 0, reset_node 1 0, stop_by_handle 0 0, hear 0, move 0 0",
    "open 0 0, hear 0, stop_node 1 0, reset_by_handle 0 0, hear 0, kill 0, bury 0 process, start 0",
    "open 0 0, hear 0, move 0 0, replace 0, stop_node 1 0, move 0 0",
    "kill 0, stop_node 1 0, bury 0 socket, start 0, listen 0, open 0 0, hear 0, move 0 0",
    "stop 0, tick 1, stop_node 0 1, reset 0, tick 1, open 1 1, hear 1, move 1 1",
    "replace 0, hear 0, reset 0, stop_node 0 0, hear 0",
    "open 0 0, open 2 0, regrant, close 0 0, hear 0, listen 0",
    "stop_node 1 1, replace 1, crash, hear 1",
    "open 0 0, hear 0, move 0 0, die 0 0, see_death 0 socket",
    "open 0 1, hear 1, move 0 1, stop 1, tick 1",
    "open 0 0, hear 0, move 0 0, lapse 0",
    "open 0 0, hear 0, move 0 0, stop 1, reset 1, tick 0",
    "request_stop 0, tick 0, reset 1, tick 1, request_stop 0, reset 1",
    "request_stop 0, beat, reset 1, crash, hear 0, leave 0, hear 1, leave 1, boot",
    "open 0 0, stop_node 1 0, tick 0, hear 0, move 0 0",
    "open 1 1, hear 1, stop_by_handle 1 1, close 1 1, beat, move 1 1",
    "kill 1, fail 1, stop 0, reset_node 1 1, listen 1, open 0 1, hear 1, move 0 1",
    "open 0 0, hear 0, stop_node 1 0, kill 0, open 2 0, fail 0, reset_node 1 0, listen 0, hear 0, move 2 0",
    "kill 0, fail 0, stop_node 1 0, reset 1, listen 0, open 0 0, hear 0, move 0 0",
    "stop_node 0 0, stop 1, crash, kill 0, kill 1, boot, listen 0, connect 0, open 0 0, hear 0, move 0 0",
]
"""Each has broken a promise once, or would with a slip of the pen."""


def test_no_promise_is_broken_by_one_event_and_a_death_at_any_step() -> None:
    """To the end: whatever happens by itself after one request, death or reload, and a death, in every order.

    Without these bounds: test_ownership_parts.
    """
    states, steps = explore_all(begin("nobody owns anything"), 1, 1)
    assert steps > states > 800


@pytest.mark.parametrize("name", BEGINNINGS)
def test_the_real_objects_go_where_the_model_goes(name: str) -> None:
    found = run(name, DEPTH)
    assert found.depth == DEPTH and found.taken > found.steps > 30


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_what_once_broke_a_promise(schedule: str) -> None:
    with cells() as make:
        walk = Walk(make(), begin("nobody owns anything"))
        for step in schedule.split(", "):
            name, *arguments = step.split()
            walk.take((name, *(int(a) if a.isdigit() else a for a in arguments)))
        for action in settle(walk.state)[1]:
            walk.take(action)
        check_rest(walk.state)


@pytest.mark.parametrize("by", ["client", "driver"])
def test_a_stop_that_is_asked_for_in_the_middle_of_a_reset_is_heard(by: str) -> None:
    with cells() as make:
        cell = make()
        for action in begin("nobody owns anything"):
            cell.take(action)
        server = cell.server
        assert server is not None
        note = server.cell.shared.record.note

        def interrupted(entry: Mapping[str, Any]) -> None:
            note(entry)
            if by == "client":
                cell.request_stop(1)
            else:
                cell._process(1).runtime.stops.stop_workcell("an input")

        server.cell.shared.record.note = interrupted  # type: ignore[method-assign]
        assert cell.take(("reset", 0)) == "done"
        server.cell.shared.record.note = note  # type: ignore[method-assign]
        cell.take(("tick", 0))
        assert server.cell.shared.latch.stopped_ns, "by a driver that looks"


@pytest.mark.parametrize("device", [0, 1])
@pytest.mark.parametrize("by", ["daemon", "driver"])
def test_a_stop_in_the_middle_of_the_reset_of_a_node_is_kept(by: str, device: int) -> None:
    """The daemon's reset meets a stop that the driver is asked for, or the other way round, at each of its steps.

    A driver that is killed then starts as it was: what stops it does not depend on who has written first.
    """
    for place in range(6):
        with cells() as make:
            cell = make()
            for action in [*begin("nobody owns anything"), ("open", 0, device), ("hear", device)]:
                cell.take(action)
            cell.take(("stop_node", 1, device))
            cell.take(("hear", device))
            server, runtime = cell.server, cell._process(device).runtime
            assert server is not None
            with pytest.MonkeyPatch.context() as patch:
                left = [place]

                def between(call: Callable[..., Any], left: list[int] = left, cell: Cell = cell) -> Callable[..., Any]:
                    def called(*arguments: Any, **named: Any) -> Any:
                        for moment in (0, 1):
                            if moment:
                                value = call(*arguments, **named)
                            left[0] -= 1
                            if left[0] == -1:
                                if by == "daemon":
                                    cell.stop_by_handle(0, device)
                                else:
                                    cell.stop_node(1, device)
                        return value

                    return called

                if by == "daemon":
                    patch.setattr(server.cell.shared.record, "note", between(server.cell.shared.record.note))
                    patch.setattr(DriverProcess, "send", between(DriverProcess.send))
                    patch.setattr(Latch, "ordered", between(Latch.ordered))
                    cell.reset_node(2, device)
                else:
                    patch.setattr(runtime.stops, "_note", between(runtime.stops._note))
                    patch.setattr(runtime.stops, "reset_node", between(runtime.stops.reset_node))
                    cell.reset_by_handle(0, device)
            cell.take(("hear", device))
            stopped = _is_stopped(cell, device)
            assert stopped == (left[0] < 0), f"{place}: a stop since the reset was sent is kept"
            cell.take(("kill", device))
            cell.take(("bury", device, "process"))
            cell.take(("start", device))
            assert _is_stopped(cell, device) == stopped, place


def test_a_stop_that_comes_between_taking_a_request_and_serving_it_holds() -> None:
    """It has been acknowledged before the request is served, so nothing may move after that."""
    with cells() as make, pytest.MonkeyPatch.context() as patch:
        cell = make()
        for action in [*begin("nobody owns anything"), ("open", 0, 0), ("hear", 0)]:
            cell.take(action)
        hear = Handle.hear  # of a client, of whom something has come

        def heard(of: Handle, now_ns: int) -> None:
            hear(of, now_ns)
            assert cell.stop_node(1, 0) == "done"

        patch.setattr(Handle, "hear", heard)
        assert cell.move(0, 0) == "refused"
        patch.undo()
        assert _is_stopped(cell, 0)


def test_what_could_not_be_reset_is_stopped_when_its_driver_starts_again() -> None:
    with cells() as make, pytest.MonkeyPatch.context() as patch:
        cell = make()
        for action in [*begin("nobody owns anything"), ("stop_node", 1, 0), ("hear", 0)]:
            cell.take(action)

        def full(*_: Any) -> None:
            raise BlockingIOError

        patch.setattr(DriverProcess, "send", full)
        assert cell.reset_node(2, 0) == "refused"
        patch.undo()
        assert _is_stopped(cell, 0)
        for action in (("kill", 0), ("bury", 0, "process"), ("start", 0)):
            cell.take(action)
        assert _is_stopped(cell, 0)


def _is_stopped(cell: Cell, device: int) -> bool:
    runtime = cell._process(device).runtime
    block = runtime.blocks[0]
    if isinstance(block, AxisBlock):
        return bool(block.bank._queue.latched[0] & EMERGENCY_STOP)
    return bool(runtime.stops.latched_outputs)


def test_a_handle_is_closed_once_and_each_close_is_answered() -> None:
    with cells() as make:
        cell = make()
        for action in [*begin("nobody owns anything"), ("open", 0, 0), ("hear", 0)]:
            cell.take(action)
        assert cell.close(0, 0) == "", "later"
        assert cell.close(0, 0) == "refused"
        cell.hear(0)
        cell.listen(0)
        assert list(cell.clients[0].take().values()) == ["done"]
        assert not cell._session(0).waits


@pytest.mark.parametrize("device", [0, 1])
def test_a_reset_of_the_workcell_that_comes_while_a_driver_is_forked_is_one_for_it(device: int) -> None:
    with cells() as make, pytest.MonkeyPatch.context() as patch:
        cell = make()
        for action in [*begin("nobody owns anything"), ("stop_node", 1, device), ("hear", device)]:
            cell.take(action)
        for action in (("kill", device), ("bury", device, "process")):
            cell.take(action)
        spawn = ForkServer.spawn

        def slow(*arguments: Any) -> None:
            assert cell.take(("reset", 0)) == "done"
            spawn(*arguments)

        patch.setattr(ForkServer, "spawn", slow)
        cell.take(("start", device))
        cell.take(("tick", device))
        assert not _is_stopped(cell, device)


def test_no_lease_is_so_short_that_it_is_none() -> None:
    with cells() as make:
        cell = make()
        for action in begin("nobody owns anything"):
            cell.take(action)
        cell._ask(0, ClientVerb.OPEN, "axis", 3, None, 1e-12)
        cell.hear(0)
        assert [handle.lease_ns for handle in cell._process(0).runtime.clients.handles.values()] == [1]


def test_the_last_words_of_a_driver_are_heard(capsys: pytest.CaptureFixture[str]) -> None:
    with cells() as make:
        cell = make()
        for action in begin("nobody owns anything"):
            cell.take(action)
        for number in range(3):
            cell._process(1).runtime.log("error", f"the reason, part {number}")
        cell.take(("kill", 1))
        cell.take(("bury", 1, "process"))
        assert "part 2" in capsys.readouterr().err


def test_a_stop_that_a_driver_of_an_earlier_daemon_acknowledged_reaches_the_driver_of_this_one() -> None:
    with cells() as make:
        cell = make()
        for action in begin("nobody owns anything"):
            cell.take(action)
        record = cell.server.cell.shared.record  # type: ignore[union-attr]
        entries = [
            node_entry("port", "port", "", [(0, 1)], "an orphan's client", stop=True, pid=1),
            node_entry("axis", "axis", "", [(0, 0)], "another", stop=True, pid=1),
            node_entry("axis", "axis", "", [(0, 0)], "another", stop=False, pid=1),
            node_entry("axis", "axis", "gone", [(7, 0)], "a third", stop=True, pid=1),
        ]
        for entry in entries:
            StopJournal(os.dup(record.drivers_fd)).append(entry, 0.0)
        orders = cell.server.cell.shared.latch.orders  # type: ignore[union-attr]
        cell.beat()
        cell.tick(1)
        assert [*cell._process(1).runtime.stops.latched_outputs.values()] == ["an orphan's client"]
        assert cell.server.cell.shared.latch.orders == orders + 1, "of what has been reset, nothing"  # type: ignore[union-attr]


def test_nothing_of_a_dead_client_is_left() -> None:
    with cells() as make:
        cell = make()
        for action in begin("two own, one waits"):
            cell.take(action)
        server, client = cell.server, cell.clients[0]
        assert server is not None
        client.ask(ClientVerb.RESERVE_MARKER, 3, False)
        session = next(s for s in server.clients.sessions if s.peer.pid == client.pid)
        cell._watched[session.sock.fileno()]()
        assert server.requests.markers.count(session) == 3
        for action in (
            ("die", 0, 0),
            ("hear", 0),
            ("see_death", 0, "process"),
            ("notice", 0, "socket"),
            ("listen", 0),
        ):
            cell.take(action)
        assert server.requests.markers.count(session) == 0
        assert not session.waits and not session.handles
        assert {h.session.peer.user for h in server.requests.nodes.holders()} == {"client1", "client2"}


def test_the_real_objects_go_with_the_model_for_long() -> None:
    with cells() as make:
        assert sum(wander(make, 250, seed) for seed in range(WALKS)) > 200 * WALKS
