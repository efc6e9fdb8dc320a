"""Golden frames: encoders produce them, decoders accept them whole, byte by byte and with trailing bytes."""

import pytest
from frames_rig import GOLDEN, feed

from sioms.drivers.framed_adc import codec as stream
from sioms.drivers.framed_adc.cobs import FrameReceiver, frame, unstuff
from sioms.sdk.codec.checksum import crc16_ccitt_false, crc16_modbus, crc16_umts
from sioms.sdk.codec.modbus import RtuUnit, SerialLine, TcpUnit
from sioms.sdk.codec.modbus_pdu import read_write_registers
from sioms.sdk.exchange import DeviceError, Exchange, LinkError

LINE = SerialLine(115200)
U1, U7, U9, U17 = (RtuUnit(unit, LINE) for unit in (1, 7, 9, 17))


def of(check: str) -> list[str]:
    return [text for _, kind, text in GOLDEN if kind == check]


def test_the_table_is_complete() -> None:
    assert len(GOLDEN) == 74
    assert {kind: len(of(kind)) for kind in ("modbus", "dxl", "ccitt")} == {
        "modbus": 44,
        "dxl": 9,
        "ccitt": 6,
    }


def test_catalogue_check_values() -> None:
    digits = b"123456789"
    assert (crc16_modbus(digits), crc16_umts(digits), crc16_ccitt_false(digits)) == (0x4B37, 0xFEE8, 0x29B1)


@pytest.mark.parametrize("text", of("modbus"))
def test_modbus_crc(text: str) -> None:
    data = bytes.fromhex(text)
    assert crc16_modbus(data[:-2]).to_bytes(2, "little") == data[-2:]


@pytest.mark.parametrize("text", of("dxl"))
def test_dynamixel_crc(text: str) -> None:
    data = bytes.fromhex(text)
    assert crc16_umts(data[:-2]).to_bytes(2, "little") == data[-2:]


@pytest.mark.parametrize("text", of("ccitt"))
def test_sample_stream_frame(text: str) -> None:
    wire = bytes.fromhex(text)
    content = unstuff(wire[:-1])
    assert content is not None
    payload = content[:-2]
    assert frame(payload) == wire
    for step in (1, 2, len(wire)):
        receiver = FrameReceiver()
        data = wire + b"\x05trail"
        got = [p for i in range(0, len(data), step) for p in receiver.feed(data[i : i + step])]
        assert got == [payload]
        assert receiver.counters.bad_crc == receiver.counters.malformed == 0


def az_direct(kind: int, position: int, *rest: int) -> list[int]:
    """Return the registers of Oriental's direct data operation from 0x0058 on."""
    words: list[int] = []
    for value in (0, kind, position, 2000, 1500, 1500, 1000, 1, *rest):
        words += [value >> 16 & 0xFFFF, value & 0xFFFF]
    return words


