"""Both faces of the client library: the same verbs with the same signatures and the same words."""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Callable
from typing import Any

import pytest

import sioms
from sioms import aio
from sioms.client import coordinates, node_verbs
from sioms.client.cell_verbs import WorkcellVerbs
from sioms.client.faces import Awaiting, Blocking
from sioms.client.fleet_verbs import FleetMarkerVerbs, FleetVerbs
from sioms.client.session import MarkerVerbs

PAIRS = {
    sioms.Workcell: aio.AsyncWorkcell,
    sioms.Marker: aio.AsyncMarker,
    sioms.Fleet: aio.AsyncFleet,
    sioms.FleetMarker: aio.AsyncFleetMarker,
    sioms.AxisNode: aio.AsyncAxisNode,
    sioms.AnalogNode: aio.AsyncAnalogNode,
    sioms.BinaryNode: aio.AsyncBinaryNode,
    coordinates.UserAxis: coordinates.AsyncUserAxis,
}
LISTS = (
    *map(vars(node_verbs).get, ("AxisVerbs", "AnalogVerbs", "BinaryVerbs")),
    WorkcellVerbs,
    MarkerVerbs,
    FleetVerbs,
    FleetMarkerVerbs,
    coordinates.UserAxisVerbs,
)
OF_OLD = {"subscribed"}
"""Names that one face had and the other had not."""


def _public(kind: type) -> dict[str, Any]:
    return {name: getattr(kind, name) for name in dir(kind) if not name.startswith("_") and not hasattr(int, name)}


def _waits(function: object) -> bool:
    return inspect.iscoroutinefunction(function) or inspect.isasyncgenfunction(function)


def _parameters(function: Callable[..., Any]) -> list[tuple[object, ...]]:
    return [
        (p.name, p.kind, p.default, str(p.annotation).replace("Async", ""))
        for p in inspect.signature(function).parameters.values()
    ]


@pytest.mark.parametrize(("blocking", "awaiting"), PAIRS.items(), ids=lambda kind: kind.__name__)
def test_both_faces_have_the_same_verbs(blocking: type, awaiting: type) -> None:
    ours, theirs = _public(blocking), _public(awaiting)
    assert ours.keys() - OF_OLD == theirs.keys() - OF_OLD
    assert (blocking.__doc__ or "").splitlines()[0] and (awaiting.__doc__ or "").splitlines()[0]
    for name in ours.keys() - OF_OLD:
        if not callable(ours[name]):
            continue
        assert _parameters(ours[name]) == _parameters(theirs[name]), name
        if name != "fileno":  # which subscribes in one face only
            assert inspect.getdoc(ours[name]) == inspect.getdoc(theirs[name]), name
        assert inspect.getdoc(ours[name]), name
        assert not _waits(ours[name]), name


def test_what_waits_is_in_a_list_and_nowhere_else() -> None:
    """A verb of one face alone would have no twin; one whose face is its own would have words of its own."""
    for verbs in LISTS:
        assert verbs is not None
        waiting = {name for name, value in _public(verbs).items() if _waits(value)}
        (awaiting,) = [kind for kind in PAIRS.values() if issubclass(kind, verbs)]
        assert issubclass(awaiting, Awaiting)
        own = {name for name, value in _public(awaiting).items() if _waits(value)} - OF_OLD
        assert own - waiting == ({"open"} if verbs is WorkcellVerbs else set())
        (blocking,) = [kind for kind in PAIRS if issubclass(kind, verbs)]
        assert issubclass(blocking, Blocking)


def test_functions_beside_the_classes() -> None:
    assert _parameters(sioms.select)[2] == _parameters(aio.select)[2]
    assert sioms.select.__doc__ == aio.select.__doc__


def test_a_verb_that_would_need_a_loop_is_told_so() -> None:
    class Sleeps:
        async def doze(self) -> None:
            await asyncio.sleep(0)

    class Dozes(Blocking, Sleeps):
        pass

    dozes: Any = Dozes()
    with pytest.raises(RuntimeError, match="waits for an event loop"):
        dozes.doze()


def test_stops_are_told_apart_by_name() -> None:
    for node, cell in ((sioms.AxisNode, sioms.Workcell), (aio.AsyncAxisNode, aio.AsyncWorkcell)):
        assert "not latched" in (node.stop.__doc__ or "")
        assert "this node alone" in (node.emergency_stop.__doc__ or "")
        assert "whole workcell" in (cell.emergency_stop_workcell.__doc__ or "")
        assert node.stop_all.__doc__ == node.emergency_stop.__doc__
