"""What a driver author writes: one of three small classes. The kit does everything else.

* :class:`TickDriver`: the host closes the loop, or the device is simulated: ``tick`` at ``tick_hz``.
* :class:`LineDriver`: request and reply on a serial or TCP line, one or more :class:`LineUnit` on it
  (a bus); hooks are generators of exchanges (see ``exchange``).
* :class:`StreamDriver`: a device that pushes: ``feed`` takes the bytes as they come.

All three have ``Settings`` (the device's table in the configuration; unknown keys are errors) and
``describe``, which is pure: it runs before there is a process and tells the blocks. The kit owns the
process, the tick, clients, command buffers, markers, synch, emergency stop, dead-man, publication,
reconnection with back-off and link counters. A driver has no threads, no sleeps and no retries.

A driver is found by its entry point in the group ``sioms.drivers``, or by the path of its file in
the configuration (``driver = "./mydriver.py"``, the class named ``DRIVER`` in it).

Concurrency: every hook is called from the one thread of the driver process.
"""

from __future__ import annotations

import errno
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import msgspec

from sioms.native.language import Record
from sioms.protocol.flags import Request

from .blocks import AnyBlock, BlockSpec, Description
from .exchange import Steps
from .locks import claims_of
from .settings import LineSettings

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from sioms.motion import DriveAction, MarkerPort
    from sioms.protocol.nodeinfo import ChannelInfo

    from .golden import Golden
    from .pages import Pages


class InputNode(Protocol):
    """A node of another device that this driver reads (``Description.inputs``)."""

    def read(self, now_ns: int) -> Mapping[str, NDArray[Any]] | None:
        """Return the readings, shape (channels,) each, by name; None while it is not there.

        ``value`` is the position of axes and the data of all others; the columns of its record are there, too.
        """

    def measured(self, now_ns: int, since_ns: int = 0) -> NDArray[np.float64]:
        """Return the values, shape (channels,), for who acts on them: not older than ``since_ns`` [ns].

        Raises:
            NotMeasuredError: they are not to be relied on, with a sentence (sioms.sdk.inputs).
        """

    def fresh(self, now_ns: int) -> list[tuple[int, Mapping[str, NDArray[Any]]]]:
        """Return all snapshots since the last look, oldest first, as (stamp_ns, readings)."""

    @property
    def missed(self) -> int:
        """Snapshots that had been overwritten before the last call of ``fresh`` looked at them."""

    @property
    def stamp_ns(self) -> int:
        """Time stamp of what was returned last [ns]."""

    @property
    def as_of_ns(self) -> int:
        """Instant before which everything shows in what was returned last [ns, CLOCK_MONOTONIC]."""


class AtLimitError(OSError):
    """A held axis was stopped at a limit of its own; it takes commands as before."""


class HeldNode(Protocol):
    """An axis node of another device that is this device's own (``Description.holds``)."""

    @property
    def name(self) -> str:
        """Name of the node."""

    @property
    def channels(self) -> Sequence[ChannelInfo]:
        """Its axes with their limits; empty while it is not held."""

    @property
    def is_there(self) -> bool:
        """Whether it is held now."""

    def drive(self, velocities: Sequence[float]) -> None:
        """Have the axes go at velocities [unit/s] from now until the next command."""

    def stop(self) -> None:
        """Stop the axes at their greatest deceleration."""

    def reset(self, until_ns: int) -> None:
        """Reset the axes after what a reading has shown; a stop that came later stays, and the reset is refused.

        Args:
            until_ns: ``as_of_ns`` of that reading.
        """

    @property
    def shows_reset_ns(self) -> int:
        """Readings as of then or later tell what has become of the last reset [ns]; far ahead while it is not
        answered.
        """

    def trouble(self) -> OSError | None:
        """Return why it has not done as it was told since the last call: refused, stopped, in fault, gone; None: it
        has. AtLimitError when that is all it is.
        """


