"""Rigs: what each driver is configured as, which counterpart it runs against, and which nodes it then shows.

The one table that the behaviour suites, ``sioms driver check`` and ``sioms bench drivers`` read. A driver that is
not in it names its rig itself, in its class attribute ``rig``: a mapping with the keys of :class:`Rig`.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
    safe: float | None
    other: float | None = None

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
        tables: TOML of its device; ``{port}`` is the counterpart's port; ``{device}`` too, but past any wire that a test
            puts between: for a second connection to the device; ``{data}`` is where it sends datagrams unasked.
        counterpart: module of ``sioms.tools.counterparts`` or path of a Python file, and options; empty for a driver
            that needs none; with ``--link PATH`` left out, as it is added, unless ``tcp``.
        tcp: the counterpart chooses its own TCP or UDP port.
        axes, analogs, inputs, outputs: its nodes.
        name: of the rig where it is not the driver's, as for register maps.
        checked: messages carry a checksum, so that damage can be told from data.
    """

    driver: str
    tables: str
    counterpart: Sequence[str] = ()
    tcp: bool = False
    axes: tuple[Axis, ...] = ()
    analogs: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    outputs: tuple[Output, ...] = ()
    name: str = ""
    checked: bool = True

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
        """What kind of line leads to the counterpart: serial, tcp, udp, or '' for none."""
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
        """Return its tables for a port, for the counterpart's own, and for the one that its data come to."""
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
        raise ValueError(
            f"rig: unknown key {unknown[0]}; one of {', '.join(Rig.__dataclass_fields__)} is right"
        )
    try:
        return msgspec.convert(dict(keys), Rig)
    except msgspec.ValidationError as error:
        raise ValueError(f"rig: {error}") from None


def find_rig(name: str) -> Rig | None:
    """Return the rig of a registered driver or shipped register map, None when there is none."""
    return next((rig for rig in (*RIGS, *MAP_RIGS, *KERNEL_RIGS) if rig.title == name), None)


LIMITS = "position_min = -1.0\nposition_max = 1.0\n"
SERVO = "velocity_max = 1.0\nacceleration_max = 10.0\njerk_max = 2000.0\nforce_max = 100.0\n"
QUICK = "override = { turnaround_s = 0.2 }\n"
"""A simulated block answers at once: what is not answered need not be waited for as long as on a network."""
PATIENT = "turnaround_s = 0.15\n"
"""Where the kernel holds up all real-time processes for 50 ms (sched_rt_runtime_us), that is no fault of the device: of starts during
which a simulated module was held up for 70 ms, 10 of 12 failed with the 50 ms of the manual, none with these."""
DRIVE = "travel_per_turn = 0.01\nvelocity_max = 0.2\nacceleration_max = 2.0\n" + LIMITS

