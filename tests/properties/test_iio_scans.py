"""Scans of any types: an encoder that works bit by bit in Python's integers, and any cut of the stream."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from sioms.drivers.iio.codec import Element, ElementType, Layout, ScanReceiver


@st.composite
def kinds(draw: Any) -> ElementType:
    storage = draw(st.sampled_from([8, 16, 32, 64]))
    bits = draw(st.integers(1, storage))
    signed = draw(st.booleans()) or bits == 64  # unsigned 64 bits do not fit what is returned
    return ElementType(draw(st.booleans()), signed, bits, storage, 1, draw(st.integers(0, storage - bits)))


def encode(values: list[int], types: list[ElementType], junk: int) -> bytes:
    """Put each value at its own alignment, with junk in all bits that are not its own."""
    scan = b""
    for value, kind in zip(values, types, strict=True):
        size = kind.storage // 8
        scan += b"\xa5" * (-len(scan) % size)
        mask = (1 << kind.bits) - 1 << kind.shift
        word = ((value & (1 << kind.bits) - 1) << kind.shift) | (junk & ((1 << kind.storage) - 1) & ~mask)
        scan += word.to_bytes(size, "big" if kind.big else "little")
    return scan + b"\x5a" * (-len(scan) % max(kind.storage // 8 for kind in types))


@given(st.lists(kinds(), min_size=1, max_size=6), st.data(), st.integers(0, 2**64 - 1))
def test_what_was_put_in_comes_out(types: list[ElementType], data: Any, junk: int) -> None:
    layout = Layout([Element(str(i), 10 * i, kind) for i, kind in enumerate(types)])
    rows = []
    for _ in range(data.draw(st.integers(1, 4))):
        bounds = [(-(1 << k.bits - 1), (1 << k.bits - 1) - 1) if k.signed else (0, (1 << k.bits) - 1) for k in types]
        rows.append([data.draw(st.integers(low, high)) for low, high in bounds])
    wire = b"".join(encode(row, types, junk) for row in rows)
    assert len(wire) == layout.size * len(rows)
    receiver, whole, at = ScanReceiver(layout.size), b"", 0
    while at < len(wire):
        size = data.draw(st.integers(1, 40))
        whole += receiver.feed(wire[at : at + size])
        at += size
    assert whole == wire
    got = layout.decode(whole)
    assert all(not len(values) for values in layout.decode(b"").values())
    assert [[int(got[str(i)][n]) for i in range(len(types))] for n in range(len(rows))] == rows
