"""A Linux IIO device in sysfs: found by name, read and set attribute by attribute, failures told in sentences."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Sequence
from pathlib import Path

from sioms.sdk.exchange import LinkError

from .codec import Element, Layout, kind_of, parse_type

TIMESTAMP = "timestamp"
"""Name of the channel that carries the time of a scan."""
RATE_TOLERANCE = 0.05
"""So far may a device's rate be from the one that is wanted."""


def find_device(sysfs: str, wanted: str) -> Path:
    """Return the folder of a device.

    Args:
        sysfs: where the devices are, ``/sys/bus/iio/devices``.
        wanted: its name or label, or its number as ``iio:device0``.

    Raises:
        LinkError: there is none, or several of that name.
    """
    folders = sorted(Path(sysfs).glob("iio:device*"))
    names = {folder: {folder.name, *_names(folder)} for folder in folders}
    found = [folder for folder in folders if wanted in names[folder]]
    if len(found) == 1:
        return found[0]
    if found:
        which = ", ".join(folder.name for folder in found)
        raise LinkError(f"find IIO device {wanted!r}: {len(found)} bear that name; want one of {which}")
    there = ", ".join(f"{folder.name} ({', '.join(_names(folder)) or 'no name'})" for folder in folders)
    raise LinkError(f"find IIO device {wanted!r} in {sysfs}: there is {there or 'no IIO device at all'}")


def _names(folder: Path) -> list[str]:
    found = []
    for attribute in ("name", "label"):
        try:
            found.append((folder / attribute).read_text().strip())
        except OSError:
            continue
    return found


class IioDevice:
    """One device.

    Args:
        folder: of its attributes.

    Concurrency: one thread.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def has(self, attribute: str) -> bool:
        """Tell whether it has an attribute."""
        return (self.folder / attribute).exists()

    def read(self, attribute: str) -> str:
        """Return an attribute.

        Raises:
            LinkError: it is not there, or the device does not answer the kernel.
        """
        try:
            # the kernel ends the names of clocks by a line feed and a zero
            return (self.folder / attribute).read_text().strip("\0 \t\n")
        except OSError as error:
            raise LinkError(f"read {self.folder / attribute}: {_why(error)}") from None

    def number(self, attribute: str) -> float:
        """Return an attribute that is a number."""
        text = self.read(attribute)
        try:
            return float(text.split()[0])
        except (ValueError, IndexError):
            raise LinkError(f"read {self.folder / attribute}: {text!r} is not a number") from None

    def write(self, attribute: str, value: object) -> None:
        """Set an attribute.

        Raises:
            LinkError: it is not there, may not be written, or refuses the value.
        """
        path = self.folder / attribute
        try:
            fd = os.open(path, os.O_WRONLY | os.O_TRUNC | os.O_CLOEXEC)
            try:
                os.write(fd, f"{value}\n".encode())
            finally:
                os.close(fd)
        except OSError as error:
            raise LinkError(f"write {value} to {path}: {_why(error)}") from None

    def scaling(self, channel: str) -> tuple[float, float]:
        """Return offset and scale of a channel, its own or those of all of its kind: value = (raw + offset) * scale."""
        kind = kind_of(channel)
        shared = [f"in_{channel}", *([f"in_{kind}-{kind}"] if "-" in channel else []), f"in_{kind}"]
        pair = []
        for what, default in (("offset", 0.0), ("scale", 1.0)):
            there = [f"{name}_{what}" for name in shared if self.has(f"{name}_{what}")]
            pair.append(self.number(there[0]) if there else default)
        return pair[0], pair[1]

    def set_trigger(self, wanted: str) -> IioDevice | None:
        """Choose what starts each scan; return it, None where nothing does.

        Args:
            wanted: name of a trigger; '' leaves what is set.

        Raises:
            LinkError: there is no such trigger: the kernel takes any name, and has no trigger then.
        """
        there = {
            trigger.read("name"): trigger
            for trigger in map(IioDevice, sorted(self.folder.parent.glob("trigger*")))
            if trigger.has("name")
        }
        if wanted and wanted not in there:
            has = ", ".join(there) or "none; mkdir /sys/kernel/config/iio/triggers/hrtimer/NAME makes one"
            raise LinkError(f"set trigger {wanted!r} of {self.folder.name}: there is {has}")
        if wanted:
            self.write("trigger/current_trigger", wanted)
        return there.get(self.read("trigger/current_trigger")) if self.has("trigger/current_trigger") else None

    def set_rate(self, trigger: IioDevice | None, channels: Sequence[str], rate_hz: float) -> bool:
        """Set how often it samples, by its trigger where that has a rate; return whether anything has one.

        Raises:
            LinkError: it samples at another rate.
        """
        rate = "sampling_frequency"
        own = [rate, f"in_{rate}", *dict.fromkeys(f"in_{kind_of(name)}_{rate}" for name in channels)]
        own += [f"in_{name}_{rate}" for name in channels]
        holders = [(trigger, rate)] if trigger is not None and trigger.has(rate) else [(self, name) for name in own]
        there = [(holder, attribute) for holder, attribute in holders if holder.has(attribute)]
        for holder, attribute in there:
            with contextlib.suppress(LinkError):  # one that only tells its rate, or has no such one
                holder.write(attribute, f"{rate_hz:g}")
            got_hz = holder.number(attribute)
            if abs(got_hz / rate_hz - 1) > RATE_TOLERANCE:
                can = holder.read(f"{attribute}_available") if holder.has(f"{attribute}_available") else ""
                text = f"rate_hz = {rate_hz:g}, but {holder.folder.name} samples at {got_hz:g} Hz"
                raise LinkError(f"{text}; want {'one of ' + can if can else 'that'}")
        return bool(there)

    @property
    def buffer(self) -> str:
        """Where its buffer is set up; since kernel 5.11 there may be several, of which this is the first."""
        return "buffer" if self.has("buffer") else "buffer0"

    def switch_on(self, channels: Sequence[str], *, timestamp: bool) -> Layout:
        """Choose what a scan holds, with the buffer off; return where it lies."""
        scan = "scan_elements" if self.has("scan_elements") else "buffer0"
        there = {path.name[3:-3] for path in (self.folder / scan).glob("in_*_en")}
        for channel in channels:
            if channel not in there:
                has = ", ".join(sorted(there - {TIMESTAMP})) or "none"
                raise LinkError(f"switch on channel {channel} of {self.folder.name}: it has {has}")
        wanted = {*channels, *([TIMESTAMP] if timestamp and TIMESTAMP in there else [])}
        for name in sorted(there - wanted) + sorted(wanted):
            self.write(f"{scan}/in_{name}_en", int(name in wanted))
        elements = []
        for name in wanted:
            try:
                kind = parse_type(self.read(f"{scan}/in_{name}_type"))
            except ValueError as error:
                raise LinkError(f"switch on channel {name} of {self.folder.name}: {error}") from None
            elements.append(Element(name, int(self.number(f"{scan}/in_{name}_index")), kind))
        return Layout(elements)


def _why(error: OSError) -> str:
    return {
        errno.EACCES: "no permission; give the daemon's user rights on it by a udev rule",
        errno.EBUSY: "busy; its buffer is on, or another program uses it",
        errno.ENOENT: "no such attribute; check the device, and whether it is still there",
        errno.EINVAL: "the device does not take that value",
    }.get(error.errno or 0, os.strerror(error.errno or errno.EIO).lower())