RIGS: tuple[Rig, ...] = (
    Rig(
        "sim-axes",
        '[device.sim_axes]\ndriver = "sim-axes"\nlate_max_s = 0.5\nhistory = 1024\n'
        f'[[device.sim_axes.axis]]\nname = "servo"\n{LIMITS}{SERVO}motor = {{ mass = 1.0, viscous = 2.0, encoder_step = 1e-6 }}\n'
        '[[device.sim_axes.axis]]\nname = "stepper"\nvelocity_max = 0.25\nacceleration_max = 1.0\n' + LIMITS
        + "stepper = { mass = 0.5, step = 2.0e-4, microsteps = 16, hold_force = 40.0, damping_ratio = 0.3 }\n",
        axes=(Axis("sim_axes.servo"), Axis("sim_axes.stepper", tolerance=1e-3)),
        analogs=("sim_axes.plant",),
    ),
    Rig("sim-force", '[device.sim_force]\ndriver = "sim-force"\n', analogs=("sim_force",)),
    Rig("sim-tactile", '[device.sim_tactile]\ndriver = "sim-tactile"\n', analogs=("sim_tactile",)),
    Rig(
        "sim-io",
        '[device.sim_io]\ndriver = "sim-io"\noutputs = 8\ninputs = 8\nsafe = 1\n'
        "loop = [{ bit = 0, output_bit = 0 }, { bit = 7, output_bit = 7 }]\n",
        inputs=("sim_io.in",), outputs=(Output("sim_io", 8, 1),),
    ),
    Rig(
        "modbus-axis",
        '[device.modbus_axis]\ndriver = "modbus-axis"\nmap = "leadshine"\npoll_hz = 50.0\n'
        'line = { serial = "{port}", baud = 115200 }\n'
        f'[[device.modbus_axis.axis]]\nname = "x"\naddress = 1\n{DRIVE}',
        ("leadshine", "--units", "1"),
        axes=(Axis("modbus_axis", velocity=0.02, tolerance=1e-5),),
    ),
    Rig(
        "tmcl",
        f'[device.tmcl]\ndriver = "tmcl"\nmodule = 1140\npoll_hz = 50.0\n{PATIENT}'
        'line = { serial = "{port}", baud = 115200 }\n'
        f'[[device.tmcl.axis]]\nname = "x"\nmotor = 0\nmicrosteps_per_turn = 51200\n{DRIVE.replace("0.2", "0.1")}',
        ("tmcl", "--motors", "1"),
        axes=(Axis("tmcl", velocity=0.02, tolerance=1e-5),),
    ),
    Rig(
        "grbl",
        '[device.grbl]\ndriver = "grbl"\nquick_stop = "cancel"\npoll_hz = 25.0\nline = { serial = "{port}" }\n'
        '[[device.grbl.axis]]\nname = "x"\nletter = "X"\nvelocity_max = 0.1\nacceleration_max = 0.5\n' + LIMITS,
        ("grbl", "--no-homing"),
        axes=(Axis("grbl", velocity=0.02, tolerance=1e-5),), checked=False,
    ),
    Rig(
        "odrive",
        '[device.odrive]\ndriver = "odrive"\nquick_stop = "hold"\nline = { serial = "{port}" }\n'
        '[[device.odrive.axis]]\nname = "x"\nnumber = 0\ntravel_per_turn = 0.01\nvelocity_max = 0.1\n'
        "acceleration_max = 0.3\n" + LIMITS,
        ("odrive", "--friction", "1.0"),
        axes=(Axis("odrive", velocity=0.02, tolerance=3e-4),),
    ),
    Rig(
        "dynamixel",
        f'[device.dynamixel]\ndriver = "dynamixel"\nquick_stop = "hold"\n{PATIENT}'
        'line = { serial = "{port}", baud = 1000000 }\n'
        '[[device.dynamixel.axis]]\nname = "x"\nid = 1\nzero = 2048\ntravel_per_turn = 0.05\n'
        "velocity_max = 0.07\nacceleration_max = 0.5\n" + LIMITS,
        ("dynamixel", "--ids", "1"),
        axes=(Axis("dynamixel", velocity=0.02, tolerance=5e-5),),
    ),
    Rig(
        "framed-adc",
        '[device.framed_adc]\ndriver = "framed-adc"\nchannels = 4\nrate_hz = 200\nscale = 0.0005\nunit = "N"\n'
        'line = { serial = "{port}", baud = 921600 }\n',
        ("adc", "--channels", "4", "--columns", "2"),
        analogs=("framed_adc",),
    ),
    Rig(
        "ascii-stream",
        '[device.ascii_stream]\ndriver = "ascii-stream"\nline = { serial = "{port}" }\ncolumns = ["a", "b"]\n'
        'rate_hz = 200.0\ntime = "ms"\nunit = "N"\nchecksum = true\n',
        ("ascii_stream", "--rate", "200", "--time", "ms", "--checksum"),
        analogs=("ascii_stream",),
    ),
    Rig(
        "iio",
        '[device.iio]\ndriver = "iio"\ndevice = "iio_dummy_part_no"\nmode = "buffer"\ntrigger = "instance1"\n'
        'channels = ["voltage0", "accel_x"]\nrate_hz = 200.0\nsysfs = "{port}/sysfs"\ndev = "{port}/dev"\n',
        ("iio",), analogs=("iio",), checked=False,
    ),
    Rig(
        "ft300",
        '[device.ft300]\ndriver = "ft300"\nline = { serial = "{port}", baud = 19200 }\n',
        ("ft300", "--baud", "19200"),
        analogs=("ft300",),
    ),
    Rig(
        "ati-rdt",
        '[device.ati_rdt]\ndriver = "ati-rdt"\nrate_hz = 1000\nfull_scale = [400, 400, 400, 20, 20, 20]\n'
        'line = { udp = "{port}" }\npage = "{device}"\n',
        ("ati_rdt", "--port", "0"), tcp=True,
        analogs=("ati_rdt",), checked=False,
    ),
    Rig(
        "schunk-ft",
        '[device.schunk_ft]\ndriver = "schunk-ft"\nfull_scale = [400, 400, 400, 15, 15, 15]\n'
        'line = { tcp = "{port}" }\ndata = "{data}"\n',
        ("schunk_ifb", "--port", "0", "--data-port", "0"), tcp=True,
        analogs=("schunk_ft",), checked=False,
    ),
    Rig(
        "modbus-io",
        '[device.modbus_io]\ndriver = "modbus-io"\nmap = "moxa_e1200"\nmodel = "E1212"\nsafe = { do = 0 }\n'
        + QUICK + 'line = { tcp = "{port}" }\n',
        ("moxa", "--model", "E1212"), tcp=True,
        inputs=("modbus_io",), outputs=(Output("modbus_io.do", 8, 0),),
    ),
)  # fmt: skip

