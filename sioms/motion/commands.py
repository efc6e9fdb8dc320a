"""Validation of written axis records, vectorised over the array; nothing is taken when one is bad.

A record is checked field by field against the flags of its ``control_mode``; fields whose flag is
not set are ignored. The rules are one table (RULES), so that a message can always say what would
have been accepted.
"""

from __future__ import annotations

import errno
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sioms.protocol.flags import QUANTITIES, ControlMode, NodeClass
from sioms.protocol.records import WRITE, AxisWrite, numpy_dtype, tuple_of

from .settings import AxisKind, AxisSettings
from .types import CommandError, MarkerPort, RecordError

WIRE_DTYPE = np.dtype(numpy_dtype(NodeClass.AXIS))
COMMAND_DTYPE = np.dtype([*numpy_dtype(NodeClass.AXIS), ("signal_generation", "<i8"), ("wait_generation", "<i8")])
"""A record as buffered: ``axis`` is the bank axis, marker tokens are resolved to number and generation."""

M = ControlMode
KNOWN = sum(ControlMode)
COMBINATIONS = (
    M.JERK,
    M.ACCELERATION,
    M.VELOCITY,
    M.VELOCITY | M.ACCELERATION,
    M.POSITION,
    M.POSITION | M.VELOCITY,
    M.POSITION | M.VELOCITY | M.ACCELERATION,
    M.FORCE,
    M.FORCE_VELOCITY,
)
POINT_MOVE = int(M.POSITION), int(M.POSITION | M.VELOCITY | M.ACCELERATION | M.SPECIFIED_TIME)
FORCE_FLAGS = M.FORCE | M.FORCE_VELOCITY | M.SPECIFIED_FORCE_OFFSET | M.SPECIFIED_MAX_FORCE
_IS_COMBINATION = np.zeros(QUANTITIES + 1, dtype=bool)
_IS_COMBINATION[[int(c) for c in COMBINATIONS]] = True


class Command(tuple_of("Command", COMMAND_DTYPE.names or ()), AxisWrite):  # type: ignore[misc]
    """One buffered record as Python numbers, in the order of COMMAND_DTYPE."""

    __slots__ = ()
    signal_generation: int
    wait_generation: int


def is_point_move(mode: Any) -> Any:
    """Tell whether a control mode, or each of an array of them, commands a point move (see arrival.py)."""
    quantity, mask = POINT_MOVE
    return (mode & mask) == quantity


LONGEST_MOVE_S = 7600.0
"""No longer move to a position is planned (error -101 of Ruckig)."""


