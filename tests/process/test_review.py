"""What a client must not be able to do to driver or daemon, and what must not go on after a loss."""

from __future__ import annotations

import errno
import fcntl
import os
import resource
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import Daemon, Waiting, axes, raises, wait_for
from wire_rig import SLIDE, Wire

import sioms
from sioms.client.channel import Call, Channel
from sioms.client.command import command
from sioms.client.connecting import connect
from sioms.protocol.flags import PROTOCOL_VERSION, Request
from sioms.protocol.records import BINARY_WRITE
from sioms.protocol.verbs import Hello, Ioctl, Message, Write


def test_the_stop_request_file_cannot_be_taken_away(daemon: Daemon, cell: sioms.Workcell) -> None:
    channel = Channel(connect(daemon.socket), "the daemon")
    fd, taken = channel.call(Call("hello", Hello(PROTOCOL_VERSION, "rogue"))).fds.take()
    try:
        with pytest.raises(OSError):
            os.pwrite(taken, bytes(8), 0)  # what drivers say is theirs to say
        os.ftruncate(fd, 0)
        wait_for(lambda: cell.status()["stopped_ns"], "a change of whatever kind is a stop")
        time.sleep(0.02)  # it does not say when it was asked for: the time of the file's change tells, to some 10 ms
        cell.reset()
        os.ftruncate(fd, 1 << 20)
        wait_for(lambda: cell.status()["stopped_ns"], "stopped again")
        time.sleep(0.02)
    finally:
        os.close(fd)
        os.close(taken)
        channel.close()
    assert all(device["deaths"] == 0 for device in cell.status()["devices"])
    cell.reset()


UDP = """
import struct
from sioms.sdk.blocks import BinaryBlock, BlockSpec, Description
from sioms.sdk.driver import LineDriver, LineUnit
from sioms.sdk.exchange import Exchange, LinkError
from sioms.sdk.settings import LineSettings
from sioms.protocol.flags import NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
import msgspec, time


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    line: LineSettings


def ask(kind, value=0):
    def decode(reply):
        if reply[:1] != kind:
            raise LinkError("reply to another request")
        return reply[1]
    timeout_s = 0.3 if kind == b"P" else 5.0  # a slow answer to a write is no loss, nor is a busy machine
    return Exchange(kind + bytes([value]), lambda data: 2, decode, timeout_s, False, kind.decode())


class Unit(LineUnit):
    name = "port"
    misses = 2

    def __init__(self, spec):
        self.block = BinaryBlock(spec)
        self.blocks_ = [self.block]

    blocks = property(lambda self: self.blocks_)

    def open(self):
        yield ask(b"O")

    def poll(self):
        value = yield ask(b"P")
        self.block.set(0, value, time.monotonic_ns())

    def write_outputs(self, spec, channels, values):
        yield ask(b"W", int(values[-1]))


class Port(LineDriver):
    Settings = Settings
    recovery_s = 0.02

    @classmethod
    def describe(cls, name, settings):
        channels = (ChannelInfo("port", width=8, minimum=0, maximum=255),)
        spec = BlockSpec("", NodeClass.BINARY, channels, writable=True, safe=(0,))
        return Description((spec,), 20.0, lease_s=1.0)

    def __init__(self, name, settings, kit):
        super().__init__(name, settings, kit)
        self.line = settings.line
        self._units = [Unit(self.describe(name, settings).blocks[0])]

    units = property(lambda self: self._units)


DRIVER = Port
"""


class Device:
    """Eight outputs behind a datagram socket, each request answered after a delay; keeps what was written."""

    def __init__(self) -> None:
        self.sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sock.bind(("127.0.0.1", 0))
        self.port = self.sock.getsockname()[1]
        self.value, self.written, self.delay_s, self.mute = 0, list[int](), 0.0, False
        self.asked = threading.Event()
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while True:
            request, where = self.sock.recvfrom(16)
            if request == b"end":
                return
            if self.mute:
                continue
            if request[:1] == b"W":
                self.asked.set()
                time.sleep(self.delay_s)
                self.value = request[1]
                self.written.append(request[1])
            self.sock.sendto(request[:1] + bytes([self.value]), where)

    def close(self) -> None:
        self.sock.sendto(b"end", self.sock.getsockname())


@pytest.fixture
def port(start_daemon: Callable[..., Daemon]) -> Iterator[tuple[Daemon, Device]]:
    """A daemon with one port, and the device behind it."""
    device = Device()
    text = (
        f'[workcell]\nname = "test"\n[device.port0]\ndriver = "./port.py"\nline = '
        f'{{ udp = "127.0.0.1:{device.port}" }}\n'
    )
    daemon = start_daemon(text, files={"port.py": UDP})
    daemon.wait_up("port0")
    yield daemon, device
    device.close()


