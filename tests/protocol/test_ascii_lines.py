"""Golden lines of the ASCII stream: each form that the format allows, and what is no sample."""

from __future__ import annotations

import pytest

from sioms.drivers.ascii_stream.codec import LineReceiver

GOLDEN = [
    (b"1.5,-2,3e2\n", (1.5, -2.0, 300.0)),
    (b"1.5;-2;3e2\r\n", (1.5, -2.0, 300.0)),
    (b"1.5\t-2\t3e2\n", (1.5, -2.0, 300.0)),
    (b"  1.5   -2 +3e2  \r\n", (1.5, -2.0, 300.0)),
    (b"1.5, -2;\t3e2\n", (1.5, -2.0, 300.0)),
    # the exclusive-or of the characters before the star, worked by hand: 31^2c^32^2c^33 = 30
    (b"1,2,3*30\n", (1.0, 2.0, 3.0)),
    (b"1 2 3*30\r\n", (1.0, 2.0, 3.0)),
    (b"1,2,3*31\n", None),
    (b"1,2,3*3\n", None),
    (b"1,2\n", None),
    (b"1,2,3,4\n", None),
    (b"# 1,2,3\n", None),
    (b"\r\n", None),
    (b"1,2,0x3\n", None),
    (b"1,2,inf\n", None),
    (b"1,2,3\xff\n", None),
]


@pytest.mark.parametrize(("line", "row"), GOLDEN)
def test_golden_lines(line: bytes, row: tuple[float, ...] | None) -> None:
    wanted = [] if row is None else [row]
    assert LineReceiver(3).feed(b"ut,off\n" + line) == wanted
    receiver = LineReceiver(3)
    assert [r for byte in b"ut,off\n" + line for r in receiver.feed(bytes([byte]))] == wanted
    assert LineReceiver(3).feed(b"\n" + line + b"7,8,9") == wanted, "what follows is not yet a line"
