"""Wrong values at every public verb of both faces: an error with a sentence here, and the node goes on."""

from __future__ import annotations

import asyncio
import errno
import inspect
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from daemon_rig import Daemon

import sioms
from sioms import aio
from sioms.client.coordinates import UserAxis
from sioms.client.node import AnalogNode, AxisNode, BinaryNode
from sioms.protocol.flags import Request

GOOD: dict[str, Any] = {
    "position": 0.0, "velocity": 0.0, "step": 0.0, "user": 0.0, "after": 0, "request": Request.GET_LIMITS, "which": 0,
    "records": sioms.command(position=0.0), "values": 0.0, "every": 0, "name": "mod0.readonly", "token": 1, "number": 1,
    "count": 1, "handle": 0, "axis": 0, "last": 0, "gains": [1.0], "positions": 0.0, "nodes": None,
    "level": "warning", "text": "a word", "lease": 1.0, "node": "mod0.xaxis", "what": "drift", "severity": 0,
}  # fmt: skip
"""What the other parameters of a verb get."""
NO_NUMBER: list[Any] = ["1", [], {}, True, object(), b"x", 1j, [1.0]]
WRONG: dict[str, list[Any]] = {
    "float": [*NO_NUMBER, None, 1 << 2000],
    "float | None": [*NO_NUMBER, 1 << 2000],
    "int": [*NO_NUMBER, None, 1.5, math.nan, 1 << 70],
    "int | None": [*NO_NUMBER, 1.5, 1 << 70],
    "int | str": [[], {}, None, 1.5, True, object(), "nowhere"],
    "str": [5, [], {}, None, b"x", object()],
    "Sequence[float]": [5, "12", [None], [True], ["1"], [1 << 2000], None],
    "Records": [5, None, [5], ["x"], object(), {1: 2}],
    "Request": [5, None, "HOME", [], 1 << 70],
    "Any": ["1", [], {}, object()],
}
ANY_TEXT = {"why", "text", "note"}
"""A stop or an acknowledgement is not refused for what it says."""
FLAGS = {"replace", "persist", "gone"}
WORDS = {
    "position",
    "velocity",
    "acceleration",
    "jerk",
    "force",
    "time",
    "max_velocity",
    "axis",
    "wait",
    "signal",
}


def _public(kind: type) -> Iterator[tuple[str, Any]]:
    for name, function in inspect.getmembers(kind, callable):
        if not name.startswith("_") and name not in ("close", "release", "forget", "close_handle"):
            yield name, function


def _attempts(kind: type) -> Iterator[tuple[str, list[Any], dict[str, Any]]]:
    """Every verb with one wrong value at one place."""
    for name, function in _public(kind):
        parameters = list(inspect.signature(function).parameters.values())[1:]
        good = [
            GOOD[p.name]
            for p in parameters
            if p.default is p.empty and p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)
        ]
        required = [p.name for p in parameters if p.default is p.empty and p.kind is p.POSITIONAL_OR_KEYWORD]
        for p in parameters:
            if p.name in ANY_TEXT | FLAGS or p.annotation in ("object", "bool", "type[Node] | None"):
                continue
            for wrong in WRONG.get(str(p.annotation), []):
                if p.kind is p.VAR_POSITIONAL:
                    if wrong is not True:  # of an output of one bit it is right
                        yield name, [*good, wrong], {}
                elif p.kind is p.VAR_KEYWORD:
                    word = "velocity_max" if name == "set_limits" else "time"
                    if wrong is not None:
                        yield name, good, {word: wrong}
                elif p.name in required:
                    at = required.index(p.name)
                    yield name, [*good[:at], wrong, *good[at + 1 :]], {}
                else:
                    yield name, good, {p.name: wrong}