MAP_RIGS: tuple[Rig, ...] = (
    Rig(
        "modbus-axis",
        '[device.leadshine]\ndriver = "modbus-axis"\nmap = "leadshine"\npoll_hz = 40.0\n'
        'line = { serial = "{port}", baud = 115200 }\n'
        f'[[device.leadshine.axis]]\nname = "x"\naddress = 1\nhoming = true\nvelocity_by = "path"\n{DRIVE}',
        ("leadshine", "--units", "1"),
        axes=(Axis("leadshine", velocity=0.02, tolerance=1e-5),), name="leadshine",
    ),
    Rig(
        "modbus-axis",
        '[device.oriental_az]\ndriver = "modbus-axis"\nmap = "oriental_az"\npoll_hz = 20.0\n'
        'line = { serial = "{port}", baud = 230400, parity = "E" }\n'
        f'[[device.oriental_az.axis]]\nname = "x"\naddress = 1\nhoming = true\n{DRIVE}',
        ("oriental_az", "--units", "1", "--communication-timeout-s", "0.5"),
        axes=(Axis("oriental_az", velocity=0.02, tolerance=1e-5),), name="oriental_az",
    ),
    Rig(
        "modbus-io",
        '[device.moxa_e1200]\ndriver = "modbus-io"\nmap = "moxa_e1200"\nmodel = "E1212"\nsafe = { do = 0 }\n'
        + QUICK + 'line = { tcp = "{port}" }\n',
        ("moxa", "--model", "E1212", "--watchdog-s", "1.0"), tcp=True,
        inputs=("moxa_e1200",), outputs=(Output("moxa_e1200.do", 8, 0),), name="moxa_e1200",
    ),
    Rig(
        "modbus-io",
        '[device.wago_750]\ndriver = "modbus-io"\nmap = "wago_750"\nchannels = { di = 8, do = 8, ai = 2, ao = 2 }\n'
        'safe = { do = 0, ao = 0 }\nmain = "di"\nwatchdog_s = 0.5\n' + QUICK + 'line = { tcp = "{port}" }\n',
        ("wago", "--inputs", "8", "--outputs", "8", "--analogs", "2"), tcp=True,
        inputs=("wago_750",), outputs=(Output("wago_750.do", 8, 0), Output("wago_750.ao", 0, 0, 5.0)), analogs=("wago_750.ai",), name="wago_750",
    ),
)  # fmt: skip

KERNEL_RIGS: tuple[Rig, ...] = (
    Rig(
        "gpio",
        '[device.gpio]\ndriver = "gpio"\nchip = "{port}"\ntick_hz = 100.0\n'
        + "".join(f"[[device.gpio.output]]\nline = {i}\nsafe = {i % 2}\n" for i in range(4))
        + "".join(f"[[device.gpio.input]]\nline = {4 + i}\n" for i in range(4)),
        ("gpio_sim",), inputs=("gpio.in",), outputs=(Output("gpio", 4, 0b1010),), checked=False,
    ),
    Rig(
        "iio",
        '[device.iio_dummy]\ndriver = "iio"\ndevice = "sioms_dummy"\nmode = "buffer"\ntrigger = "sioms_timer"\n'
        'channels = ["voltage0", "accel_x"]\nrate_hz = 50.0\n',
        ("iio_dummy",), analogs=("iio_dummy",), name="iio-dummy", checked=False,
    ),
)  # fmt: skip
"""Rigs whose device the kernel simulates, where it does: not among all, but found by name."""
