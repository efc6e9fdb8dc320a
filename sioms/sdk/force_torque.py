"""Six-component force/torque sensors: their channels, and how a reading gets its flags and into its page."""

from __future__ import annotations

import errno
import math
from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from sioms.protocol.flags import AnalogStatus, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo

from .blocks import AnalogBlock, BlockSpec, unfit
from .driver import Kit, Refusal
from .settings import LineSettings

COMPONENTS = ("fx", "fy", "fz", "tx", "ty", "tz")
UNITS = ("N", "N", "N", "N*m", "N*m", "N*m")
Six = tuple[float, float, float, float, float, float]
SAY_AGAIN_NS = 1_000_000_000
"""A status that changes all the time is told of once in this time [ns]."""


class ForceSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys that sensors on Ethernet share.

    Attributes:
        line: to the sensor.
        full_scale: greatest forces [N] and torques [N m] of the sensor's calibration; None leaves the ranges open.
        history: snapshots kept for readers.
    """

    line: LineSettings
    full_scale: Six | None = None
    history: int = 256


def force_spec(full_scale: Six | None, history: int, description: str) -> BlockSpec:
    """Return the block of a sensor.

    Args:
        full_scale: greatest forces [N] and torques [N m] that the sensor measures; None leaves the ranges open.
        history: snapshots kept for readers.
        description: of the channels.

    Raises:
        ValueError: a full scale is not positive.
    """
    if full_scale is not None and not all(0 < value < math.inf for value in full_scale):
        raise ValueError(f"full_scale = {list(full_scale)}; want six positive numbers, N and N*m")
    limits = full_scale or (None,) * 6
    channels = tuple(
        ChannelInfo(name, unit, None if limit is None else -limit, limit, description=description)
        for name, unit, limit in zip(COMPONENTS, UNITS, limits, strict=True)
    )
    return BlockSpec("", NodeClass.ANALOG, channels, history=history)


def check_whole(block: BlockSpec, channels: Sequence[int]) -> None:
    """Raise Refusal when a request that holds for the whole sensor comes for a part of its channels."""
    if len(channels) != len(block.channels):
        names = ", ".join(block.channels[channel].name for channel in channels)
        raise Refusal(
            errno.EINVAL, f"{names} alone; the sensor's zero belongs to all its channels: open the whole node"
        )


class ForceBlock(AnalogBlock):
    """Forces and torques of one sensor; values at or beyond full scale are flagged as saturated.

    **A zero that vanished is told.** Once the sensor has taken a zero of its own (``zeroed``), readings count from
    there. When that zero is gone or may be (``lose_zero``), they are INVALID until somebody says what counts: a new
    zero of the sensor, one of the driver's (ZERO_DEVICE), or the sensor's own taken back (``forget_zero``).

    Attributes:
        saturated, invalid: readings so far that were flagged as such.
        is_zeroed: the sensor counts from a zero that was taken on request.
    """

    def __init__(self, spec: BlockSpec, device: str, kit: Kit) -> None:
        super().__init__(spec)
        self._device, self._kit = device, kit
        self._limit = np.array([math.inf if c.maximum is None else c.maximum for c in spec.channels])
        self._scale = np.ones(self.n)
        self._size = np.empty(self.n)
        self.saturated = self.invalid = 0
        self.is_zeroed = False
        self._lost_zero = ""
        self._zeroless = np.zeros(self.n, dtype=np.bool_)  # without a zero since it was lost
        self._measured = np.zeros(self.n, dtype=np.int64)  # the flags but for that
        self._status = "ok"
        self._told, self._told_ns = "ok", -SAY_AGAIN_NS

    @property
    def status(self) -> str:
        """The sensor's status in words, and that of its zero."""
        return self._status if not self._lost_zero else f"{self._status}; {self._lost_zero}"

    def take_zero(self) -> None:
        """Note that the sensor has taken a zero of its own; the driver's is cleared."""
        self.is_zeroed, self._lost_zero = True, ""
        self.offset[:] = 0.0

    def forget_zero(self) -> None:
        """Note that the sensor counts from its factory's zero; the driver's is cleared."""
        self.is_zeroed, self._lost_zero = False, ""
        self.offset[:] = 0.0

    def lose_zero(self, why: str) -> None:
        """Flag readings as INVALID until there is a zero again; nothing when that is the case."""
        if self._lost_zero:
            return
        self.is_zeroed = False
        self._lost_zero = f"zero lost: {why}; zero it again"
        self._zeroless[:] = True
        self._measured[:] = self.flags
        self._kit.log("error", f"{self._device}: {self._lost_zero}: its readings are INVALID until then")

    def unfit(self) -> NDArray[np.bool_]:
        """Return which readings are no measurement; one that only lacks a zero is."""
        return unfit(self._measured if self._lost_zero else self.flags, self.data)

    def set_offset(self, channels: NDArray[np.intp], offset: NDArray[np.float64]) -> None:
        """Take readings of some channels for their zero; when all have one again, none is lost any more."""
        super().set_offset(channels, offset)
        self._zeroless[channels] = False
        if self._lost_zero and not self._zeroless.any():
            self._lost_zero = ""
            self._kit.log("info", f"{self._device}: zeroed again")

    def set_scale(self, force_n: float, torque_nm: float) -> None:
        """Tell what one of the sensor's numbers is [N], [N m]."""
        self._scale[:3], self._scale[3:] = force_n, torque_nm

    def show(self, values: Sequence[float], stamp_ns: int, flags: int = 0) -> None:
        """Take a reading and publish it; the arguments are those of ``fill``."""
        self.fill(values, stamp_ns, flags)
        self._kit.publish(self, stamp_ns)

    def fill(self, values: Sequence[float], stamp_ns: int, flags: int = 0) -> None:
        """Take a reading.

        Args:
            values: six numbers as the sensor sends them.
            stamp_ns: when they were measured [ns, CLOCK_MONOTONIC].
            flags: of AnalogStatus, what the sensor says of the whole reading.
        """
        data = self.data
        np.multiply(values, self._scale, out=data)
        np.abs(data, out=self._size)
        self.flags[:] = flags
        # one comparison for the ordinary case: not-a-number is not smaller either
        if not (self._size < self._limit).all():
            self.flags[self._size >= self._limit] |= int(AnalogStatus.SATURATED)
            self.flags[~np.isfinite(data)] |= int(AnalogStatus.INVALID)
            flags = int(np.bitwise_or.reduce(self.flags))
        if self._lost_zero:
            self._measured[:] = self.flags
            self.flags[self._zeroless] |= int(AnalogStatus.INVALID)
            flags |= int(AnalogStatus.INVALID)
        if flags:
            self.saturated += bool(flags & AnalogStatus.SATURATED)
            self.invalid += bool(flags & AnalogStatus.INVALID)
        self.stamp_ns = stamp_ns

    def say(self, status: str, now_ns: int) -> None:
        """Note the sensor's status, and log a change of it."""
        self._status = status
        if status != self._told and now_ns - self._told_ns >= SAY_AGAIN_NS:
            self._told, self._told_ns = status, now_ns
            self._kit.log("info" if status == "ok" else "warning", f"{self._device}: status: {status}")
