"""Codecs under any cut of the stream, any damage and any bytes."""

from collections.abc import Callable
from itertools import pairwise

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from sioms.drivers.ascii_stream.codec import MAX_LINE_BYTES, LineReceiver
from sioms.drivers.framed_adc import codec as sample_stream
from sioms.drivers.framed_adc.cobs import (
    MAX_PAYLOAD_BYTES,
    MAX_WIRE_BYTES,
    FrameReceiver,
    frame,
    stuff,
    unstuff,
)
from sioms.sdk.codec import modbus_pdu
from sioms.sdk.codec.modbus import RtuUnit, SerialLine, TcpUnit, frame_rtu, frame_tcp
from sioms.sdk.exchange import DeviceError, Exchange, LinkError

LINE = SerialLine(19200)
PAYLOADS = st.lists(st.binary(min_size=1, max_size=MAX_PAYLOAD_BYTES), max_size=12)
CUTS = st.lists(st.integers(1, 64), min_size=1, max_size=40)


def cut(data: bytes, sizes: list[int]) -> list[bytes]:
    """Cut data into pieces of the sizes, taken round and round."""
    pieces, at, i = [], 0, 0
    while at < len(data):
        size = sizes[i % len(sizes)]
        pieces.append(data[at : at + size])
        at, i = at + size, i + 1
    return pieces


@given(st.binary(max_size=1200))
@example(b"\1" * 254)
@example(b"\1" * 254 + b"\0")
@example(b"\1" * 508)
@example(b"\0" * 3)
@example(b"")
def test_stuffing_round_trip(data: bytes) -> None:
    stuffed = stuff(data)
    assert 0 not in stuffed
    assert len(stuffed) <= len(data) + len(data) // 254 + 1
    assert unstuff(stuffed) == data


@given(PAYLOADS, CUTS)
def test_any_cut_gives_the_same_frames(payloads: list[bytes], sizes: list[int]) -> None:
    receiver = FrameReceiver()
    wire = b"".join(frame(payload) for payload in payloads)
    assert [p for piece in cut(wire, sizes) for p in receiver.feed(piece)] == payloads
    assert receiver.counters.frames == len(payloads)


@given(PAYLOADS, st.binary(max_size=2000), CUTS)
def test_any_bytes_then_resynchronisation(payloads: list[bytes], noise: bytes, sizes: list[int]) -> None:
    whole, pieces = FrameReceiver(), FrameReceiver()
    data = noise + b"\0" + b"".join(frame(payload) for payload in payloads)
    got = whole.feed(data)
    assert [p for piece in cut(data, sizes) for p in pieces.feed(piece)] == got
    assert got[len(got) - len(payloads) :] == payloads
    assert whole.counters == pieces.counters
    for payload in got:
        sample_stream.parse_samples(payload)


def test_an_endless_frame_takes_no_memory() -> None:
    receiver = FrameReceiver()
    for _ in range(1000):
        assert receiver.feed(b"\x55" * 1000) == []
        assert len(receiver._rest) <= MAX_WIRE_BYTES
    assert receiver.counters.oversized == 1
    assert receiver.feed(b"tail\0" + frame(b"good")) == [b"good"]


@given(st.integers(0, 255), st.integers(0, 2000), PAYLOADS.filter(bool))
def test_a_damaged_byte_never_gives_a_wrong_frame(value: int, where: int, payloads: list[bytes]) -> None:
    wire = bytearray(b"".join(frame(payload) for payload in payloads))
    wire[where % len(wire)] = value
    got = FrameReceiver().feed(bytes(wire))
    assert all(payload in payloads for payload in got)
    assert len(got) >= len(payloads) - 2


ROWS = st.lists(st.tuples(*[st.floats(-1e6, 1e6)] * 3), max_size=10)


@given(ROWS, CUTS, st.sampled_from([",", ";", "\t", "  ", ", "]), st.sampled_from(["\n", "\r\n"]), st.booleans())
def test_any_cut_gives_the_same_rows(
    rows: list[tuple[float, ...]], sizes: list[int], separator: str, end: str, checked: bool
) -> None:
    def line(row: tuple[float, ...]) -> str:
        body = separator.join(map(repr, row))
        check = 0
        for character in body.encode():
            check ^= character
        return body + (f"*{check:02X}" if checked else "") + end

    data = ("ut off" + end + "# comment" + end + "".join(map(line, rows))).encode()
    receiver = LineReceiver(3, checked)
    assert [r for piece in cut(data, sizes) for r in receiver.feed(piece)] == rows


