"""Frames of the force/torque sensors: the vendors' bytes, whole, in pieces, and among others."""

import errno

import pytest
from frames_rig import GOLDEN, feed

from sioms.drivers.ati_rdt import codec as rdt
from sioms.drivers.ati_rdt import http_get
from sioms.drivers.ft300 import codec as ft300
from sioms.drivers.schunk_ft import codec as ifb
from sioms.sdk.exchange import DeviceError, LinkError


def golden(family: str, check: str) -> list[bytes]:
    return [bytes.fromhex(text) for name, kind, text in GOLDEN if (name, kind) == (family, check)]


# --- Robotiq --------------------------------------------------------------------------------------

COUNTS = (-296, -1234, 5678, 100, -200, 300)
OTHERS = (1, 2, 3, 4, 5, 6)


def test_ft300_record() -> None:
    (record,) = golden("ft300", "ft300")
    assert ft300.build_record(COUNTS) == record
    other = ft300.build_record(OTHERS)
    for step in (1, 2, 7, 100):
        receiver = ft300.RecordReceiver()
        data = record[5:] + record + other + record[:9]
        got = [each for i in range(0, len(data), step) for each in receiver.feed(data[i : i + step])]
        assert got == [(COUNTS, False), (OTHERS, False)]
        assert receiver.feed(record[9:]) == [(COUNTS, False)]
        assert receiver.counters == ft300.Counters(records=3, skipped_bytes=11)


def test_ft300_damage_and_heads_in_data() -> None:
    (record,) = golden("ft300", "ft300")
    # 0x4e20 = 20000 counts = 200 N: the two bytes of the head, twice in the data
    tricky = ft300.build_record((20000, 0, 20000, 1, 2, 3))
    damaged = bytearray(record)
    damaged[4] ^= 0x10
    receiver = ft300.RecordReceiver()
    got = receiver.feed(tricky[3:] + tricky + bytes(damaged) + tricky + record[:-1] + tricky)
    values = (20000, 0, 20000, 1, 2, 3)
    assert got == [(values, False), (values, True), (values, True)]
    assert receiver.counters.lost == 2 and receiver.counters.bad_crc >= 2
    receiver.restart()
    assert receiver.feed(record[1:] + record) == [(COUNTS, False)], "what was before the start is no loss"


# --- ATI ------------------------------------------------------------------------------------------


def test_rdt_request_and_record() -> None:
    start, bias, record = golden("ati_rdt", "none")
    assert rdt.request(rdt.Command.REALTIME) == start == rdt.start(rdt.Command.REALTIME, 0.1).data
    assert rdt.request(rdt.Command.BIAS) == bias
    assert rdt.request(rdt.Command.STOP).hex(" ") == "12 34 00 00 00 00 00 00"
    assert rdt.request(rdt.Command.BUFFERED, 7).hex(" ") == "12 34 00 03 00 00 00 07"
    expected = rdt.Record(1, 1, 0, 1000000, -2000000, 3000000, 10000, -20000, 30000)
    assert rdt.parse(record) == [expected] and rdt.build(expected) == record
    assert rdt.parse(record * 40) == [expected] * 40
    for wrong in (b"", record[:-1], record + b"\0", record * 41):
        assert rdt.parse(wrong) is None
    exchange = rdt.start(rdt.Command.BUFFERED, 0.1)
    assert exchange.repeatable
    assert feed(exchange, record + record, 72) == expected == feed(exchange, record, 36)
    with pytest.raises(LinkError, match="10 bytes received; want records"):
        feed(exchange, record[:10], 10)


