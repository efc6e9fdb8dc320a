"""Rigs of all registered drivers: what each is configured as and run against, and which nodes it then shows.

A new driver gets a line in RIGS; the suites under tests/devices run for it without any further word.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from conftest import Running
from daemon_rig import Daemon, daemons


@dataclass(frozen=True)
class Axis:
    """An axis node of a rig.

    Attributes:
        node: its name; a node of one axis.
        reach: how far the suite moves it [unit].
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
    """A writable binary node of one port: its width, and its safe value (None: it keeps the last)."""

    node: str
    width: int
    safe: int | None


@dataclass(frozen=True)
class Rig:
    """A driver at work.

    Attributes:
        driver: registered name.
        tables: TOML of its device; ``{port}`` is the counterpart's port.
        counterpart: module and options, empty for a driver that needs none; with "--link" left out, as the
            suite adds it, unless ``tcp``.
        axes, analogs, inputs, outputs: its nodes.
    """

    driver: str
    tables: str
    counterpart: Sequence[str] = ()
    tcp: bool = False
    axes: tuple[Axis, ...] = ()
    analogs: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    outputs: tuple[Output, ...] = field(default=())

    @property
    def device(self) -> str:
        """Name of the device in the suite's workcell."""
        return self.driver.replace("-", "_")

    @property
    def nodes(self) -> list[str]:
        """One node of each block that the suite looks at."""
        names = [axis.node for axis in self.axes] + [output.node for output in self.outputs]
        return [*names, *self.analogs, *self.inputs]


LIMITS = "position_min = -1.0\nposition_max = 1.0\n"
SERVO = "velocity_max = 1.0\nacceleration_max = 10.0\njerk_max = 2000.0\nforce_max = 100.0\n"
DRIVE = "travel_per_turn = 0.01\nvelocity_max = 0.2\nacceleration_max = 2.0\n" + LIMITS

RIGS = (
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
        '[device.tmcl]\ndriver = "tmcl"\nmodule = 1140\npoll_hz = 50.0\n'
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
        axes=(Axis("grbl", velocity=0.02, tolerance=1e-5),),
    ),
    Rig(
        "odrive",
        '[device.odrive]\ndriver = "odrive"\nquick_stop = "hold"\nline = { serial = "{port}" }\n'
        '[[device.odrive.axis]]\nname = "x"\nnumber = 0\ntravel_per_turn = 0.01\nvelocity_max = 0.1\n'
        "acceleration_max = 0.3\n" + LIMITS,
        ("odrive",),
        axes=(Axis("odrive", velocity=0.02, tolerance=3e-4),),
    ),
    Rig(
        "dynamixel",
        '[device.dynamixel]\ndriver = "dynamixel"\nquick_stop = "hold"\nline = { serial = "{port}", baud = 1000000 }\n'
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
        "modbus-io",
        '[device.modbus_io]\ndriver = "modbus-io"\nmap = "moxa_e1200"\nmodel = "E1212"\nsafe = { do = 0 }\n'
        'line = { tcp = "{port}" }\n',
        ("moxa", "--model", "E1212"), tcp=True,
        inputs=("modbus_io",), outputs=(Output("modbus_io.do", 8, 0),),
    ),
)  # fmt: skip


@contextmanager
def everything() -> Iterator[Daemon]:
    """Run all rigs in one workcell, each driver up and its link good."""
    with ExitStack() as stack:
        start = stack.enter_context(daemons())
        counterparts: dict[str, Running] = {}
        folder = Path(stack.enter_context(_folder()))
        for rig in RIGS:  # all start at the same time
            if rig.counterpart:
                name, *options = rig.counterpart
                link = [] if rig.tcp else ["--link", str(folder / rig.device)]
                command = [sys.executable, "-m", f"sioms.tools.counterparts.{name}", *link, *options]
                counterparts[rig.device] = Running(command, {}, None)
                stack.callback(counterparts[rig.device].end)
        text = '[workcell]\nname = "all"\n'
        for rig in RIGS:
            port = ""
            if rig.counterpart:
                port = counterparts[rig.device].wait_line(r"^ready (\S+)$").group(1)
            text += rig.tables.replace("{port}", port)
        daemon = start(text)
        for rig in RIGS:
            daemon.wait_up(rig.device)
        yield daemon


@contextmanager
def _folder() -> Iterator[str]:
    folder = tempfile.mkdtemp(prefix="sioms-", dir="/tmp")
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
