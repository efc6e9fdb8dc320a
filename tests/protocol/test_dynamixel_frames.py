"""Dynamixel packets: the golden ones, stuffing, and what is wrong with bad ones."""

from pathlib import Path

import pytest

from sioms.drivers.dynamixel import codec as dxl
from sioms.drivers.dynamixel import simulator
from sioms.drivers.dynamixel.codec import Bus, Status
from sioms.sdk.exchange import DeviceError, Exchange, LinkError

GOLDEN = [
    line.split("|")[2]
    for line in (Path(__file__).parent / "golden_frames.txt").read_text().splitlines()
    if line.startswith("dynamixel|")
]
BUS = Bus(1e-5, 0.02)
REQUESTS = [
    (BUS.ping(1).data, "ff ff fd 00 01 03 00 01 19 4e"),
    (BUS.read(1, 132, 4).data, "ff ff fd 00 01 07 00 02 84 00 04 00 1d 15"),
    (BUS.write(1, 116, 512, 4).data, "ff ff fd 00 01 09 00 03 74 00 00 02 00 00 ca 89"),
    (dxl.sync_read([1, 2], 132, 4), "ff ff fd 00 fe 09 00 82 84 00 04 00 01 02 ce fa"),
    (
        dxl.sync_write({1: 150, 2: 170}, 116, 4),
        "ff ff fd 00 fe 11 00 83 74 00 04 00 01 96 00 00 00 02 aa 00 00 00 82 87",
    ),
    (BUS.reboot(1).data, "ff ff fd 00 01 03 00 08 2f 4e"),
]
REPLIES = [
    (BUS.ping(1), "ff ff fd 00 01 07 00 55 00 06 04 26 65 5d", Status(1, b"\x06\x04\x26", False)),
    (BUS.read(1, 132, 4), "ff ff fd 00 01 08 00 55 00 a6 00 00 00 8c c0", Status(1, b"\xa6\0\0\0", False)),
    (BUS.write(1, 116, 512, 4), "ff ff fd 00 01 04 00 55 00 a1 0c", Status(1, b"", False)),
]


def test_the_golden_frames_are_all_used() -> None:
    assert {text for _, text in REQUESTS} | {text for _, text, _ in REPLIES} == set(GOLDEN)
    for data, text in REQUESTS:
        assert data.hex(" ") == text
    assert (BUS.ping(1).repeatable, BUS.read(1, 0, 1).repeatable) == (True, True)
    assert not BUS.write(1, 116, 0, 4).repeatable and not BUS.reboot(1).repeatable


@pytest.mark.parametrize(("exchange", "text", "status"), REPLIES)
def test_reply(exchange: Exchange, text: str, status: Status) -> None:
    data = bytes.fromhex(text)
    for end in range(len(data) + 3):
        size = exchange.want((data + b"\xff\xff\xfd")[:end])
        assert size == (len(data) if end >= len(data) else None)
    for before in (b"\0", b"\xff", b"\xff\xff\xfd", exchange.data, exchange.data + b"\0\xff"):
        late = before + data
        assert all(exchange.want(late[:end]) is None for end in range(len(late)))
        assert exchange.want(late + b"\0") == len(late)
        assert exchange.decode(late) == status
    assert exchange.decode(data) == status


def answer(servo: int, content: str) -> bytes:
    return dxl.packet(servo, dxl.STATUS, bytes.fromhex(content))


@pytest.mark.parametrize(
    ("data", "error", "words"),
    [
        (answer(1, "00 a6 00 00 00")[:-1] + b"\0", LinkError, "CRC"),
        (answer(2, "00 a6 00 00 00"), LinkError, "from servo 2"),
        (answer(1, "00 a6 00"), LinkError, "2 bytes"),
        (answer(1, "04"), DeviceError, "error 4, data range"),
        (answer(1, "87"), DeviceError, "error 7, access"),
    ],
)
def test_bad_replies(data: bytes, error: type[Exception], words: str) -> None:
    exchange = BUS.read(1, 132, 4)
    with pytest.raises(error, match=words):
        assert exchange.want(data) == len(data)
        exchange.decode(data)


def test_what_cannot_be_a_reply() -> None:
    for data in (b"\xff\xff\xfd\x00\x01\xff\xff", b"\xff\xff\xfd\x00\x01\x01\x00", bytes(2050)):
        with pytest.raises(LinkError, match="want "):
            BUS.ping(1).want(data)
    for value, size in ((256, 1), (-1, 1), (70000, 2), (-40000, 2), (1 << 32, 4)):
        with pytest.raises(ValueError, match="want "):
            dxl.little(value, size)


def test_alert_and_stuffing() -> None:
    alert = BUS.read(1, 132, 4).decode(answer(1, "80 01 00 00 00"))
    assert alert == Status(1, b"\x01\0\0\0", True)
    for text in ("ff ff fd 00", "00 ff ff fd", "ff ff fd fd", "ff ff ff fd"):
        data = answer(1, "00 " + text)
        assert b"\xff\xff\xfd" not in data[7:].replace(b"\xff\xff\xfd\xfd", b"")
        assert BUS.read(1, 132, 4).decode(data).data == bytes.fromhex(text)


def test_the_simulated_servo_answers_as_the_manual_says() -> None:
    now = 1.0
    bus = simulator.Bus([1], 1030, lambda: now)
    bus.servos[1].put(6, 38, 1)
    assert bus.take(bytes.fromhex(GOLDEN[0]))[0].hex(" ") == GOLDEN[1]
    bus.servos[1].mover.position = 166.0
    request = bytes.fromhex("ff ff fd 00 01 07 00 02 84 00 04 00 1d 15")
    assert bus.take(b"noise" + request[:5]) == []
    assert bus.take(request[5:])[0].hex(" ") == REPLIES[1][1]
    assert bus.take(request[:-1] + b"\0") == []
    assert bus.take(bytes.fromhex(REQUESTS[2][1]))[0].hex(" ") == REPLIES[2][1]
    assert len(bus.take(dxl.sync_read([1, 2], 132, 4))) == 1
