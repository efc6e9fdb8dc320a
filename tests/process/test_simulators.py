"""The simulated devices as processes: outside masters drive them, and each fault of the line is seen for what it is."""

from __future__ import annotations

import json
import socket
import sys
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import minimalmodbus
import pytest
import serial
from pymodbus.client import ModbusTcpClient

from sioms.drivers.framed_adc import codec as stream
from sioms.drivers.framed_adc.cobs import FrameReceiver
from sioms.sdk.codec.modbus import RtuUnit, SerialLine, TcpUnit
from sioms.sdk.exchange import DeviceError, Exchange, LinkError

LINE = SerialLine(115200)
DRIVE = RtuUnit(1, LINE)


class Simulator:
    """A simulator's process: its port and its commands."""

    def __init__(self, start: Callable[..., Any], name: str, *options: object) -> None:
        command = [sys.executable, "-m", f"sioms.drivers.{name}", *map(str, options)]
        self.running = start(command)
        self.port: str = self.running.wait_line(r"^ready (\S+)$").group(1)

    def tell(self, line: str) -> Any:
        """Send a command and return its answer's value."""
        pipe = self.running.process.stdin
        before = len(self.running.lines)
        pipe.write(line + "\n")
        pipe.flush()
        deadline = time.monotonic() + 5
        while len(self.running.lines) == before:
            assert time.monotonic() < deadline, f"no answer to {line}"
            time.sleep(0.001)
        answer = self.running.lines[before]
        assert answer.startswith("ok"), answer
        return json.loads(answer[3:]) if answer[3:] else None

    def end(self) -> int:
        """Close its input; it ends by itself."""
        self.running.process.stdin.close()
        return int(self.running.wait_exit(5))


@pytest.fixture
def simulator(start: Callable[..., Any]) -> Callable[..., Simulator]:
    return lambda name, *options: Simulator(start, name, *options)


@pytest.fixture
def link(short_folder: Path) -> Path:
    return short_folder / "port"


def ask(port: serial.Serial, exchange: Exchange) -> Any:
    """Do an exchange as the kit does, without its repetitions."""
    port.read(port.in_waiting)
    port.write(exchange.data)
    got, deadline = b"", time.monotonic() + exchange.timeout_s
    while time.monotonic() < deadline:
        got += port.read(port.in_waiting or 1)
        size = exchange.want(got)
        if size is not None and len(got) >= size:
            return exchange.decode(got[:size])
    raise LinkError(f"{exchange.what}: {len(got)} bytes within its time-out")


def open_port(name: str) -> serial.Serial:
    return serial.Serial(name, 115200, timeout=0.005, exclusive=True)


def test_minimalmodbus_drives_the_leadshine(simulator: Callable[..., Simulator], link: Path) -> None:
    """An outside client agrees on every register it touches, and the vendor's golden replies come byte for byte."""
    drive = simulator("modbus.simulated.leadshine", "--link", link, "--units", "1,7")
    master = minimalmodbus.Instrument(str(link), 1)
    master.serial.baudrate, master.serial.timeout = 115200, 0.3
    assert master.read_register(0x0001) == 10000
    began = time.monotonic()
    # one turn at 200 rpm: 0.3 s
    master.write_registers(0x6200, [1, 0, 10000, 200, 50, 50, 0, 0x10])
    seen = set()
    while not (status := master.read_register(0x1003)) & 0x20:
        seen.add(status)
        assert time.monotonic() - began < 5
    assert (seen, status) == ({0x06}, 0x32)
    assert 0.29 < time.monotonic() - began < 2
    assert master.read_long(0x602C, signed=True) == master.read_long(0x1014, signed=True) == 10000
    for request, reply in (
        ("01 03 10 03 00 01 70 ca", "01 03 02 00 32 39 91"),
        ("01 10 62 00 00 08 10 00 41 ff ff b1 e0 00 c8 00 32 00 32 00 00 00 10", None),
        (
            "07 10 62 00 00 08 10 00 01 00 00 27 10 00 00 27 10 27 10 00 00 00 10 8d 50",
            "07 10 62 00 00 08 de 11",
        ),
        ("01 03 10 03 00 01 70 ca", "01 03 02 00 06 38 46"),
        ("01 06 60 02 00 40 37 fa", "01 06 60 02 00 40 37 fa"),
    ):
        if reply is None:
            master.write_registers(0x6200, [0x41, 0xFFFF, 0xB1E0, 200, 50, 50, 0, 0x10])
            continue
        master.serial.write(bytes.fromhex(request))
        assert master.serial.read(len(bytes.fromhex(reply))).hex(" ") == reply
    for register, function in ((0x4000, 3), (0x1003, 4)):
        with pytest.raises(minimalmodbus.IllegalRequestError):
            master.read_register(register, functioncode=function)
    stranger = minimalmodbus.Instrument(str(link), 2)
    with pytest.raises(minimalmodbus.NoResponseError):
        stranger.read_register(0x1003)
    assert drive.tell("state")["velocity"] == 0
    assert drive.end() == 0 and not link.exists()