REQUESTS = [
    (U1.read_holding(0, 10), "01 03 00 00 00 0a c5 cd"),
    (U17.read_holding(0x6B, 3), "11 03 00 6b 00 03 76 87"),
    (U1.read_discrete(0, 16), "01 02 00 00 00 10 79 c6"),
    (U1.write_coil(3, True), "01 05 00 03 ff 00 7c 3a"),
    (U1.write_coils(0, 8, 0xA5), "01 0f 00 00 00 08 01 a5 3e ee"),
    (
        U7.write_registers(0x6200, [1, 0, 10000, 0, 10000, 10000, 0, 0x10]),
        "07 10 62 00 00 08 10 00 01 00 00 27 10 00 00 27 10 27 10 00 00 00 10 8d 50",
    ),
    (
        U1.write_registers(0x6200, [1, 0, 10000, 200, 50, 50, 0, 0x10]),
        "01 10 62 00 00 08 10 00 01 00 00 27 10 00 c8 00 32 00 32 00 00 00 10 ae 33",
    ),
    (
        U1.write_registers(0x6200, [0x41, 0xFFFF, 0xD8F0, 200, 50, 50, 0, 0x10]),
        "01 10 62 00 00 08 10 00 41 ff ff d8 f0 00 c8 00 32 00 32 00 00 00 10 45 d4",
    ),
    (U1.write_register(0x6002, 0x40), "01 06 60 02 00 40 37 fa"),
    (U1.write_register(0x6002, 0x20), "01 06 60 02 00 20 37 d2"),
    (U1.read_holding(0x1003, 1), "01 03 10 03 00 01 70 ca"),
    (U1.read_holding(0x602C, 2), "01 03 60 2c 00 02 1b c2"),
    (U1.read_holding(0x2203, 1), "01 03 22 03 00 01 7e 72"),
    (U1.write_register(0x1801, 0x1111), "01 06 18 01 11 11 12 f6"),
    (U1.write_register(0x1801, 0x4001), "01 06 18 01 40 01 2e aa"),
    (U1.write_register(0x1801, 0x2211), "01 06 18 01 22 11 06 06"),
    (U1.write_register(0x0191, 32), "01 06 01 91 00 20 d8 03"),
    (U1.write_register(0x000F, 1), "01 06 00 0f 00 01 78 09"),
    (U1.write_register(0x000F, 0), "01 06 00 0f 00 00 b9 c9"),
    (
        U1.write_registers(0x58, az_direct(2, 8500)),
        "01 10 00 58 00 10 20 00 00 00 00 00 00 00 02 00 00 21 34 00 00 07 d0 00 00 05 dc 00 00 05 dc 00 00 "
        "03 e8 00 00 00 01 1c 08",
    ),
    (
        U1.write_registers(0x58, az_direct(1, 10000, 0)),
        "01 10 00 58 00 12 24 00 00 00 00 00 00 00 01 00 00 27 10 00 00 07 d0 00 00 05 dc 00 00 05 dc 00 00 "
        "03 e8 00 00 00 01 00 00 00 00 79 8c",
    ),
    (U1.write_registers(0x66, [0xFFFF, 0xFFFC]), "01 10 00 66 00 02 04 ff ff ff fc 34 38"),
    (U1.write_registers(0x7C, [0, 0x20]), "01 10 00 7c 00 02 04 00 00 00 20 f5 06"),
    (U1.write_registers(0x7C, [0, 0]), "01 10 00 7c 00 02 04 00 00 00 00 f4 de"),
    (U1.write_registers(0x7C, [0, 0x10]), "01 10 00 7c 00 02 04 00 00 00 10 f5 12"),
    (U1.write_registers(0x7C, [0, 0x40]), "01 10 00 7c 00 02 04 00 00 00 40 f5 2e"),
    (U1.write_registers(0x7C, [0, 0x80]), "01 10 00 7c 00 02 04 00 00 00 80 f5 7e"),
    (U1.write_registers(0x180, [0, 1]), "01 10 01 80 00 02 04 00 00 00 01 37 9f"),
    (U1.write_registers(0x180, [0, 0]), "01 10 01 80 00 02 04 00 00 00 00 f6 5f"),
    (U1.write_registers(0x18A, [0, 1]), "01 10 01 8a 00 02 04 00 00 00 01 b7 e0"),
    (U1.read_holding(0x7E, 2), "01 03 00 7e 00 02 a4 13"),
    (U1.read_holding(0x80, 2), "01 03 00 80 00 02 c5 e3"),
    (U1.read_holding(0xCC, 2), "01 03 00 cc 00 02 04 34"),
    (U9.read_holding(0xB4, 6), "09 03 00 b4 00 06 84 a6"),
    (U9.write_registers(0x19A, [0x0200]), "09 10 01 9a 00 01 02 02 00 cd ca"),
]
REPLIES = [
    (U7.write_registers(0x6200, [0] * 8), "07 10 62 00 00 08 de 11", None),
    (U1.read_holding(0x1003, 1), "01 03 02 00 06 38 46", (6,)),
    (U1.read_holding(0x1003, 1), "01 03 02 00 32 39 91", (0x32,)),
    (U1.read_holding(0x602C, 2), "01 03 04 ff ff d8 f0 a0 53", (0xFFFF, 0xD8F0)),
    (
        U9.read_holding(0xB4, 6),
        "09 03 0c fe d8 fb 2e 16 2e 00 64 ff 38 01 2c 9d fc",
        (0xFED8, 0xFB2E, 0x162E, 0x0064, 0xFF38, 0x012C),
    ),
    (U9.write_registers(0x19A, [0x0200]), "09 10 01 9a 00 01 21 52", None),
    (U1.write_register(0x6002, 0x40), "01 06 60 02 00 40 37 fa", None),
    (U1.write_coil(3, True), "01 05 00 03 ff 00 7c 3a", None),
]


@pytest.mark.parametrize(("exchange", "text"), REQUESTS, ids=lambda x: x.what if isinstance(x, Exchange) else "")
def test_request(exchange: Exchange, text: str) -> None:
    assert exchange.data.hex(" ") == text
    assert exchange.repeatable == (exchange.data[1] in (1, 2, 3, 4))


@pytest.mark.parametrize(("exchange", "text", "value"), REPLIES)
def test_reply(exchange: Exchange, text: str, value: object) -> None:
    data = bytes.fromhex(text)
    for step in (1, 2, 3, len(data)):
        assert feed(exchange, data, step) == value
        assert feed(exchange, data + b"\x00\x55\xaa", step) == value


def test_every_modbus_frame_is_used() -> None:
    used = {text for _, text in REQUESTS} | {text for _, text, _ in REPLIES}
    exceptions = {"01 83 02 c0 f1", "01 83 08 40 f6", "01 90 03 0c 01"}
    assert used | exceptions == set(of("modbus"))


