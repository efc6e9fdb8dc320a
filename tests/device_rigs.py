"""Rigs of all registered drivers: what each is configured as and run against, and which nodes it then shows.

A new driver gets a line in RIGS; the suites under tests/devices run for it without any further word.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from conftest import Running
from daemon_rig import Daemon, daemons

from sioms.check.rigs import RIGS as SHIPPED
from sioms.check.rigs import Axis, Output, Rig

__all__ = ["GROUPS", "RIGS", "Axis", "Output", "Rig", "at_work", "group_of"]

LIMITS = "position_min = -1.0\nposition_max = 1.0\n"

GPIO = Path(__file__).with_name("fake_gpio.py")

# Rigs of the shipped drivers stand in sioms.check.rigs; that of the GPIO lines on a kernel without simulated ones here.
RIGS = (
    *SHIPPED,
    Rig(
        str(GPIO),
        f'[device.gpio]\ndriver = "{GPIO}"\nchip = "/dev/gpiochip0"\n'
        + "".join(f"[[device.gpio.output]]\nline = {i}\nsafe = {i % 2}\n" for i in range(4))
        + "".join(f"[[device.gpio.input]]\nline = {8 + i}\n" for i in range(4)),
        inputs=("gpio.in",), outputs=(Output("gpio", 4, 0b1010),), name="gpio",
    ),
)  # fmt: skip


TOGETHER = 4
"""Devices of one workcell: all at once would keep the processors of a small machine busy by themselves."""
GROUPS = tuple(RIGS[i : i + TOGETHER] for i in range(0, len(RIGS), TOGETHER))


def group_of(what: object) -> int | None:
    """Return the number of the group that holds a rig, an axis, an output or a node; None when none does."""
    name = what.device if isinstance(what, Rig) else what.node if isinstance(what, Axis | Output) else what
    if not isinstance(name, str):
        return None
    device = name.split(".")[0]
    return next((i for i, group in enumerate(GROUPS) if any(rig.device == device for rig in group)), None)


@contextmanager
def at_work(rigs: Sequence[Rig]) -> Iterator[Daemon]:
    """Run some rigs in one workcell, each driver up and its link good."""
    with ExitStack() as stack:
        start = stack.enter_context(daemons())
        simulators: dict[str, Running] = {}
        folder = Path(stack.enter_context(_folder()))
        for rig in rigs:  # all start at the same time
            if rig.simulator:
                name, *options = rig.simulator
                link = [] if rig.tcp else ["--link", str(folder / rig.device)]
                command = [sys.executable, "-m", name, *link, *options]
                simulators[rig.device] = Running(command, {}, None)
                stack.callback(simulators[rig.device].end)
        text = '[workcell]\nname = "all"\n'
        for rig in rigs:
            port = ""
            if rig.simulator:
                port = simulators[rig.device].wait_line(r"^ready (\S+)$").group(1)
            text += rig.configured(port, port)
        daemon = start(text)
        for rig in rigs:
            daemon.wait_up(rig.device)
        yield daemon


@contextmanager
def _folder() -> Iterator[str]:
    folder = tempfile.mkdtemp(prefix="sioms-", dir="/tmp")
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
