"""The kernel's dummy IIO device: ``python -m sioms.drivers.iio.kernel_dummy --link PATH`` makes it, with a trigger of a
rate.

Device and trigger are the kernel's own (iio_simple_dummy and a timer of hrtimer, set up in configfs by root), with its
attributes, its buffer and its refusals; the readings are fixed numbers. Where there is no such kernel, one is started
by ``tests/kernel/run.py``. Their names are ``sioms_dummy`` and ``sioms_timer``; PATH is only what is told as the port.
Commands on standard input: ``unplug``, ``plug``.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import sys
from pathlib import Path

from sioms.simulation.control import serve

CONFIGFS = Path("/sys/kernel/config/iio")
NAME = "sioms_dummy"
TRIGGER = "sioms_timer"


class DummyDevice:
    """Device and trigger in configfs.

    Raises:
        OSError: this kernel has none, or we are not allowed to.

    Concurrency: one thread.
    """

    def __init__(self) -> None:
        self._device = CONFIGFS / "devices" / "dummy" / NAME
        self._trigger = CONFIGFS / "triggers" / "hrtimer" / TRIGGER
        self._trigger.mkdir()
        self._device.mkdir()

    def plug(self) -> None:
        """Make the device appear; nothing when it is there."""
        self._device.mkdir(exist_ok=True)

    def unplug(self) -> None:
        """Make the device vanish, whoever reads it."""
        with contextlib.suppress(FileNotFoundError):
            self._device.rmdir()

    def remove(self) -> None:
        """Take device and trigger out of the kernel."""
        self.unplug()
        self._trigger.rmdir()


async def run() -> None:
    """Serve until told to end."""
    parser = argparse.ArgumentParser(description="dummy IIO device of the kernel")
    parser.add_argument("--link", required=True, help="told as the port; nothing is made there")
    options = parser.parse_args()
    try:
        device = DummyDevice()
    except OSError as error:
        sys.exit(
            f"make a device in {CONFIGFS}: {error.strerror}; want root on a kernel with iio_dummy and iio-trig-hrtimer"
        )

    async def close() -> None:
        device.remove()

    await serve(options.link, {"unplug": device.unplug, "plug": device.plug}, close)


if __name__ == "__main__":
    asyncio.run(run())