@given(st.binary(max_size=9000), CUTS, st.booleans())
def test_line_receiver_takes_any_bytes(data: bytes, sizes: list[int], checked: bool) -> None:
    whole, pieces = LineReceiver(2, checked), LineReceiver(2, checked)
    assert whole.feed(data) == [r for piece in cut(data, sizes) for r in pieces.feed(piece)]
    assert len(pieces._rest) <= MAX_LINE_BYTES + 64


def rtu(unit: int, pdu: bytes) -> bytes:
    return frame_rtu(unit, pdu)


def tcp(unit: int, pdu: bytes) -> bytes:
    return frame_tcp(1, unit, pdu)


Framing = Callable[[int, bytes], bytes]
REQUESTS = st.one_of(
    st.builds(modbus_pdu.read_bits, st.sampled_from([1, 2]), st.integers(0, 60000), st.integers(1, 2000)),
    st.builds(modbus_pdu.read_registers, st.sampled_from([3, 4]), st.integers(0, 60000), st.integers(1, 125)),
    st.builds(modbus_pdu.write_register, st.integers(0, 65535), st.integers(0, 65535)),
    st.builds(
        modbus_pdu.write_registers,
        st.integers(0, 60000),
        st.lists(st.integers(0, 65535), min_size=1, max_size=123),
    ),
)


def exchange_of(framing: Framing, pdu: modbus_pdu.Pdu) -> Exchange:
    return (RtuUnit(5, LINE) if framing is rtu else TcpUnit(5)).exchange(pdu)


def receive(exchange: Exchange, pieces: list[bytes]) -> object:
    got = b""
    for piece in pieces:
        got += piece
        size = exchange.want(got)
        if size is not None and len(got) >= size:
            return exchange.decode(got[:size])
    raise LinkError("incomplete")


@pytest.mark.parametrize("framing", [rtu, tcp])
@given(st.data(), REQUESTS, CUTS)
def test_modbus_reply_in_any_cut(framing: Framing, data: st.DataObject, pdu: modbus_pdu.Pdu, sizes: list[int]) -> None:
    body = data.draw(st.binary(min_size=pdu.size - len(pdu.head), max_size=pdu.size - len(pdu.head)))
    exchange = exchange_of(framing, pdu)
    reply = framing(5, pdu.head + body)
    assert receive(exchange, cut(reply, sizes)) == pdu.decode(pdu.head + body)
    with pytest.raises(LinkError):
        receive(exchange, cut(reply[:-1], sizes))


@pytest.mark.parametrize("framing", [rtu, tcp])
@given(REQUESTS, st.binary(max_size=300), CUTS, st.booleans())
@settings(max_examples=300)
def test_modbus_any_bytes_raise_only_link_or_device_error(
    framing: Framing, pdu: modbus_pdu.Pdu, noise: bytes, sizes: list[int], framed: bool
) -> None:
    exchange = exchange_of(framing, pdu)
    reply = framing(5, noise) if framed else noise
    try:
        value = receive(exchange, cut(reply, sizes))
    except (LinkError, DeviceError):
        return
    assert framed and noise.startswith(pdu.head) and value == pdu.decode(noise[: pdu.size])


@given(REQUESTS, st.integers(0, 400), st.integers(1, 255))
def test_modbus_rtu_one_damaged_byte_is_seen(pdu: modbus_pdu.Pdu, where: int, flip: int) -> None:
    reply = bytearray(frame_rtu(5, pdu.head + bytes(pdu.size - len(pdu.head))))
    reply[where % len(reply)] ^= flip
    with pytest.raises(LinkError):
        receive(exchange_of(rtu, pdu), [bytes(reply)])


@given(st.binary(max_size=600), CUTS)
def test_stream_replies_in_any_bytes(noise: bytes, sizes: list[int]) -> None:
    for exchange in (sample_stream.hello(), sample_stream.start(1, 100)):
        with pytest.raises((LinkError, DeviceError)):
            receive(exchange, [*cut(noise, sizes), b""])


def test_pairwise_cuts_cover_everything() -> None:
    """Every two-piece cut of a real reply, which random cuts may leave out."""
    exchange = RtuUnit(1, LINE).read_holding(0x602C, 2)
    reply = bytes.fromhex("01 03 04 ff ff d8 f0 a0 53")
    for a, b in pairwise(range(len(reply) + 1)):
        assert receive(exchange, [reply[:a], reply[a:b], reply[b:]]) == (0xFFFF, 0xD8F0)