@pytest.mark.parametrize(
    ("word", "model", "text", "invalid", "saturated"),
    [
        (0, "net", "ok", False, False),
        (0x80010000, "net", "a monitored condition is latched", False, False),
        (0x80020000, "net", "saturation or A/D converter", True, True),
        (0x80030000, "net", "saturation or A/D converter; a monitored condition is latched", True, True),
        (0x84000010, "net", "program memory; no serial data", True, False),
        (0x80000100, "net", "watchdog, stack, EEPROM, flash, analog watchdog or excitation", True, False),
        (0x80008000, "net", "bit 15, which has no meaning here", True, False),
        (0x80000000, "net", "an error without a name", True, False),
        (0x00010000, "axia", "a monitored condition is latched", False, False),
        (0x10000008, "axia", "simulated error; busy", False, False),
        (0xC0000000, "axia", "force or torque out of range", True, True),
        (0x88000000, "axia", "gage out of range", True, True),
        (0x80000006, "axia", "broken gage; supply voltage", True, False),
        (0x80020000, "axia", "bit 17, which has no meaning here", True, False),
    ],
)
def test_rdt_status(word: int, model: str, text: str, invalid: bool, saturated: bool) -> None:
    family = rdt.Model(model)
    assert rdt.status_text(word, family) == text
    assert (rdt.is_invalid(word, family), rdt.is_saturated(word, family)) == (invalid, saturated)


PAGE = """<?xml version="1.0"?><netft><prodname>Net F/T</prodname><setserial>FT12345 </setserial><cfgcpf>1000000</cfgcpf>
<cfgcpt>500000</cfgcpt><scfgfu>lbf</scfgfu><scfgtu>lbf-in</scfgtu><comrdtrate>7000</comrdtrate></netft>"""  # noqa: E501


def test_the_sensors_page() -> None:
    page = rdt.parse_page(PAGE)
    assert page == rdt.SensorPage("Net F/T", "FT12345", 1e6, 5e5, "lbf", "lbf-in", 7000.0)
    for wrong, words in (
        ("<html>welcome</html>", "no element prodname; is this a Net F/T"),
        (PAGE.replace("1000000", "many"), "cfgcpf is 'many'; want a positive number"),
        (PAGE.replace("500000", "-1"), "cfgcpt is '-1'"),
        (PAGE.replace("7000", "inf"), "comrdtrate is 'inf'"),
    ):
        with pytest.raises(LinkError, match=words):
            rdt.parse_page(wrong)


def test_units_of_sensors() -> None:
    # independent of the table: 1 lbf = 0.45359237 kg under standard gravity, 1 ft = 12 in = 0.3048 m
    pound = 0.45359237 * 9.80665
    for name, newton in (
        ("N", 1),
        ("lbf", pound),
        ("klbf", 1000 * pound),
        ("kN", 1000),
        ("kgf", 9.80665),
        (" gf ", 0.00980665),
    ):
        assert rdt.force_unit(name) == pytest.approx(newton, rel=1e-12)
    torques = {
        "Nm": 1,
        "N-m": 1,
        "N m": 1,
        "Nmm": 1e-3,
        "N-mm": 1e-3,
        "kNm": 1000,
        "lbf-in": pound * 0.0254,
        "in-lbf": pound * 0.0254,
        "lbf-ft": pound * 0.3048,
        "kgf-cm": 9.80665e-2,
    }
    for name, value in torques.items():
        assert rdt.torque_unit(name) == pytest.approx(value, rel=1e-12), name
    assert rdt.force_unit("furlong") is None and rdt.torque_unit("") is None and rdt.torque_unit("N") is None


# --- a web page -----------------------------------------------------------------------------------


def parse(text: str) -> str:
    return text


@pytest.mark.parametrize("step", [1, 3, 1000])
def test_a_page_by_length_and_by_the_end_of_the_connection(step: int) -> None:
    exchange = http_get.get("192.168.1.1", "/netftapi2.xml", parse, 1.0)
    assert exchange.data == b"GET /netftapi2.xml HTTP/1.0\r\nHost: 192.168.1.1\r\n\r\n"
    with_length = b"HTTP/1.1 200 OK\r\nServer: x\r\ncontent-length: 5\r\n\r\nhello"
    assert feed(exchange, with_length + b"more", step) == "hello"
    open_end = b"HTTP/1.0 200 OK\nContent-Type: text/xml\n\nhello"
    assert exchange.want(open_end) is None and exchange.decode(open_end) == "hello"
    for reply, words in (
        (with_length[:-1], "cut after 53 of 54 bytes"),
        (b"HTTP/1.0 404 Not Found\r\n\r\n", "answers 404; is it another device"),
        (b"SSH-2.0-OpenSSH_9.2\r\n", "not the reply of a web server"),
        (b"HTTP/1.0 200 OK\r\nHalf: he", "not the reply of a web server"),
        (b"", "0 bytes that are not the reply"),
    ):
        with pytest.raises(LinkError, match=words):
            exchange.decode(reply)
    with pytest.raises(LinkError, match="longer than 65536"):
        exchange.want(b"x" * 70000)