def test_each_fault_of_the_line_is_seen(simulator: Callable[..., Simulator], link: Path) -> None:
    drive = simulator("modbus.simulated.leadshine", "--link", link)
    status = DRIVE.read_holding(0x1003, 1)
    with open_port(str(link)) as port:
        assert ask(port, status) == (2,)
        for fault, words in (
            ("noise 1", "unit|CRC|starts|time-out"),
            ("cut 1 2", "5 bytes"),
            ("mute 1", "0 bytes"),
        ):
            drive.tell(fault)
            with pytest.raises(LinkError, match=words):
                ask(port, status)
        # muted: carried out without a reply; deaf: neither
        drive.tell("mute 1")
        with pytest.raises(LinkError):
            ask(port, DRIVE.write_register(0x0191, 40))
        assert ask(port, DRIVE.read_holding(0x0191, 1)) == (40,)
        drive.tell("deaf 1")
        with pytest.raises(LinkError):
            ask(port, DRIVE.write_register(0x0191, 50))
        assert ask(port, DRIVE.read_holding(0x0191, 1)) == (40,)
        # doubled: the second copy must not answer the next request; draining makes it so
        drive.tell("double 1")
        assert ask(port, status) == (2,)
        time.sleep(0.01)
        assert ask(port, DRIVE.read_holding(0x0001, 1)) == (10000,)
        # a damaged request: this family answers exception 8, which is a fault of the line, not a refusal
        port.write(bytes.fromhex("01 03 10 03 00 01 70 cb"))
        time.sleep(0.05)
        with pytest.raises(LinkError, match="exception 8"):
            status.decode(port.read(16))
        with pytest.raises(DeviceError, match="illegal address"):
            ask(port, DRIVE.read_holding(0x7000, 1))
        drive.tell("garbage 40")
        time.sleep(0.02)
        assert ask(port, status) == (2,)


def test_unplugging_and_replugging(simulator: Callable[..., Simulator], link: Path) -> None:
    drive = simulator("modbus.simulated.leadshine", "--link", link)
    with open_port(str(link)) as port:
        assert ask(port, DRIVE.read_holding(0x1003, 1)) == (2,)
        drive.tell("unplug")
        with pytest.raises((OSError, LinkError)):
            ask(port, DRIVE.read_holding(0x1003, 1))
    assert not link.exists()
    drive.tell("plug")
    with open_port(str(link)) as port:
        assert ask(port, DRIVE.read_holding(0x1003, 1)) == (2,)


def test_a_port_takes_masters_with_parity_one_after_the_other(simulator: Callable[..., Simulator], link: Path) -> None:
    simulator("modbus.simulated.oriental_az", "--link", link)
    for _ in range(3):
        with serial.Serial(str(link), 230400, parity="E", timeout=0.005, exclusive=True) as port:
            assert ask(port, DRIVE.read_holding(0x7E, 2)) == (0, 1 << 5 | 1 << 14)


def test_a_jog_ends_when_its_host_falls_silent(simulator: Callable[..., Simulator], link: Path) -> None:
    drive = simulator("modbus.simulated.leadshine", "--link", link)
    with open_port(str(link)) as port:
        for _ in range(5):
            ask(port, DRIVE.write_register(0x1801, 0x4001))
            time.sleep(0.02)
        assert drive.tell("state")["velocity"] > 0
        time.sleep(0.15)
        assert drive.tell("state")["velocity"] == 0


def test_minimalmodbus_drives_the_oriental(simulator: Callable[..., Simulator], link: Path) -> None:
    drive = simulator("modbus.simulated.oriental_az", "--link", link, "--communication-timeout-s", "0.3")
    master = minimalmodbus.Instrument(str(link), 1)
    master.serial.baudrate, master.serial.timeout = 115200, 0.3
    golden = (
        "01 10 00 58 00 10 20 00 00 00 00 00 00 00 02 00 00 21 34 00 00 07 d0 00 00 05 dc 00 00 05 dc 00 00 03 e8 "
        "00 00 00 01 1c 08"
    )
    master.serial.write(bytes.fromhex(golden))
    assert master.serial.read(8).hex(" ").startswith("01 10 00 58 00 10")
    for _ in range(20):
        assert master.read_long(0x7E) == 1 << 13
    assert master.read_long(0xD0, signed=True) > 0
    time.sleep(0.6)
    assert master.read_long(0x80) == 0x85
    master.write_long(0x180, 1)
    master.write_long(0x180, 0)
    drive.tell("state")
    deadline = time.monotonic() + 10
    while master.read_long(0x80) or not master.read_long(0x7E) & 1 << 5:
        master.write_long(0x180, 1)
        assert time.monotonic() < deadline
    with pytest.raises(minimalmodbus.ModbusException):
        master.read_register(0x0200)


