"""How a Grbl controller is found: brought to rest whatever it does, identified, its limits compared with the
configuration.
"""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Callable, Generator, Mapping, Sequence
from typing import Any

from sioms.motion import AxisSettings
from sioms.sdk.exchange import DeviceError, LinkError, Pause, Send, StateLost, Step, Steps

from . import codec as grbl
from .codec import Answer, Report
from .machine import compare_limits

TIMEOUT_S = 0.5
RESET_S = 3.0
HOLD_S = 5.0
MOVING = ("Run", "Hold", "Jog")
Clock = Callable[[], int]
Hearing = Callable[[Report, Sequence[str]], None]
"""Takes a report and the lines that came before it."""


def to_rest(clock: Clock, hear: Hearing) -> Generator[Step, Any, tuple[Report, bool, bool]]:
    """Bring the controller to rest and to the state of a fresh start, whatever it does and whoever left it so.

    Jogs and programs are braked with their position kept; a reset at rest then clears lines, modes, overrides, spindle
    and holds.

    Returns:
        The last report, whether it had to be reset in motion (its position is then lost), and whether it greeted before
        that.
    """
    yield Send(grbl.END_CUT_LINE + grbl.JOG_CANCEL, "end a cut line, cancel jogs")
    yield Pause(0.1)
    rests, greeted, report = True, False, None
    with contextlib.suppress(LinkError):  # booting, or deaf as it homes or waits after an alarm: only a reset ends that
        try:
            report, lines = yield grbl.status(TIMEOUT_S)
            greeted = grbl.greets(lines)
        except StateLost:
            greeted = True
            report, _ = yield grbl.status(TIMEOUT_S)
    if report is not None and report.state in MOVING:
        rests = yield from brake(clock, hear, HOLD_S)
    lines = yield grbl.reset(RESET_S)
    try:
        report, more = yield grbl.status(TIMEOUT_S)
    except StateLost:  # it was booting: the first greeting was of its start, the second answers the reset
        greeted = True
        report, more = yield grbl.status(TIMEOUT_S)
    hear(report, (*lines[:-1], *more))
    return report, not rests, greeted


def brake(clock: Clock, hear: Hearing, limit_s: float) -> Generator[Step, Any, bool]:
    """Brake with the position kept, and send that again until the controller rests; return whether it does.

    A line that has waited for room in the planner goes out when a cancel has emptied it, so one report of rest is not
    enough.

    Args:
        clock: the time [ns].
        hear: gets each report.
        limit_s: longest time for it [s].
    """
    limit_ns, rested = clock() + int(limit_s * 1e9), 0
    while rested < 2:
        report, lines = yield grbl.status(TIMEOUT_S)
        hear(report, lines)
        rests = report.state not in MOVING or (report.state, report.sub) == ("Hold", 0)
        rested = rested + 1 if rests else 0
        if not rests:
            if clock() >= limit_ns:
                return False
            yield Send(grbl.HOLD if report.state == "Run" else grbl.JOG_CANCEL, "brake")
        yield Pause(0.02)
    return True


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
            told = compare_limits(dict(found), index, float(scale), settings.velocity_max, settings.acceleration_max)
        except DeviceError as error:
            raise DeviceError(error.errno, f"open {name}: axis {settings.name}: {error}") from None
        if not told:
            log("warning", f"{name} {settings.name}: the controller does not tell its limits")
