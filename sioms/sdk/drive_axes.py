"""Axes of drives that close their own loop: their configuration, and a unit that obeys the bank.

A driver of such a family subclasses :class:`AxesUnit`, reads the drive in ``poll`` and calls ``report``, and tells how
to start, stop, home and reset one axis. What is the same for all is here: the actions of the bank, starts that a stop
has made void, the speed of a move of given time, and velocities that would run past a soft limit.
"""

from __future__ import annotations

import errno
import math
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, assert_never

import msgspec
import numpy as np
from numpy.typing import NDArray

from sioms.motion import ActionKind, AxisSettings, Command, DriveAction, DriveBank, Homing
from sioms.protocol.flags import AxisStatus, ControlMode, NodeClass
from sioms.protocol.nodeinfo import ChannelInfo

from .blocks import AnyBlock, AxisBlock, BlockSpec, Description
from .driver import Kit, LineUnit
from .exchange import DeviceError, LinkError, Steps, while_wanted
from .settings import LineSettings
from .tables import from_table, table_type

BANK_MODES = (
    ControlMode.SPECIFIED_TIME
    | ControlMode.WAIT_FOR_EXTERNAL_SYNCH
    | ControlMode.SPECIFIED_MAX_VEL_ACC
    | ControlMode.SPECIFIED_WAIT_MARKER
    | ControlMode.SPECIFIED_SIGNAL_MARKER
)
"""What the bank adds to the modes that a drive has."""
POSITION_MODES = ControlMode.POSITION | ControlMode.RELATIVE
SHORT_NS = 500_000_000
"""How long an axis may stand short of its target before that is a fault."""
LATENCY_S = 0.03
"""Longest time that a start may wait for the line before the drive gets it."""
_SERVO_KEYS = ("kind", "modes", "homing", "jerk_max", "k", "kz", "kp", "kb", "ki", "force_offset")
_UNUSED_KEYS = (*_SERVO_KEYS, "velocity_filter_s", "following_error_max", "start_velocity")


class DriveSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Keys that the devices of such drives share.

    Attributes:
        line: that the drives are on.
        poll_hz: rate at which each is read.
        capacity: commands that each axis buffers.
        history: snapshots kept for readers.
    """

    line: LineSettings
    poll_hz: float = 50.0
    capacity: int = 4096
    history: int = 64


def drive_table(extra: Mapping[str, tuple[Any, Any]], *, force: bool = False) -> Any:
    """Return the table of an axis: the keys of AxisSettings that such a drive leaves, and ``extra``.

    Args:
        extra: further keys: name to (type, default).
        force: the drive has a force or torque mode, so ``force_max`` is a key.
    """
    without = _UNUSED_KEYS if force else (*_UNUSED_KEYS, "force_max")
    return table_type(AxisSettings, without=without, extra=extra)


def axis_settings(axis: Any, modes: ControlMode, *, homing: bool = False, required: bool = False) -> AxisSettings:
    """Return an axis as the bank knows it; a drive homes by its own parameters, so only "required" matters."""
    own = Homing(axis.velocity_max, axis.velocity_max, required=required) if homing else None
    return from_table(AxisSettings, axis, {"modes": modes, "homing": own})


def axis_spec(name: str, settings: Sequence[AxisSettings], about: str, capacity: int, history: int) -> BlockSpec:
    """Return the block of these axes."""
    channels = []
    for axis in settings:
        limits = {"velocity": axis.velocity_max, "acceleration": axis.acceleration_max}
        if axis.modes & ControlMode.FORCE:
            limits["force"] = axis.force_max
        channels.append(
            ChannelInfo(
                axis.name, axis.unit, axis.position_min, axis.position_max,
                modes=int(axis.modes), limits=limits, description=about,
            )
        )  # fmt: skip
    return BlockSpec(name, NodeClass.AXIS, tuple(channels), history=history, capacity=capacity)


def check_axes(
    axes: Sequence[Any], what: str, key: str, span: tuple[int, int] | None, poll_hz: float, highest_hz: float
) -> None:
    """Check what all drivers of axes have in common.

    Args:
        axes: tables of the configuration, one an axis.
        what: is behind an axis, e.g. a motor.
        key: of an axis, that tells it from the others: an address, a number, a letter.
        span: lowest and highest value of the key; None: any.
        poll_hz, highest_hz: rate of polling, and the highest that is possible [Hz].

    Raises:
        ValueError: there is no axis, two have the same key, a key or the rate is out of range.
    """
    if not axes:
        raise ValueError(f"axis: none given; want a table [[...axis]] for each {what}")
    if not 0.1 <= poll_hz <= highest_hz:
        raise ValueError(f"poll_hz = {poll_hz:g}; want 0.1 to {highest_hz:g}")
    values = [getattr(axis, key) for axis in axes]
    for value in values:
        if values.count(value) > 1:
            raise ValueError(f"axis: {values.count(value)} axes have {key} = {value}; want one each")
        if span is not None and not span[0] <= value <= span[1]:
            raise ValueError(f"axis: {key} = {value}; want {span[0]} to {span[1]}")


def polled(specs: Sequence[BlockSpec], poll_hz: float) -> Description:
    """Describe a device of these blocks that is polled at a rate [Hz]; five polls late, its driver is called hung."""
    return Description(tuple(specs), poll_hz, lease_s=max(0.5, 5 / poll_hz))


def trapezoid_speed(distance: float, duration_s: float, top: float, rate: float) -> float:
    """Return the speed whose trapezoid covers a distance in a time, d = v T - v^2/a, at most ``top``.

    Args:
        distance: to go, either sign [unit].
        duration_s: time for it [s].
        top: highest speed [unit/s].
        rate: acceleration and deceleration [unit/s^2].

    Example:
        >>> round(trapezoid_speed(1.0, 2.0, 10.0, 4.0), 6)
        0.535898
    """
    under = (rate * duration_s) ** 2 - 4 * rate * abs(distance)
    if duration_s <= 0 or under < 0 or distance == 0:
        return top
    return min(top, (rate * duration_s - math.sqrt(under)) / 2)


class AxesUnit(LineUnit):
    """One device on a line with one or several axes whose loops it closes itself.

    Args:
        name: for messages.
        settings: of the axes, as the bank knows them.
        spec: their block.
        kit: services.
        clock: the time [ns, CLOCK_MONOTONIC].
        settle_s: how long after its start a move may take to be seen moving [s].

    Concurrency: the one thread of the driver process.
    """

    def __init__(
        self,
        name: str,
        settings: Sequence[AxisSettings],
        spec: BlockSpec,
        kit: Kit,
        *,
        clock: Callable[[], int] = time.monotonic_ns,
        settle_s: float = 0.05,
    ) -> None:
        self.name = name
        self.clock = clock
        self.bank = DriveBank(settings, markers=kit.markers, capacity=spec.capacity, settle_s=settle_s)
        self.block = AxisBlock(spec, self.bank)
        self._kit = kit
        self._epoch = [0] * len(settings)
        self._runs = [False] * len(settings)
        self._guarded_ns = 0
        self._goes = [False] * len(settings)
        self._stood_ns = [0] * len(settings)
        self._raw = np.zeros(len(settings))
        self._stood = [True] * len(settings)

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        """The one block of axes."""
        return (self.block,)

    # --- what a family tells ---------------------------------------------------------------------

    @abstractmethod
    def start_position(self, axis: int, position: float, speed: float, action: DriveAction) -> Steps:
        """Start a move to a raw position [unit] with a top speed [unit/s] and ``action.acceleration_max``."""

    def start_velocity(self, axis: int, velocity: float, action: DriveAction) -> Steps:
        """Run at a velocity [unit/s] until told otherwise."""
        raise DeviceError(errno.EOPNOTSUPP, f"{self.name}: the drive has no velocity mode")

    def start_force(self, axis: int, force: float, action: DriveAction) -> Steps:
        """Hold a force or torque until told otherwise."""
        raise DeviceError(errno.EOPNOTSUPP, f"{self.name}: the drive has no force mode")

    @abstractmethod
    def halt(self, axis: int, *, fastest: bool) -> Steps:
        """Stop one axis; repeatable, needs no prior state."""

    def home(self, axis: int) -> Steps:
        """Begin the drive's own homing."""
        raise DeviceError(errno.EOPNOTSUPP, f"{self.name}: the drive cannot home by itself; use CALIBRATE_DEVICE")

    def reset(self, axis: int) -> Steps:
        """Clear the drive's fault; raises DeviceError with what is left of it."""
        yield from ()

    # --- what is the same for all ----------------------------------------------------------------

    def report(
        self,
        position: NDArray[np.float64],
        velocity: NDArray[np.float64],
        moving: NDArray[np.bool_],
        done: NDArray[np.bool_],
        fault: Sequence[str],
        force: NDArray[np.float64] | None = None,
        holds: NDArray[np.bool_] | None = None,
    ) -> None:
        """Tell the bank what was read, and keep velocities inside the soft limits.

        Motion that was not commanded is a fault (sioms.motion.watch).

        Args:
            position: raw positions (n,) [unit].
            velocity: measured velocities (n,) [unit/s].
            moving: it moves, or will by an order that it has taken (n,).
            done: it has reached its target (n,).
            fault: why the drive is in fault, '' when it is not, for each axis.
            force: measured forces or torques (n,), None when the drive tells none.
            holds: it is switched on and holds its axis when nothing is commanded (n,); False of one that has let go, so
                that it may be turned by hand. None: all hold.
        """
        now_ns = self.clock()
        self.block.stamp_ns = now_ns
        self._raw = position.copy()
        self.bank.poll(now_ns, position, velocity, moving, done, fault, force, holds, self.block.asked_ns)
        self._guard(now_ns)
        self._look_for_short_moves(now_ns, moving, done)

    def rests(self, axis: int, stands: bool) -> bool:
        """Tell whether an axis rests: it stands now, and has stood at the look before. To be called once a poll.

        For drives that tell a measured speed: a motor that swings about its target, or that is turned round, passes a
        speed of 0 and goes on.
        """
        stood, self._stood[axis] = self._stood[axis], stands
        return stands and stood

    def lose_place(self, axis: int, text: str) -> None:
        """Say that the drive does not know where this axis is, for a reason that only the family can see.

        A counter of uptime or boots that went back, a bit "reference lost", an encoder error. The axis is in fault, and
        takes
        no positions until it is homed or calibrated: RESET alone does not do. May be called from ``open`` and ``poll``,
        again and again while it lasts.
        """
        self.bank.lose_place([axis], f"{self.name}: {text}", self.clock())

    def break_off(self, axis: int, text: str) -> None:
        """Say that the drive's search for its reference has ended without one, whoever has ended it: the axis is in
        fault, as by ``lose_place``, also where its place was lost before.
        """
        self.bank.break_off([axis], f"{self.name}: {text}", self.clock())

    def act(self, action: DriveAction) -> Steps:
        """Carry out what the bank wants; a stop makes void the starts that still wait for the line."""
        if action.kind is not ActionKind.RESET:
            self._runs[action.axis] = self._goes[action.axis] = False
        if action.is_stop:
            self._epoch[action.axis] += 1
            return self.halt(action.axis, fastest=action.kind is ActionKind.QUICK_STOP)
        if action.kind is ActionKind.RESET:
            return self.reset(action.axis)  # a stop that overtakes it does not make it void
        return self._unless_overtaken(action, self._epoch[action.axis])

    def stop(self) -> Steps:
        """Stop all axes the fastest way; one that does not obey keeps none of the others from being stopped."""
        failures: list[LinkError | DeviceError] = []
        for axis in range(self.bank.n):
            self._epoch[axis] += 1
            self._runs[axis] = self._goes[axis] = False
            try:
                yield from self.halt(axis, fastest=True)
            except (LinkError, DeviceError) as error:
                failures.append(error)
        if failures:
            raise failures[0]

    def _unless_overtaken(self, action: DriveAction, epoch: int) -> Steps:
        """Carry out an action, and no further once a stop has overtaken it."""
        yield from while_wanted(self._steps(action), lambda: epoch == self._epoch[action.axis])

    def _steps(self, action: DriveAction) -> Steps:
        match action.kind:
            case ActionKind.START:
                if action.command is not None:
                    yield from self._start(action.command, action)
            case ActionKind.HOME:
                yield from self.home(action.axis)
            case ActionKind.RESET:
                yield from self.reset(action.axis)
            case ActionKind.STOP | ActionKind.QUICK_STOP:
                yield from self.halt(action.axis, fastest=action.kind is ActionKind.QUICK_STOP)
            case _:
                assert_never(action.kind)

    def _start(self, command: Command, action: DriveAction) -> Steps:
        mode, axis = ControlMode(command.control_mode), action.axis
        if mode & ControlMode.POSITION:
            if mode & ControlMode.VELOCITY:
                text = "the drive cannot pass a position with a velocity; POSITION alone is right"
                raise DeviceError(errno.EINVAL, text)
            speed = action.velocity_max
            if mode & ControlMode.SPECIFIED_TIME and command.time > 0:
                # a little early rather than late: when its time is over the axis is stopped
                duration_s = command.time - min(LATENCY_S, command.time / 4)
                distance = command.position - self.raw_position(axis)
                speed = trapezoid_speed(distance, duration_s, speed, action.acceleration_max)
            yield from self.start_position(axis, command.position, speed, action)
            self._goes[axis], self._stood_ns[axis] = True, 0
        elif mode & ControlMode.FORCE:
            self._runs[axis] = True
            yield from self.start_force(axis, command.force, action)
        else:
            self._runs[axis] = True
            yield from self.start_velocity(axis, command.velocity, action)

    def raw_position(self, axis: int) -> float:
        """Return the position that the drive reported last, without calibration [unit]."""
        return float(self._raw[axis])

    def _look_for_short_moves(self, now_ns: int, moving: NDArray[np.bool_], done: NDArray[np.bool_]) -> None:
        """Put an axis in fault that came to rest before its target: a limit switch, a stall, a stop by others."""
        for axis in _where(self._goes):
            if moving[axis]:
                self._stood_ns[axis] = 0
            elif done[axis] and self._stood_ns[axis]:  # it was so at the last look, too
                self._goes[axis] = False
            elif not self._stood_ns[axis]:
                self._stood_ns[axis] = now_ns
            elif now_ns - self._stood_ns[axis] > SHORT_NS:
                self._goes[axis] = False
                text = (
                    f"{self.name}: came to rest at {self.bank.rows['position'][axis]:g} before its target; check its "
                    "limit switches"
                )
                self.bank.fault([axis], text, now_ns)

    def _guard(self, now_ns: int) -> None:
        """Stop an axis that runs at a velocity, or by a force, before it passes a soft limit."""
        between_s = min(1.0, (now_ns - self._guarded_ns) / 1e9)
        self._guarded_ns = now_ns
        for axis in _where(self._runs):
            if end_at_soft_limit(self.bank, axis, between_s, self.name, self._kit.log, now_ns):
                self._runs[axis] = False


