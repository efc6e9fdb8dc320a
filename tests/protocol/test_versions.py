"""What the processes of one version tell each other is what they told each other when it was given its number."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from enum import IntEnum, IntFlag
from pathlib import Path
from struct import Struct
from typing import Any

from sioms.protocol import (
    driver_verbs,
    flags,
    journal,
    latch,
    markers,
    messages,
    nodeinfo,
    page,
    records,
    stopfile,
    verbs,
)  # fmt: skip

KNOWN = Path(__file__).with_name("versions.txt")
"""Each version, and the fingerprint of what was told under it."""


OWN = {
    "PROTOCOL_VERSION",
    "TYPE_CHECKING",
    "EMSGSIZE",
    "SOMEBODY",
    "_GOOD",
    "_LOOKS",
    "_ORDERED",
    "_SHORT",
    "_SHORT_HEAD",
}
"""Values that each process has for itself."""


def described(value: Any) -> Iterator[str]:
    """Tell of a value of a module what both ends have to agree on."""
    match value:
        case verbs.Socket():
            for verb, kind in sorted(value.items()):
                fields = [(name, field.words, field.most) for name, field in kind.fields.items()]
                rules = kind.notice, kind.states, kind.then, int(kind.right), kind.shown, kind.query
                yield f"{value.sender} to {value.receiver}: {verb} {kind.__name__} {fields} {rules}"
        case Struct():
            yield value.format
        case type() if issubclass(value, IntEnum | IntFlag):
            yield str([(each.name, int(each)) for each in value])
        case type() if value.__module__ == records.__name__:
            yield str([(n, c.code) for n, c in vars(value).items() if isinstance(c, records.Column)])
        case int() | str() | bytes():
            yield repr(value)


def facts() -> list[str]:
    """Return all of it, a line each."""
    modules = (driver_verbs, flags, journal, latch, markers, messages, nodeinfo, page, records, stopfile, verbs)
    return [
        f"{module.__name__}.{name}: {line}"
        for module in modules
        for name, value in sorted(vars(module).items())
        if name not in OWN and not name.startswith("__")
        for line in described(value)
    ]


def test_whatever_can_be_told_wrongly_is_among_the_facts() -> None:
    text = "\n".join(facts())
    wanted = ("AlarmChanged", "'at_ns'", "latch._ORDERS", "page.", "'ACCELERATION'", "stopfile._REQUEST", "markers.")
    assert [word for word in wanted if word.lower() not in text.lower()] == []


def test_a_change_of_what_processes_tell_each_other_has_a_version_of_its_own() -> None:
    known = dict(line.split() for line in KNOWN.read_text().splitlines())
    assert [*known] == sorted(known, key=int) and len({*known.values()}) == len(known)
    fingerprint = hashlib.sha256("\n".join(facts()).encode()).hexdigest()[:16]
    assert [*known.items()][-1] == (str(flags.PROTOCOL_VERSION), fingerprint), (
        "what processes tell each other is not what it was when PROTOCOL_VERSION got its value: raise it "
        f"(docs/versions.md), and add a line to {KNOWN.name}, the version and {fingerprint}"
    )
