"""Events of journals as they are recorded, and back again. Pure."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sioms.protocol import verbs
from sioms.protocol.flags import Request
from sioms.protocol.journal import Event as Noted
from sioms.protocol.journal import Note
from sioms.protocol.messages import MalformedMessage

from .messages import Event


def told(source: str, noted: Noted) -> Event:
    """Return an event of a journal as it is recorded."""
    try:
        kind, values = Note(noted.kind), noted.values()
        fields, word = _FIELDS[kind](*values), str(kind.name).lower()
    except (ValueError, TypeError, MalformedMessage) as error:
        return Event(noted.stamp_ns, noted.number, source, f"unknown {noted.kind}", text=str(error), raw=noted.payload)
    return Event(noted.stamp_ns, noted.number, source, word, **fields)


def _command(node: str, who: str, packet: bytes, errno: int, why: str) -> dict[str, Any]:
    data: dict[str, Any] = {}
    try:
        number, message = verbs.take(packet, verbs.ON_HANDLE)
        data = {"verb": type(message).__name__, "number": number}
        for name, value in zip(message.fields, message, strict=True):
            data[name] = len(value) if isinstance(value, bytes) else value
        if isinstance(message, verbs.Ioctl):
            data["request"] = Request(message.request).name
    except (MalformedMessage, ValueError):
        pass
    return {"node": node, "who": who, "error": errno, "text": why, "data": data, "raw": packet}


_FIELDS: dict[int, Any] = {
    Note.COMMAND: _command,
    Note.REFUSAL: lambda node, who, number, errno, why: {
        "node": node, "who": who, "error": errno, "text": why, "data": {"number": number},
    },
    Note.STOP: lambda how, why, parts: {"text": why, "data": {"stop": how, "parts": parts}},
    Note.FAULT: lambda names, why: {"text": why, "data": {"channels": names}},
    Note.LINK: lambda state, why: {"text": why, "data": {"state": state}},
    Note.RESET: lambda block, channels: {"data": {"block": block, "channels": channels}},
    Note.LOG: lambda level, event, values: {
        "text": event, "who": str(values.get("peer") or values.get("by") or ""), "node": str(values.get("node") or ""),
        "data": {"level": level, **values},
    },
    Note.REQUEST: lambda who, verb, arguments, errno, why: {
        "who": who, "error": errno, "text": why, "data": {"verb": verb, "arguments": arguments},
        "node": str(arguments[0]) if verb in ("Open", "EmergencyStop", "Reset") else "",
    },
    Note.MARKER: lambda device, number: {"data": {"device": device, "marker": number}},
    Note.CLOSED: lambda node, who: {"node": node, "who": who},
}  # fmt: skip


def noted(event: Event) -> tuple[int, list[Any]] | None:
    """Return kind and payload of the note that an event was, the inverse of ``told``.

    What the recorder told of itself is a line of the daemon's log. None: it was no note of this version.
    """
    if event.source == "recorder":
        return Note.LOG, ["info", f"recorder: {event.kind}", {"text": event.text, "node": event.node}]
    kind = Note.__members__.get(event.kind.upper())
    if kind is None:
        return None
    try:
        return kind, _VALUES[kind](event, event.data or {})
    except (KeyError, TypeError, ValueError, AttributeError):
        return None  # a recording that somebody has written otherwise


_VALUES: dict[int, Callable[[Event, dict[str, Any]], list[Any]]] = {
    Note.COMMAND: lambda e, _: [e.node, e.who, e.raw, e.error, e.text],
    Note.REFUSAL: lambda e, data: [e.node, e.who, data["number"], e.error, e.text],
    Note.STOP: lambda e, data: [data["stop"], e.text, data["parts"]],
    Note.FAULT: lambda e, data: [data["channels"], e.text],
    Note.LINK: lambda e, data: [data["state"], e.text],
    Note.RESET: lambda _, data: [data["block"], data["channels"]],
    Note.LOG: lambda e, data: [data["level"], e.text, {key: data[key] for key in data if key != "level"}],
    Note.REQUEST: lambda e, data: [e.who, data["verb"], data["arguments"], e.error, e.text],
    Note.MARKER: lambda _, data: [data["device"], data["marker"]],
    Note.CLOSED: lambda e, _: [e.node, e.who],
}
