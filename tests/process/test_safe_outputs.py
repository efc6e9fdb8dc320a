"""Safe outputs until the device has them, and single bits of a port, on a block that is silent, busy or restarted."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from struct import pack, unpack
from typing import Any

import pytest
from daemon_rig import wait_for

import sioms

MAP = """
family = "block"
title = "block of 8 outputs"
source = "this test"
word_order = "big"
turnaround_s = {turnaround_s}
[signals]
do = {{ table = "coil", address = 0, count = 8 }}
[ports.do]
signal = "do"
node_class = "binary"
writable = true
"""
CONFIG = """
[workcell]
name = "outputs"
[device.io0]
driver = "modbus-io"
map = "{folder}/block.toml"
line = {{ tcp = "127.0.0.1:{port}" }}
channels = {{ do = 8 }}
safe = {{ do = {safe} }}
{more}
"""
REFUSED = 4
"""Server device failure; what is answered with 6, busy, the driver asks again by itself."""


class Block(threading.Thread):
    """Eight outputs on Modbus TCP, and what can go wrong with them.

    Attributes:
        outputs: that are really on.
        silent: it hears and does nothing.
        refuse: so many writes get an exception and are not carried out.
        lose: so many writes are carried out and not answered.
        writes: what was written, in order.
    """

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.outputs, self.silent, self.refuse, self.lose = 0, False, 0, 0
        self.writes: list[int] = []
        self.slow_s = 0.0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]

    def run(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(connection,), daemon=True).start()

    def end(self) -> None:
        self._listener.close()

    def _serve(self, connection: socket.socket) -> None:
        with connection, suppress(ConnectionError):
            while head := connection.recv(7, socket.MSG_WAITALL):
                number, _, size, unit = unpack(">HHHB", head)
                body = connection.recv(size - 1, socket.MSG_WAITALL)
                time.sleep(self.slow_s)
                reply = None if self.silent else self._answer(body)
                if reply is not None:
                    connection.sendall(pack(">HHHB", number, 0, len(reply) + 1, unit) + reply)

    def _answer(self, body: bytes) -> bytes | None:
        if body[0] == 1:
            return bytes((1, 1, self.outputs))
        if self.refuse:
            self.refuse -= 1
            return bytes((body[0] | 0x80, REFUSED))
        self.outputs = body[6]
        self.writes.append(self.outputs)
        if self.lose:
            self.lose -= 1
            return None
        return body[:5]


class Cell:
    """The block, a daemon, and a client that holds the whole port or single bits of it."""

    def __init__(
        self,
        start: Callable[..., Any],
        folder: Path,
        block: Block,
        safe: int = 0,
        turnaround_s: float = 0.3,
        more: str = "",
    ) -> None:
        self.block, self.socket = block, str(folder / "s")
        (folder / "block.toml").write_text(MAP.format(turnaround_s=turnaround_s))
        config = folder / "cell.toml"
        config.write_text(CONFIG.format(folder=folder, port=block.port, safe=safe, more=more))
        command = [
            sys.executable,
            "-m",
            "sioms.daemon.main",
            "--config",
            str(config),
            "--socket",
            self.socket,
        ]
        self.daemon = start(command)
        self.daemon.wait_line("event=ready", 40.0)
        self.client = sioms.Workcell(self.socket)
        wait_for(self.reads, "io0 up")

    def reads(self) -> bool:
        try:
            with self.client.open("io0.readonly") as node:
                return node.read().data[0] == self.block.outputs
        except OSError:
            return False

    def reads_at_all(self, node: Any) -> bool:
        """Tell whether an open node can be read."""
        try:
            node.read()
        except OSError:
            return False
        return True

    def told(self) -> str:
        return str(self.client.status()["devices"][0])

    def wait_outputs(self, value: int, within_s: float = 5.0) -> None:
        wait_for(lambda: self.block.outputs == value, f"outputs {value:#x}", within_s)


@pytest.fixture
def make(start: Callable[..., Any], short_folder: Path) -> Iterator[Callable[..., Cell]]:
    block = Block()
    block.start()
    yield lambda **given: Cell(start, short_folder, block, **given)
    block.end()


@pytest.mark.parametrize(
    ("trouble", "cause"),
    [("silent", "close"), ("silent for long", "stop"), ("refused", "close"), ("reply lost", "stop")],
)
def test_a_safe_value_is_sent_until_the_device_has_it(make: Callable[..., Cell], trouble: str, cause: str) -> None:
    cell = make()
    block = cell.block
    node = cell.client.open("io0", "rw")
    node.set(0xF0)
    assert block.outputs == 0xF0
    if trouble == "refused":
        block.refuse = 3
    elif trouble == "reply lost":
        block.lose = 3
    else:
        block.silent = True
        time.sleep(0.05)
    if cause == "stop":
        cell.client.emergency_stop()
    else:
        node.close()
    if block.silent:
        time.sleep(0.15 if trouble == "silent" else 2.0)
        assert block.outputs == 0xF0
        block.silent = False
    cell.wait_outputs(0)


def test_what_cannot_be_made_safe_is_told_and_a_stop_does_not_keep_from_trying(
    make: Callable[..., Cell],
) -> None:
    cell = make(safe=1)
    block = cell.block
    cell.wait_outputs(1)
    node = cell.client.open("io0", "rw")
    node.set(0xF0)
    block.refuse = 10**9
    cell.client.emergency_stop()
    wait_for(lambda: "safe outputs not confirmed" in cell.told(), "the state told")
    assert "'link': 'good'" in cell.told()
    began, tries = time.monotonic(), block.refuse
    time.sleep(1.0)
    assert (tries - block.refuse) / (time.monotonic() - began) > 20, "tries a second"
    assert sum("safe outputs not confirmed" in line for line in cell.daemon.lines) <= 3
    with pytest.raises(OSError, match="write its safe value"):
        node.set(0xF1)
    with pytest.raises(OSError, match="exception 4"):
        node.set(1)
    block.refuse = 0
    cell.wait_outputs(1)
    wait_for(lambda: "safe outputs not confirmed" not in cell.told(), "the state gone")
    # nobody may take it away again while the stop lasts
    block.outputs = 0xFF
    cell.wait_outputs(1)
    node.set(1)
    cell.client.reset()
    node.set(0xF0)
    assert block.outputs == 0xF0


def test_the_end_of_the_daemon_makes_outputs_safe_on_a_device_that_refuses(make: Callable[..., Cell]) -> None:
    cell = make()
    node = cell.client.open("io0", "rw")
    node.set(0xF0)
    cell.block.refuse = 5
    cell.daemon.process.kill()
    cell.wait_outputs(0, 2.0)


def test_what_the_device_has_dropped_is_not_brought_back_by_another_bit(make: Callable[..., Cell]) -> None:
    cell = make()
    first, second = cell.client.open("io0.bit7", "rw"), cell.client.open("io0.bit6", "rw")
    first.set(1)
    assert cell.block.outputs == 0x80
    cell.block.outputs = 0  # it has restarted
    wait_for(cell.reads, "the reading")
    second.set(1)
    assert cell.block.outputs == 0x40
    first.set(1)
    assert cell.block.outputs == 0xC0


def test_a_refused_bit_leaves_the_others_as_they_are(make: Callable[..., Cell]) -> None:
    cell = make(safe=0x03)
    cell.wait_outputs(3)
    first, second = cell.client.open("io0.bit7", "rw"), cell.client.open("io0.bit6", "rw")
    first.set(1)
    cell.block.refuse = 1
    with pytest.raises(OSError, match="exception 4"):
        second.set(1)
    second.close()
    time.sleep(0.2)
    assert cell.block.outputs == 0x83
    assert all(value & 0x80 for value in cell.block.writes[cell.block.writes.index(0x83) :])
    first.close()
    cell.wait_outputs(3)


def test_bits_of_two_clients_that_wait_for_the_line_do_not_undo_each_other(make: Callable[..., Cell]) -> None:
    cell = make()
    cell.block.slow_s = 0.003
    failures: list[BaseException] = []

    def toggle(bit: int) -> None:
        try:
            with sioms.Workcell(cell.socket) as own, own.open(f"io0.bit{bit}", "rw") as node:
                for i in range(60):
                    node.set(i & 1)
                    assert cell.block.outputs >> bit & 1 == i & 1
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=toggle, args=(bit,)) for bit in (0, 3, 7)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert not failures, failures[0]
    cell.wait_outputs(0)


# --- a silent unit, and a stop input on it --------------------------------------------------------


def test_a_silent_unit_reads_as_good_for_no_longer_than_its_silence(make: Callable[..., Cell]) -> None:
    """Its time-outs would add up to seconds: what counts is the age of what is read."""
    cell = make(turnaround_s=2.0)
    with cell.client.open("io0.readonly") as node:
        node.read()
        cell.block.silent = True
        began = time.monotonic()
        wait_for(lambda: not cell.reads_at_all(node), "the loss", 2.0)
        took_s = time.monotonic() - began
        assert 0.3 < took_s < 1.0, f"{took_s:.2f} s"
        cell.block.silent = False
        wait_for(lambda: cell.reads_at_all(node), "the link again", 10.0)


SOURCE = '[[emergency_stop]]\nnode = "io0.bit0"\nactive = 1\n'


@pytest.mark.parametrize("on_loss", ["", 'on_loss = "none"\n'])
def test_a_stop_input_that_cannot_be_read_stops_the_workcell(make: Callable[..., Cell], on_loss: str) -> None:
    cell = make(more=SOURCE + on_loss)
    stopped = lambda: cell.client.status()["stopped_ns"]  # noqa: E731
    assert not stopped()
    cell.block.silent = True
    if on_loss:
        wait_for(lambda: "lost" in cell.told(), "the loss")
        time.sleep(0.3)
        assert not stopped()
        return
    wait_for(stopped, "the stop", 1.5)
    assert "input io0.bit0" in cell.client.status()["stop_source"]
    cell.client.reset()
    wait_for(stopped, "the stop again, for it still cannot be read")
    cell.block.silent = False
    wait_for(cell.reads, "the link again", 10.0)
    cell.client.reset()
    time.sleep(0.3)
    assert not stopped()


def test_a_stop_input_whose_driver_dies_stops_the_workcell(make: Callable[..., Cell]) -> None:
    cell = make(more=SOURCE)
    os.kill(cell.client.status()["devices"][0]["pid"], signal.SIGKILL)
    wait_for(lambda: cell.client.status()["stopped_ns"], "the stop")
    assert "input io0.bit0" in cell.client.status()["stop_source"]


def test_a_port_that_accepts_and_closes_is_tried_more_and_more_seldom(start: Any, short_folder: Path) -> None:
    """It was four times a second for ever, with eight lines in the log."""
    listener = socket.create_server(("127.0.0.1", 0))
    accepted: list[float] = []

    def serve() -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            accepted.append(time.monotonic())
            connection.close()

    threading.Thread(target=serve, daemon=True).start()
    (short_folder / "block.toml").write_text(MAP.format(turnaround_s=0.1))
    config = short_folder / "cell.toml"
    config.write_text(CONFIG.format(folder=short_folder, port=listener.getsockname()[1], safe=0, more=""))
    command = ["-m", "sioms.daemon.main", "--config", str(config), "--socket", str(short_folder / "s")]
    daemon = start([sys.executable, *command])
    daemon.wait_line("event=ready", 40.0)
    wait_for(lambda: len(accepted) >= 5, "five attempts", 20.0)
    listener.close()
    pauses = [late - early for early, late in pairwise(accepted)]
    assert pauses[3] > 1.5 and pauses[3] > pauses[1] > pauses[0], pauses
    assert sum("event=link" in line for line in daemon.lines) <= 2 * len(accepted) + 1