def _fault(what: str, error: BaseException | None) -> list[str]:
    """Return what is wrong with the answer to a wrong value."""
    text = str(error)
    good = (
        (
            isinstance(error, TypeError | ValueError)
            or (isinstance(error, OSError) and error.errno and error.errno != errno.EPROTO)
        )
        and len(text) > 15
        and text.isprintable()
    )
    odd = (
        "unsupported operand",
        "has no attribute",
        "malformed",
        "not callable",
        "unhashable",
        "not iterable",
    )
    return [] if good and not any(word in text for word in odd) else [f"{what}: {error!r}"]


def _try(thing: Any, kind: type) -> list[str]:
    """Return the faults of all verbs."""
    faults: list[str] = []
    for verb, arguments, words in _attempts(kind):
        what, error = f"{verb}{arguments}{words}", None
        try:
            answer = getattr(thing, verb)(*arguments, **words)
            if inspect.isgenerator(answer):
                list(answer)
        except Exception as caught:
            error = caught
        faults += _fault(what, error)
    return faults


NODES = {"mod0": AxisNode, "force0": AnalogNode, "io0.bit0": BinaryNode}


@pytest.mark.parametrize("name", NODES)
def test_blocking_nodes(daemon: Daemon, name: str) -> None:
    with daemon.cell() as cell, cell.open(name, "r" if name == "force0" else "rw", timeout=5.0) as node:
        assert type(node) is NODES[name] and len(list(_attempts(type(node)))) > 50
        assert _try(node, type(node)) == []
        assert node.read().number and node.statistics(), "the node works on"


def test_blocking_session_and_coordinates(daemon: Daemon) -> None:
    with daemon.cell() as cell:
        assert _try(cell, sioms.Workcell) == []
        with cell.open("mod0.xaxis", "rw", timeout=5.0) as node:
            assert _try(node.user(0, offset=0.1, direction=-1), UserAxis) == []
            assert node.read().number, "the node works on"
        assert not cell.status()["stopped_ns"]


def test_words_of_commands() -> None:
    faults: list[str] = []
    for word in WORDS:
        more = [1 << 65] if word in ("axis", "wait", "signal") else [None]
        for wrong in [*NO_NUMBER, 1 << 2000, *more]:
            words: dict[str, Any] = {"position": 0.0, word: wrong}
            try:
                sioms.command(**words)
                error = None
            except Exception as caught:
                error = caught
            faults += _fault(f"command {words}", error)
    assert faults == []
    assert sioms.command(np.int32(1), position=np.float32(0.5)) == sioms.command(1, position=0.5)


def test_asyncio(daemon: Daemon) -> None:
    async def attempts(thing: Any, kind: type) -> list[str]:
        faults: list[str] = []
        for verb, arguments, words in _attempts(kind):
            error = None
            try:
                called = getattr(thing, verb)(*arguments, **words)
                if inspect.isasyncgen(called):
                    await anext(called)
                elif inspect.isawaitable(called):
                    await called
                elif inspect.isgenerator(called):
                    list(called)
            except Exception as caught:
                error = caught
            faults += _fault(f"{verb}{arguments}{words}", error)
        return faults

    async def go() -> list[str]:
        async with await aio.connect(daemon.socket) as cell:
            faults = await attempts(cell, aio.AsyncWorkcell)
            for name in NODES:
                async with await cell.open(name, "r" if name == "force0" else "rw", 5.0) as node:
                    faults += await attempts(node, type(node))
                    assert (await node.fresh()).number, "the node works on"
            return faults

    assert asyncio.run(go()) == []


@pytest.mark.parametrize("timeout", [math.nan, "1", [], True])
def test_time_outs_are_seconds(daemon: Daemon, timeout: Any) -> None:
    with daemon.cell() as cell, cell.open("mod0.readonly") as node:
        for call in (
            lambda: node.wait_until_idle(timeout),
            lambda: node.wait_new(0, timeout),
            lambda: node.wait_room(1, timeout),
            lambda: sioms.select([node], timeout=timeout),
        ):
            with pytest.raises((TypeError, ValueError), match="time-out"):
                call()
        assert node.read().number
