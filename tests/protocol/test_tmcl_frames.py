"""TMCL telegrams: the golden ones, and what is wrong with bad ones."""

from pathlib import Path

import pytest

from sioms.drivers.tmcl import simulator
from sioms.drivers.tmcl.codec import (
    Axis,
    Module,
    Op,
    checksum,
    is_telegram,
    padding,
    remnants,
    request,
    separator,
)
from sioms.sdk.exchange import DeviceError, Exchange, LinkError

GOLDEN = [
    line.split("|")[2]
    for line in (Path(__file__).parent / "golden_frames.txt").read_text().splitlines()
    if line.startswith("tmcl|")
]
M = Module(1, 2, 0.05)
REQUESTS = [
    (M.exchange(Op.ROR, 0, 0, 1000), "01 01 00 00 00 00 03 e8 ed"),
    (M.exchange(Op.MST), "01 03 00 00 00 00 00 00 04"),
    (M.exchange(Op.MVP, 0, 0, 10000), "01 04 00 00 00 00 27 10 3c"),
    (M.exchange(Op.MVP, 1, 0, -500), "01 04 01 00 ff ff fe 0c 0e"),
    (M.get(Axis.ACTUAL_POSITION, 0), "01 06 01 00 00 00 00 00 08"),
    (M.set(Axis.MAX_SPEED, 0, 20000), "01 05 04 00 00 00 4e 20 78"),
]
REPLIES = [
    (M.exchange(Op.MVP, 0, 0, 10000), "02 01 64 04 00 00 27 10 a2", 10000),
    (M.get(Axis.ACTUAL_POSITION, 0), "02 01 64 06 00 00 27 10 a4", 10000),
]


def test_the_golden_frames_are_all_used() -> None:
    assert {text for _, text in REQUESTS} | {text for _, text, _ in REPLIES} == set(GOLDEN)
    for text in GOLDEN:
        data = bytes.fromhex(text)
        assert checksum(data[:-1]) == data[-1]


@pytest.mark.parametrize(("exchange", "text"), REQUESTS)
def test_request(exchange: Exchange, text: str) -> None:
    assert exchange.data.hex(" ") == text
    assert exchange.repeatable == (exchange.data[1] in (3, 6))


@pytest.mark.parametrize(("exchange", "text", "value"), REPLIES)
def test_reply(exchange: Exchange, text: str, value: int) -> None:
    data = bytes.fromhex(text) + b"\x02\x01"
    for cut in range(9):
        assert exchange.want(data[:cut]) is None
    assert exchange.want(data[:9]) == exchange.want(data) == 9
    assert exchange.decode(data[:9]) == value


@pytest.mark.parametrize(("exchange", "text", "value"), REPLIES)
@pytest.mark.parametrize("before", [b"\0", b"\xff\0\0", b"echo", b"echo\0"])
def test_a_reply_behind_an_echo_or_stray_bytes(exchange: Exchange, text: str, value: int, before: bytes) -> None:
    before = before.replace(b"echo", exchange.data)
    data = before + bytes.fromhex(text)
    for cut in range(len(data)):
        assert exchange.want(data[:cut]) is None
    assert exchange.want(data + data) == len(data)
    assert exchange.decode(data) == value


def test_an_endless_echo_is_no_reply() -> None:
    with pytest.raises(LinkError, match="no reply in 27 bytes"):
        M.exchange(Op.MST).want(M.exchange(Op.MST).data * 3)


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("02 01 64 06 00 00 27 10 a5", LinkError, "checksum of the reply"),
        ("02 02 64 06 00 00 27 10 a5", LinkError, "goes from 2"),
        ("03 01 64 06 00 00 27 10 a5", LinkError, "to 3"),
        ("02 00 01 00 00 00 00 00 03", LinkError, "received a wrong checksum"),
        ("02 01 64 05 00 00 27 10 a3", LinkError, "answers command 5"),
        ("02 01 01 04 00 00 00 00 08", LinkError, "received a wrong checksum"),
        ("02 01 03 06 00 00 00 00 0c", DeviceError, "status 3, wrong type"),
        ("02 01 05 06 00 00 00 00 0e", DeviceError, "EEPROM is locked"),
    ],
)
def test_bad_replies(text: str, error: type[Exception], words: str) -> None:
    exchange, data = M.get(Axis.ACTUAL_POSITION, 0), bytes.fromhex(text)
    with pytest.raises(error, match=words):
        exchange.decode(data)
    with pytest.raises(error, match=words):
        assert exchange.want(data) == 9
        exchange.decode(data)


