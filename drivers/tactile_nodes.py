"""The nodes ``strain``, ``shape`` and ``mean`` that a driver of a tactile finger shows beside its raw readings.

No driver itself: drivers that deliver frames of a finger's elements compose it (decision 0043). Their table
then has a table ``shape``:

    [device.tactile0.shape]
    finger_file = "finger.toml"          # from sioms tactile calibrate
    load_node = "lord1.fz"               # optional: a force sensor under the finger
    load_scale = 50.0                    # N/m for a newton: one over the length of contact in metres

``mean_frames`` in that table adds ``mean``: the shape of the mean of so many frames, one mean after the other, stamped
as the last of them, by an estimator that knows how much less noise it has: contacts too light for a single frame.

Requests on ``strain``, ``shape`` and ``mean``: ZERO_DEVICE takes a new baseline from the next frames and is answered
when it is in force, or refused when something touches or the elements fail; CALIBRATE_DEVICE with the text of a
finger's file loads that finger, without an argument its own again; on ``strain`` SET_GAINS and GET_GAINS hold strain
per output.

The physics is imported when there is a finger: it brings scipy, which takes a second, and drivers of many other sensors
have this part, too.
"""

from __future__ import annotations

import errno
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from sioms.documents import read_text
from sioms.protocol.flags import AnalogStatus, NodeClass, Request
from sioms.protocol.nodeinfo import ChannelInfo
from sioms.sdk.blocks import AnalogBlock, AnyBlock, BlockSpec
from sioms.sdk.driver import Awaited, Driver, Kit, Refusal
from sioms.sdk.inputs import NotMeasuredError

if TYPE_CHECKING:
    from sioms.tactile.finger import Finger
    from sioms.tactile.sensing import LoadTare, ShapeSensor

Array = NDArray[np.float64]

STRAIN, SHAPE, MEAN = "strain", "shape", "mean"
MOST_FRAMES = 100_000
"""Frames that a baseline may be averaged from."""
BEHIND_NS = 20_000_000
"""How long a driver may work on what came together before it leaves shapes out [ns]."""


class ShapeSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keys of the table ``shape``.

    Attributes:
        finger_file: the calibrated finger.
        load_node: node of one channel that reads the force on the finger; none when empty.
        load_scale: N/m for one unit of that node, negative when pressing lowers it.
        load_deviation: standard deviation of the load [N/m].
        load_age_s: how much older than the frame a reading may be; an older one is not used.
        settle_frames: frames averaged for the baseline.
        conductor: what touches is a conductor; undoes the proximity effect where the finger's file has it.
        compiled: fit by numba: five times as fast, but seconds to start the first time on a machine.
        mean_frames: frames of a mean that the node ``mean`` shows the shape of; 0: there is no such node.
    """

    finger_file: str
    load_node: str = ""
    load_scale: float = 1.0
    load_deviation: float = 4.0
    load_age_s: float = 0.05
    settle_frames: int = 20
    conductor: bool = True
    compiled: bool = False
    mean_frames: int = 0


def inputs(settings: ShapeSettings | None) -> tuple[str, ...]:
    """Return the nodes of other devices that are read."""
    return (settings.load_node,) if settings is not None and settings.load_node else ()


def specs(settings: ShapeSettings | None, elements: int, history: int) -> tuple[BlockSpec, ...]:
    """Return the blocks, none without settings; reads the finger's file, so that its mistakes show before the start.

    Raises:
        ValueError: a file that cannot be read or is no finger of so many elements, or a load that cannot be.
    """
    if settings is None:
        return ()
    from sioms.tactile.sensing import CHANNELS

    _finger(settings, elements)
    _tare(settings)
    if not 0.0 < settings.load_age_s < math.inf:
        raise ValueError(f"shape: load_age_s = {settings.load_age_s:g}; want a positive time in seconds")
    if settings.settle_frames < 1:
        raise ValueError(f"shape: settle_frames = {settings.settle_frames}; want 1 or more")
    if settings.mean_frames and not 2 <= settings.mean_frames <= MOST_FRAMES:
        raise ValueError(f"shape: mean_frames = {settings.mean_frames}; want 2 to {MOST_FRAMES}, or 0 for no means")
    strains = tuple(ChannelInfo(f"e{i}", "", description="radial strain, tension positive") for i in range(elements))
    shape = tuple(ChannelInfo(name, unit, description=what) for name, unit, what in CHANNELS)
    means = (BlockSpec(MEAN, NodeClass.ANALOG, shape, history=history),) if settings.mean_frames else ()
    return (
        BlockSpec(STRAIN, NodeClass.ANALOG, strains, history=history),
        BlockSpec(SHAPE, NodeClass.ANALOG, shape, history=history),
        *means,
    )


class TactileNodes:
    """Fills the nodes from raw frames.

    Concurrency: the one thread of the driver process.

    Args:
        settings: checked by ``specs``.
        blocks: what ``specs`` returned.
        kit: services; reads the load node.

    Attributes:
        blocks: strain, shape and, where it is wanted, mean.
    """

    _sensor: ShapeSensor
    _averaging: ShapeSensor
    """Of means; only where there are some."""
    _sum: Array
    _summed: int

    def __init__(self, settings: ShapeSettings, blocks: Sequence[BlockSpec], kit: Kit) -> None:
        from sioms.tactile.sensing import numbers

        self._settings, self._kit, self._numbers = settings, kit, numbers
        self.blocks = tuple(AnalogBlock(spec) for spec in blocks)
        self.strain, self.shape, *self._means = self.blocks
        for block in self.blocks:
            block.corrected_by_driver = True
        for block in self._means:  # until the first one is there
            block.data[:], block.flags[:] = np.nan, int(AnalogStatus.INVALID)
        self._take_up(_finger(settings, self.strain.n))
        self._stamp_ns = 0
        self._left_out = 0

    def take(
        self, raw: Array, flags: NDArray[np.int64], stamp_ns: int, now_ns: int, begun_ns: int | None = None
    ) -> tuple[AnalogBlock, ...]:
        """Sense one frame and fill the blocks.

        Args:
            raw: readings in the finger's raw unit.
            flags: AnalogStatus of each; what is INVALID is not used.
            stamp_ns: time of the frame.
            now_ns: present time, at which the load node is read.
            begun_ns: when the driver began with what came together with this frame; None: it is the only one.

        Returns:
            The blocks to be published: strain and shape; strains alone where frames come faster than this machine
            estimates shapes. The next shape then has the flag OVERRUN. With the last frame of a mean, mean, too.
        """
        readings = np.where(flags & int(AnalogStatus.INVALID), np.nan, raw)
        # a device's clock that began anew may lie a little before the frames already sensed
        self._stamp_ns = max(self._stamp_ns, stamp_ns)
        strain, load = self._sensor.strain(readings, self._stamp_ns, self._load(stamp_ns, now_ns))
        told = int(np.bitwise_or.reduce(flags)) & int(AnalogStatus.OVERRUN | AnalogStatus.SATURATED)
        lost, saturated = told & int(AnalogStatus.OVERRUN), told & int(AnalogStatus.SATURATED)
        self.strain.data[:] = strain.strains
        self.strain.flags[:] = lost | np.where(
            strain.saturated, int(AnalogStatus.SATURATED), flags & int(AnalogStatus.SATURATED)
        )
        self._left_out |= lost
        new = self.blocks
        if begun_ns is not None and self._kit.now_ns() - begun_ns > BEHIND_NS:
            self._left_out |= int(AnalogStatus.OVERRUN)
            new = new[:1]
        else:
            self.shape.data[:] = self._numbers(self._sensor.estimate(strain, load))
            self.shape.flags[:], self._left_out = self._left_out | saturated, 0
        if self._means:
            new = (*new, *self._mean(np.where(strain.saturated, np.nan, readings)))
        for block in new:
            block.flags[np.isnan(block.data)] |= int(AnalogStatus.INVALID)
            block.stamp_ns = stamp_ns
        return new

    def _mean(self, readings: Array) -> tuple[AnalogBlock, ...]:
        """Add a frame; return the block of the mean with the last of its frames. One frame without an element, or with
        one that is saturated, is enough for a mean without it.
        """
        self._sum += readings
        self._summed += 1
        if self._summed < self._settings.mean_frames:
            return ()
        frame, self._sum, self._summed = self._sum / self._summed, np.zeros(self.strain.n), 0
        (block,) = self._means
        block.data[:], block.flags[:] = self._numbers(self._averaging.frame(frame, self._stamp_ns)), 0
        return (block,)

    def ioctl(self, block: BlockSpec, request: Request, argument: Any) -> Any:
        """Answer the requests named above.

        Raises:
            Refusal: another request, or an argument that makes no sense.
        """
        on_strain = block.name == STRAIN
        try:
            match request:
                case Request.ZERO_DEVICE:
                    return self._rebase(block, argument)
                case Request.CALIBRATE_DEVICE:
                    return self._load_finger(argument)
                case Request.GET_GAINS if on_strain:
                    return self._sensor.gains.ravel().tolist()
                case Request.SET_GAINS if on_strain:
                    return self._set_gains(argument)
        except OSError as error:
            raise Refusal(errno.EIO, f"finger_file {self._settings.finger_file}: {error.strerror}") from None
        except (ValueError, TypeError, ArithmeticError) as error:  # of what a client has sent
            raise Refusal(errno.EINVAL, str(error)) from None
        raise Refusal(errno.ENOTTY, f"{request.name} is not a request {block.name} knows")

    def _rebase(self, block: BlockSpec, argument: Any) -> Awaited:
        frames = 1 if argument is None else argument
        if type(frames) is not int or not 1 <= frames <= MOST_FRAMES:
            raise Refusal(errno.EINVAL, f"{argument!r} frames; want 1 to {MOST_FRAMES}")
        sensor, now_ns = self._sensor, self._kit.now_ns()
        try:
            rebases = [sensor.rebase(frames, now_ns)]
            if self._means:
                rebases.append(self._averaging.rebase(math.ceil(frames / self._settings.mean_frames), now_ns))
        except ValueError as error:
            raise Refusal(errno.EBUSY, f"{error}; the baseline stays as it was") from None

        def ready() -> tuple[list[float]] | None:
            for rebase in rebases:
                if rebase.refused:
                    raise Refusal(errno.EBUSY, f"{rebase.refused}; the baseline stays as it was")
            if self._sensor is not sensor:
                raise Refusal(errno.ECANCELED, "another finger has been loaded meanwhile")
            return ([0.0] * len(block.channels),) if all(rebase.done for rebase in rebases) else None

        return Awaited(ready)

    def _load_finger(self, text: Any) -> str:
        if text is None or text == []:
            text = read_text(Path(self._settings.finger_file))
        if not isinstance(text, str):
            raise Refusal(errno.EINVAL, f"{type(text).__name__} given; want the text of a finger's file")
        from sioms.tactile.finger import from_toml

        finger = from_toml(text)
        _check(finger, self.strain.n, "the finger given")
        self._take_up(finger)
        return finger.name

    def _take_up(self, finger: Finger) -> None:
        self._sensor = self._make(finger, self._settings.settle_frames)
        self._sum, self._summed = np.zeros(self.strain.n), 0
        if self._means:
            many = self._settings.mean_frames
            quieter = tuple(one / math.sqrt(many) for one in finger.elements.noise)
            calm = msgspec.structs.replace(finger, elements=msgspec.structs.replace(finger.elements, noise=quieter))
            self._averaging = self._make(calm, math.ceil(self._settings.settle_frames / many))

    def _set_gains(self, argument: Any) -> None:
        n = self.strain.n
        given = np.array(argument, dtype=np.float64).ravel()
        if given.size not in (n, n * n):
            raise ValueError(f"{given.size} gains; want {n}, or {n} rows of {n}")
        for sensor in (self._sensor, *([self._averaging] if self._means else [])):
            sensor.set_gains(given if given.size == n else given.reshape(n, n))

    def _load(self, stamp_ns: int, now_ns: int) -> float | None:
        """Return the load node's reading if it is there, valid and young enough."""
        if not self._settings.load_node:
            return None
        oldest_ns = stamp_ns - round(self._settings.load_age_s * 1e9)
        try:
            return float(self._kit.inputs[self._settings.load_node].measured(now_ns, oldest_ns)[0])
        except NotMeasuredError:
            return None

    def _make(self, finger: Finger, settle_frames: int) -> ShapeSensor:
        from sioms.tactile.cylinder import forget_amplitudes
        from sioms.tactile.sensing import ShapeSensor

        settings = self._settings
        sensor = ShapeSensor(
            finger,
            compiled=settings.compiled,
            conductor=settings.conductor,
            tare=_tare(settings),
            settle_frames=settle_frames,
        )
        sensor.warm()
        forget_amplitudes()
        return sensor


