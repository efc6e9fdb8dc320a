"""What a stop makes void on a drive of its own loop, and what it does not."""

from __future__ import annotations

from typing import Any

from sioms.motion import ActionKind, DriveAction
from sioms.protocol.markers import TABLE_SIZE, MarkerTable
from sioms.sdk.exchange import Send
from sioms.sdk.markers import Markers


def sent(steps: Any) -> list[bytes]:
    return [step.data for step in steps]


def make() -> Any:
    import msgspec

    from sioms.drivers.tmcl.driver import Tmcl

    class Kit:
        markers = Markers(MarkerTable(memoryview(bytearray(TABLE_SIZE))), lambda number: None)

    table = {
        "line": {"serial": "/dev/null"},
        "axis": [{"name": "x", "velocity_max": 0.1, "acceleration_max": 1.0}],
    }
    unit: Any = Tmcl("mod0", msgspec.convert(table, Tmcl.Settings), Kit()).units[0]
    unit.reset = lambda axis: iter((Send(b"reset", "reset"),))
    unit.home = lambda axis: iter((Send(b"home", "home"),))
    unit.halt = lambda axis, fastest: iter((Send(b"halt", "halt"),))
    return unit


def action(kind: ActionKind) -> DriveAction:
    return DriveAction(kind, 0, None, 0.1, 1.0)


def test_a_reset_is_carried_out_though_a_stop_overtakes_it() -> None:
    unit = make()
    reset = unit.act(action(ActionKind.RESET))
    assert sent(unit.act(action(ActionKind.STOP))) == [b"halt"]
    assert sent(reset) == [b"reset"]


def test_homing_is_not() -> None:
    unit = make()
    home = unit.act(action(ActionKind.HOME))
    assert sent(unit.act(action(ActionKind.QUICK_STOP))) == [b"halt"]
    assert sent(home) == []
