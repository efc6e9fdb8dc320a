"""How an experiment on axes ends early: what an axis says then, and the exception that carries it to the user."""

from __future__ import annotations

from sioms.client.snapshot import AxisSnapshot
from sioms.protocol.flags import AxisStatus

BROKEN = AxisStatus.FAULT | AxisStatus.EMERGENCY_STOP | AxisStatus.FOLLOWING_ERROR | AxisStatus.STALLED


class ExperimentStopped(RuntimeError):
    """The experiment did not come to its end; the axis has been halted. The message says why."""


def check_running(node: str, snapshot: AxisSnapshot) -> None:
    """Look whether an axis can go on.

    Raises:
        ExperimentStopped: it is stopped, or has a fault.
    """
    broken = AxisStatus(snapshot.status[0]) & BROKEN
    if broken:
        why = " and ".join(str(flag.name).lower().replace("_", " ") for flag in AxisStatus if flag & broken)
        raise ExperimentStopped(f"run an experiment on {node}: {why}; the axis is halted")
