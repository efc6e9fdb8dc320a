"""The compiled decoders take what those in Python take, with the same meaning, and nothing else."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sioms.protocol.compiled import add_decoders
from sioms.protocol.messages import HandleVerb, MalformedMessage, encode
from sioms.protocol.verbs import ON_HANDLE, Socket, take

QUICK = Socket(ON_HANDLE.sender, ON_HANDLE.receiver, ON_HANDLE.states)
QUICK.update(ON_HANDLE)
add_decoders(QUICK)
PLAIN = Socket(ON_HANDLE.sender, ON_HANDLE.receiver, ON_HANDLE.states)
PLAIN.update(ON_HANDLE)

VALUES = st.one_of(
    st.integers(-(2**63), 2**64 - 1),
    st.floats(),
    st.booleans(),
    st.none(),
    st.binary(max_size=40),
    st.text(max_size=9),
    st.lists(st.integers(0, 300), max_size=3),
)


def outcome(packet: bytes, socket: Socket) -> Any:
    try:
        number, message = take(packet, socket, pending={7})
    except MalformedMessage as error:
        return str(error)
    return number, type(message), [(type(part), part) for part in message]


def test_writes_are_among_them() -> None:
    assert HandleVerb.WRITE in QUICK.decoders and HandleVerb.KEEPALIVE in QUICK.decoders
    assert HandleVerb.IOCTL not in QUICK.decoders  # its argument may be anything


@pytest.mark.parametrize("timeout", [0.0, 0, 2.5, None, float("inf"), float("nan"), True, "1", -(2**63)])
@pytest.mark.parametrize("number", [1, 7, 0, -1, 2**53, 1.0])
def test_a_write_means_the_same(timeout: Any, number: Any) -> None:
    packet = encode(HandleVerb.WRITE, number, 1, timeout, b"abc")
    assert outcome(packet, QUICK) == outcome(packet, PLAIN)


@given(st.sampled_from(sorted(ON_HANDLE)), VALUES, st.lists(VALUES, max_size=4))
def test_any_arguments_mean_the_same(verb: int, number: Any, arguments: list[Any]) -> None:
    packet = encode(verb, number, *arguments)
    assert repr(outcome(packet, QUICK)) == repr(outcome(packet, PLAIN))


@given(st.binary(max_size=60))
def test_any_bytes_mean_the_same(data: bytes) -> None:
    assert repr(outcome(data, QUICK)) == repr(outcome(data, PLAIN))


@given(st.integers(0, 200), st.integers(0, 255), st.binary(max_size=4))
def test_damaged_writes_mean_the_same(at: int, byte: int, tail: bytes) -> None:
    whole = bytearray(encode(HandleVerb.WRITE, 5, 1, 0.5, struct.pack("<6d", *range(6))) + tail)
    whole[at % len(whole)] = byte
    assert repr(outcome(bytes(whole), QUICK)) == repr(outcome(bytes(whole), PLAIN))
