"""Alarms on a real daemon: raised in the driver, latched, acknowledged by somebody, kept, and what they stop."""

from __future__ import annotations

import errno
import os
import signal
import time
from collections.abc import Callable
from typing import Any

import pytest
from daemon_rig import FORCE, IO, Daemon, axes, raises, wait_for

import sioms

ALARMS = """
[[alarm]]
node = "mod0"
high = 0.05
hihi = 0.30
on_major = "stop_node"
on_invalid = "none"

[[alarm]]
node = "io0.in.bit0"
state = 1
severity = "minor"
on_minor = "stop_workcell"
on_invalid = "none"

[[alarm]]
node = "force0.fx"
high = 100.0
"""
CELL = '[workcell]\nname = "test"\n' + axes("mod0", "xaxis", "yaxis") + IO + FORCE + ALARMS


def found(cell: sioms.Workcell, node: str) -> dict[str, Any] | None:
    """Return what is listed of a node's alarm on its value."""
    return next((a for a in cell.alarms() if a["node"] == node and a["what"] in ("position", "data")), None)


def test_limits_of_an_axis_stop_it_and_stand_until_they_are_acknowledged(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(CELL)
    with daemon.cell("tester") as cell, cell.open("mod0", "rw") as mod0:
        assert cell.alarms() == []
        mod0["xaxis"].move(0.1)
        mod0.wait_until_idle(timeout=10.0)
        alarm = wait_for(lambda: found(cell, "mod0.xaxis"), "an alarm")
        assert (alarm["severity"], alarm["state"], alarm["times"]) == (1, "unacknowledged", 1)
        assert "has reached 0.05 m" in alarm["text"]
        (done,) = cell.acknowledge("mod0.xaxis.readonly", "we know")
        assert done["state"] == "acknowledged" and "tester" in done["by"] and done["note"] == "we know"
        mod0["xaxis"].move(0.5)
        with pytest.raises(OSError, match=r"alarm of mod0: position .* has reached 0.3 m"):
            mod0.wait_until_idle(timeout=10.0)
            mod0["yaxis"].move(0.1)
        assert found(cell, "mod0.xaxis")["state"] == "unacknowledged", "it is worse than what was acknowledged"  # type: ignore[index]
        assert mod0.read()["xaxis"].position < 0.45
        cell.acknowledge("mod0", "driven back")
        time.sleep(0.002)  # within a millisecond of its stop nobody is taken to have seen it
        cell.reset("mod0")
        mod0["xaxis"].move(0.0)
        mod0.wait_until_idle(timeout=10.0)
        wait_for(lambda: cell.alarms() == [], "no alarms")
        with raises(errno.ENOENT, "no such node or device", "sioms alarms"):
            cell.acknowledge("mod7")
        with cell.open("io0.bit0", "rw") as output:
            output.set(1)
            wait_for(lambda: cell.status()["stopped_ns"], "a stop of the workcell")
        assert "alarm of io0.in.bit0: it reads 1" in cell.status()["stop_source"]
        assert wait_for(lambda: found(cell, "io0.in.bit0"), "its alarm")["worst"] == 1, "the stop makes it good again"
        # What a dead driver watched is not known; its death is an alarm of its own, and what was acknowledged goes.
        cell.acknowledge("io0", "known")
        os.kill(daemon.device("force0")["pid"], signal.SIGKILL)
        lost = wait_for(lambda: found(cell, "force0.fx"), "that the force is not watched")
        assert lost["worst"] == 3 and "its driver does not watch it" in lost["text"]
        wait_for(lambda: found(cell, "force0.fx")["state"] == "returned", "that it is watched again")  # type: ignore[index]
        cell.tell_alarm("mod0.xaxis", "drift", 1, "its belt slips")  # no driver knows, and no reload or restart ends it
        cell.reload()
    daemon.terminate()
    # The stop has set the output to its safe value: the input is good again, and nothing of io0 is left.
    again = start_daemon(CELL, at=daemon.folder)
    with again.cell("tester") as cell:
        left = {(a["node"], a["what"], a["state"]) for a in cell.alarms()}
        drift = ("mod0.xaxis", "drift", "unacknowledged")
        assert left == {("force0.fx", "data", "returned"), ("force0", "driver", "returned"), drift}
        cell.tell_alarm("mod0.xaxis", "drift", 0)
        assert len(cell.acknowledge()) == 3 and cell.alarms() == []


def test_all_that_is_wrong_with_alarms_is_told_at_once(start_daemon: Callable[..., Daemon]) -> None:
    daemon = start_daemon(CELL)
    wrong = """
[[alarm]]
node = "mod0.zaxis"
high = 1.0
[[alarm]]
node = "mod0"
column = "status"
high = 1.0
[[alarm]]
node = "io0.in.bit1"
high = 1.0
[[alarm]]
node = "force0"
high = 1.0
on_minor = "stop_device"
[[alarm]]
node = "force0"
state = 1
"""
    daemon.configure(CELL + wrong)
    words = (
        "number 4: node = mod0.zaxis, which does not exist", "number 5: column = status; want one of the axis node",
        "number 6: io0.in.bit1 is a binary node of single bits; want state", "number 7: on_minor = stop_device; device",
        "number 8: state = 1; force0 is not a binary node",
    )  # fmt: skip
    with daemon.cell("tester") as cell, raises(errno.EINVAL, *words):
        cell.reload()
