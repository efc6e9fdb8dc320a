"""A GPIO chip simulated by the kernel: ``python -m sioms.drivers.gpio.simulator --link PATH`` makes one, PATH leads to
it.

The chip is the kernel's own (gpio-sim, set up in configfs by root), so that what holds of the character device holds
here: who holds a line, edges and their stamps, bias, debouncing, a chip that vanishes. Where there is no such kernel,
one is started by ``tests/kernel/run.py``. Commands on standard input: ``pull LINE 0|1`` (what is outside of an input),
``level LINE``, ``unplug``, ``plug``, ``power_cycle [SECONDS]`` (of a chip on USB: gone, then anew), ``state``.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import sys
from pathlib import Path

from sioms.simulation.control import serve

CONFIGFS = Path("/sys/kernel/config/gpio-sim")
PLATFORM = Path("/sys/devices/platform")
WORDS = ("pull-down", "pull-up")


class SimulatedChip:
    """A chip of gpio-sim.

    Args:
        names: of its lines; '' for one without.

    Raises:
        OSError: this kernel has no gpio-sim, or we are not allowed to.

    Attributes:
        path: of its character device; another one after it was plugged again.

    Concurrency: one thread.
    """

    def __init__(self, names: list[str]) -> None:
        self._folder = CONFIGFS / f"sioms{os.getpid()}"
        self._bank = self._folder / "bank0"
        self._bank.mkdir(parents=True)
        (self._bank / "num_lines").write_text(str(len(names)))
        for line, name in enumerate(names):
            if name:
                (self._bank / f"line{line}").mkdir()
                (self._bank / f"line{line}" / "name").write_text(name)
        self.count = len(names)
        self.path = Path()
        self.plug()

    def plug(self) -> None:
        """Make the chip appear; nothing when it is there."""
        if self._read("live") == "0":
            (self._folder / "live").write_text("1")
        chip = (self._bank / "chip_name").read_text().strip()
        self.path = Path("/dev") / chip
        self._lines = PLATFORM / self._read("dev_name") / chip

    def unplug(self) -> None:
        """Make the chip vanish, whoever holds its lines."""
        if self._read("live") == "1":
            (self._folder / "live").write_text("0")

    def pull(self, line: int, level: int) -> None:
        """Set what is outside of an input line; an output drives against it and wins."""
        (self._lines / f"sim_gpio{line}" / "pull").write_text(WORDS[level])

    def pulled(self, line: int) -> int:
        """Return what pulls a line: from outside, or its own resistor, whatever came last."""
        return WORDS.index((self._lines / f"sim_gpio{line}" / "pull").read_text().strip())

    def level(self, line: int) -> int:
        """Return the level of a line."""
        return int((self._lines / f"sim_gpio{line}" / "value").read_text())

    def remove(self) -> None:
        """Take the chip out of the kernel."""
        self.unplug()
        for inner in (*self._bank.glob("line*"), self._bank, self._folder):
            inner.rmdir()

    def _read(self, name: str) -> str:
        return (self._folder / name).read_text().strip()


async def run() -> None:
    """Serve until told to end."""
    parser = argparse.ArgumentParser(description="GPIO chip simulated by the kernel")
    parser.add_argument("--link", type=Path, required=True, help="made to lead to the chip's device")
    parser.add_argument("--names", default=",,,,,,,", help="of the lines, by commas (%(default)r: eight without)")
    options = parser.parse_args()
    try:
        chip = SimulatedChip(options.names.split(","))
    except OSError as error:
        sys.exit(f"make a chip in {CONFIGFS}: {error.strerror}; want root on a kernel with gpio-sim")

    def plug() -> None:
        chip.plug()
        options.link.unlink(missing_ok=True)
        options.link.symlink_to(chip.path)

    def power_cycle(off_s: str = "0.2") -> None:
        chip.unplug()
        asyncio.get_running_loop().call_later(float(off_s), plug)

    async def close() -> None:
        chip.remove()
        with contextlib.suppress(OSError):
            options.link.unlink()

    plug()
    await serve(
        str(options.link),
        {
            "pull": lambda line, level: chip.pull(int(line), int(level)),
            "level": lambda line: chip.level(int(line)),
            "unplug": chip.unplug,
            "plug": plug,
            "power_cycle": power_cycle,
            "state": lambda: {"levels": list(map(chip.level, range(chip.count)))},
        },
        close,
    )


if __name__ == "__main__":
    asyncio.run(run())
