"""Trials of the line: messages chopped, damaged, late, doubled, lost; a mute device; cables pulled; random bytes;
speed.
"""

from __future__ import annotations

import itertools
import time
from contextlib import ExitStack
from typing import Any

from sioms.protocol.flags import NodeClass

from .calm import Calm
from .station import Station, Unanswered, wait_for
from .trial import Failed, NotApplicable, Trial

BACK_S = 12.0
MORE_S = 6.0
LEAST = 4
"""Messages bent or readings seen, without which a disturbance goes on for up to MORE_S [s]."""
JUDGED = 2
"""Readings without which a disturbance goes on as well, where they are judged."""
LOST_S = 15.0
LEAST_RECOVERY_S = 0.005
LATE_TIMEOUT_S = 3.0
LATE_SHARE = 0.1
"""Of replies: of 0.3 a poll of seven reads nothing, and an opening of twenty does not come to its end."""
SPARSE = 200.0
"""Random bytes a second that leave most messages whole."""
RATIO = 1.3
"""Longest cycle over what rate and line allow."""
LOOKS = 4


def prepare(station: Station) -> None:
    """Bring axes to a place other than 0, so that a reply taken for another one shows."""
    for axis in station.rig.axes:
        with station.cell.open(axis.node, "rw", timeout=5.0) as node:
            node.move(axis.reach, timeout=1.0)
            node.wait_until_idle(20.0)


def disturbed(station: Station, seconds: float, *, judge: bool = True, babble: float = 0.0, **faults: Any) -> Calm:
    """Bend messages for a time, and check that the driver lives, reads nothing wrong, and is good again after.

    Args:
        station: the driver at work, at rest.
        seconds: how long.
        judge: readings made of bent messages are wrong ones.
        babble: random bytes a second beside the replies.
        faults: of the wire.

    Returns:
        The watch over its readings.
    """
    before, bent = station.status(), station.totals()["bent"]
    with Calm(station) as calm:
        if babble:
            station.tell_wire(f"babble {babble:g} {seconds:g}")
        station.fault(**faults)
        calm.watch(seconds)
        deadline = time.monotonic() + MORE_S
        # a busy machine lets few messages pass: wait until the trial has tried something, and seen what came of it
        while not babble and time.monotonic() < deadline:
            tried = calm.count if "chop" in faults else _bent_since(station, bent)
            if tried >= LEAST and (calm.count >= JUDGED or not judge):
                break
            calm.watch(0.1)
        station.fault()
        _check_alive(station, before)
        if judge and calm.wrong:
            seen = f"{len(calm.wrong)} of {calm.count} readings were wrong, the first: {calm.wrong[0]}"
            raise Failed("no reading made of a bent message, or of the reply to another request", seen, calm.traffic)
        check_back(station)
    return calm


def _bent_since(station: Station, before: int) -> int:
    return station.totals()["bent"] - before


def _check_alive(station: Station, before: dict[str, Any]) -> None:
    after = station.status()
    if (after["pid"], after["deaths"]) != (before["pid"], before["deaths"]):
        said = [line for line in (station.daemon.log() if station.daemon else "").splitlines() if "level=error" in line]
        why = said[-1][-400:] if said else after["reason"]
        raise Failed("the driver process to live on", f"it died: {why}")


def check_back(station: Station) -> float:
    """Wait for a good link after a disturbance; return how long that took [s]."""
    try:
        return station.wait_fresh(BACK_S)
    except TimeoutError as error:
        raise Failed(f"a good link within {BACK_S:g} s after the disturbance", str(error)) from None


def _summary(station: Station, calm: Calm, before: dict[str, int]) -> str:
    return f"{station.totals()['bent'] - before['bent']} messages bent, {calm.count} readings, none wrong"


