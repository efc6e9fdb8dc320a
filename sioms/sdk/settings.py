"""Settings that many drivers share: the line to the device.

All are msgspec structs that forbid unknown keys, so that a key nobody reads is an error.
"""

from __future__ import annotations

from typing import Literal

import msgspec


class LineSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The line to a device; the key that names it tells the kind.

    ``line = { serial = "/dev/ttyUSB0", baud = 115200, parity = "N" }``,
    ``line = { tcp = "192.168.0.20:502" }`` or
    ``line = { udp = "192.168.1.1:49152" }``. ``local`` is the address on this side, where it matters; with it the port
    of ``udp`` may be 0, which listens to any port of that host. ``path`` is a device file that only sends; drivers of
    the kernel's own interfaces give it, not the configuration.
    """

    serial: str | None = None
    baud: int = 115200
    parity: Literal["N", "E", "O"] = "N"
    stop_bits: Literal[1, 2] = 1
    tcp: str | None = None
    udp: str | None = None
    path: str | None = None
    local: str = ""
    connect_timeout_s: float = 1.0

    def __post_init__(self) -> None:
        named = [key for key in ("serial", "tcp", "udp", "path") if getattr(self, key) is not None]
        if len(named) != 1:
            raise ValueError(f"line names {', '.join(named) or 'nothing'}; want exactly one of serial, tcp, udp")
        if not 300 <= self.baud <= 12_000_000:
            raise ValueError(f"baud = {self.baud}; want 300 to 12000000")
        if self.local:
            _check_address("local", self.local, lowest=0)
        if self.tcp is not None:
            _check_address("tcp", self.tcp)
        if self.udp is not None:
            _check_address("udp", self.udp, lowest=0 if self.local else 1)

    @property
    def bits_per_character(self) -> int:
        """Bits a character takes on a serial line: start, eight data, parity, stop."""
        return 9 + (self.parity != "N") + self.stop_bits

    @property
    def speed(self) -> str:
        """Speed and format of a serial line in words, e.g. ``115200 baud, 8N1``."""
        return f"{self.baud} baud, 8{self.parity}{self.stop_bits}"

    def __str__(self) -> str:
        return self.serial or self.tcp or self.udp or self.path or "?"


def _check_address(key: str, value: str, lowest: int = 1) -> None:
    """Raise ValueError when a key does not name a host and a port from ``lowest`` on."""
    host, _, port = value.rpartition(":")
    if not host or not port.isdigit() or not lowest <= int(port) < 65536:
        raise ValueError(f'{key} = "{value}"; want "host:port" with a port from {lowest} to 65535')
