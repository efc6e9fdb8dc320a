"""A Linux IIO device as files: ``python -m sioms.drivers.iio.simulator --link FOLDER`` serves FOLDER/sysfs and
FOLDER/dev.

As far as files can it behaves like the kernel's dummy device (``iio_simple_dummy``): the same channels and scan types,
a trigger with a rate, a buffer that is set up by attributes and read as whole scans from a FIFO, stamps of the chosen
clock. What files
cannot do: refuse a value when it is written, refuse a second reader, or answer EBUSY to raw readings while the buffer
    runs.
Commands on standard input: ``volt CHANNEL VALUE``, ``lose COUNT`` (scans that the buffer has no room for), ``bytes
COUNT`` (cut the stream in pieces of that size), ``unplug``, ``plug``, ``power_cycle [SECONDS]`` (of a converter on USB:
gone, then anew), ``freeze [COUNT]`` (the last scan again, its time too), ``foreign rate|scale|enable VALUE`` (another
program writes the attribute), ``state``.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import fcntl
import os
import shutil
import struct
import termios
import time
from collections.abc import Callable
from pathlib import Path

from sioms.simulation.control import serve
from sioms.simulation.supply import Standstill

PERIOD_S = 0.002
SCALES = {"voltage0": 1.3333, "voltage1-voltage2": 0.0025, "voltage3-voltage4": 0.0025, "accel_x": 0.01}
"""Channel to what a count is worth in the kernel's unit: mV, m/s^2."""
OFFSETS = {"voltage0": 7.0}
TYPES = {
    "voltage0": "le:u13/16>>0", "voltage1-voltage2": "le:s12/16>>0", "voltage3-voltage4": "le:s11/16>>0",
    "accel_x": "le:s16/16>>0", "timestamp": "le:s64/64>>0",
}  # fmt: skip
LARGEST = {
    "voltage0": (0, 8191),
    "voltage1-voltage2": (-2048, 2047),
    "voltage3-voltage4": (-1024, 1023),
    "accel_x": (-32768, 32767),
}


