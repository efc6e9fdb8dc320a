"""A drive that closes its own loop, on Modbus, by its register map: the hooks of a LineUnit.

The drive makes its own profiles; the bank decides when a command goes out and when it has ended. Velocity
by jog makes use of drives whose jog ends by itself: every poll sends it again while it shall go on.
"""

from __future__ import annotations

import errno
import math
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import suppress
from typing import Any, assert_never

import numpy as np

from sioms.motion import ActionKind, AxisSettings, Command, DriveAction, DriveBank
from sioms.protocol.flags import AxisStatus, ControlMode
from sioms.sdk.blocks import AnyBlock, AxisBlock, BlockSpec
from sioms.sdk.drive_axes import end_at_soft_limit
from sioms.sdk.driver import Kit, LineUnit
from sioms.sdk.exchange import DeviceError, Pause, Steps, while_wanted

from .guard import Guard
from .unit import MappedUnit, Read, Values

SELDOM_NS = 1_000_000_000
SEARCH_RESTS_NS = 3_000_000_000
"""How long a drive may stand in the middle of a search for its reference."""
BEGIN_NS = 100_000_000
"""What a drive may take to begin a homing that it has taken."""
HOME_TURNS = 0.005
"""How near to 0 a drive stands that has homed and has no status bit for that, in turns of the motor."""
REST_S = 5.0
"""Longest time that a drive may take to come to rest when it is opened [s]."""
LOOKS_AT_REST = 10
"""Looks at a braking drive before it is told to stop again."""
LOOK_S = 0.02
LATENCY_S = 0.03
"""Longest time that a start may wait for the line before the drive gets it."""