@pytest.mark.parametrize(
    ("exchange", "text", "error", "words"),
    [
        (U1.read_holding(0, 10), "01 83 02 c0 f1", DeviceError, "illegal address"),
        (U1.read_holding(0, 10), "01 83 08 40 f6", LinkError, "checksum or parity error"),
        (U1.write_registers(0, [1]), "01 90 03 0c 01", DeviceError, "illegal value"),
        (U1.read_holding(0x1003, 1), "01 03 02 00 06 38 47", LinkError, "CRC"),
        (U1.read_holding(0x1003, 1), "02 03", LinkError, "unit 2"),
        (U1.read_holding(0x1003, 1), "01 04", LinkError, "starts with 04"),
        (U1.read_holding(0x1003, 2), "01 03 02 00 06 38 46", LinkError, "starts with 03 02"),
        (U1.write_register(0x6002, 0x40), "01 06 60 02 00 20 37 d2", LinkError, "starts with"),
    ],
)
def test_refused_and_wrong_replies(exchange: Exchange, text: str, error: type[Exception], words: str) -> None:
    data = bytes.fromhex(text)
    for step in (1, len(data)):
        with pytest.raises(error, match=words):
            feed(exchange, data, step)


def test_tcp_skips_late_replies() -> None:
    unit = TcpUnit(1)
    late = bytes.fromhex("0001 0000 0005 01 03 02 1234")
    unit.read_holding(0, 1)
    exchange = unit.read_holding(0, 1)
    assert exchange.data.hex(" ") == "00 02 00 00 00 06 01 03 00 00 00 01"
    reply = bytes.fromhex("0002 0000 0005 01 03 02 00ff")
    for step in (1, 3, 7, 100):
        assert feed(exchange, reply, step) == (255,)
        assert feed(exchange, late + reply + late, step) == (255,)
        with pytest.raises(LinkError, match="newer"):
            feed(exchange, bytes.fromhex("0003 0000 0005 01 03 02 00ff"), step)
        with pytest.raises(LinkError, match="not a Modbus TCP header"):
            feed(exchange, b"HTTP/1.1 400 Bad Request", step)
        with pytest.raises(DeviceError, match="busy"):
            feed(exchange, bytes.fromhex("0002 0000 0003 01 83 06"), step)


def test_tcp_transaction_numbers_wrap() -> None:
    unit = TcpUnit(1)
    unit._last = 0xFFFE
    first, second = unit.read_coils(0, 9), unit.read_coils(0, 9)
    assert (first.data[:2], second.data[:2]) == (b"\xff\xff", b"\x00\x00")
    late = b"\xff\xff\0\0\0\x05\x01\x01\x02\xff\xff"
    assert feed(second, late + b"\0\0\0\0\0\x05\x01\x01\x02\x03\xff", 1) == 0x103


def test_limits_of_requests() -> None:
    assert len(U1.write_registers(0, [0] * 123).data) == 255
    assert len(U1.exchange(read_write_registers(0, 125, 0, [0] * 121)).data) == 255
    for build in (
        lambda: U1.read_holding(0, 126),
        lambda: U1.read_holding(0, 0),
        lambda: U1.read_coils(0, 2001),
        lambda: U1.read_holding(0xFFFF, 2),
        lambda: U1.write_registers(0, [0] * 124),
        lambda: U1.write_registers(0, [65536]),
        lambda: U1.write_register(0, -1),
        lambda: U1.write_coils(0, 1969, 0),
        lambda: U1.write_coils(0, 3, 8),
        lambda: read_write_registers(0, 1, 0, [0] * 122),
        lambda: RtuUnit(0, LINE),
        lambda: RtuUnit(248, LINE),
    ):
        with pytest.raises(ValueError, match="is right"):
            build()


def test_sample_stream_messages() -> None:
    wires = dict(enumerate(of("ccitt")))
    assert stream.hello().data.hex(" ") == wires[1]
    assert stream.start(1, 1000).data.hex(" ") == wires[3]
    assert stream.stop(1).data.hex(" ") == wires[4]
    samples, reply, acknowledge = (bytes.fromhex(wires[i]) for i in (0, 2, 5))
    for step in (1, 5, 100):
        # the stream may still be running, and the line may be entered in the middle of a frame
        assert feed(stream.hello(), samples[3:] + samples + acknowledge + reply, step) == stream.Hello(
            1, 4, stream.Format.I16, 1000, "TAC4"
        )
        assert feed(stream.start(1, 1000), samples + acknowledge, step) is None
        with pytest.raises(DeviceError, match="busy"):
            feed(stream.start(1, 1000), frame(bytes((0x1F, 0x12, 3))), step)
        with pytest.raises(LinkError, match="incomplete"):
            feed(stream.stop(1), samples + acknowledge, step)
    block = stream.SampleBlock(1, 7, 123456, 0, (100, -200, 0, 32767))
    assert frame(stream.build_samples(block, stream.Format.I16)) == samples
    payload = FrameReceiver().feed(samples)[0]
    assert stream.parse_samples(payload) == block
    assert stream.parse_samples(payload[:-1]) is None
    for form in (stream.Format.I32, stream.Format.F32):
        assert stream.parse_samples(stream.build_samples(block, form)) == block