def test_values_that_do_not_fit() -> None:
    with pytest.raises(ValueError, match="want "):
        M.exchange(Op.MVP, 0, 0, 2**31)


def every_request(address: int = 1) -> list[bytes]:
    """Return what a driver may send, with values that give all checksums."""
    values = [*range(-140, 140, 3), 1019, 260864, 0x01010000, 0x0201, -(2**31), 2**31 - 1, 0x01040000]
    heads = [(op, kind, motor) for op in (1, 2, 3, 4, 5, 6, 9, 10, 13, 128, 136) for kind in (0, 4) for motor in (0, 3)]
    return [request(address, *head, value) for head in heads for value in values]


def test_zeros_may_complete_a_motion_command() -> None:
    sent = request(1, Op.ROR, 0, 0, 1019)
    held = sent[:3] + sent[4:]  # a byte was lost
    assert is_telegram(held + b"\0") and int.from_bytes((held + b"\0")[4:8]) == 260864
    assert not is_telegram(held + padding(1, [sent])[:1])


@pytest.mark.parametrize("address", [1, 2, 136, 254, 255])
def test_no_padding_completes_a_telegram(address: int) -> None:
    for sent in every_request(address):
        pads = padding(address, [sent])
        assert len(pads) == 9 and 0 not in pads and address not in pads
        for piece in remnants(sent):
            assert not is_telegram(piece + pads[: 9 - len(piece)])


def test_no_cut_of_a_search_is_a_telegram() -> None:
    for address in range(1, 256):
        ask = request(address, Op.VERSION, 1, 0, 0)
        row = ask + bytes((separator(ask),)) + ask + bytes((separator(ask),)) + ask
        good = [start for start in range(len(row) - 8) if is_telegram(row[start : start + 9])]
        assert good == [0, 10, 20]


def test_the_simulated_module_answers_as_the_manual_says() -> None:
    now = 5.0
    module = simulator.Module(clock=lambda: now)
    module.motors[0].mover.position = 10000.0
    assert module.take(bytes.fromhex("01 06 01 00 00 00 00 00 08"))[0].hex(" ") == "02 01 64 06 00 00 27 10 a4"
    assert module.take(bytes.fromhex("01 04 00 00 00 00 27 10 3c"))[0].hex(" ") == "02 01 64 04 00 00 27 10 a2"
    # cut anywhere, another address, a wrong checksum with the stale command byte, an unknown axis
    assert module.take(bytes.fromhex("01 06 01")) == []
    assert module.take(bytes.fromhex("00 00 00 00 00 08"))[0][2] == 100
    assert module.take(bytes.fromhex("07 06 01 00 00 00 00 00 0e")) == []
    assert module.take(bytes.fromhex("01 03 00 00 00 00 00 00 05"))[0].hex(" ") == "02 07 01 06 00 00 00 00 10"
    # nine bytes however long they take, and out of step for ever
    assert module.take(b"\0" + bytes.fromhex("01 06 01 00 00 00 00 00 08"))[0][2] == 1
    now += 3600.0
    assert module.take(bytes.fromhex("01 06 01 00 00 00 00 00 08"))[0][2] == 1
    assert module.take(bytes(8))[0][2] == 1
    assert module.take(bytes.fromhex("01 06 01 05 00 00 00 00 0d"))[0][2] == 3
    assert module.take(bytes.fromhex("01 88 00 00 00 00 00 00 89"))[0] == b"\x021140V140"