class DriveUnit(LineUnit):
    """One drive on the line.

    Args:
        name: for messages.
        mapped: the unit and its map.
        settings: the axis as the bank knows it.
        jogs: velocity goes by jog, which is sent again by every poll.
        enable: switch the drive on when it is opened and reset.
        spec: its block.
        kit: services.
        clock: the time [ns, CLOCK_MONOTONIC].
    """

    def __init__(
        self,
        name: str,
        mapped: MappedUnit,
        settings: AxisSettings,
        spec: BlockSpec,
        kit: Kit,
        *,
        jogs: bool,
        enable: bool = True,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.name = name
        self._mapped, self._jogs, self._clock = mapped, jogs, clock
        self._enable = enable and "enable" in mapped.rmap.commands
        self._rmap = mapped.rmap
        if self._rmap.axis is None:
            raise ValueError(f"{name}: the map describes no axis")
        self._axis = self._rmap.axis
        self.bank = DriveBank([settings], markers=kit.markers, capacity=spec.capacity)
        self._block = AxisBlock(spec, self.bank)
        self._plans = {
            group: self._mapped.plan(self._rmap.poll.get(group, ())) for group in ("always", "seldom", "open")
        }
        # the place last: what is read while it brakes, or before its homing sets the zero, is not where it rests
        self._plans["always"] = tuple(sorted(self._plans["always"], key=self._has_place))
        self._alarm_plan = self._mapped.plan([self._rmap.alarms.signal] if self._rmap.alarms else [])
        self._log = kit.log
        self._guard = Guard(mapped, log=kit.log)
        self._seldom_ns = 0
        self._alarm = 0
        self._homes = False
        self._homing_ns = 0
        """When a homing was asked for that has not been seen to begin; 0: it has."""
        self._homed: bool | None = None
        self._moved_ns = 0
        """When it moved last, or did not home [ns]."""
        self._runs = self._lost = self._is_slow = False
        self._polled_ns = 0
        self._epoch = 0
        self._jog = ""
        self._jog_speed = 0.0
        self._position = 0.0
        self._last: tuple[int, float] | None = None

    @property
    def blocks(self) -> Sequence[AnyBlock]:
        """The one axis."""
        return (self._block,)

    def open(self) -> Steps:
        """Identify the drive, bring it to rest, see whether it was off meanwhile, and switch it on.

        Whatever another master or an earlier host left running ends here, before anything is switched on.
        """
        self._jog, self._jog_speed, self._last, self._seldom_ns = "", 0.0, None, 0
        self._homes, self._runs, self._alarm = False, False, 0
        yield from self._guard.clear()
        yield from self._mapped.identify({"pulses_per_turn": self._mapped.gearing.pulses_per_turn})
        yield from self._bring_to_rest()
        yield from self._end_silence_alarm()
        was_off = yield from self._guard.open()
        if was_off and not self._rmap.restart.keeps_place:
            self._lose_place("it was switched off, and counts from another zero")
        if self._enable:
            yield from self._mapped.command("enable")

    def poll(self) -> Steps:
        """Read the status and the position, keep a jog alive, and tell the bank."""
        if self._jog:
            yield from self._mapped.command(self._jog)
        values = yield from self._mapped.read(self._plans["always"])
        now_ns = self._clock()
        self._block.stamp_ns = now_ns
        yield from self._guard.poll(now_ns)
        yield from self._read_seldom(values, now_ns)
        fault = self._fault(values)
        moving, done = self._motion(values)
        self._position = float(values[self._axis.position])
        self._look_at_place(values, now_ns)
        self._look_at_search(moving, now_ns)
        self.bank.poll(
            now_ns,
            np.array([self._position]),
            np.array([self._velocity(values, now_ns)]),
            np.array([moving]),
            np.array([done]),
            [fault],
            holds=np.array([self._holds(values)]),
            asked_ns=self._block.asked_ns,
        )
        self._end_before_soft_limit(now_ns)
        lost = bool(int(self.bank.rows["status"][0]) & AxisStatus.POSITION_LOST)
        if lost and not self._lost:  # one fault for one cause: look at once whether it was a restart
            self._guard.look_soon()
        self._lost = lost

    def act(self, action: DriveAction) -> Steps:
        """Start a command, stop, home or reset.

        A stop makes void what was asked before it and is still waiting for the line.
        """
        if action.kind is not ActionKind.RESET:
            self._jog, self._homes, self._runs = "", False, False
        if action.is_stop:
            self._epoch += 1
        if action.is_stop or action.kind is ActionKind.RESET:
            return self._act(action)
        return self._unless_overtaken(action, self._epoch)

    def stop(self) -> Steps:
        """Stop, whatever goes on."""
        self._jog, self._homes, self._runs = "", False, False
        self._epoch += 1
        return self._brake("fastest")

    # --- inside ----------------------------------------------------------------------------------

    def _has_place(self, read: Read) -> bool:
        return any(name == self._axis.position for name, *_ in read.parts)

    def _bring_to_rest(self) -> Steps:
        """Stop the drive until it reads at rest.

        Raises:
            DeviceError: EBUSY, it moves on: somebody else commands it.
        """
        end_ns = self._clock() + int(REST_S * 1e9)
        while True:
            yield from self._mapped.command("fastest")
            for _ in range(LOOKS_AT_REST):
                values = yield from self._mapped.read(self._plans["always"])
                if not self._motion(values)[0]:
                    return
                yield Pause(LOOK_S)
            if self._clock() > end_ns:
                text = f"{self.name}: still moves {REST_S:g} s after it was told to stop"
                raise DeviceError(errno.EBUSY, f"{text}; look for another master on its line")

    def _end_silence_alarm(self) -> Steps:
        """Reset the alarm by which the drive tells that the host before this one, or the cable, fell silent."""
        if self._rmap.alarms is not None and self._rmap.dead_man.alarm:
            values = yield from self._mapped.read(self._alarm_plan)
            if int(values[self._rmap.alarms.signal]) == self._rmap.dead_man.alarm:
                yield from self._mapped.command("reset")

    def _lose_place(self, text: str) -> None:
        """Say that the drive does not know where it is; no positions are taken until it is homed or calibrated."""
        self.bank.lose_place([0], f"{self.name}: position lost: {text}", self._clock())

    def _look_at_place(self, values: Values, now_ns: int) -> None:
        """Tell the bank when the drive has found or lost its reference."""
        alarms = self._rmap.alarms
        if alarms is not None and self._alarm in alarms.place_lost:
            self._lose_place(self._mapped.alarm_text(self._alarm))
        if "homed" in self._axis.status and not self._homes:
            self._note_reference(self._bit(values, "homed"), now_ns)

    def _look_at_search(self, moving: bool, now_ns: int) -> None:
        """End a homing that was broken off, by another master: the drive stands for long, and knows no reference."""
        if not self._homes or moving:
            self._moved_ns = now_ns
        elif now_ns - self._moved_ns > SEARCH_RESTS_NS:
            self._homes = False
            text = "the homing was broken off, and found no reference; RESET, then HOME again"
            self.bank.break_off([0], f"{self.name}: {text}", now_ns)

    def _end_before_soft_limit(self, now_ns: int) -> None:
        """Stop a velocity before it passes a soft limit."""
        between_s, self._polled_ns = min(1.0, (now_ns - self._polled_ns) / 1e9), now_ns
        if self._runs and end_at_soft_limit(self.bank, 0, between_s, self.name, self._log, now_ns):
            self._runs = False

    def _holds(self, values: Values) -> bool:
        """Return whether the drive is switched on, so that its axis cannot be turned by hand."""
        return "enabled" not in self._axis.status or self._bit(values, "enabled")

    def _unless_overtaken(self, action: DriveAction, epoch: int) -> Steps:
        """Carry out an action, and no further once a stop has overtaken it: a command may take several messages."""
        yield from while_wanted(self._act(action), lambda: epoch == self._epoch)

    def _act(self, action: DriveAction) -> Steps:
        match action.kind:
            case ActionKind.START:
                if action.command is not None:
                    yield from self._start(action.command, action)
            case ActionKind.STOP:
                yield from self._brake("stop")
            case ActionKind.QUICK_STOP:
                yield from self._brake("fastest")
            case ActionKind.HOME:
                yield from self._home()
            case ActionKind.RESET:
                yield from self._reset()
            case _:
                assert_never(action.kind)

    def _brake(self, stop: str) -> Steps:
        """Stop, and no slower than the axis may, whatever ramp the command has that runs."""
        if self._is_slow and "brake" in self._rmap.commands:
            hardest = self.bank.settings[0].acceleration_max
            with suppress(DeviceError):  # the stop must go out all the same
                yield from self._mapped.command("brake", acceleration=hardest, deceleration=hardest)
        yield from self._mapped.command(stop)

    def _start(self, command: Command, action: DriveAction) -> Steps:
        mode = ControlMode(command.control_mode)
        self._is_slow = action.acceleration_max < self.bank.settings[0].acceleration_max
        ramps = {"acceleration": action.acceleration_max, "deceleration": action.acceleration_max}
        if mode & ControlMode.POSITION:
            if mode & ControlMode.VELOCITY:
                text = "the drive cannot pass a position with a velocity; want POSITION alone"
                raise DeviceError(errno.EINVAL, text)
            speed = self._speed(command, mode, action)
            yield from self._mapped.command("position", position=command.position, speed=speed, **ramps)
            return
        self._runs = True
        if self._jogs:
            yield from self._start_jog(command.velocity)
        else:
            yield from self._mapped.command("velocity", velocity=command.velocity, **ramps)

    def _speed(self, command: Command, mode: ControlMode, action: DriveAction) -> float:
        """Return the top speed; for a move of given time the one whose trapezoid takes that time.

        The move ends a little early rather than late, for when its time is over the axis is stopped: the ramps
        count as the register holds them, the speed goes up to the next step of its register.
        """
        top = action.velocity_max
        duration_s = command.time - min(LATENCY_S, command.time / 4)
        if not mode & ControlMode.SPECIFIED_TIME or command.time <= 0:
            return top
        rate = self._mapped.in_register("position", "acceleration", action.acceleration_max)
        # d = v T - v^2 / a, the smaller root; none when the time is too short for the acceleration
        distance = abs(command.position - self._position)
        under = (rate * duration_s) ** 2 - 4 * rate * distance
        if under < 0 or distance == 0:
            return top
        speed = (rate * duration_s - math.sqrt(under)) / 2
        return min(top, self._mapped.in_register("position", "speed", speed, more=1))

    def _start_jog(self, velocity: float) -> Steps:
        """Begin or turn a jog; it is sent again by every poll, until it is stopped."""
        speed = abs(velocity)
        if speed == 0:
            yield from self._mapped.command("stop")
            return
        if speed != self._jog_speed:
            yield from self._mapped.command("jog_speed", speed=speed)
            self._jog_speed = speed
        forward = velocity * self._mapped.gearing.travel_per_turn > 0
        self._jog = "jog_plus" if forward else "jog_minus"
        yield from self._mapped.command(self._jog)

    def _home(self) -> Steps:
        self._homed = None
        if "home" not in self._rmap.commands:
            raise DeviceError(errno.EOPNOTSUPP, "the drive cannot home by itself; use CALIBRATE_DEVICE")
        self._homes, self._homing_ns = True, self._clock()
        yield from self._mapped.command("home")
        self._homing_ns = self._clock()

    def _reset(self) -> Steps:
        if self._alarm and self._rmap.alarms and self._alarm in self._rmap.alarms.lasting:
            raise DeviceError(errno.EIO, self._mapped.alarm_text(self._alarm))
        if "reset" in self._rmap.commands:
            yield from self._mapped.command("reset")
        if self._enable:
            yield from self._mapped.command("enable")
        self._seldom_ns = 0

    def _read_seldom(self, values: Values, now_ns: int) -> Generator[Any, Any, None]:
        """Read the alarm when the drive says fault, and the rest once a second.

        Without an alarm the drive is asked once more: it may have been reset between the two answers.
        """
        if self._rmap.alarms and self._bit(values, "fault"):
            alarm = yield from self._mapped.read(self._alarm_plan)
            self._alarm = int(alarm[self._rmap.alarms.signal])
            if not self._alarm:
                values |= yield from self._mapped.read(self._plans["always"])
        else:
            self._alarm = 0
        if now_ns >= self._seldom_ns and self._plans["seldom"]:
            self._seldom_ns = now_ns + SELDOM_NS
            values |= yield from self._mapped.read(self._plans["seldom"])

    def _note_reference(self, homed: bool, now_ns: int) -> None:
        """Tell the bank when the drive finds its reference, or loses it."""
        if self._homed and not homed:
            self.bank.lose_place([0], f"position lost: {self.name} no longer knows its reference", now_ns)
        if self._homed is not homed:
            self.bank.set_homed([0], homed)
        self._homed = homed

    def _bit(self, values: Values, name: str) -> bool:
        bit = self._axis.status.get(name)
        if bit is None:
            return False
        return bool(int(values[bit.signal]) >> bit.bit & 1) != bit.inverted

    def _fault(self, values: Values) -> str:
        if self._bit(values, "fault"):
            return self._mapped.alarm_text(self._alarm) or "the drive reports a fault without a code"
        if "enabled" in self._axis.status and not self._bit(values, "enabled"):
            return "the drive is switched off"
        return ""

    def _motion(self, values: Values) -> tuple[bool, bool]:
        """Return whether the drive moves, and whether what it was told is done."""
        status: Mapping[str, Any] = self._axis.status
        moving = self._bit(values, "moving") if "moving" in status else not self._bit(values, "done")
        if moving or ("homed" in status and not self._bit(values, "homed")):
            self._homing_ns = 0
        if self._homes and self._homing_ns and self._clock() - self._homing_ns < BEGIN_NS:
            return moving, False  # what it tells yet may be of the homing before
        if self._homes and "homed" in status:
            done = self._bit(values, "homed")
        else:
            name = next((each for each in ("done", "in_position") if each in status), None)
            done = self._bit(values, name) if name else not moving
            if self._homes:  # what was broken off stands still as well
                done = done and abs(float(values[self._axis.position])) <= HOME_TURNS * abs(
                    self._mapped.gearing.travel_per_turn
                )
        if done and self._homes and not moving:
            self._homes, self._last = False, None  # its zero is another one
        return moving, done

    def _velocity(self, values: Values, now_ns: int) -> float:
        """Return the drive's velocity, or the difference of positions when it tells none."""
        if self._axis.velocity is not None:
            return float(values[self._axis.velocity])
        last, self._last = self._last, (now_ns, self._position)
        if last is None or now_ns <= last[0]:
            return 0.0
        velocity = (self._position - last[1]) / ((now_ns - last[0]) / 1e9)
        has_new_zero = self._homes and abs(velocity) > self.bank.settings[0].velocity_max
        return 0.0 if has_new_zero else velocity