class Kit(Protocol):
    """What the kit offers a driver."""

    @property
    def markers(self) -> MarkerPort:
        """Marker access for the banks."""

    @property
    def inputs(self) -> Mapping[str, InputNode]:
        """The nodes named in ``Description.inputs`` and in ``Description.holds``."""

    @property
    def held(self) -> Mapping[str, HeldNode]:
        """The nodes named in ``Description.holds``."""

    def log(self, level: str, text: str) -> None:
        """Write a line to the daemon's log; level is debug, info, warning or error."""

    def emergency_stop(self, source: str) -> None:
        """Stop the whole workcell: for an input that is an emergency-stop source."""

    def publish(self, block: AnyBlock, stamp_ns: int) -> None:
        """Publish a block now; only stream drivers need it, for several frames in one feed."""

    def now_ns(self) -> int:
        """Return the time [ns, CLOCK_MONOTONIC]."""


class QuietSteps(Protocol):
    """How a TickDriver ticks while nothing happens, as steps (sioms.native); the loop asks for nothing else then."""

    @property
    def record(self) -> Record:
        """What the steps work on."""

    @property
    def tick(self) -> Callable[[Any, int, int, int], int]:
        """Step of a tick: takes the record, the tick's time, the instant up to which everything is shown [ns], and its
        number; notes the instants and publishes. Returns 0, or something else when ``TickDriver.tick`` is to be called.
        """

    @property
    def slack(self) -> Callable[[Any, int, int, int], int]:
        """Step between ticks: takes the record, now, and the time of the next tick [ns], and 0. Returns 0, or 1 when
        ``TickDriver.slack`` is to be called.
        """

    @property
    def rest(self) -> Callable[[Any, int, int, int], int]:
        """Step after a tick of a device that nobody looks at: takes the record, and three times 0. Returns 1 when the
        device is at rest, as ``TickDriver.is_at_rest`` does, else 0.
        """

    @property
    def stop(self) -> Callable[[Any, int, int, int], int]:
        """Step of a stop: takes the record, now [ns], whether it is latched, and when it was asked for [ns]; all axes
        begin to stop, as from then if that is behind the last tick, as ``Bank.emergency_stop`` would have them, or
        ``Bank.stop``, which is called later for what else there is to be done. Returns 0, or 1 when nothing has been
        done because it takes more than that.
        """

    def is_ready(self, watched: bool, awaited: bool = False) -> bool:
        """Tell whether the next ticks may be steps, and hand the record over.

        Args:
            watched: ``rest`` is not asked.
            awaited: somebody waits for the end of a motion; the tick that finds one has to be the driver's then.
        """

    def resume(self) -> None:
        """Take the record over: steps have been done."""


@dataclass(frozen=True, slots=True)
class Awaited:
    """The answer of ``Driver.ioctl`` to a request that readings to come will have done.

    Args:
        ready: asked after each publication: (value,) when it is done, None while it is not; raises Refusal when it
            cannot be. A device that is lost, and the client's time-out, end the request without it.
    """

    ready: Callable[[], tuple[Any] | None]


class Refusal(Exception):
    """A driver refuses a client's request: becomes the client's OSError.

    Args:
        errno_: POSIX errno, e.g. EINVAL.
        text: sentence without full stop: what is wrong and what would be right.
    """

    def __init__(self, errno_: int, text: str) -> None:
        super().__init__(text)
        self.errno = errno_