def _bent(seconds: tuple[float, float], *, needs_check: bool = True, **faults: Any) -> Any:
    """Return a trial that bends by some faults for (quick, full) seconds."""

    def run(station: Station, full: bool) -> str:
        judge = not needs_check or (station.rig.checked and station.rig.line == "serial")
        before = dict(station.totals())
        calm = disturbed(station, seconds[full], judge=judge, **faults)
        if before["bent"] == station.totals()["bent"] and "chop" not in faults:
            raise NotApplicable("no message of the device passed meanwhile")
        if judge:
            return _summary(station, calm, before)
        why = "TCP and UDP guard their own bytes" if station.rig.line != "serial" else "its messages carry no checksum"
        return f"{station.totals()['bent'] - before['bent']} messages bent; readings not judged: {why}"

    return run


def chopped(station: Station, full: bool) -> str:
    """Deliver replies byte by byte, then cut anywhere; readings must go on coming."""
    if station.rig.line == "udp":
        raise NotApplicable("datagrams are not cut")
    texts = []
    for how in ("bytes", "cuts"):
        seconds = 3.0 if full else 0.35
        calm = disturbed(station, seconds, chop=how)
        if calm.count < 2:
            raise Failed("readings while replies come in pieces", f"{calm.count} readings in {seconds:g} s ({how})")
        texts.append(f"{how}: {calm.count} readings")
    return ", ".join(texts)


def mute(station: Station, full: bool) -> str:
    """Lose all replies: readings must be refused, commands too; then all is good again and nothing moves."""
    return _cut_off(station, lambda: station.fault(lose=1.0), station.fault, "the device fell mute")


def unplugged(station: Station, full: bool) -> str:
    """Pull the cable and put it back."""
    try:
        station.pull("plug")
    except Unanswered:
        raise NotApplicable("the driver has no line, and no device that can be pulled") from None
    for _ in range(4 if full else 1):
        text = _cut_off(station, lambda: station.pull("unplug"), lambda: station.pull("plug"), "the cable was pulled")
    return text


def _cut_off(station: Station, cut: Any, mend: Any, what: str) -> str:
    before = station.status()
    with Calm(station) as calm:
        cut()
        began = time.monotonic()
        try:
            if not wait_for(lambda: not station.is_good(), LOST_S):
                raise Failed(f"a lost link within {LOST_S:g} s after {what}", "the link is told to be good")
            lost_s = time.monotonic() - began
            reason = station.status()["link_reason"]
            _refused(station)
        finally:
            mend()
        back_s = check_back(station)
        _check_alive(station, before)
        calm.watch(0.15)
        if calm.wrong:
            raise Failed("the same readings as before, no motion", calm.wrong[0], calm.traffic)
    return f"lost after {1e3 * lost_s:.0f} ms ({reason}), good {1e3 * back_s:.0f} ms after it was there again"


def _refused(station: Station) -> None:
    """Check that a lost device gives no readings and takes no commands."""
    for node in station.nodes:
        with station.cell.open(node.reader) as opened:
            try:
                opened.read()
            except OSError:
                continue
            raise Failed("reads refused while the device is lost", f"{node.name} was read")
    for axis in station.rig.axes[:1]:
        with station.cell.open(axis.node, "rw", timeout=2.0) as node:
            try:
                node.move(0.0)
            except OSError:
                continue
            raise Failed("commands refused while the device is lost", f"{axis.node} took a move")


def late(station: Station, full: bool) -> str:
    """Let replies come a little after the driver has given up waiting for them."""
    timeout_s, answer_s = _timeout(station)
    most_s = max(LEAST_RECOVERY_S, 2 * answer_s)
    low, high = timeout_s + 0.1 * most_s, timeout_s + 0.9 * most_s
    before = dict(station.totals())
    seconds = max((8.0 if full else 1.5), 4 * timeout_s)
    calm = disturbed(station, seconds, late=LATE_SHARE, late_s=(low, high))
    bent = _bent_since(station, before["bent"])
    if not bent:
        raise NotApplicable("no message of the device passed meanwhile")
    return (
        f"{bent} replies up to {1e3 * (high - timeout_s):.1f} ms after the time-out of {1e3 * timeout_s:.0f} ms, "
        f"{calm.count} readings, none wrong"
    )


