"""The plain codec against the package msgpack: the same bytes, the same values, the same refusals."""

from __future__ import annotations

import math

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sioms.protocol import wire

INTEGERS = st.integers(-(1 << 63), (1 << 64) - 1)
LEAVES = st.none() | st.booleans() | INTEGERS | st.floats() | st.text(max_size=300) | st.binary(max_size=300)
VALUES = st.recursive(
    LEAVES,
    lambda inner: st.lists(inner, max_size=20) | st.dictionaries(st.text(max_size=40), inner, max_size=20),
)
EDGES = [
    0,
    127,
    128,
    255,
    256,
    65535,
    65536,
    (1 << 32) - 1,
    1 << 32,
    -1,
    -32,
    -33,
    -128,
    -129,
    -32768,
    -32769,
]


def theirs(data: bytes) -> object:
    wire.check(data, 1 << 30)
    return msgpack.unpackb(data, raw=False, use_list=True, strict_map_key=True)


def same(a: object, b: object) -> bool:
    """Compare with types, and with NaN equal to itself."""
    if isinstance(a, float) and math.isnan(a):
        return isinstance(b, float) and math.isnan(b)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict) and isinstance(b, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    return type(a) is type(b) and a == b


@given(VALUES)
def test_the_same_bytes_and_back(value):
    packed = wire.pack(value)
    assert packed == msgpack.packb(value, use_bin_type=True)
    assert same(wire.unpack(packed), theirs(packed))


@pytest.mark.parametrize("size", [0, 15, 16, 31, 32, 255, 256, 65535, 65536])
def test_every_form_of_length(size):
    for value in (
        "x" * size,
        b"x" * size,
        [0] * size,
        {str(i): i for i in range(size)},
        [*EDGES, size, -size],
    ):
        packed = wire.pack(value)
        assert packed == msgpack.packb(value, use_bin_type=True)
        assert same(wire.unpack(packed), theirs(packed))


@given(st.binary(max_size=40) | VALUES.map(wire.pack).flatmap(lambda b: st.integers(0, len(b)).map(lambda n: b[:n])))
def test_nonsense_is_refused_and_sense_is_taken_like_the_package_does(data):
    try:
        expected = theirs(data)
    except Exception:  # a wide family
        with pytest.raises(ValueError):
            wire.unpack(data)
        return
    try:
        got = wire.unpack(data)
    except ValueError as error:
        assert "do not contain this type" in str(error)  # extension types, which messages do not hold
    else:
        assert same(got, expected)


def test_deep_nesting_and_great_promises_cost_nothing():
    for data in (
        b"\x91" * 100_000,
        b"\xdd\xff\xff\xff\xff",
        b"\xdf\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
    ):
        with pytest.raises(ValueError):
            wire.unpack(data)


def test_what_messages_do_not_hold():
    with pytest.raises(TypeError):
        wire.pack({1, 2})
    with pytest.raises(OverflowError):
        wire.pack(1 << 64)