def _send(node: sioms.BinaryNode, value: int) -> None:
    """Send a write and do not wait for its answer."""
    node._channel.send(Call("write", Write(0, 0.0, BINARY_WRITE.pack(0, 0, value, 0))))


def test_writes_on_their_way_do_not_come_after_the_safe_value(port: tuple[Daemon, Device]) -> None:
    daemon, device = port
    with daemon.cell("writer") as cell:
        node = cell.open("port0", "rw")
        node.set(1)
        device.delay_s = 0.05
        device.asked.clear()
        for value in (3, 5, 7, 9):
            _send(node, value)
        assert device.asked.wait(5.0)
        node.close()
    wait_for(lambda: device.value == 0, "the safe value")
    time.sleep(0.3)
    assert device.value == 0, f"written: {device.written}"


def test_writes_on_their_way_do_not_come_after_an_emergency_stop(port: tuple[Daemon, Device]) -> None:
    daemon, device = port
    with daemon.cell("writer") as cell, cell.open("port0", "rw") as node:
        device.delay_s = 0.05
        device.asked.clear()
        for value in (3, 5, 7, 9):
            _send(node, value)
        assert device.asked.wait(5.0)
        cell.emergency_stop()
        wait_for(lambda: device.written[-1:] == [0], "the safe value")
        cell.reset()
        time.sleep(0.3)
        assert device.value == 0, f"written: {device.written}"
        node.set(1)
        assert device.value == 1


def test_what_was_sent_before_a_stop_is_not_taken_after_its_reset(start_daemon: Callable[..., Daemon]) -> None:
    """A driver that has had no processor meanwhile reads it only then."""
    daemon = start_daemon('[workcell]\nname = "test"\n' + axes("mod0", "xaxis"))
    pid = daemon.device("mod0")["pid"]
    jog = Write(0, 0.0, command(0, velocity=0.1))
    with daemon.cell("writer") as cell, cell.open("mod0", "rw") as node, daemon.cell("other") as other:

        def send(message: Message) -> Call:
            node._channel.send(call := Call("request", message))
            return call

        os.kill(pid, signal.SIGSTOP)
        try:
            early = [send(message) for message in (jog, Ioctl(int(Request.HOME), None, 0.0), jog)]
            other.emergency_stop()
            other.reset()
            late = send(jog)
        finally:
            os.kill(pid, signal.SIGCONT)
        for call in early:
            with raises(errno.ECANCELED, "mod0", "sent before the last reset"):
                node._channel.wait(call.number, call)
        node._channel.wait(late.number, late)
        wait_for(lambda: node.read().velocity[0] > 0.05, "what was sent after the reset")


def test_outputs_whose_writer_went_during_a_loss_are_made_safe_after_it(port: tuple[Daemon, Device]) -> None:
    daemon, device = port
    with daemon.cell("writer") as cell:
        node = cell.open("port0", "rw")
        node.set(5)
        device.mute = True
        wait_for(lambda: daemon.device("port0")["link"] != "good", "lost")
        node.close()
    assert device.value == 5
    device.mute = False
    daemon.wait_up("port0")
    wait_for(lambda: device.value == 0, "the safe value")


def test_two_writers_of_one_port_keep_each_others_bits(port: tuple[Daemon, Device]) -> None:
    daemon, device = port
    with (
        daemon.cell("writer") as cell,
        cell.open("port0.bit0", "rw") as first,
        cell.open("port0.bit1", "rw") as other,
    ):
        device.delay_s = 0.05
        device.asked.clear()
        _send(first, 1)
        assert device.asked.wait(5.0)
        other.set(1)
        assert device.value == 3, f"written: {device.written}"


def test_nothing_that_is_asked_of_a_lost_drive_begins_when_it_is_back(start: Any, short_folder: Path) -> None:
    wire = Wire(start, short_folder, "modbus.simulated.leadshine")
    cell = wire.serve(SLIDE)
    wire.wait_up("slide0")
    with cell.open("slide0", "rw") as node:
        node.move(0.01)
        node.wait_until_idle(10.0)
        os.kill(wire.device.process.pid, signal.SIGSTOP)
        wait_for(lambda: not wire.reads("slide0"), "lost")
        node.reset()
        with raises(errno.EIO, "slide0", "does not answer"):
            node.move(0.05)
        with raises(errno.EIO, "slide0", "does not answer"):
            node.move(0.05, timeout=5.0, replace=True)
        os.kill(wire.device.process.pid, signal.SIGCONT)
        wire.wait_up("slide0")
        time.sleep(0.5)
        assert node.read().position[0] == pytest.approx(0.01, abs=1e-3) and not node.read().in_motion[0]
        node.reset()
        node.move(0.02)
        node.wait_until_idle(10.0)
        assert node.read().position[0] == pytest.approx(0.02, abs=1e-3)