def test_pymodbus_and_our_codec_agree_on_the_moxa(simulator: Callable[..., Simulator]) -> None:
    block = simulator("modbus.simulated.moxa", "--model", "E1212")
    host, port = block.port.split(":")
    block.tell("loop on")
    client = ModbusTcpClient(host, port=int(port))
    assert client.connect()
    assert client.write_coils(1, [True, False, True]).isError() is False
    assert client.write_coil(6, True).isError() is False
    assert client.read_discrete_inputs(0, count=8).bits == [
        False,
        True,
        False,
        True,
        False,
        False,
        True,
        False,
    ]
    registers = client.read_input_registers(5000, count=10).registers
    assert b"".join(word.to_bytes(2, "big") for word in registers).rstrip(b"\0") == b"E1212"
    client.close()
    unit = TcpUnit(1)
    with socket.create_connection((host, int(port)), 2) as sock:

        def call(exchange: Exchange, got: bytes = b"") -> Any:
            sock.sendall(exchange.data)
            while (size := exchange.want(got)) is None or len(got) < size:
                got += sock.recv(512)
            return exchange.decode(got[:size])

        assert call(unit.read_discrete(0, 8)) == 0x4A == call(unit.read_coils(0, 8))
        call(unit.write_coil(0, True))
        assert call(unit.read_discrete(0, 8)) == 0x4B
        with pytest.raises(DeviceError, match="illegal address"):
            call(unit.read_input(0, 1))
        # a late reply is not taken for the next one
        block.tell("late 0.2 1")
        sock.sendall(unit.read_discrete(0, 8).data)
        time.sleep(0.02)
        block.tell("di 7 1")
        time.sleep(0.25)
        assert call(unit.read_discrete(0, 8)) == 0xCB


@pytest.fixture
def array(simulator: Callable[..., Simulator], link: Path) -> Iterator[tuple[Simulator, serial.Serial]]:
    device = simulator("framed_adc.simulator", "--link", link)
    with open_port(str(link)) as port:
        yield device, port


def blocks_of(port: serial.Serial, receiver: FrameReceiver, count: int) -> list[stream.SampleBlock]:
    """Return the next blocks."""
    blocks: list[stream.SampleBlock] = []
    deadline = time.monotonic() + 5
    while len(blocks) < count:
        assert time.monotonic() < deadline, f"{len(blocks)} of {count} blocks; {receiver.counters}"
        payloads = receiver.feed(port.read(port.in_waiting or 1))
        blocks += [block for payload in payloads if (block := stream.parse_samples(payload))]
    return blocks


def steps_of(blocks: list[stream.SampleBlock]) -> list[int]:
    return [(b.sequence - a.sequence) % 65536 for a, b in pairwise(blocks)]


def test_the_front_end_streams(array: tuple[Simulator, serial.Serial]) -> None:
    device, port = array
    assert ask(port, stream.hello()) == stream.Hello(1, 16, stream.Format.I16, 1000, "TAC16")
    with pytest.raises(DeviceError, match="out of range"):
        ask(port, stream.start(1, 5000))
    ask(port, stream.start(1, 100))  # its port holds what comes in most of a second, if the reader is held up
    receiver = FrameReceiver()
    blocks = blocks_of(port, receiver, 40)
    assert set(steps_of(blocks)) == {1}
    assert (blocks[-1].t_us - blocks[0].t_us) / 39 == pytest.approx(10000, abs=2)
    assert all(abs(value) < 30 for block in blocks for value in block.values)
    device.tell("touch 3 1 2 0.7")
    device.tell("lose 3")
    blocks = blocks[-1:] + blocks_of(port, receiver, 40)
    assert sorted(steps_of(blocks))[-2:] == [1, 4]
    # 3 N at 2000 counts/N, the greatest at column 1 of row 2
    assert sum(blocks[-1].values) == pytest.approx(6000, abs=60)
    assert max(range(16), key=lambda i: blocks[-1].values[i]) == 2 * 4 + 1
    device.tell("noise 2")
    blocks_of(port, receiver, 50)
    assert receiver.counters.bad_crc + receiver.counters.malformed >= 2
    # requests are answered while the stream runs
    ask(port, stream.zero(1))
    assert ask(port, stream.hello()).channels == 16
    assert max(map(abs, blocks_of(port, receiver, 30)[-1].values)) < 30
    ask(port, stream.stop(1))
    assert device.tell("state")["rate_hz"] == 0
    assert device.end() == 0
