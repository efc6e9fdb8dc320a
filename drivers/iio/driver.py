"""Analog inputs behind Linux IIO: converters, accelerometers, thermometers that the kernel has a driver for.

Mode "raw" reads each channel's attribute in every tick; mode "buffer" lets the kernel collect whole scans, each with
the time at which it was taken, and reads them from ``/dev/iio:deviceN``. Values are in SI: what the kernel calls
millivolts, kilopascals or gauss becomes V, Pa and T.

    [device.adc0]
    driver = "iio"
    device = "ads1115"
    channels = ["voltage0", "voltage1"]
    mode = "buffer"
    rate_hz = 860.0
    trigger = "sioms-hrtimer"

A converter behind the elements of a calibrated tactile finger has a table ``shape``, see ``tactile_nodes``;
``element_offset`` and ``element_scale`` turn its values, which are in SI, into what the finger was calibrated in: per
cent of the untouched output.
"""

from __future__ import annotations

import errno
import math
import time
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from sioms.drivers import tactile_nodes
from sioms.protocol.flags import AnalogStatus, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import AnalogBlock, BlockSpec, Description
from sioms.sdk.driver import Driver, Kit, StreamDriver, TickDriver
from sioms.sdk.exchange import LinkError, Steps
from sioms.sdk.golden import Golden, Incomplete
from sioms.sdk.settings import LineSettings

from .codec import Element, ElementType, Layout, ScanReceiver, parse_type, unit_of
from .device import TIMESTAMP, IioDevice, find_device

SCALING_S = 1.0
"""Period in which scale and offset are looked at: any program may set them."""


class IioSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keys of the device.

    Attributes:
        device: its name or label, or ``iio:device0`` where names are not unique.
        channels: as the kernel names them, without ``in_`` and ``_raw``: voltage0, voltage0-voltage1, accel_x, temp.
        mode: "raw": attributes read one by one; "buffer": scans collected by the kernel.
        rate_hz: readings, or scans, per second; a buffer's device is set to it where it can be.
        trigger: name of the trigger that starts each scan; '' leaves what is set.
        buffer_length: scans that the kernel keeps.
        watermark: scans after which the driver is woken.
        minimum, maximum: range of the values, in SI.
        history: snapshots kept for readers.
        shape: of a tactile finger: shows its strains and the shape that touches it, too.
        element_scale, element_offset: per cent for the finger's file = (value - offset) * scale; one number, or one a
            channel.
        sysfs: where the devices are.
        dev: where their buffers are.
    """

    device: str
    channels: list[str]
    mode: Literal["raw", "buffer"] = "raw"
    rate_hz: float = 50.0
    trigger: str = ""
    buffer_length: int = 256
    watermark: int = 1
    minimum: float | None = None
    maximum: float | None = None
    history: int = 256
    shape: tactile_nodes.ShapeSettings | None = None
    element_scale: float | list[float] = 1.0
    element_offset: float | list[float] = 0.0
    sysfs: str = "/sys/bus/iio/devices"
    dev: str = "/dev"


class Iio(tactile_nodes.FingerDriver, StreamDriver):
    """Scans of a buffer.

    Concurrency: the one thread of the driver process.
    """

    Settings = IioSettings
    heartbeat_s = SCALING_S

    @classmethod
    def variant(cls, settings: IioSettings) -> type[Driver]:
        """Return the class of the mode."""
        return IioRaw if settings.mode == "raw" else cls

    @classmethod
    def describe(cls, name: str, settings: IioSettings) -> Description:
        """Tell the channels; raises ValueError for settings that cannot be."""
        return _describe(settings)

    @classmethod
    def claims(cls, settings: IioSettings) -> Sequence[str]:
        """Return the buffer, which the kernel gives to one only; single values may be read by many."""
        return [f"buffer of IIO device {settings.device}"] if settings.mode == "buffer" else []

    @classmethod
    def golden(cls, settings: Any) -> Sequence[Golden]:
        """Return a scan of the kernel's dummy device; scans carry no checksum."""
        types = ("le:u13/16>>0", "le:s12/16>>0", "le:s11/16>>0", "le:s16/16>>0", "le:s64/64>>0")
        layout = Layout([Element(f"c{i}", i, parse_type(text)) for i, text in enumerate(types)])

        def first(data: bytes) -> tuple[int, ...]:
            scan = ScanReceiver(layout.size).feed(data)
            if not scan:
                raise Incomplete("no whole scan")
            return tuple(int(values[0]) for values in layout.decode(scan).values())

        scan = "49 00 21 00 de 07 22 00 08 07 06 05 04 03 02 01"
        return (Golden("scan", reply=scan, value=(73, 33, -34, 34, 0x0102030405060708), read=first),)

    def __init__(self, name: str, settings: IioSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self._block, self._finger = _blocks(settings, kit)
        self.silence_s = max(0.5, (20 + 3 * settings.watermark) / settings.rate_hz)
        self._stamp_ns = 0
        self._newest_ns = 0
        self._changed = ""
        self._scans = self._lost = self._old = 0

    @property
    def line(self) -> LineSettings:  # type: ignore[override]  # found anew each time: numbers change with plugging
        """The buffer's character device."""
        try:
            folder = find_device(self.settings.sysfs, self.settings.device)
        except LinkError as error:
            raise OSError(errno.ENODEV, str(error)) from None
        return LineSettings(path=f"{self.settings.dev}/{folder.name}")

    def open(self) -> Steps:
        """Set up the scan, then switch the buffer on; a driver that was killed may have left it on."""
        settings = self.settings
        device = self._device()
        device.write(f"{device.buffer}/enable", 0)
        layout = device.switch_on(settings.channels, timestamp=True)
        trigger = device.set_trigger(settings.trigger)
        self._has_rate = device.set_rate(trigger, settings.channels, settings.rate_hz)
        self._is_realtime = not self._choose_clock(device)
        for key, value in (("length", settings.buffer_length), ("watermark", settings.watermark)):
            if device.has(f"{device.buffer}/{key}"):
                device.write(f"{device.buffer}/{key}", value)
        self._layout, self._receiver = layout, ScanReceiver(layout.size)
        self._scaling = [_Scaling(device, channel) for channel in settings.channels]
        self._types = {element.name: element.type for element in layout.elements}
        self._last_ns, self.trouble, self._changed = 0, "", ""
        self._began_ns = time.monotonic_ns() if TIMESTAMP in self._types else 0
        try:
            device.write(f"{device.buffer}/enable", 1)
        except LinkError as error:
            hint = "" if trigger else "; no trigger is set, and its buffer may need one"
            raise LinkError(f"{error}{hint}") from None
        yield from ()

    def feed(self, data: bytes, now_ns: int) -> int:
        """Publish a snapshot for every scan."""
        if self._changed:
            raise LinkError(self._changed)
        raw = self._layout.decode(self._receiver.feed(data))
        scans = len(raw[self.settings.channels[0]])
        if not scans:
            return 0
        values = np.empty((scans, self._block.n))
        flags = np.empty((scans, self._block.n), dtype=np.int64)
        for index, (channel, scaling) in enumerate(zip(self.settings.channels, self._scaling, strict=True)):
            values[:, index] = scaling.to_si(raw[channel])
            flags[:, index] = _saturated(raw[channel], self._types[channel])
        stamps, taken = self._stamps(raw, scans, now_ns), 0
        for row, flag, stamp_ns in zip(values, flags, stamps, strict=True):
            if stamp_ns < self._began_ns:
                continue  # left over from before: the driver was killed with the buffer on
            if not self._is_new(stamp_ns):
                continue
            self._block.data[:] = row
            self._block.flags[:] = flag | self._overrun(stamp_ns)
            self._stamp_ns = self._block.stamp_ns = max(stamp_ns, self._stamp_ns + 1)
            self.kit.publish(self._block, self._block.stamp_ns)
            if self._finger is not None:
                for derived in self._finger.take(row, self._block.flags, self._block.stamp_ns, now_ns, now_ns):
                    self.kit.publish(derived, derived.stamp_ns)
            taken += 1
        self._scans += taken
        if taken:
            self.trouble = ""
        return taken

    def heartbeat(self) -> Steps:
        """Look whether somebody has changed scale or offset; what has come since is then of another unit."""
        device = self._device()
        self._changed = next(filter(None, (scaling.change(device) for scaling in self._scaling)), "")
        yield from ()

    def counters(self) -> Mapping[str, int | str]:
        """Return how many scans came, how many are missing between them, and how many were old ones."""
        return {"scans": self._scans, "lost_scans": self._lost, "old_scans": self._old}

    def close(self) -> Steps:
        """Switch the buffer off."""
        device = self._device()
        device.write(f"{device.buffer}/enable", 0)
        yield from ()

    def _device(self) -> IioDevice:
        return IioDevice(find_device(self.settings.sysfs, self.settings.device))

    def _choose_clock(self, device: IioDevice) -> bool:
        """Ask for stamps of the monotonic clock; return whether that is granted."""
        if not device.has("current_timestamp_clock"):
            return False
        device.write("current_timestamp_clock", "monotonic")
        return device.read("current_timestamp_clock") == "monotonic"

    def _stamps(self, raw: Mapping[str, NDArray[np.int64]], scans: int, now_ns: int) -> list[int]:
        """Return when each scan was taken [ns, CLOCK_MONOTONIC]; never later than now."""
        if TIMESTAMP not in raw:
            return [now_ns - round((scans - 1 - i) * 1e9 / self.settings.rate_hz) for i in range(scans)]
        ahead_ns = _wall_ahead_ns() if self._is_realtime else 0
        return [min(int(stamp) - ahead_ns, now_ns) for stamp in raw[TIMESTAMP]]

    def _is_new(self, stamp_ns: int) -> bool:
        """Tell whether a scan was taken after all before it; without a channel of time it cannot be told."""
        if TIMESTAMP not in self._types or stamp_ns > self._newest_ns:
            self._newest_ns = stamp_ns
            return True
        self._old += 1
        self.trouble = "scans come, but the time at which they were taken stands still"
        return False

    def _overrun(self, stamp_ns: int) -> int:
        """Return OVERRUN when the time since the last scan holds more than one of them."""
        last_ns, self._last_ns = self._last_ns, stamp_ns
        if not last_ns or not self._has_rate or TIMESTAMP not in self._types:
            return 0
        missing = round((stamp_ns - last_ns) / 1e9 * self.settings.rate_hz) - 1
        self._lost += max(0, missing)
        return int(AnalogStatus.OVERRUN) if missing > 0 else 0


class IioRaw(tactile_nodes.FingerDriver, TickDriver):
    """Attributes read one by one.

    Concurrency: the one thread of the driver process; a slow converter keeps it, and its tick, for as long as a
        conversion takes.
    """

    Settings = IioSettings

    @classmethod
    def describe(cls, name: str, settings: IioSettings) -> Description:
        """Tell the channels."""
        return _describe(settings)

    def __init__(self, name: str, settings: IioSettings, kit: Kit) -> None:
        super().__init__(name, settings, kit)
        self._block, self._finger = _blocks(settings, kit)
        self._failed = 0

    def open(self) -> None:
        """Find the device and how its channels are scaled."""
        self._device = IioDevice(find_device(self.settings.sysfs, self.settings.device))
        self._scaling = [_Scaling(self._device, channel) for channel in self.settings.channels]
        for scaling in self._scaling:
            self._device.read(scaling.attribute)
        self._look_ns = time.monotonic_ns() + int(SCALING_S * 1e9)

    def tick(self, now_ns: int) -> None:
        """Read every channel; one that fails is INVALID, a device that is gone is a loss."""
        if now_ns >= self._look_ns:
            self._look_ns = now_ns + int(SCALING_S * 1e9)
            for changed in filter(None, [scaling.change(self._device) for scaling in self._scaling]):
                raise LinkError(changed)
        for index, scaling in enumerate(self._scaling):
            try:
                self._block.data[index] = scaling.value(self._device.number(scaling.attribute))
                self._block.flags[index] = 0
            except LinkError:
                if not self._device.folder.exists():
                    raise
                self._failed += 1
                self._block.flags[index] = int(AnalogStatus.INVALID)
        self._block.stamp_ns = time.monotonic_ns()
        if self._finger is not None:
            self._finger.take(self._block.data, self._block.flags, self._block.stamp_ns, now_ns)

    def counters(self) -> Mapping[str, int | str]:
        """Return how many readings the device did not give."""
        return {"failed_readings": self._failed}


class _Finger(tactile_nodes.TactileNodes):
    """The nodes of a finger behind a converter: values become the finger's raw unit first.

    Concurrency: the one thread of the driver process.
    """

    def __init__(self, settings: IioSettings, shape: tactile_nodes.ShapeSettings, specs: Sequence[BlockSpec], kit: Kit):
        super().__init__(shape, specs, kit)
        self._factor = np.asarray(settings.element_scale, dtype=np.float64)
        self._offset = np.asarray(settings.element_offset, dtype=np.float64)

    def take(
        self, raw: NDArray[np.float64], flags: NDArray[np.int64], stamp_ns: int, now_ns: int,
        begun_ns: int | None = None,
    ) -> tuple[AnalogBlock, ...]:  # fmt: skip
        """Sense one frame, as ``TactileNodes.take``."""
        return super().take((raw - self._offset) * self._factor, flags, stamp_ns, now_ns, begun_ns)


def _wall_ahead_ns() -> int:
    """Return how far the wall clock is ahead of the monotonic one, by the promptest of three looks: a process may be
    kept waiting between the two.
    """
    looks = []
    for _ in range(3):
        before_ns, wall_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        looks.append((after_ns - before_ns, wall_ns - (before_ns + after_ns) // 2))
    return min(looks)[1]


def _blocks(settings: IioSettings, kit: Kit) -> tuple[AnalogBlock, _Finger | None]:
    first, *more = _describe(settings).blocks
    return AnalogBlock(first), _Finger(settings, settings.shape, more, kit) if settings.shape else None


class _Scaling:
    """How a channel's number becomes SI.

    Attributes:
        attribute: where a single reading stands; ``_input`` ones are scaled by the kernel.
    """

    def __init__(self, device: IioDevice, channel: str) -> None:
        self._channel = channel
        _, self._factor = unit_of(channel)
        self.attribute = f"in_{channel}_raw"
        self._offset, self._scale = device.scaling(channel)
        if not device.has(self.attribute) and device.has(f"in_{channel}_input"):
            self.attribute, self._offset, self._scale = f"in_{channel}_input", 0.0, 1.0

    def change(self, device: IioDevice) -> str:
        """Return a sentence when scale or offset are no longer those that were read, '' otherwise."""
        if self.attribute.endswith("_input"):
            return ""
        offset, scale = device.scaling(self._channel)
        if (offset, scale) == (self._offset, self._scale):
            return ""
        before, after = (
            f"offset {self._offset:g}, scale {self._scale:g}",
            f"offset {offset:g}, scale {scale:g}",
        )
        return f"{device.folder.name}: {self._channel} has {after} after {before}: another program has set it"

    def value(self, number: float) -> float:
        return (number + self._offset) * self._scale * self._factor

    def to_si(self, raw: NDArray[np.int64]) -> NDArray[np.float64]:
        values: NDArray[np.float64] = (raw.astype(np.float64) + self._offset) * (self._scale * self._factor)
        return values


def _saturated(raw: NDArray[np.int64], kind: ElementType) -> NDArray[np.int64]:
    """Return SATURATED where a converter is at its end; an unsigned 0 is an input at rest."""
    top = (1 << kind.bits - kind.signed) - 1
    at_end = (raw >= top) | (raw <= -top - 1) if kind.signed else raw >= top
    return np.where(at_end, int(AnalogStatus.SATURATED), 0)


def _describe(settings: IioSettings) -> Description:
    _check(settings)
    channels = tuple(
        ChannelInfo(name, unit_of(name)[0], settings.minimum, settings.maximum) for name in settings.channels
    )
    block = BlockSpec("", NodeClass.ANALOG, channels, history=settings.history)
    more = tactile_nodes.specs(settings.shape, len(settings.channels), settings.history)
    inputs, lease_s = tactile_nodes.inputs(settings.shape), max(0.5, 10 / settings.rate_hz)
    return Description((block, *more), settings.rate_hz, inputs, lease_s)


def _check(settings: IioSettings) -> None:
    """Raise ValueError for settings that contradict each other."""
    if not settings.channels:
        raise ValueError("channels: none given; want e.g. voltage0")
    for channel in settings.channels:
        if settings.channels.count(channel) > 1:
            raise ValueError(f"channels: {channel} is given {settings.channels.count(channel)} times; want each once")
        if channel.startswith("in_") or channel.endswith("_raw") or channel == TIMESTAMP:
            raise ValueError(f"channels: {channel}; want the name alone, e.g. voltage0 for in_voltage0_raw")
    for key in ("element_scale", "element_offset"):
        value = getattr(settings, key)
        numbers = value if isinstance(value, list) else [value]
        if isinstance(value, list) and len(value) != len(settings.channels):
            raise ValueError(f"{key}: {len(value)} for {len(settings.channels)} channels; want one number, or one each")
        if not all(map(math.isfinite, numbers)) or (key == "element_scale" and 0 in numbers):
            raise ValueError(f"{key} = {value}; want finite numbers{', not 0' * (key == 'element_scale')}")
    most_hz = 1000 if settings.mode == "raw" else 20_000
    if not 0.1 <= settings.rate_hz <= most_hz:
        raise ValueError(f"rate_hz = {settings.rate_hz:g}; want 0.1 to {most_hz} in mode {settings.mode}")
    if settings.mode == "raw" and settings.trigger:
        raise ValueError(f"trigger = {settings.trigger}: readings in mode raw have none; want mode = buffer")
    if not 1 <= settings.watermark <= settings.buffer_length:
        raise ValueError(
            f"watermark = {settings.watermark}, buffer_length = {settings.buffer_length}; want 1 to the length"
        )
