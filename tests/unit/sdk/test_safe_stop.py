"""One stop: every path takes it, in one order, and a step that fails keeps no other from being done."""

from __future__ import annotations

import errno
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sioms.protocol.flags import NodeClass
from sioms.protocol.journal import HEADER, JOURNAL_SIZE, JournalWriter
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import AxisBlock, BinaryBlock, BlockSpec
from sioms.sdk.effects import Effects
from sioms.sdk.stops import Reason, Stop, Stops

KIT = Path(__file__).parents[3] / "sioms" / "sdk"


class Device:
    """Two axes and a port with a safe value, in a process that notes what it is told."""

    def __init__(self, failing: str = "") -> None:
        self.told: list[str] = []
        self.failing = failing
        verbs = {verb: self.note(verb) for verb in ("stop", "emergency_stop", "fault")}
        bank: Any = SimpleNamespace(**verbs, take_events=lambda: self.note("events")() or [], take_faults=list)
        axes = tuple(ChannelInfo(name, "m") for name in "xy")
        port = (ChannelInfo("o", "", width=4),)
        self.axes = AxisBlock(BlockSpec("", NodeClass.AXIS, axes), bank)
        self.port = BinaryBlock(BlockSpec("out", NodeClass.BINARY, port, writable=True, safe=(0,)))
        engine: Any = SimpleNamespace(
            stop=self.note("device stops"), make_safe=self.note("outputs"), recover=self.note("recover"),
            drop_writes=self.note("writes"),
        )  # fmt: skip
        outputs: Any = SimpleNamespace(want=lambda *_: None, forget=self.note("outputs are forgotten"))
        waits: Any = SimpleNamespace(end_axes=lambda *_: self.note("waits")() or [], end_block=self.note("all waits"))
        latch: Any = SimpleNamespace(resets=0, orders=0, ended_stop_ns=0)
        nothing: Any = SimpleNamespace(mark=0)
        self.stops = Stops(
            "dev",
            [self.axes, self.port],
            outputs,
            Effects(),
            waits,
            nothing,
            {},
            nothing,
            nothing,
            latch,
            0,
            nothing,
            nothing,
            [],
            JournalWriter(memoryview(bytearray(HEADER + JOURNAL_SIZE))),
        )
        self.stops.engine = engine

    def note(self, what: str) -> Any:
        """Return a function that notes that it was called, and fails if it is to."""

        def called(*_: object) -> None:
            self.told.append(what)
            if what == self.failing:
                raise RuntimeError(what)

        return called


@pytest.mark.parametrize(
    ("stop", "number", "wanted"),
    [
        (Stop.CONTROLLED, 0, "stop, device stops, writes, outputs, events"),
        (Stop.CONTROLLED, errno.ECANCELED, "stop, device stops, writes, outputs, waits, events"),
        (Stop.EMERGENCY, errno.ECANCELED, "emergency_stop, device stops, writes, outputs, waits, events"),
        (Stop.FAILURE, 0, "emergency_stop, recover, device stops, writes, outputs, events"),
        (Stop.LOSS, errno.EIO, "fault, outputs are forgotten, all waits, all waits, events"),
    ],
)
def test_the_order_is_one(stop: Stop, number: int, wanted: str) -> None:
    device = Device()
    device.stops.safe_stop(Reason(stop, "why", number), [(device.axes, [0, 1], -1), (device.port, [0], -1)])
    assert ", ".join(device.told) == wanted
    whole = Device()
    whole.stops.safe_stop(Reason(stop, "why", number))
    assert ", ".join(whole.told) == wanted


@pytest.mark.parametrize("failing", ["recover", "device stops", "writes", "outputs", "events"])
def test_a_step_that_fails_keeps_no_other_from_being_done(failing: str) -> None:
    device = Device(failing)
    with pytest.raises(RuntimeError, match=failing):
        device.stops.safe_stop(Reason(Stop.FAILURE, "why"))
    assert ", ".join(device.told) == "emergency_stop, recover, device stops, writes, outputs, events"


def test_of_an_output_only_what_is_asked_for_is_stopped() -> None:
    """Writes to other bits of the port, that are under way, go on."""
    device = Device()
    device.stops.safe_stop(Reason(Stop.CONTROLLED, "why"), [(device.port, [0], 2)])
    assert device.told == ["writes", "outputs", "events"]


def test_nothing_stops_past_it() -> None:
    """In the kit, only safe_stop tells banks and engines to stop."""
    call = re.compile(r"bank\.(stop|emergency_stop|fault)\(\W*(axes|np\.arange|owned)|engine\.(stop|recover)\b")
    found = {path.name for path in KIT.glob("*.py") if call.search(path.read_text(encoding="utf-8"))}
    assert found == {"stops.py"}