class Limits:
    """Limits of every axis as arrays (n,), absent ones infinite.

    ``velocity``, ``acceleration`` and ``force`` are the configured maxima.
    """

    def __init__(self, settings: Sequence[AxisSettings]) -> None:
        inf = np.inf

        def column(name: str, absent: float) -> NDArray[np.float64]:
            values = [getattr(s, name) for s in settings]
            return np.array([absent if v is None else v for v in values], dtype=np.float64)

        self.minimum = column("position_min", -inf)
        self.maximum = column("position_max", inf)
        self.velocity = column("velocity_max", inf)
        self.acceleration = column("acceleration_max", inf)
        self.jerk = column("jerk_max", inf)
        self.force = column("force_max", inf)
        take_up = np.array([s.backlash.distance if s.backlash else 0.0 for s in settings])
        self.room_below, self.room_above = np.maximum(take_up, 0.0), np.maximum(-take_up, 0.0)
        """Stretches inside the soft limits that point moves leave for their take-up."""

    def about_room(self, axis: int) -> str:
        """Return what to add to the limits in a message, when a take-up narrows them."""
        room = float(max(self.room_below[axis], self.room_above[axis]))
        return f" with {room:g} left for the take-up of backlash" if room else ""

    def reach(self, axis: NDArray[np.int64], mode: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the lowest and highest position that each command of these modes may lead its axis to."""
        low, high, point = self.minimum[axis], self.maximum[axis], is_point_move(mode)
        return low + point * self.room_below[axis], high - point * self.room_above[axis]


class Rule(NamedTuple):
    """What bounds a column of a command where its flag is set."""

    flag: int
    field: str
    bound: str
    """Name of the array in Limits: |value| at most that; "" when only finiteness is asked."""
    positive: bool
    unit: str


def _rule(field: str, bound: str = "", *, positive: bool = False) -> Rule:
    column = WRITE[NodeClass.AXIS][field]
    return Rule(column.flag, field, bound, positive, column.unit)


RULES = (
    _rule("velocity", "velocity"),
    _rule("acceleration", "acceleration"),
    _rule("jerk", "jerk"),
    _rule("force", "force"),
    _rule("force_velocity"),
    _rule("time"),
    _rule("k"),
    _rule("kz"),
    _rule("kp"),
    _rule("kb"),
    _rule("force_offset", "force"),
    _rule("max_velocity", "velocity", positive=True),
    _rule("max_acceleration", "acceleration", positive=True),
    _rule("max_force", "force", positive=True),
)

TOWARDS = _rule("acceleration", "acceleration", positive=True)
"""With a velocity to go over to, the acceleration is a size."""


class Validator:
    """Checks arrays of records against the axes of one bank. Pure: keeps no record.

    Args:
        settings: of the axes.
        limits: of the axes.
        markers: seam to the marker table.
        passing: whether the axes can pass a position at a velocity.
    """

    def __init__(
        self, settings: Sequence[AxisSettings], limits: Limits, markers: MarkerPort, passing: bool = True
    ) -> None:
        self._settings = settings
        self._limits = limits
        self._markers = markers
        self._passing = passing
        self._modes = np.array([int(s.modes) for s in settings], dtype=np.uint32)
        stepper = np.array([s.kind is AxisKind.STEPPER for s in settings])
        self._modes[stepper] &= np.uint32(KNOWN & ~FORCE_FLAGS)

    @property
    def offered(self) -> list[int]:
        """Control-mode flags that each axis can do."""
        return [int(mode) for mode in self._modes]

    @staticmethod
    def place(records: NDArray[Any], axes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the bank axis of each record.

        Args:
            records: structured array of WIRE_DTYPE.
            axes: bank axis of each node-local index.

        Raises:
            RecordError: EINVAL, an axis that the node does not have.
        """
        local = records["axis"]
        bad = (local < 0) | (local >= len(axes))
        if bad.any():
            i = int(bad.argmax())
            raise RecordError(errno.EINVAL, "", i, f"axis {local[i]} does not exist; want 0 to {len(axes) - 1}")
        placed: NDArray[np.int64] = axes[local]
        return placed

    def check(self, records: NDArray[Any], placed: NDArray[np.int64]) -> NDArray[Any]:
        """Return the records as COMMAND_DTYPE, with bank axes and captured markers.

        Args:
            records: structured array of WIRE_DTYPE.
            placed: bank axis of each record.

        Raises:
            RecordError: EINVAL for what no axis like this could do, ERANGE for a value outside
                its limits, and what the marker port raises.
        """
        commands = np.zeros(len(records), dtype=COMMAND_DTYPE)
        for name in WIRE_DTYPE.names or ():
            commands[name] = records[name]
        commands["axis"] = placed
        self._check_modes(commands)
        self._check_values(commands)
        self._check_position(commands)
        self._capture(commands)
        return commands

    def refuse(self, errno_: int, commands: NDArray[Any], i: int, what: str) -> RecordError:
        """Build the error for record i."""
        axis = int(commands["axis"][i])
        return RecordError(errno_, f"{axis} ({self._settings[axis].name})", i, what)

    def _check_modes(self, commands: NDArray[Any]) -> None:
        mode = commands["control_mode"]
        bad = ~_IS_COMBINATION[mode & QUANTITIES] | ((mode & ~np.uint32(KNOWN)) != 0)
        bad |= ((mode & int(M.RELATIVE)) != 0) & ((mode & int(M.POSITION)) == 0)
        if bad.any():
            i = int(bad.argmax())
            names = ", ".join(str(c.name) for c in COMBINATIONS)
            raise self.refuse(
                errno.EINVAL,
                commands,
                i,
                f"control_mode {int(mode[i]):#06x} is not a command; want one of {names}, RELATIVE only with POSITION",
            )
        passes = int(M.POSITION | M.VELOCITY)
        bad = (mode & passes) == passes
        if bad.any() and not self._passing:
            raise self.refuse(
                errno.EINVAL,
                commands,
                int(bad.argmax()),
                "this axis cannot pass a position at a velocity; want POSITION or VELOCITY alone",
            )
        missing = mode & ~self._modes[commands["axis"]]
        if missing.any():
            i = int((missing != 0).argmax())
            offered = ControlMode(int(self._modes[commands["axis"][i]]))
            raise self.refuse(
                errno.EINVAL,
                commands,
                i,
                f"this axis cannot do {ControlMode(int(missing[i])).name}; it has {offered.name}",
            )

    def _check_values(self, commands: NDArray[Any]) -> None:
        mode, axis = commands["control_mode"], commands["axis"]
        present = int(np.bitwise_or.reduce(mode)) if len(mode) else 0
        for rule in RULES:
            if not present & rule.flag:
                continue
            held = (mode & rule.flag) != 0
            value = commands[rule.field]
            bad = held & ~np.isfinite(value)
            if bad.any():
                i = int(bad.argmax())
                raise self.refuse(errno.EINVAL, commands, i, f"{rule.field} is {value[i]}; want a finite number")
            if rule.bound:
                bound = getattr(self._limits, rule.bound)[axis]
                bad = held & ((np.abs(value) > bound) | (rule.positive & (value <= 0)))
                if bad.any():
                    raise self._out_of_range(commands, int(bad.argmax()), rule, bound)
        if present & M.SPECIFIED_TIME:
            self._check_time(commands)
        if present & M.ACCELERATION:
            towards = (mode & QUANTITIES) == int(M.VELOCITY | M.ACCELERATION)
            bad = towards & (commands["acceleration"] <= 0)
            if bad.any():
                raise self._out_of_range(commands, int(bad.argmax()), TOWARDS, self._limits.acceleration[axis])
        if present & M.SPECIFIED_GAINS:
            bad = ((mode & int(M.SPECIFIED_GAINS)) != 0) & (np.abs(commands["kp"]) >= 1)
            if bad.any():
                i = int(bad.argmax())
                raise self.refuse(
                    errno.ERANGE,
                    commands,
                    i,
                    f"kp {commands['kp'][i]} makes the law unstable; want between -1 and 1",
                )

    def _out_of_range(self, commands: NDArray[Any], i: int, rule: Rule, bound: NDArray[np.float64]) -> RecordError:
        settings = self._settings[int(commands["axis"][i])]
        unit = rule.unit.format(u=settings.unit, f=settings.force_unit)
        low = "above 0" if rule.positive else f"{-bound[i]:g}"
        return self.refuse(
            errno.ERANGE,
            commands,
            i,
            f"{rule.field} {commands[rule.field][i]:g} {unit} is outside the limits; want {low} to {bound[i]:g} {unit}",
        )

    def _check_time(self, commands: NDArray[Any]) -> None:
        mode, time = commands["control_mode"], commands["time"]
        timed = (mode & int(M.SPECIFIED_TIME)) != 0
        bad = timed & ((time == 0) | (time > 1e6))
        passing = int(M.POSITION | M.VELOCITY)
        bad |= timed & (time < 0) & ((mode & passing) == passing)
        moves = timed & ((mode & int(M.POSITION)) != 0)
        bad |= moves & (time > LONGEST_MOVE_S)
        if bad.any():
            i = int(bad.argmax())
            most = f"{LONGEST_MOVE_S:g}" if moves[i] else "1e6"
            raise self.refuse(
                errno.EINVAL,
                commands,
                i,
                f"time {time[i]:g} s; want more than 0 and at most {most} s, or negative for "
                "'until the next command' (not with a position that is passed)",
            )

    def _check_position(self, commands: NDArray[Any]) -> None:
        mode, axis, value = commands["control_mode"], commands["axis"], commands["position"]
        held = (mode & int(M.POSITION)) != 0
        if not held.any():
            return
        bad = held & ~np.isfinite(value)
        if bad.any():
            i = int(bad.argmax())
            raise self.refuse(errno.EINVAL, commands, i, f"position is {value[i]}; want a finite number")
        low, high = self._limits.reach(axis, mode)
        bad = held & ((mode & int(M.RELATIVE)) == 0) & ((value < low) | (value > high))
        if bad.any():
            i = int(bad.argmax())
            unit = self._settings[int(axis[i])].unit
            raise self.refuse(
                errno.ERANGE,
                commands,
                i,
                f"position {value[i]:g} {unit} is outside the soft limits; want {low[i]:g} to {high[i]:g} {unit}"
                + self._limits.about_room(int(axis[i])),
            )

    def _capture(self, commands: NDArray[Any]) -> None:
        mode = commands["control_mode"]
        for flag, field, generation in (
            (M.SPECIFIED_SIGNAL_MARKER, "signal_marker_number", "signal_generation"),
            (M.SPECIFIED_WAIT_MARKER, "wait_marker_number", "wait_generation"),
        ):
            held = (mode & int(flag)) != 0
            tokens = commands[field]
            for token in np.unique(tokens[held]).tolist():
                rows = held & (tokens == token)
                try:
                    captured = self._markers.capture(token, signal=flag is M.SPECIFIED_SIGNAL_MARKER)
                except CommandError as e:
                    raise self.refuse(e.errno, commands, int(rows.argmax()), f"{field}: {e}") from None
                commands[field][rows], commands[generation][rows] = captured
            commands[field][~held] = 0