class Driver(ABC):
    """What all drivers share.

    Args:
        name: device name in the configuration.
        settings: its validated table.
        kit: services.

    Attributes:
        inputs_ns: a driver that sets it in each tick to the time at which its readings were there
            [ns, CLOCK_MONOTONIC] splits the tick's time in two in the statistics.
        rig: what ``sioms driver check`` runs a driver with that is not shipped: a mapping with the keys of ``Rig``
            of ``sioms.check.rigs``.
        realtime_priority: SCHED_FIFO priority of its process unless the configuration says otherwise; 0: an ordinary
            process. For drivers of hardware; a simulation has no business before other people's work.
    """

    Settings: ClassVar[type[msgspec.Struct]]
    rig: ClassVar[Mapping[str, Any]] = {}
    realtime_priority: ClassVar[int] = 50
    inputs_ns = 0

    def __init__(self, name: str, settings: Any, kit: Kit) -> None:
        self.name = name
        self.settings = settings
        self.kit = kit

    @classmethod
    def variant(cls, settings: Any) -> type[Driver]:
        """Return the class that serves these settings: for a device that either pushes or is asked."""
        return cls

    @classmethod
    @abstractmethod
    def describe(cls, name: str, settings: Any) -> Description:
        """Tell the blocks, rate and inputs; pure; raises ValueError with a sentence for bad settings."""

    @classmethod
    def claims(cls, settings: Any) -> Sequence[str]:
        """Return what no other device may use, in words that are equal for the same: here the key ``line``."""
        return claims_of(settings)

    @classmethod
    def golden(cls, settings: Any) -> Sequence[Golden]:
        """Return messages of the vendor's manual and what the driver makes of them; ``settings`` may be None."""
        return ()

    @property
    @abstractmethod
    def blocks(self) -> Sequence[AnyBlock]:
        """The blocks in the order of the description, made in __init__."""

    def counters(self) -> Mapping[str, int | str]:
        """Return the counters that the driver's codec keeps, and the device's status in words, for GET_STATISTICS."""
        return {}

    def ioctl(self, block: BlockSpec, request: Request, channels: Sequence[int], argument: Any) -> Any:
        """Answer a request that the kit does not answer itself: CALIBRATE_DEVICE of a sensor with a tare of its own ...

        The kit answers all axis requests through the bank, and zero and gains of analog blocks. Return a
        msgpack-able value, ``Awaited`` for one that comes with later readings, or in a driver with a line the steps
        that end in one.

        Raises:
            Refusal: not supported or not now.
        """
        raise Refusal(errno.ENOTTY, f"{request.name} is not a request this device knows")


class TickDriver(Driver):
    """A driver whose ``tick`` runs at the described rate; the kit publishes all blocks after it."""

    def open(self) -> None:  # a hook that may stay empty
        """Get ready; raises LinkError to be retried later."""

    @abstractmethod
    def tick(self, now_ns: int) -> None:
        """Do one period: read inputs, tick the banks, drive the outputs, fill the blocks.

        A LinkError says that the device is gone: the kit tells the readers and opens it again.

        Args:
            now_ns: the scheduled time of this tick [ns, CLOCK_MONOTONIC], not the time it began. After a stop a tick
                may come early, at 250 Hz or less, or be for the time it begins when it is late; a quarter of a period
                after the last one at the soonest.
        """

    def write_outputs(self, block: BlockSpec, channels: Sequence[int], values: Sequence[float]) -> None:
        """Set output channels of a writable binary or analog block; takes effect in the next tick.

        Values are validated against the channel's width or range. Called for clients, and for the
        safe values when a writer goes away or the workcell stops.
        """
        raise NotImplementedError(f"{type(self).__name__} describes a writable block but takes no outputs")

    def quiet_steps(self, pages: Pages, instants: NDArray[np.int64]) -> QuietSteps | None:
        """Return the steps that tick while nothing happens; None, as by default, where there are none.

        Args:
            pages: what the steps publish, as ``Pages.record``.
            instants: where the steps note when the readings are there and when the outputs are set [ns].
        """
        return None

    def slack(self, now_ns: int, until_ns: int) -> None:  # a hook that may stay empty
        """Use the time between two ticks, e.g. for ``bank.plan_ahead``: after a tick, or, of a slow rate, before the
        next.
        """

    def is_at_rest(self) -> bool:
        """Return whether a tick that is left out would change nothing but the readings' time stamps.

        Asked after a tick, while nobody has a node of the device open or reads one through another device. When it has
        been true for a second, ticks come seldom until it is not: see ``sioms.sdk.idling``. Only for what is simulated:
        a real device has faults to be seen and a watchdog to be fed.
        """
        return False

    def close(self) -> None:  # a hook that may stay empty
        """Leave the device safe; axes have already been stopped."""


