"""How a Grbl controller is found: brought to rest whatever it does, identified, its limits compared with the configuration."""

from __future__ import annotations

import errno
from collections.abc import Callable, Generator, Mapping, Sequence
from typing import Any

from sioms.motion import AxisSettings

from .codec import grbl
from .codec.grbl import Answer, Report
from .codec.grbl_machine import compare_limits
from .exchange import DeviceError, LinkError, Pause, Send, Step, Steps

TIMEOUT_S = 0.5
RESET_S = 3.0
HOLD_S = 5.0
Clock = Callable[[], int]
Hearing = Callable[[Report, Sequence[str]], None]
"""Takes a report and the lines that came before it."""


def to_rest(clock: Clock, hear: Hearing) -> Generator[Step, Any, Report]:
    """End jogs and programs that go on, with the position kept; return the last report."""
    yield Send(b"\n" + grbl.JOG_CANCEL, "end a cut line, cancel jogs")
    yield Pause(0.1)
    report: Report
    try:
        report, _ = yield grbl.status(TIMEOUT_S)
    except LinkError:  # booting, or deaf because it homes: only a reset ends that
        yield grbl.reset(RESET_S)
        report, _ = yield grbl.status(TIMEOUT_S)
    if report.state in ("Run", "Hold"):
        yield from _hold_and_reset(clock)
    elif report.state == "Jog":  # it brakes; what is asked next it would refuse
        report = yield from until_rest(clock, hear)
    return report


def until_rest(clock: Clock, hear: Hearing) -> Generator[Step, Any, Report]:
    """Wait until cancelled jogs have come to rest; return the last report, and give each to ``hear``."""
    limit_ns = clock() + int(HOLD_S * 1e9)
    while True:
        yield Pause(0.02)
        report: Report
        report, lines = yield grbl.status(TIMEOUT_S)
        hear(report, lines)
        if report.state not in ("Jog", "Hold") or clock() >= limit_ns:
            return report


def _hold_and_reset(clock: Clock) -> Steps:
    """End a program with its position kept: hold, wait for rest, reset."""
    yield Send(grbl.HOLD, "feed hold")
    limit_ns = clock() + int(HOLD_S * 1e9)
    while clock() < limit_ns:
        yield Pause(0.05)
        report, _ = yield grbl.status(TIMEOUT_S)
        if (report.state, report.sub) == ("Hold", 0) or report.state == "Idle":
            break
    yield grbl.reset(RESET_S)


def identify(name: str, wanted: str) -> Steps:
    """Refuse what is no Grbl controller, or whose version does not contain a text; raises DeviceError."""
    answer: Answer = yield grbl.command("$I", TIMEOUT_S, repeatable=True)
    version = answer.tagged("VER")
    if not version or wanted not in version:
        text = f"identify {name}: version {version or 'not told'}; the configuration says "
        raise DeviceError(errno.ENODEV, f"{text}{wanted or 'a Grbl controller'}")


def compare(
    name: str,
    found: Mapping[int, float],
    axes: Sequence[AxisSettings],
    indices: Sequence[int],
    per_unit: Sequence[float],
    log: Callable[[str, str], None],
) -> None:
    """Compare the controller's limits with the configured ones; FluidNC does not tell them by number.

    Args:
        name: of the device.
        found: its settings by number.
        axes: as configured.
        indices: of their letters.
        per_unit: millimetres or degrees in the unit of each.
        log: takes what is to be said.

    Raises:
        DeviceError: an axis may do more than its controller.
    """
    for settings, index, scale in zip(axes, indices, per_unit, strict=True):
        try:
            told = compare_limits(
                dict(found), index, float(scale), settings.velocity_max, settings.acceleration_max
            )
        except DeviceError as error:
            raise DeviceError(error.errno, f"open {name}: axis {settings.name}: {error}") from None
        if not told:
            log("warning", f"{name} {settings.name}: the controller does not tell its limits")