def test_a_reload_restarts_a_device_whose_driver_describes_it_otherwise(port: tuple[Daemon, Device]) -> None:
    daemon, _ = port
    file = daemon.folder / "port.py"
    with daemon.cell("admin") as cell:
        before = daemon.device("port0")["pid"]
        cell.reload()
        assert daemon.device("port0")["pid"] == before, "nothing has changed"
        file.write_text(UDP.replace("width=8, minimum=0, maximum=255", "width=4, minimum=0, maximum=15"))
        cell.reload()
        wait_for(lambda: any(d["pid"] not in (0, before) for d in cell.status()["devices"]), "a new process")
        daemon.wait_up("port0")
        with cell.open("port0", "rw") as node, raises(errno.EINVAL, "want 0 to 15"):
            node.set(16)


def test_an_open_that_waits_ends_when_a_reload_changes_its_node(port: tuple[Daemon, Device]) -> None:
    daemon, _ = port
    with daemon.cell("holder") as cell, daemon.cell("waiting") as other, cell.open("port0", "rw"):
        waiting = Waiting(lambda: other.open("port0.bit7", "rw", timeout=20.0), other)
        (daemon.folder / "port.py").write_text(
            UDP.replace("width=8, minimum=0, maximum=255", "width=4, minimum=0, maximum=15")
        )
        cell.reload()
        assert waiting.errno() == errno.EIO and "changed meanwhile" in str(waiting.error)


def test_a_client_cannot_block_its_driver_by_the_wake_pipe(daemon: Daemon, cell: sioms.Workcell) -> None:
    with cell.open("mod0.readonly") as node:
        wake = node.fileno()
        os.set_blocking(wake, True)
        fcntl.fcntl(wake, fcntl.F_SETPIPE_SZ, 4096)
        skipped = node.statistics(1)["skipped"]
        first = node.history(0)[-1].number
        wait_for(
            lambda: node.history(0, gone=True)[-1].number > first + 5000,
            "5,000 wakes that nobody takes",
            20.0,
        )
        assert daemon.device("mod0")["generation"] == 1
        statistics = node.statistics(5000)
        assert statistics["skipped"] - skipped < 500, f"a driver that waits for a wake skips nearly all: {statistics}"
        assert len(os.read(wake, 1 << 16)) == 4096


def test_a_driver_without_descriptors_left_lives_on(port: tuple[Daemon, Device]) -> None:
    daemon, _ = port
    with daemon.cell("reader") as cell:
        first = cell.open("port0.readonly")
        pid = daemon.device("port0")["pid"]
        used = max(int(fd) for fd in os.listdir(f"/proc/{pid}/fd")) + 1
        before = resource.prlimit(pid, resource.RLIMIT_NOFILE)
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (used, before[1]))
        more = [cell.open("port0.readonly") for _ in range(4)]
        daemon.said("too many open descriptors")
        resource.prlimit(pid, resource.RLIMIT_NOFILE, before)
        assert daemon.device("port0")["pid"] == pid
        assert first.read().data[0] == 0
        for node in more:
            node.close()


def test_a_closed_contact_stops_nothing_before_it_has_been_read(start_daemon: Callable[..., Daemon]) -> None:
    device = Device()
    device.value = 1
    text = (
        f'[workcell]\nname = "test"\n[device.port0]\ndriver = "./port.py"\nline = '
        f'{{ udp = "127.0.0.1:{device.port}" }}\n'
    )
    text += '[[emergency_stop]]\nnode = "port0.bit0"\nactive = 0\n'
    daemon = start_daemon(text, files={"port.py": UDP.replace("safe=(0,)", "safe=(None,)")})
    daemon.wait_up("port0")
    with daemon.cell("watcher") as cell, cell.open("port0.bit0.readonly") as contact:
        contact.read()
        assert cell.status()["stopped_ns"] == 0, cell.status()["stop_source"]
        device.value = 0
        wait_for(lambda: cell.status()["stopped_ns"], "the stop")
        assert "port0" in cell.status()["stop_source"]
    device.close()
