"""Rigs: what each driver is configured as, which simulator it runs against, and which nodes it then has.

A family of drivers has its rigs in the file ``rig.toml`` of its folder; the behaviour suites, ``sioms driver check``
and ``sioms bench drivers`` read them. A driver from elsewhere names its rig in its class attribute ``rig``: a mapping
with the keys of :class:`Rig`.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import msgspec

LINES = ("serial", "tcp", "udp")


@dataclass(frozen=True)
class Axis:
    """An axis node of a rig.

    Attributes:
        node: its name; a node of one axis.
        reach: how far it is moved [unit].
        velocity: within its limits [unit/s].
        tolerance: of a position that was reached [unit].
        beyond: a position outside of its soft limits, None when it has none.
    """

    node: str
    reach: float = 0.02
    velocity: float = 0.1
    tolerance: float = 2e-3
    beyond: float | None = 5.0


@dataclass(frozen=True)
class Output:
    """A writable node.

    Attributes:
        node: its name.
        width: bits of its one port, 0 for an analog node.
        safe: its safe value, in all channels; None: it keeps the last.
        other: another value that it takes; found out for bits.
    """

    node: str
    width: int
    safe: int | float | None  # an integer of a port stays one
    other: int | float | None = None

    @property
    def another(self) -> float:
        """A value other than the safe one."""
        if self.other is not None:
            return self.other
        return 0b10 if self.safe != 0b10 else 0b01

    def shown(self, node: Any, value: float) -> bool:
        """Tell whether an opened node reads a value in its first channel."""
        return bool(abs(node.read().data[0] - value) <= (0 if self.width else 1e-3 * max(1.0, abs(value))))


@dataclass(frozen=True)
class Rig:
    """A driver at work.

    Attributes:
        driver: registered name, or the path of a file.
        tables: TOML of its device; ``{port}`` is the simulator's port; ``{device}`` too, but past any wire that a test
            puts between: for a second connection to the device; ``{data}`` is where it sends datagrams unasked.
        simulator: module or path of a Python file, and options; empty for a driver that needs none; with ``--link
            PATH`` left out, as it is added, unless ``tcp``.
        tcp: the simulator chooses its own TCP or UDP port.
        axes, analogs, inputs, outputs: its nodes.
        name: of the rig where it is not the driver's, as for register maps.
        checked: messages carry a checksum, so that damage can be told from data.
        kernel: where a kernel that simulates the device has it made, '' where a program simulates it. Not every kernel
            does: it is not among all, but found by name.
    """

    driver: str
    tables: str
    simulator: Sequence[str] = ()
    tcp: bool = False
    axes: tuple[Axis, ...] = ()
    analogs: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    outputs: tuple[Output, ...] = ()
    name: str = ""
    checked: bool = True
    kernel: str = ""

    @property
    def title(self) -> str:
        """What it is called."""
        return self.name or self.driver

    @property
    def device(self) -> str:
        """Name of its device in the workcell: that of the first table."""
        found = re.search(r"^\s*\[device\.([\w-]+)\]", self.tables, re.MULTILINE)
        return found.group(1) if found else self.driver.replace("-", "_")

    @property
    def nodes(self) -> list[str]:
        """One node of each block that the suite looks at."""
        names = [axis.node for axis in self.axes] + [output.node for output in self.outputs]
        return [*names, *self.analogs, *self.inputs]

    @property
    def line(self) -> str:
        """What kind of line leads to the simulator: serial, tcp, udp, or '' for none."""
        found = re.search(rf'\b({"|".join(LINES)})\s*=\s*"\{{port\}}"', self.tables)
        return found.group(1) if found else ""

    @property
    def pushes(self) -> bool:
        """Whether the device sends datagrams to a port of the host, beside the line on which it is told to."""
        return "{data}" in self.tables

    @property
    def table(self) -> dict[str, Any]:
        """The device's table, without what the daemon reads of it, its port a place holder."""
        port = "127.0.0.1:1" if self.line in ("tcp", "udp") else "/dev/null"
        device = tomllib.loads(self.configured(port, "127.0.0.1:1"))["device"][self.device]
        return {key: value for key, value in device.items() if key != "driver"}

    def configured(self, port: str, device: str, data: str = "") -> str:
        """Return its tables for a port, for the simulator's own, and for the one that its data come to."""
        text = self.tables.replace("{port}", port).replace("{device}", device)
        return text.replace("{data}", data or device)

    def setting(self, key: str, default: float) -> float:
        """Return a number of the tables, e.g. ``baud`` or ``poll_hz``."""
        found = re.search(rf"\b{key}\s*=\s*([0-9.eE+]+)", self.tables)
        return float(found.group(1)) if found else default

    @property
    def bits_per_character(self) -> int:
        """Bits of a character on its serial line."""
        parity = re.search(r'\bparity\s*=\s*"[EO]"', self.tables) is not None
        return 9 + parity + int(self.setting("stop_bits", 1))


def rig_of(keys: Mapping[str, Any]) -> Rig:
    """Return the rig that a driver's attribute ``rig`` describes.

    Raises:
        ValueError: an unknown key or a wrong value, with a sentence.
    """
    unknown = sorted(set(keys) - set(Rig.__dataclass_fields__))
    if unknown:
        raise ValueError(f"rig: unknown key {unknown[0]}; want one of {', '.join(Rig.__dataclass_fields__)}")
    try:
        return msgspec.convert(dict(keys), Rig)
    except msgspec.ValidationError as error:
        raise ValueError(f"rig: {error}") from None


def find_rig(name: str) -> Rig | None:
    """Return the rig of a registered driver or shipped register map, None when there is none."""
    return next((rig for rig in SHIPPED if rig.title == name), None)


def _shipped() -> tuple[Rig, ...]:
    """Return the rigs of the families under ``sioms.drivers``, from the file ``rig.toml`` of each."""
    families = sorted(files("sioms.drivers").iterdir(), key=lambda each: each.name)
    documents = [each / "rig.toml" for each in families if each.is_dir()]
    tables = [tomllib.loads(each.read_text("utf-8")) for each in documents if each.is_file()]
    return tuple(rig_of(keys) for table in tables for keys in table["rig"])


SHIPPED = _shipped()
RIGS = tuple(rig for rig in SHIPPED if not rig.name and not rig.kernel)
"""One for each driver whose device is simulated by a program."""
MAP_RIGS = tuple(rig for rig in SHIPPED if rig.name and not rig.kernel)
"""Of the register maps."""