def _tare(settings: ShapeSettings) -> LoadTare | None:
    if not settings.load_node:
        return None
    from sioms.tactile.sensing import LoadTare

    try:
        return LoadTare(settings.load_scale, settings.load_deviation, 2.0)
    except ValueError as error:
        raise ValueError(f"shape: {error}") from None


class FingerDriver(Driver):
    """What drivers have in common whose channels may be the elements of a finger; beside their own kind of driver.

    Concurrency: the one thread of the driver process.
    """

    _block: AnalogBlock
    _finger: TactileNodes | None

    def _make_blocks(self, specs: Sequence[BlockSpec], shape: ShapeSettings | None) -> None:
        """Make the block of the channels, and the nodes of a finger where there is one."""
        first, *more = specs
        self._block = AnalogBlock(first)
        self._finger = TactileNodes(shape, more, self.kit) if shape is not None else None

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        """The channels; of a finger its strains and shape, too."""
        return (self._block,) if self._finger is None else (self._block, *self._finger.blocks)

    def ioctl(self, block: BlockSpec, request: Request, channels: Sequence[int], argument: Any) -> Any:
        """Answer the requests of a finger's nodes."""
        if self._finger is None or not block.name:
            return super().ioctl(block, request, channels, argument)
        return self._finger.ioctl(block, request, argument)


def _finger(settings: ShapeSettings, elements: int) -> Finger:
    from sioms.tactile.finger import from_toml

    path = Path(settings.finger_file)
    try:
        finger = from_toml(read_text(path))
    except OSError as error:
        raise ValueError(f"shape: finger_file {path}: {error.strerror}; sioms tactile calibrate writes one") from None
    except ValueError as error:
        raise ValueError(f"shape: finger_file {path}: {error}") from None
    _check(finger, elements, f"shape: finger_file {path}")
    return finger


def _check(finger: Finger, elements: int, what: str) -> None:
    count = len(finger.angles_rad)
    if count != elements:
        raise ValueError(f"{what}: finger {finger.name!r} has {count} elements; the device has {elements}")