class Dummy:
    """The device in a folder.

    Args:
        folder: for ``sysfs`` and ``dev``; made anew.
        number: of the device.
    """

    def __init__(self, folder: Path, number: int, name: str) -> None:
        self.root = folder / "sysfs" / f"iio:device{number}"
        self.trigger = folder / "sysfs" / "trigger0"
        self.fifo = folder / "dev" / f"iio:device{number}"
        self.name = name
        self.raw = {"voltage0": 73, "voltage1-voltage2": 33, "voltage3-voltage4": -34, "accel_x": 34}
        self.lose = self.sent = self.lost = 0
        self.piece = 65536
        self.standstill = Standstill()
        self.next_s = 0.0
        self._pipe = -1
        self._gone: list[int] = []

    def plug(self) -> None:
        """Make the files appear, with the buffer off; nothing when they are there."""
        if self._pipe >= 0:
            return
        for path in (
            self.root / "scan_elements",
            self.root / "buffer",
            self.root / "trigger",
            self.trigger,
            self.fifo.parent,
        ):
            path.mkdir(parents=True, exist_ok=True)
        files = {
            "name": self.name, "current_timestamp_clock": "realtime\n\0", "trigger/current_trigger": "",
            "buffer/enable": 0, "buffer/length": 2, "buffer/watermark": 1,
            "in_voltage_scale": SCALES["voltage0"], "in_voltage0_offset": OFFSETS["voltage0"],
            "in_voltage-voltage_scale": SCALES["voltage1-voltage2"], "in_accel_x_scale": SCALES["accel_x"],
        }  # fmt: skip
        for index, (channel, kind) in enumerate(TYPES.items()):
            files |= {
                f"scan_elements/in_{channel}_en": 0,
                f"scan_elements/in_{channel}_index": index,
                f"scan_elements/in_{channel}_type": kind,
            }
        for attribute, value in files.items():
            (self.root / attribute).write_text(f"{value}\n")
        (self.trigger / "name").write_text("instance1\n")
        (self.trigger / "sampling_frequency").write_text("100\n")
        self.show()
        os.mkfifo(self.fifo)
        self._pipe = os.open(self.fifo, os.O_RDWR | os.O_NONBLOCK)

    def unplug(self) -> None:
        """Make the files vanish; who has the buffer open hears nothing more, as of a device that the kernel has
        removed.
        """
        if self._pipe >= 0:
            self._gone.append(self._pipe)
            self._pipe = -1
        self.fifo.unlink(missing_ok=True)
        shutil.rmtree(self.root, ignore_errors=True)
        shutil.rmtree(self.trigger, ignore_errors=True)

    def show(self) -> None:
        """Write the single readings."""
        for channel, raw in self.raw.items():
            path = self.root / f"in_{channel}_raw"
            fresh = path.with_suffix(".new")
            fresh.write_text(f"{raw}\n")
            fresh.replace(path)

    def read(self, attribute: str) -> str:
        """Return what stands in an attribute."""
        with contextlib.suppress(OSError):
            return (self.root / attribute).read_text().strip("\0 \n")
        return ""

    def volt(self, channel: str, value: str) -> None:
        """Apply a voltage [V], or an acceleration; the converter clips."""
        factor = 1e3 if channel.startswith("voltage") else 1.0
        low, high = LARGEST[channel]
        counts = round(float(value) * factor / SCALES[channel] - OFFSETS.get(channel, 0.0))
        self.raw[channel] = min(max(counts, low), high)
        self.show()

    def due(self) -> None:
        """Put the scans that were triggered since the last look into the buffer."""
        if self._pipe < 0 or self.read("buffer/enable") != "1" or self.read("trigger/current_trigger") != "instance1":
            self.next_s = 0.0
            return
        period_s = 1 / float((self.trigger / "sampling_frequency").read_text().strip() or 100)
        now_s = time.monotonic()
        self.next_s = self.next_s or now_s
        while self.next_s <= now_s:
            scan = self.standstill.bend(self._scan(self.next_s))
            self.next_s += period_s
            if self.lose:
                self.lose, self.lost = self.lose - 1, self.lost + 1
                continue
            if self._waiting() >= int(self.read("buffer/length") or 2) * len(scan):
                self.lost += 1  # the kernel's buffer keeps the oldest
                continue
            for at in range(0, len(scan), self.piece):
                os.write(self._pipe, scan[at : at + self.piece])
            self.sent += 1

    def _waiting(self) -> int:
        """Return how many bytes the reader has not taken."""
        return int(struct.unpack("i", fcntl.ioctl(self._pipe, termios.FIONREAD, bytes(4)))[0])

    def _scan(self, at_s: float) -> bytes:
        """Return a scan of what is switched on: each value at its own alignment, the whole padded to the largest."""
        scan = b""
        on = [channel for channel in TYPES if self.read(f"scan_elements/in_{channel}_en") == "1"]
        for channel in on:
            if channel == "timestamp":
                is_monotonic = self.read("current_timestamp_clock") == "monotonic"
                ahead_ns = 0 if is_monotonic else min((_wall_ahead() for _ in range(3)), key=lambda look: look[0])[1]
                scan += bytes(-len(scan) % 8) + struct.pack("<q", round(at_s * 1e9) + ahead_ns)
            else:
                raw = self.raw[channel] & (1 << int(TYPES[channel][4:].split("/")[0])) - 1
                scan += struct.pack("<H", raw)
        return scan + bytes(-len(scan) % (8 if "timestamp" in on else 2))

    def foreign(self, kind: str, value: str) -> None:
        """Let another program write an attribute."""
        places = {
            "rate": self.trigger / "sampling_frequency",
            "scale": self.root / "in_voltage_scale",
            "enable": self.root / "buffer/enable",
        }
        if kind not in places:
            raise ValueError(f"{kind}; want one of {', '.join(places)}")
        places[kind].write_text(f"{value}\n")

    def state(self) -> dict[str, object]:
        """Return what a bystander sees."""
        on = [channel for channel in TYPES if self.read(f"scan_elements/in_{channel}_en") == "1"]
        words = ("buffer/enable", "buffer/length", "buffer/watermark", "current_timestamp_clock")
        return {"sent": self.sent, "lost": self.lost, "on": on, **{word: self.read(word) for word in words}}


def _wall_ahead() -> tuple[int, int]:
    """Return how long it took to look at both clocks, and how far the wall clock is ahead [ns]."""
    before_ns, wall_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
    return after_ns - before_ns, wall_ns - (before_ns + after_ns) // 2


async def run() -> None:
    """Serve until told to end."""
    parser = argparse.ArgumentParser(description="simulated Linux IIO device as files")
    parser.add_argument("--link", type=Path, required=True, help="folder for sysfs and dev, made anew")
    parser.add_argument("--number", type=int, default=0)
    parser.add_argument("--name", default="iio_dummy_part_no")
    options = parser.parse_args()
    device = Dummy(options.link, options.number, options.name)
    device.plug()

    async def sample() -> None:
        while True:
            device.due()
            await asyncio.sleep(PERIOD_S)

    sampling = asyncio.create_task(sample())

    async def close() -> None:
        sampling.cancel()
        device.unplug()

    def lose(count: str) -> None:
        device.lose = int(count)

    def cut(count: str) -> None:
        device.piece = int(count)

    def power_cycle(off_s: str = "0.2") -> None:
        device.unplug()
        asyncio.get_running_loop().call_later(float(off_s), device.plug)

    handlers: dict[str, Callable[..., object]] = {
        "volt": device.volt, "lose": lose, "bytes": cut, "state": device.state,
        "unplug": device.unplug, "plug": device.plug, "power_cycle": power_cycle, "freeze": device.standstill.set,
        "foreign": device.foreign,
    }  # fmt: skip
    await serve(str(options.link), handlers, close)


if __name__ == "__main__":
    asyncio.run(run())
