"""The protocol's enumerations, side by side with those of the standard library."""

from __future__ import annotations

import copy
import enum
import pickle
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sioms.protocol import driver_verbs, enumeration, flags, messages
from sioms.protocol.flags import AxisStatus


def pair(kind: str, members: dict[str, int]) -> tuple[Any, Any]:
    """Make the same class twice: of the standard library's base, and of ours."""
    original = getattr(enum, kind)("Made", members)
    base = getattr(enumeration, kind)
    return original, type(base)("Made", (base,), dict(members))


NAMES = st.sampled_from(["A", "B", "C", "D", "E_F"])
CODES = st.dictionaries(NAMES, st.integers(0, 300), min_size=1).filter(lambda d: len(set(d.values())) == len(d))
BITS = st.dictionaries(NAMES, st.sampled_from([1 << n for n in range(9)]), min_size=1).filter(
    lambda d: len(set(d.values())) == len(d)
)
WORD = st.integers(0, 1 << 10)


def shown(value: Any) -> tuple[object, ...]:
    return (
        int(value),
        repr(value),
        str(value),
        f"{value}",
        f"{value:#x}",
        value.name,
        value.value,
        bool(value),
    )


def outcome(act: Any) -> object:
    """Return what came of it, in a form that both kinds share."""
    try:
        value = act()
    except (ValueError, KeyError, AttributeError, TypeError) as error:
        return type(error)
    return shown(value) if hasattr(value, "name") else value


@given(CODES, st.integers(-5, 305))
def test_codes_are_as_the_original(members, value):
    ours, theirs = (cls for cls in reversed(pair("IntEnum", members)))
    assert [shown(m) for m in ours] == [shown(m) for m in theirs]
    assert outcome(lambda: ours(value)) == outcome(lambda: theirs(value))
    assert outcome(lambda: ours["A"]) == outcome(lambda: theirs["A"])
    assert len(ours) == len(theirs)


@given(BITS, WORD, WORD)
def test_flags_are_as_the_original(members, a, b):
    theirs, ours = pair("IntFlag", members)
    assert int(ours(a)) == int(theirs(a)) == a  # bits without a name are kept
    mask = sum(members.values())
    a, b = (
        a & mask,
        b & mask,
    )  # what such bits are called, and how they invert, differs between versions of Python
    for act in (
        lambda c: c(a), lambda c: c(a) | c(b), lambda c: c(a) & c(b), lambda c: c(a) ^ c(b), lambda c: c(a) | b,
        lambda c: a & c(b), lambda c: a | c(b), lambda c: c(a) & ~c(b), lambda c: c(a) in c(b), lambda c: len(c(a)),
        lambda c: [shown(m) for m in c(a)], lambda c: [shown(m) for m in c], lambda c: c(a) + 1, lambda c: c(a) == a,
        lambda c: {c(a): 1}[a], lambda c: c(a) >> 1,
    ):  # fmt: skip
        assert outcome(lambda act=act: act(ours)) == outcome(lambda act=act: act(theirs))


def test_members_cannot_be_changed_and_copy_to_themselves():
    assert pickle.loads(pickle.dumps(AxisStatus.MOVING)) is AxisStatus.MOVING
    assert copy.deepcopy(AxisStatus.MOVING | AxisStatus.HOMED) == AxisStatus.MOVING | AxisStatus.HOMED
    with pytest.raises(AttributeError):
        AxisStatus.MOVING.name = "x"  # type: ignore[misc]
    with pytest.raises(AttributeError):
        AxisStatus.MOVING = 5  # type: ignore[misc,assignment]


def test_the_protocol_uses_them():
    for module, least in ((flags, 8), (messages, 2), (driver_verbs, 2)):
        made = [
            v for v in vars(module).values() if isinstance(v, enumeration._Members) and v.__module__ == module.__name__
        ]
        assert len(made) >= least
        assert all(len(cls) > 0 for cls in made)
