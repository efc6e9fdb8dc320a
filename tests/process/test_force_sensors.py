"""Force/torque sensors under the real daemon, against simulated ones on a pty, on UDP and on TCP.

Starting a cell takes seconds on a busy machine, so each test tells a whole story in one.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import minimalmodbus
import numpy as np
import pytest
from conftest import PATIENCE_S
from daemon_rig import raises, wait_for
from wire_rig import Wire

import sioms
from sioms.protocol.flags import AnalogStatus, Request

LOAD = (10.0, -20.0, 30.0, 1.0, -2.0, 3.0)
PUT = "load " + " ".join(map(str, LOAD))
FT300 = 'driver = "ft300"\nline = { serial = "{port}", baud = 19200 }\n'
ATI = (
    '[device.f0]\ndriver = "ati-rdt"\nline = { udp = "{port}" }\npage = "{port}"\nfull_scale = [400, 400, 400, 20, 20, '
    "20]\n"
)
SCHUNK = '[device.f0]\ndriver = "schunk-ft"\nline = { tcp = "{port}" }\ndata = "{port}"\n'


class Sensor(Wire):
    """A sensor behind its line; its nodes have no read-only companion, as nobody can write them."""

    def reader(self, node: str) -> str:
        return node


UNREAD = 1 << 30
"""No flags of a reading."""


def shows(node: Any, expected: tuple[float, ...], what: str) -> None:
    """Wait for a reading; one that is refused is that of a simulator which had to wait for a processor (0.16 s)."""

    def shown() -> bool:
        with contextlib.suppress(OSError):
            return bool(node.read().data == pytest.approx(expected, abs=0.5))
        return False

    wait_for(shown, f"{what}: {expected}")


def stream(node: Any) -> Any:
    return node.statistics(1)["stream"]


def flags(node: Any) -> int:
    """Return the flags of a reading, UNREAD while there is none: see ``shows``."""
    with contextlib.suppress(OSError):
        return int(node.read().flags[0])
    return UNREAD


def lost_and_back(wire: Sensor, cause: str, words: str, cure: str = "clear") -> None:
    """Tell the sensor to fail: its node cannot be read, with these words as the reason, until it is told otherwise."""
    wire.tell(cause)

    def refused() -> bool:
        try:
            with wire.client.open("f0") as opened:
                opened.read()
        except OSError as error:
            assert error.errno in (errno.EIO, errno.ENODEV, errno.ESTALE), error
            return True
        return False

    wait_for(refused, f"f0 lost by {cause}")
    wait_for(lambda: re.search(words, wire.reason("f0")), f"{words} in {wire.reason('f0')}")
    wire.tell(cure)
    wire.wait_up("f0")


def test_ft300_streams_through_damage_and_a_restart(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Sensor(start, short_folder, "ft300.simulator", "--baud", "19200")
    wire.tell("register 410 0")
    cell = wire.serve("[device.f0]\n" + FT300)
    wire.wait_up("f0")
    wire.tell(PUT)
    with cell.open("f0") as node:
        shows(node, LOAD, "the load")
        number = node.read().number
        node.wait_new(number + 50, 5.0)
        stamps = [snapshot.stamp_ns for snapshot in node.history(number)]
        # the usual distance: 50 ms without a processor at either end are 10 % of their mean
        assert np.median(np.diff(stamps)) == pytest.approx(10e6, rel=0.1)
        node.zero(20)
        shows(node, (0.0,) * 6, "zeroed in software")
        wire.tell("noise 3")
        wait_for(lambda: stream(node)["lost"] >= 3, "damage counted")
        wire.tell("garbage 200")
        wait_for(lambda: stream(node)["skipped_bytes"] >= 200, "garbage counted")
        wire.tell("load 400 0 0 0 0 0")
        wait_for(lambda: flags(node) & AnalogStatus.SATURATED, "overload flagged")
        wire.tell(PUT)
        with raises(errno.ENOTTY, "CALIBRATE_DEVICE"):
            node.ioctl(Request.CALIBRATE_DEVICE)
        # a sensor that began anew streams no more: it is told to again
        wire.tell("power_cycle 0.3")
        wait_for(lambda: wire.tell("state")["streaming"], "streaming again")
        wire.wait_up("f0")
    wire.daemon.signal(signal.SIGTERM)
    assert wire.daemon.wait_exit(15) == 0
    assert not wire.tell("state")["streaming"]


def test_an_outside_master_agrees_on_the_ft300_and_the_driver_polls(
    start: Callable[..., Any], short_folder: Path
) -> None:
    wire = Sensor(start, short_folder, "ft300.simulator", "--baud", "19200")
    wire.tell(PUT)
    master = minimalmodbus.Instrument(wire.port, 9)
    master.serial.baudrate, master.serial.timeout = 19200, 0.3
    assert (
        master.read_string(500, 3) == "FT3-21" and master.read_register(513) << 16 | master.read_register(512) == 123456
    )
    words = [master.read_register(180 + i, signed=True) for i in range(6)]
    assert words == pytest.approx([1000, -2000, 3000, 1000, -2000, 3000], abs=40)
    with pytest.raises(minimalmodbus.IllegalRequestError):
        master.read_register(0)
    master.serial.write(bytes.fromhex("09 10 01 9a 00 01 02 02 00 cd ca"))
    assert master.serial.read(8).hex(" ") == "09 10 01 9a 00 01 21 52"
    assert wire.tell("state")["streaming"]
    master.serial.close()
    cell = wire.serve("[device.f0]\n" + FT300 + 'mode = "modbus"\npoll_hz = 40.0\nacceleration = true\n')
    wire.wait_up("f0")
    with cell.open("f0") as node, cell.open("f0.acceleration") as acceleration:
        shows(node, LOAD, "the load")
        assert acceleration.read().data == pytest.approx([0, 0, 9.80665], abs=1e-3)
        assert not wire.tell("state")["streaming"]
        for fault in ("noise 1", "cut 1 3"):
            before = node.statistics(1)["link"]["repeats"]
            wire.tell(fault)
            wait_for(lambda n=before: node.statistics(1)["link"]["repeats"] > n, f"repeated after {fault}")
        shows(node, LOAD, "the load after faults")
    lost_and_back(wire, "mute", "no reply within its time-out")


def test_ft300_configured_wrongly(start: Callable[..., Any], short_folder: Path) -> None:
    """Each device is refused for a reason of its own, in one workcell; none shows data."""
    wire = Sensor(start, short_folder, "ft300.simulator", "--baud", "19200")
    drive = start(
        [
            sys.executable,
            "-m",
            "sioms.drivers.modbus.simulated.leadshine",
            "--link",
            short_folder / "drive",
            "--units",
            "9",
        ]
    )
    drive.wait_line("^ready ")
    tables = {
        "f0": FT300 + "address = 8\n",
        "d0": FT300.replace("{port}", str(short_folder / "drive")),
        "n0": FT300.replace("{port}", str(short_folder / "nothing")),
    }
    wire.serve("".join(f"[device.{name}]\n{table}" for name, table in tables.items()))
    for name, words in (
        ("f0", "identify f0 at address 8 on .*no reply within its time-out; check port, power and address"),
        ("d0", "no FT 300 answers there: .*illegal address|which is not a firmware version"),
        ("n0", "open .*nothing: no such port; is the device plugged in"),
    ):
        wait_for(
            lambda name=name, words=words: re.search(words, wire.reason(name)),
            f"{words} in {wire.reason(name)}",
        )
        assert not wire.reads(name)


def test_ati_through_a_bad_network_and_stalls(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Sensor(start, short_folder, "ati_rdt.simulator", "--port", "0")
    cell = wire.serve(ATI)
    wire.wait_up("f0")
    wire.tell(PUT)
    with cell.open("f0") as node:
        shows(node, LOAD, "the load")
        number = node.read().number
        node.wait_new(number + 200, 5.0)
        history = node.history(number)
        stamps = [snapshot.stamp_ns for snapshot in history]
        assert (stamps[-1] - stamps[0]) / (history[-1].number - history[0].number) == pytest.approx(1e6, rel=0.02)
        before = stream(node)
        wire.tell("mute 5")
        wait_for(lambda: stream(node)["lost"] >= before["lost"] + 5, "losses counted")
        assert any(snapshot.flags[0] & AnalogStatus.OVERRUN for snapshot in node.history(0))
        wire.tell("double 4")
        wait_for(lambda: stream(node)["doubled"] >= before["doubled"] + 4, "doubles counted")
        wire.tell("late 0.01 3")
        wait_for(lambda: stream(node)["late"] >= before["late"] + 3, "late ones counted")
        wire.tell("cut 2 10")
        wire.tell("garbage 35")
        wait_for(lambda: stream(node)["malformed"] >= before["malformed"] + 3, "malformed ones counted")
        forge(node, wire.pid("f0"))
        wire.tell("status 0x80000004")
        wait_for(lambda: flags(node) == AnalogStatus.INVALID, "flagged invalid")
        assert stream(node)["status"] == "temperature"
        wire.daemon.wait_line("f0: status: temperature")
        wire.tell("status 0")
        wire.tell("load 500 0 0 0 0 0")
        wait_for(lambda: flags(node) == AnalogStatus.INVALID | AnalogStatus.SATURATED, "overload flagged")
        wire.tell(PUT)
        shows(node, LOAD, "the load again")
        node.zero(50)
        shows(node, (0.0,) * 6, "zeroed in software")
        node.ioctl(Request.CALIBRATE_DEVICE, timeout=5.0)
        shows(node, (0.0,) * 6, "zeroed by the sensor")
        wire.tell("load")
        shows(node, tuple(-value for value in LOAD), "counted from the sensor's zero")
        # the sensor loses its own zero with its power: told, until there is another
        wire.tell("power_cycle 0.3")
        wait_for(lambda: wire.tell("state")["streaming"], "streaming again")
        wire.wait_up("f0")
        shows(node, (0.0,) * 6, "restarted")
        assert flags(node) & AnalogStatus.INVALID and "zero lost" in stream(node)["status"]
        wire.daemon.wait_line("f0: zero lost: .*; zero it again: its readings are INVALID until then")
        node.ioctl(Request.CALIBRATE_DEVICE, timeout=5.0)
        wait_for(lambda: not flags(node), "good behind a new zero")
    lost_and_back(wire, "stall", "start the realtime stream: no reply|no good frame", "resume")
    wire.daemon.signal(signal.SIGTERM)
    assert wire.daemon.wait_exit(15) == 0
    wait_for(lambda: not wire.tell("state")["streaming"], "the stream stopped")


def forge(node: Any, pid: int) -> None:
    """Send the driver datagrams from elsewhere: they are counted and change nothing."""
    inodes = {os.readlink(f"/proc/{pid}/fd/{fd}")[8:-1] for fd in os.listdir(f"/proc/{pid}/fd") if _is_socket(pid, fd)}
    rows = [line.split() for line in Path("/proc/net/udp").read_text().splitlines()[1:]]
    (port,) = {int(row[1].split(":")[1], 16) for row in rows if row[9] in inodes}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for _ in range(10):
            stranger.sendto(bytes(11) + b"\x01" + bytes(24), ("127.0.0.1", port))
    wait_for(lambda: node.statistics(1)["link"]["strangers"] >= 10, "strangers counted")


def _is_socket(pid: int, fd: str) -> bool:
    try:
        return os.readlink(f"/proc/{pid}/fd/{fd}").startswith("socket:")
    except FileNotFoundError:
        return False


def apart(wire: Sensor, tables: Mapping[str, str]) -> str:
    """Return the tables of devices, each with a spelling of its own for the one sensor, which two may not claim."""
    text = ""
    spellings = ("127.1", "127.0.1", "0x7f.1", "2130706433", "127.0.0.1")
    for spelling, (name, table) in zip(spellings, tables.items(), strict=False):
        said = wire.port.replace("127.0.0.1", spelling)
        line = re.sub(r'((?:udp|tcp) = ")127\.0\.0\.1', rf"\g<1>{spelling}", table)
        text += f"[device.{name}]\n" + re.sub(r'((?:udp|tcp) = ")\{port\}', rf"\g<1>{said}", line)
    return text


def test_ati_wrong_host_port_identity_and_page(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Sensor(start, short_folder, "ati_rdt.simulator", "--port", "0", "--model", "axia")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        closed = f"127.0.0.1:{probe.getsockname()[1]}"
    base = ATI.replace("[device.f0]\n", "")
    tables = {
        "model": base + 'model = "net"\n',
        "rate": base + "rate_hz = 7000\n",
        "serial": base + 'serial_number = "FT1"\n',
        "port": base.replace('udp = "{port}"', f'udp = "{closed}"'),
        "host": base.replace("{port}", closed),
    }
    wire.serve(apart(wire, tables))
    for name, words in (
        ("model", "is a 'ETHERNET AXIA'; the configuration says model = net"),
        ("rate", "sends 1000 records/s; the configuration says rate_hz = 7000; change one of them"),
        ("serial", "has serial number 'FT12345'; the configuration says 'FT1'"),
        ("port", f"{closed.partition(':')[2]}: nothing takes datagrams at this port; check host and port"),
        ("host", "identify host: get http://127.0.0.1/netftapi2.xml: connect to .*: connection refused"),
    ):
        wait_for(
            lambda name=name, words=words: re.search(words, wire.reason(name)),
            f"{words} in {wire.reason(name)}",
        )
        assert not wire.reads(name)
    assert not wire.tell("state")["streaming"] and wire.tell("sent") == 0


PAGE = (
    b"<prodname>Net F/T</prodname><setserial>FT1</setserial><cfgcpf>1e6</cfgcpf><cfgcpt>1e6</cfgcpt><scfgfu>N</scfgfu>"
    b"<scfgtu>Nm</scfgtu><comrdtrate>1000</comrdtrate>"
)
OK = b"HTTP/1.0 200 OK\r\n\r\n"
BAD_PAGES: dict[str, tuple[bytes, str]] = {
    "mute": (b"HTTP/1.0 200 OK\r\nContent-Length: 999999999\r\n\r\n", "no reply within its time-out"),
    "endless": (OK + b"x" * 100_000, "the page is longer than 65536 bytes"),
    "other": (
        b"HTTP/1.0 200 OK\r\nContent-Length: 5\r\n\r\nhello",
        "no element prodname; is this a Net F/T or an Ethernet Axia",
    ),
    "absent": (
        b"HTTP/1.0 404 Not Found\r\nContent-Length: 0\r\n\r\n",
        "the web server answers 404; is it another device",
    ),
    "number": (
        b"HTTP/1.0 200 OK\r\nContent-Length: %d\r\n\r\n" % len(PAGE) + PAGE.replace(b"1e6", b"NaN", 1),
        "cfgcpf is 'NaN'",
    ),
}
"""What a web server says, bytes at a time, and the words of the sentence; it keeps the connection open."""


@contextlib.contextmanager
def servers(replies: Iterable[bytes]) -> Iterator[list[tuple[str, list[bytes]]]]:
    """Serve each reply at a port of its own, in two pieces; a reply may be changed by its list."""
    with contextlib.ExitStack() as stack:
        found = []
        for reply in replies:
            listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
            current = [reply]

            def serve(listener: socket.socket = listener, current: list[bytes] = current) -> None:
                with contextlib.suppress(OSError), contextlib.ExitStack() as kept:
                    while True:
                        sock = kept.enter_context(listener.accept()[0])
                        with contextlib.suppress(OSError):
                            sock.recv(1000)
                            sock.sendall(current[0][:20])
                            sock.sendall(current[0][20:])

            threading.Thread(target=serve, daemon=True).start()
            stack.callback(listener.shutdown, socket.SHUT_RDWR)
            found.append((f"127.0.0.1:{listener.getsockname()[1]}", current))
        yield found


def test_ati_with_a_page_that_is_none(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Sensor(start, short_folder, "ati_rdt.simulator", "--port", "0", "--rate", "1000")
    with servers(reply for reply, _ in BAD_PAGES.values()) as places:
        table = ATI.partition("]\n")[2].replace('page = "{port}"', 'page = "PLACE"')
        pairs = zip(BAD_PAGES, places, strict=True)
        wire.serve(apart(wire, {name: table.replace("PLACE", place) for name, (place, _) in pairs}))
        for name, (_, words) in BAD_PAGES.items():
            wait_for(lambda n=name, w=words: w in wire.reason(n), f"{words!r} in {wire.reason(name)!r}")
            assert not wire.reads(name)
        assert wire.tell("sent") == 0, "no stream of a sensor that was not identified"
        places[0][1][0] = b"HTTP/1.0 200 OK\r\nContent-Length: %d\r\n\r\n" % len(PAGE) + PAGE
        wire.wait_up("mute")


def test_schunk_through_a_bad_network_stalls_and_deaths(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Sensor(start, short_folder, "schunk_ft.simulator", "--port", "0", "--data-port", "0")
    cell = wire.serve(SCHUNK + "tool = 1\nnoise_filter = 2\n")
    wire.wait_up("f0")
    wire.tell(PUT)
    assert (wire.tell("state")["tool"], wire.tell("state")["noise_filter"]) == (1, 2)
    with cell.open("f0") as node:
        shows(node, LOAD, "the load")
        before = stream(node)
        for fault, counter, count in (
            ("mute 5", "lost", 5),
            ("double 4", "doubled", 4),
            ("late 0.01 3", "late", 3),
            ("cut 2 10", "malformed", 2),
        ):
            wire.tell(fault)
            wait_for(lambda k=counter, n=count: stream(node)[k] >= before[k] + n, f"{fault} counted as {counter}")
        node.ioctl(Request.CALIBRATE_DEVICE, timeout=5.0)
        shows(node, (0.0,) * 6, "tared by the sensor")
        node.ioctl(Request.CALIBRATE_DEVICE, 0, timeout=5.0)
        shows(node, LOAD, "the tare taken back")
        with raises(errno.EINVAL, "want nothing for a tare, or 0"):
            node.ioctl(Request.CALIBRATE_DEVICE, 5)
        wire.tell("hang_up")  # the commands' connection: samples go on, and the next command connects anew
        number = node.read().number
        node.wait_new(number + 300, 5.0)
        assert wire.reads("f0")
        node.ioctl(Request.CALIBRATE_DEVICE, timeout=5.0)
        shows(node, (0.0,) * 6, "tared again")
        wire.tell("status 0x2")
        wait_for(lambda: flags(node) == AnalogStatus.INVALID, "flagged invalid")
        wire.tell("status 0")
    lost_and_back(wire, "stall", "no good frame .*look whether a firewall keeps UDP", "resume")
    wire.tell("stall")
    wire.tell("product FTX-9")
    wire.tell("resume")
    pid = wire.pid("f0")
    os.kill(pid, signal.SIGKILL)
    wait_for(lambda: wire.pid("f0") not in (0, pid), "a new driver")
    wire.wait_up("f0")
    wire.daemon.wait_line("FTX-9")
    wire.daemon.signal(signal.SIGTERM)
    assert wire.daemon.wait_exit(15) == 0
    assert not wire.tell("state")["streaming"]


def test_schunk_connection_lost_and_box_restarted(start: Callable[..., Any], short_folder: Path) -> None:
    """Replies are numbered from 1 on each connection; a supply that is off for 0.3 s leaves the host's connection dead,
    without a word.
    """
    wire = Sensor(start, short_folder, "schunk_ft.simulator", "--port", "0", "--data-port", "0")
    cell = wire.serve(SCHUNK + "noise_filter = 3\n")
    wire.wait_up("f0")
    with cell.open("f0") as node:
        for _ in range(3):
            wire.tell("hang_up")
            node.ioctl(Request.CALIBRATE_DEVICE, timeout=5.0)
        assert flags(node) == 0
        wire.tell("power_cycle 0.3")

        def doubted() -> bool:  # a reading that is refused because it is old is no sign of the restart
            with contextlib.suppress(OSError):
                return flags(node) == AnalogStatus.INVALID and "zero lost: its tare" in stream(node)["status"]
            return False

        wait_for(doubted, "good again, with its zero in doubt", PATIENCE_S)
        state = wire.tell("state")
        assert state["noise_filter"] == 3 and not state["tared"]
        wire.tell("refuse 1")
        with raises(errno.EBUSY, "tare: the sensor answers error 04, busy"):
            node.ioctl(Request.CALIBRATE_DEVICE, timeout=5.0)
        assert flags(node) == AnalogStatus.INVALID
        node.zero(20)
        wait_for(lambda: flags(node) == 0, "good behind a zero of the driver's")


def test_schunk_as_the_vendors_simulator(start: Callable[..., Any], short_folder: Path) -> None:
    """Streams before it is asked, answers every parameter alike: taken, every record read, none of 5 s lost."""
    wire = Sensor(start, short_folder, "schunk_ft.simulator", "--port", "0", "--data-port", "0", "--vendor")
    cell = wire.serve(SCHUNK)
    wire.wait_up("f0")
    with cell.open("f0") as node:
        before, began = stream(node), time.monotonic()
        time.sleep(2.0)
        after, took_s = stream(node), time.monotonic() - began
        assert after["records"] - before["records"] + after["lost"] - before["lost"] == pytest.approx(
            1000 * took_s, rel=0.1
        )
        assert after["malformed"] == 0


def test_schunk_wrong_host_identity_and_a_taken_port(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Sensor(start, short_folder, "schunk_ft.simulator", "--port", "0", "--data-port", "0")
    base = SCHUNK.replace("[device.f0]\n", "")
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder,
        socket.create_server(("127.0.0.1", 0)) as web,
    ):
        holder.bind(("127.0.0.1", 0))
        taken = f"127.0.0.1:{holder.getsockname()[1]}"
        host = f"127.0.0.1:{web.getsockname()[1]}"
        tables = {
            "product": base + 'product = "FTN"\n',
            "taken": base.replace('data = "{port}"', f'data = "{taken}"'),
            "mute": base.replace('tcp = "{port}"', f'tcp = "{host}"').replace(
                'data = "{port}"', 'data = "127.0.0.3:5999"'
            ),
        }
        wire.serve(apart(wire, tables))
        for name, words in (
            ("product", "the sensor calls itself 'KMS'; the configuration says 'FTN'"),
            ("taken", f"listen on {taken} for .*:0: address already in use"),
            ("mute", "open mute: stop at .*: no reply within its time-out; check its address"),
        ):
            wait_for(
                lambda name=name, words=words: re.search(words, wire.reason(name)),
                f"{words} in {wire.reason(name)}",
            )
            assert not wire.reads(name)
    assert not wire.tell("state")["streaming"]


def test_back_off_of_a_dead_sensor(start: Callable[..., Any], short_folder: Path) -> None:
    """A sensor that never answers is asked less and less often."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as dead:
        dead.bind(("127.0.0.1", 0))
        dead.settimeout(6.0)
        place = "{}:{}".format(*dead.getsockname())
        config = short_folder / "cell.toml"
        config.write_text(
            f'[workcell]\nname = "dead"\n[device.f0]\ndriver = "ati-rdt"\nline = {{ udp = "{place}" }}\npage = "none"\n'
            'model = "net"\ncounts_per_force = 1e6\ncounts_per_torque = 1e6\n'
        )
        daemon = start(
            [
                sys.executable,
                "-m",
                "sioms.daemon.main",
                "--config",
                config,
                "--socket",
                str(short_folder / "s"),
            ]
        )
        stops = []
        while len(stops) < 4:
            data = dead.recv(100)
            if data[3] == 0:
                stops.append(time.monotonic())
        pauses = [b - a for a, b in pairwise(stops)]
        assert pauses[1] > pauses[0] + 0.15 and pauses[2] > pauses[1] + 0.4
        daemon.wait_line("no reply within its time-out; check host and port, and that RDT is enabled")
        with sioms.Workcell(str(short_folder / "s")) as cell, raises(errno.EIO), cell.open("f0") as node:
            node.read()
