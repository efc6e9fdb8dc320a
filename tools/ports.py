"""What is plugged into this machine, and which drivers it may be for: serial ports, GPIO chips, IIO devices."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

ADAPTER = ("modbus-axis", "modbus-io", "dynamixel", "tmcl", "ft300", "grbl", "ascii-stream")
IDENTITIES: dict[tuple[int, int | None], tuple[str, ...]] = {
    (0x1209, 0x0D32): ("odrive",),  # pid.codes: ODrive v3
    (0x2A3C, None): ("tmcl",),  # Trinamic
    (0x0403, 0x6014): ("dynamixel", *ADAPTER),  # FT232H, also in ROBOTIS' U2D2
    (0x2341, None): ("grbl", "ascii-stream", "framed-adc"),  # Arduino
    (0x2E8A, None): ("ascii-stream", "framed-adc", "grbl"),  # Raspberry Pi's microcontrollers
    (0x1A86, 0x7523): ("grbl", "modbus-axis", "ascii-stream"),  # CH340: boards and cheap RS-485 adapters
}
"""Vendor and product of a USB device (None: any), and the drivers that it may be for, the likeliest first."""


@dataclass(frozen=True, slots=True)
class Port:
    """Something that a driver may open.

    Attributes:
        path: name that lasts, where there is one, else that of the device file.
        text: what it says it is.
        drivers: that it may be for, the likeliest first.
        sure: whether its identity leaves no other.
    """

    path: str
    text: str
    drivers: tuple[str, ...]
    sure: bool = False


def candidates(vendor: int | None, product: int | None) -> tuple[str, ...]:
    """Return the drivers that a USB serial device may be for.

    Example:
        >>> candidates(0x1209, 0x0D32)
        ('odrive',)
    """
    if vendor is None:
        return ADAPTER
    return IDENTITIES.get((vendor, product)) or IDENTITIES.get((vendor, None)) or ADAPTER


def found(root: Path = Path("/")) -> list[Port]:
    """Return what is plugged in.

    Args:
        root: where /dev and /sys are looked for.
    """
    return [*_serial(root), *_gpio(root), *_iio(root)]


def _serial(root: Path) -> list[Port]:
    from serial.tools import list_ports

    ports = []
    names = {path.resolve(): path for path in sorted(root.glob("dev/serial/by-id/*"))}
    for one in sorted(list_ports.comports() if root == Path("/") else [], key=lambda one: one.device):
        if one.vid is None:
            continue  # a board's own UART: every PC shows some that lead nowhere
        drivers = candidates(one.vid, one.pid)
        what = " ".join(filter(None, (one.manufacturer, one.product))) or one.description or "serial port"
        text = f"{what}, USB {one.vid:04x}:{one.pid:04x}" + (
            f", serial number {one.serial_number}" if one.serial_number else ""
        )
        path = str(names.get(Path(one.device).resolve(), one.device))
        ports.append(Port(path, text, drivers, len(drivers) == 1))
    return ports


def _gpio(root: Path) -> list[Port]:
    chips = sorted(root.glob("dev/gpiochip*"))
    return [Port(f"/dev/{chip.name}", "lines of a GPIO chip", ("gpio",)) for chip in chips]


def _iio(root: Path) -> list[Port]:
    ports = []
    for folder in sorted(root.glob("sys/bus/iio/devices/iio:device*")):
        name = _word(folder / "name")
        if name:
            ports.append(Port(name, f"{folder.name} of Linux IIO", ("iio",)))
    return ports


def _word(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""


def stanza(example: str, port: Port | None, device: str) -> str:
    """Return the example of a driver's page as a device of a configuration.

    Args:
        example: TOML with one ``[device.NAME]``.
        port: put in the place of the example's; None keeps that.
        device: name of the device.

    Example:
        >>> example = '[device.a]\\ndriver = "x"\\nline = { serial = "/dev/ttyUSB0", baud = 9600 }'
        >>> stanza(example, Port("/dev/p", "", ()), "b")
        '[device.b]\\ndriver = "x"\\nline = { serial = "/dev/p", baud = 9600 }'
    """
    lines: Sequence[str] = example.splitlines()
    first = next(line for line in lines if line.startswith("[device."))
    old = first.removeprefix("[device.").rstrip("] ")
    lines = [line.replace(f"[device.{old}", f"[device.{device}") if line.startswith("[") else line for line in lines]
    if port is not None:
        lines = [_with_port(line, port) for line in lines]
    return "\n".join(lines)


def _with_port(line: str, port: Port) -> str:
    """Put a port in the place of the one that a line of an example names, if it names one."""
    if line.startswith("line = "):
        if port.path.startswith("/"):
            return _replaced(r'\b(serial|path) = "[^"]*"', lambda found: f'{found[1]} = "{port.path}"', line)
        network = _replaced(r'\b(tcp|udp) = "[^"]*"', lambda found: f'{found[1]} = "{port.path}"', line)
        return network if network != line else f'line = {{ tcp = "{port.path}" }}'
    if line.startswith("chip = "):
        return f'chip = "{port.path}"'
    if port.drivers == ("iio",) and line.startswith("device = "):
        return f'device = "{port.path}"'
    return line


def _replaced(pattern: str, by: Callable[[re.Match[str]], str], line: str) -> str:
    return re.sub(pattern, by, line, count=1)
