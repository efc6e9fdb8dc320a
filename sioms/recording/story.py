"""What happened, in sentences: the events of a recording in order, and what began it. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from sioms.protocol.text import printable

from .messages import Event

ENDINGS = ("device lost", "device late", "fork server died", "fork server killed")
"""Lines of the daemon's log that tell of a process that has died or hangs."""
GAP_NS = 2_000_000_000
"""Events that are further apart than this do not belong to one story."""
LONGEST = 2000
"""Characters of a sentence at most."""
_QUIET = ("began", "ended", "opened again", "closed")


def utc(stamp_ns: int) -> str:
    """Return a time [ns, UTC] in words, to the microsecond; of one before 1970 or beyond 2262 the bare number."""
    if not 0 <= stamp_ns < 1 << 63:
        return f"{stamp_ns} ns"
    whole = datetime.fromtimestamp(stamp_ns // 1_000_000_000, UTC).strftime("%Y-%m-%dT%H:%M:%S")
    return f"{whole}.{stamp_ns % 1_000_000_000 // 1000:06d}Z"


def happened(event: Event, offset_ns: int) -> dict[str, object]:
    """Return an event as plain values; ``offset_ns`` is what UTC shows more than its clock."""
    return {
        "utc_ns": event.stamp_ns + offset_ns, "kind": event.kind, "source": event.source, "node": event.node,
        "who": event.who, "errno": event.error, "text": sentence(event),
    }  # fmt: skip


def sentence(event: Event) -> str:
    """Return what an event tells, without its time."""
    return printable(_sentence(event), LONGEST)


def _sentence(event: Event) -> str:
    data = event.data or {}
    refused = f", refused: {event.text}" if event.error else ""
    match event.kind:
        case "command" if data.get("verb") == "Ioctl":
            return f"{event.who} asked {event.node} for {data.get('request')}{refused}"
        case "command":
            return f"{event.who} wrote {data.get('records', 0)} bytes of records to {event.node}{refused}"
        case "refusal":
            return f"{event.who}: {event.node} refused a request later: {event.text}"
        case "stop":
            how = {"CONTROLLED": "stopped in a controlled way", "EMERGENCY": "made an emergency stop"}
            what = how.get(str(data.get("stop")), "stopped after a failure")
            return (
                f"{event.source} {what if data.get('stop') != 'LOSS' else 'gave its device up as lost'}: {event.text}"
            )
        case "fault":
            return f"{event.source}: fault of {data.get('channels')}: {event.text}"
        case "link":
            return f"{event.source}: the link to its device is {data.get('state')}" + (
                f": {event.text}" * bool(event.text)
            )
        case "reset":
            return f"{event.source} was reset"
        case "log" if event.text in ENDINGS:
            what = "is late" if event.text == "device late" else "has died"
            return f"the driver of {data.get('device', 'all devices')} {what}: {data.get('reason') or data.get('why')}"
        case "log":
            more = ", ".join(
                f"{key} {value}" for key, value in data.items() if key != "level" and value not in ("", None)
            )
            return f"the daemon logged {data.get('level')}: {event.text}" + (f" ({more})" if more else "")
        case "request":
            given = data.get("arguments")
            given = given if isinstance(given, list) else [given]
            arguments = ", ".join(str(value) for value in given if value not in ("", None))
            return f"{event.who} asked the daemon: {data.get('verb')} {arguments}".rstrip() + refused
        case "marker":
            return f"{data.get('device')} signalled marker {data.get('marker')}"
        case "daemon gone" | "daemon back":
            return event.text
        case "closed":
            return f"{event.who} has closed {event.node}, or has gone"
    return (
        f"{event.source}: {event.kind}"
        + (f" {event.node}" if event.node else "")
        + (f": {event.text}" * bool(event.text))
    )


def weight(event: Event) -> int:
    """Return how much an event is worth a black box: 3 a death, 2 a fault, 1 a stop by somebody, 0 nothing."""
    data = event.data or {}
    if event.kind == "daemon gone" or (event.source == "daemon" and event.kind == "log" and event.text in ENDINGS):
        return 3
    if event.kind == "fault" or (event.kind == "stop" and data.get("stop") in ("FAILURE", "LOSS")):
        return 2
    if event.kind == "log" and event.text == "driver" and data.get("level") == "error":
        return 2
    emergency = event.kind == "stop" and data.get("stop") == "EMERGENCY"
    return 1 if emergency or (event.kind == "log" and event.text == "emergency stop") else 0


@dataclass(frozen=True, slots=True)
class Story:
    """What happened.

    Attributes:
        cause: a word: "death", "fault", "stop" or "request" for none of these.
        first: the event that began it; None for none.
        text: of the cause, a sentence.
        events: from somewhat before it on, in order.
    """

    cause: str
    first: Event | None
    text: str
    events: Sequence[Event]


def tell(events: Sequence[Event]) -> Story:
    """Find out what began the last trouble in a recording.

    The last event of weight is followed back to the first one of the same trouble, by gaps of less than 2 s. That is
    the cause, unless a death was seen within 50 ms: what a death brings about may have been noted before.
    """
    heavy = [event for event in events if weight(event)]
    if not heavy:
        return Story("request", None, "nothing was stopped, in fault or dead", events)
    begin = len(heavy) - 1
    while begin and heavy[begin].stamp_ns - heavy[begin - 1].stamp_ns < GAP_NS:
        begin -= 1
    near = [event for event in heavy[begin:] if event.stamp_ns - heavy[begin].stamp_ns < 50_000_000]
    first = next((event for event in near if weight(event) == 3), heavy[begin])
    cause = ("request", "stop", "fault", "death")[weight(first)]
    told = [event for event in events if event.stamp_ns > heavy[begin].stamp_ns - GAP_NS and event.kind not in _QUIET]
    return Story(cause, first, sentence(first), told)