class LineUnit(ABC):
    """One device on a line. Its hooks are generators of exchanges.

    Attributes:
        name: for messages, e.g. ``mod0 unit 3``.
        misses: failed exchanges in a row after which the unit counts as lost; it is then reopened
            every few seconds, and the others on the line do not wait for it.
        silence_s: a poll that has begun and brought nothing for this long [s] loses the unit too, however many
            exchanges have failed, and however long their time-outs are: its readings would pass for new.
    """

    name: str
    misses: int = 3
    silence_s: float = 0.5

    @property
    @abstractmethod
    def blocks(self) -> Sequence[AnyBlock]:
        """The blocks this unit fills."""

    @abstractmethod
    def open(self) -> Steps:
        """Identify the device, set its dead-man, stop what moves; runs again after every loss.

        Raises:
            LinkError: no answer; retried with back-off.
            DeviceError: wrong identity and the like; the unit goes into fault, with the sentence.
        """

    @abstractmethod
    def poll(self) -> Steps:
        """Read the state once and fill the blocks.

        For axes call ``bank.poll(...)`` with what was read: the kit then carries out the actions that
        the bank wants, stops first. Runs at the described rate, and at once after a command.

        Raises:
            StateLost: what ``open`` has set is gone: the unit is opened again at once.
        """

    def act(self, action: DriveAction) -> Steps:
        """Carry out what a DriveBank wants: start a command, stop, home, or reset a fault.

        Raises:
            DeviceError: the drive refuses; the axis goes into fault.
        """
        raise NotImplementedError(f"{type(self).__name__} describes axes but carries out no actions")

    def write_outputs(self, block: BlockSpec, channels: Sequence[int], values: Sequence[float]) -> Steps:
        """Write output channels of a writable binary or analog block.

        ``block.data`` must show what the device has: ``poll`` reads it back, or this sets it when the device has
        acknowledged. The kit makes ports of single bits from it, and sends safe values until they show there.
        """
        raise NotImplementedError(f"{type(self).__name__} describes a writable block but takes no outputs")

    def stop(self) -> Steps:
        """Stop all motion of this unit as fast as it can; needs no prior state, repeatable."""
        yield from ()

    def close(self) -> Steps:
        """Leave the device safe; ``stop`` has run already."""
        yield from ()


class LineDriver(Driver):
    """A driver of one or several units on one line; one exchange is in flight at a time.

    Attributes:
        line: the line's settings.
        side_line: as of StreamDriver.
        overheard: takes bytes that no exchange waits for, and the time [ns]: for devices that also speak unasked
            (alarms); None counts them as noise.
        gap_s: silence on the line before each request [s].
        recovery_s: silence after a time-out before the input is discarded and the next request is
            sent: the longest turn-around of a device, so that a late reply is never taken for the next.
    """

    line: LineSettings
    side_line: LineSettings | None = None
    overheard: Callable[[bytes, int], None] | None = None
    gap_s: float = 0.0
    recovery_s: float = 0.05

    @property
    @abstractmethod
    def units(self) -> Sequence[LineUnit]:
        """The units on the line."""

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        """All blocks of all units, in order."""
        return [block for unit in self.units for block in unit.blocks]


class StreamDriver(Driver):
    """A driver of a device that pushes samples.

    Attributes:
        line: the line's settings; the samples come on it.
        side_line: a TCP connection beside it, for steps that are :class:`~sioms.sdk.exchange.SideExchange`.
        heartbeat_s: period of ``heartbeat`` [s], 0 = never.
        silence_s: without a good frame for this long the link is lost [s].
        advice: what to look at when a stream was started and nothing comes.
        trouble: what is wrong with what comes, where frames come and none is good; told when the link is lost by it.
        gap_s, recovery_s: as of LineDriver.
    """

    line: LineSettings
    side_line: LineSettings | None = None
    heartbeat_s: float = 0.0
    silence_s: float = 0.5
    advice: str = ""
    trouble: str = ""
    gap_s: float = 0.0
    recovery_s: float = 0.1

    @abstractmethod
    def open(self) -> Steps:
        """Identify the device and start the stream; runs again after every loss."""

    @abstractmethod
    def feed(self, data: bytes, now_ns: int) -> int:
        """Take received bytes; fill and publish the blocks (``kit.publish``) for every good frame.

        Args:
            data: bytes as they came, cut anywhere (a whole datagram on UDP).
            now_ns: time of their arrival [ns, CLOCK_MONOTONIC].

        Returns:
            The number of good frames in them; the kit supervises the stream by it. A frame is good when it is new: one
            that was seen before, or whose number or clock stands still, is none.

        Raises:
            LinkError: what comes is no longer the stream that was opened: the device restarted, or somebody else set it
                otherwise. Readers are told at once, and the stream is opened again.
        """

    def heartbeat(self) -> Steps:
        """Keep the stream alive."""
        yield from ()

    def close(self) -> Steps:
        """Stop the stream."""
        yield from ()