# --- SCHUNK ---------------------------------------------------------------------------------------


def test_schunk_commands() -> None:
    request, reply, _ = golden("schunk_ifb", "none")
    first = ifb.get(ifb.PRODUCT)
    assert first.data[4:] == request[4:] and first.repeatable
    tare, start = ifb.act(ifb.Command.TARE), ifb.act(ifb.Command.START)
    assert tare.data.hex(" ") == "ff ff 00 00 01 00 12" and tare.repeatable
    assert start.data.hex(" ") == "ff ff 00 00 01 00 40"
    for step in (1, 2, 100):
        for number in (b"\x00\x00", b"\x01\x00", b"\xff\xff"):  # the box numbers its replies as it likes
            assert feed(first, reply[:2] + number + reply[4:], step) == b"KMS"
            assert feed(tare, b"\xff\xff" + number + b"\x02\x00\x12\x00\xff", step) is None
        with pytest.raises(LinkError, match="incomplete"):
            feed(start, reply[:5], step)
    assert ifb.act(ifb.Command.TOOL, 2).data.hex(" ") == "ff ff 00 00 02 00 30 02"


@pytest.mark.parametrize(
    ("reply", "error", "words"),
    [
        ("ff ff 01 00 02 00 40 05", DeviceError, "start: the sensor answers error 05, not while it streams"),
        ("ff ff 01 00 02 00 40 77", DeviceError, "error 77, unknown error"),
        ("ff ff 01 00 02 00 41 00", LinkError, "41 00 does not answer command 40"),
        ("ff ff 01 00 01 00 40", LinkError, "40 does not answer command 40"),
        ("48 54 54 50 2f 31 2e 31", LinkError, "48 54 54 50 2f 31 begins no reply of this sensor"),
        ("ff ff 01 00 ff ff 40 00", LinkError, "begins no reply"),
    ],
)
def test_schunk_refusals_and_other_protocols(reply: str, error: type[Exception], words: str) -> None:
    for step in (1, 100):
        with pytest.raises(error, match=words) as caught:
            feed(ifb.act(ifb.Command.START), bytes.fromhex(reply), step)
        if "05" in words:
            assert isinstance(caught.value, DeviceError) and caught.value.errno == errno.EBUSY
    with pytest.raises(LinkError, match="reply is to 02 00 00"):
        feed(ifb.get(ifb.PRODUCT), bytes.fromhex("ff ff 01 00 05 00 f0 00 02 00 00"), 5)


def test_schunk_record() -> None:
    datagram = golden("schunk_ifb", "none")[2]
    record = ifb.parse(datagram)
    assert record is not None and (record.counter, record.packet, record.status) == (4416, 64, 1)
    expected = (0.50904, -0.44926, -0.99451, -0.62541, 0.31868, 0.96978)
    assert record.values == pytest.approx(expected, abs=5e-6) and ifb.build(record) == datagram
    for wrong in (
        b"",
        datagram[:-1],
        datagram + b"\0",
        b"\xff" + datagram[:-1],
        datagram[:4] + b"\x1c" + datagram[5:],
    ):
        assert ifb.parse(wrong) is None
    assert ifb.status_text(0x24) == "not ready; temperature; loaded beyond the user's range"
    assert ifb.status_text(0x41) == "bits 0x40, which have no meaning here"