def _timeout(station: Station) -> tuple[float, float]:
    """Return how long the driver waits for a reply, and how long the device needs for one [s]."""
    if speaks_unasked(station):
        raise NotApplicable("the device speaks unasked; no reply is waited for")
    with station.cell.open(station.nodes[0].reader) as node:
        requests = station.messages(200)
        gaps = sorted(b[0] - a[0] for a, b in itertools.pairwise(requests) if a[1] == ">" and b[1] == "<")
        if not gaps:
            raise NotApplicable("no request was answered")
        answer_s = gaps[len(gaps) // 2] / 1e9
        replies = node.statistics(1)["link"]["replies"]
        wait_for(lambda: node.statistics(1)["link"]["replies"] > replies + LEAST, MORE_S, 0.01)  # nothing is owed
        before = node.statistics(1)["link"]["timeouts"]
        began_ns = time.monotonic_ns()
        station.fault(lose=1.0, count=1)
        counted = wait_for(lambda: node.statistics(1)["link"]["timeouts"] > before, LATE_TIMEOUT_S, 0.0)
        now_ns = time.monotonic_ns()
    if not counted:
        raise NotApplicable(f"no time-out within {LATE_TIMEOUT_S:g} s")
    lost = [t for t, way, _, _ in station.messages(60) if way == ">" and t >= began_ns - 50_000_000]
    times = [entry for entry in station.messages(60) if entry[3] == "lost"]
    sent_ns = max((t for t in lost if times and t <= min(times[-1][0], now_ns)), default=began_ns)
    return (now_ns - sent_ns) / 1e9, answer_s


def random_bytes(station: Station, full: bool) -> str:
    """Say random bytes to the driver for seconds, beside and instead of what the device says."""
    if station.rig.line == "udp":
        disturbed(station, 5.0 if full else 1.0, judge=False, babble=4000.0, replace=0.3)
        return "datagrams of random bytes; readings not judged: a datagram without a checksum of its own cannot be told"
    dense = min(0.3 / station.character_s, 8000.0) if station.character_s else 4000.0
    judge = station.rig.checked and station.rig.line == "serial"
    seconds = 5.0 if full else 0.35
    calms = [disturbed(station, seconds, judge=judge, babble=rate, replace=0.2) for rate in (dense, SPARSE)]
    counts = " and ".join(f"{calm.count} readings" for calm in calms)
    why = "" if judge else ", not judged: no checksum guards them"
    return f"{counts} among {dense:.0f} and {SPARSE:g} random bytes a second{why}"


def timing(station: Station, full: bool) -> str:
    """Compare the cycle with what the configured rate, the line's speed and the device's answers allow.

    What else the machine does only makes a cycle longer, so the best of some looks counts.
    """
    for _ in range(LOOKS - 1):
        try:
            return _cycle(station, full)
        except Failed:
            continue
    return _cycle(station, full)


def _cycle(station: Station, full: bool) -> str:
    with station.cell.open(station.nodes[0].reader) as node:
        asked_hz = node.info.tick_hz
        seconds = 4.0 if full else 0.8
        before, number, began_ns = _carried(station), node.read().number, time.monotonic_ns()
        time.sleep(seconds)
        after, last, took_s = _carried(station), node.read().number, (time.monotonic_ns() - began_ns) / 1e9
    cycles = last - number
    if cycles < 2:
        raise Failed(f"{asked_hz * seconds:.0f} readings in {seconds:g} s", f"{cycles}")
    characters = after - before
    cycle_s, line_s = took_s / cycles, characters * station.character_s / cycles
    waited_s = _answer_s(station, began_ns, took_s)
    figures = f"{cycles / took_s:.1f} readings/s, {asked_hz:g} configured"
    if station.wires:
        figures += f"; {characters / cycles:.1f} characters a cycle"
    if line_s:
        figures += f" = {1e3 * line_s:.2f} ms at {station.baud:g} baud, line {100 * line_s / cycle_s:.0f} % busy"
    least_s = max(1 / asked_hz, line_s, waited_s * cycle_s)
    if cycle_s > RATIO * least_s:
        most = f"; at most {0.9 / line_s:.0f} Hz fit on this line" if line_s else ""
        raise Failed(f"a cycle of at most {RATIO} times {1e3 * least_s:.2f} ms{most}", figures)
    return figures


def _carried(station: Station) -> int:
    """Return the characters that went over the line so far."""
    totals = station.totals() if station.wires else {}
    return sum(totals.get(key, 0) for key in ("request_bytes", "reply_bytes"))


def _answer_s(station: Station, began_ns: int, took_s: float) -> float:
    """Return the part of a time in which a request was on its way or waited for its answer."""
    if not station.wires:
        return 0.0
    entries = [entry for entry in station.messages(3000) if began_ns <= entry[0] <= began_ns + took_s * 1e9]
    waits: list[int] = [b[0] - a[0] for a, b in itertools.pairwise(entries) if a[1] == ">" and b[1] == "<"]
    return sum(waits) / 1e9 / took_s


def outputs_missing(station: Station, full: bool) -> str:
    """Lose the reply to a command: it must not be sent again by itself, unless it may be."""
    if not station.rig.axes:
        raise NotApplicable("the device has no axes")
    axis = station.rig.axes[0]
    with ExitStack() as stack:
        node = stack.enter_context(station.cell.open(axis.node, "rw", timeout=5.0))
        place = node.read().position[0]
        step = -axis.reach / 4
        station.fault(lose=1.0, count=2)
        try:
            node.move(step, relative=True, timeout=1.0)
            node.wait_until_idle(8.0)
        except OSError:
            pass  # refused, or stopped by the fault: what counts is where the axis is
        station.fault()
        check_back(station)
        wait_for(lambda: not node.read().in_motion[0], 5.0)
        time.sleep(0.1)
        moved = node.read().position[0] - place
    if not -axis.tolerance <= moved / step <= 1 + axis.tolerance / abs(step):
        raise Failed(f"a relative move of {step:g} carried out once or not at all", f"the axis moved {moved:g}")
    return f"moved {moved:.4g} of {step:.4g}"


def speaks_unasked(station: Station) -> bool:
    """Whether the device streams its readings, and is asked for none."""
    with station.cell.open(station.nodes[0].reader) as node:
        return "stream" in node.statistics(1)


def has_class(station: Station, node_class: NodeClass) -> bool:
    """Whether the device has a node of a class."""
    return any(node.node_class is node_class for node in station.nodes)


TRIALS = (
    Trial("timing", "cycle against configured rate and line's speed", timing, wire=False),
    Trial("chopped", "replies byte by byte and cut anywhere", chopped),
    Trial("noisy", "one bit of a third of the replies flipped", _bent((0.5, 5.0), flip=0.34)),
    Trial("garbage", "random bytes before or after a third of the replies", _bent((0.4, 4.0), garbage=0.34)),
    Trial("late", "replies that come after the driver's time-out", late),
    Trial("doubled", "half of the replies twice", _bent((0.4, 4.0), needs_check=False, double=0.5)),
    Trial("missing", "one of ten replies lost", _bent((0.5, 5.0), needs_check=False, lose=0.1)),
    Trial("once", "the reply to a relative move lost", outputs_missing),
    Trial("mute", "no reply at all, then the device speaks again", mute),
    Trial("unplugged", "the cable pulled and put back", unplugged, wire=False),
    Trial("random", "random bytes for seconds", random_bytes),
)
