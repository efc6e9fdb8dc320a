"""The simulated Modbus devices against mbpoll, a master of other authors (libmodbus), on a serial line and on TCP."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from daemon_rig import wait_for
from wire_rig import Wire

MBPOLL = shutil.which("mbpoll")
pytestmark = pytest.mark.skipif(MBPOLL is None, reason="no mbpoll here; Debian and Ubuntu have the package mbpoll")


def ask(where: list[str], table: str, address: int, count: int = 1, *values: int) -> list[int]:
    """Read, or write with values; return what was read.

    Args:
        where: options of the line and, last, its port.
        table: mbpoll's type: 0 coils, 1 discrete inputs, 3 input registers, 4 holding registers, with ``:int`` of 32
            bits.
        address: as on the wire.
    """
    *options, port = where
    numbers = ["--", *map(str, values)] if values else []
    what = ["-0", "-1", "-o", "1", "-t", table, "-r", str(address)] + ([] if values else ["-c", str(count)])
    command = [MBPOLL or "", *options, *what, port, *numbers]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20)
    assert done.returncode == 0, done.stdout + done.stderr
    return [int(number) for number in re.findall(r"^\[\d+\]:\s+(-?\d+)", done.stdout, re.MULTILINE)]


def test_the_leadshine(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Wire(start, short_folder, "modbus.simulated.leadshine", "--units", "7")
    where = ["-m", "rtu", "-a", "7", "-b", "115200", "-P", "none", "-B", wire.port]
    assert ask(where, "4", 0x0001) == [10000]
    ask(where, "4", 0x6200, 1, 1, 0, 5000, 300, 20, 20, 0, 0x10)
    wait_for(lambda: ask(where, "4", 0x1003) == [0x32], "the path complete")
    assert ask(where, "4:int", 0x602C) == [5000] == [round(wire.state("position", 7))]
    ask(where, "4", 0x6200, 1, 0x41, 0xFFFF, 0x10000 - 5000, 300, 20, 20, 0, 0x10)
    wait_for(lambda: ask(where, "4:int", 0x1014) == [0], "the way back")


def test_the_oriental(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Wire(start, short_folder, "modbus.simulated.oriental_az")
    where = ["-m", "rtu", "-a", "1", "-b", "115200", "-P", "even", "-B", wire.port]
    ask(where, "4", 0x0058, 1, 0, 0, 0, 1, 0, 2000, 0, 8000, 0, 60000, 0, 60000, 0, 1000, 0, 1)
    wait_for(lambda: ask(where, "4:int", 0x00CC) == [2000], "the position")
    assert ask(where, "4:int", 0x0080) == [0] and ask(where, "4:int", 0x007E) == [1 << 5 | 1 << 14]


def test_the_moxa(start: Callable[..., Any], short_folder: Path) -> None:
    wire = Wire(start, short_folder, "modbus.simulated.moxa", "--model", "E1212", "--port", "0")
    host, _, port = wire.port.partition(":")
    where = ["-m", "tcp", "-a", "1", "-p", port, host]
    wire.tell("loop on")
    ask(where, "0", 0, 1, 1, 0, 1, 1, 0, 0, 0, 1)
    assert ask(where, "0", 0, 8) == [1, 0, 1, 1, 0, 0, 0, 1] == ask(where, "1", 0, 8) == wire.tell("state")["do"]
    words = ask(where, "3", 5000, 3)
    assert b"".join(word.to_bytes(2, "big") for word in words) == b"E1212\0"
