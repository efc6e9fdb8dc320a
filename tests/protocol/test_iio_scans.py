"""Golden scans of Linux IIO buffers: the kernel's dummy device, and layouts worked by hand from the kernel's rules."""

from __future__ import annotations

import pytest

from sioms.drivers.iio.codec import Element, Layout, ScanReceiver, parse_type


def layout(*types: str, reverse: bool = False) -> Layout:
    elements = [Element(f"c{i}", i, parse_type(text)) for i, text in enumerate(types)]
    return Layout(elements[::-1] if reverse else elements)


GOLDEN = [
    # the kernel's dummy device: 73, 33 (12 bits), -34 (11 bits), 34, time 0x0102030405060708
    (
        ("le:u13/16>>0", "le:s12/16>>0", "le:s11/16>>0", "le:s16/16>>0", "le:s64/64>>0"),
        "49 00 21 00 de 07 22 00 08 07 06 05 04 03 02 01",
        [0, 2, 4, 6, 8], (73, 33, -34, 34, 0x0102030405060708),
    ),
    # bits above the value are not part of it
    (("le:u13/16>>0",), "49 e0", [0], (73,)),
    (("le:s12/16>>0",), "ff 0f", [0], (-1,)),
    (("le:s12/16>>0",), "00 08", [0], (-2048,)),
    # a converter that is left-aligned, big-endian
    (("be:s12/16>>4",), "80 00", [0], (-2048,)),
    (("be:s12/16>>4",), "7f f0", [0], (2047,)),
    (("be:u24/32>>8",), "ab cd ef 99", [0], (0xABCDEF,)),
    (("be:s24/32>>8",), "80 00 00 00", [0], (-8388608,)),
    # three axes and a time: six bytes, two of padding, eight
    (
        ("le:s16/16>>0", "le:s16/16>>0", "le:s16/16>>0", "le:s64/64>>0"),
        "01 00 fe ff 03 00 00 00 40 42 0f 00 00 00 00 00", [0, 2, 4, 8], (1, -2, 3, 1000000),
    ),
    # a byte, a word at its own alignment, padding at the end to the largest
    (("le:u8/8>>0", "le:s32/32>>0", "le:u8/8>>0"), "05 00 00 00 fe ff ff ff 07 00 00 00", [0, 4, 8], (5, -2, 7)),
    (("le:s8/8",), "80", [0], (-128,)),
    (("le:s64/64>>0",), "ff ff ff ff ff ff ff ff", [0], (-1,)),
]  # fmt: skip


@pytest.mark.parametrize(("types", "scan", "offsets", "values"), GOLDEN)
def test_golden_scans(types: tuple[str, ...], scan: str, offsets: list[int], values: tuple[int, ...]) -> None:
    data = bytes.fromhex(scan)
    for made in (layout(*types), layout(*types, reverse=True)):
        assert (made.offsets, made.size) == (offsets, len(data))
        for copies in (1, 3):
            got = made.decode(data * copies)
            assert [got[f"c{i}"].tolist() for i in range(len(types))] == [[value] * copies for value in values]
        receiver = ScanReceiver(made.size)
        assert b"".join(receiver.feed(bytes([byte])) for byte in data + data[:-1]) == data


def test_a_repeated_element_keeps_its_words() -> None:
    made = layout("le:s16/16X4>>0")
    data = bytes.fromhex("01 00 02 00 ff ff 04 00")
    assert made.size == 8 and made.decode(data)["c0"].tolist() == [[1, 2, -1, 4]]


@pytest.mark.parametrize(
    "text", ["", "le:s12", "le:x12/16", "se:s12/16", "le:s0/16>>0", "le:s12/24>>0", "le:s12/16>>5", "le:s65/64", "le:s16/16X0>>0"]  # noqa: E501
)  # fmt: skip
def test_what_is_no_type_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="read a scan type"):
        parse_type(text)


def test_a_scan_has_an_element() -> None:
    with pytest.raises(ValueError, match="no element"):
        Layout([])