def end_at_soft_limit(
    bank: DriveBank, axis: int, between_s: float, who: str, log: Callable[[str, str], None], now_ns: int
) -> bool:
    """Stop an axis that runs at a velocity, or by a force, before it passes a soft limit; return whether it did.

    Args:
        bank: that has just been polled.
        axis: of the bank.
        between_s: time between two polls [s].
        who: the device, for the sentence.
        log: takes a level and the sentence.
        now_ns: time of the poll [ns].
    """
    settings, limits = bank.settings[axis], bank.get_limits([axis])
    low, high = limits["position_min"][0], limits["position_max"][0]
    position, velocity = float(bank.rows["position"][axis]), float(bank.rows["velocity"][axis])
    # up to two polls and the stop's way over the line pass before the drive brakes
    ahead = velocity * (2 * between_s + LATENCY_S) + velocity * abs(velocity) / (2 * settings.acceleration_max)
    passed_low = low is not None and velocity < 0 and position + ahead < low
    passed_high = high is not None and velocity > 0 and position + ahead > high
    if not passed_low and not passed_high:
        return False
    bound = low if passed_low else high
    text = f"{who} {settings.name}: stopped at {position:g}, the soft limit is {bound:g}"
    log("warning", text)
    bank.stop_at_limit([axis], AxisStatus.LIMIT_MINUS if passed_low else AxisStatus.LIMIT_PLUS, text, now_ns)
    return True


def _where(marks: Sequence[bool]) -> list[int]:
    """Return the axes that are marked."""
    return [axis for axis, mark in enumerate(marks) if mark]
