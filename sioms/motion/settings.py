"""What an axis is told to be: its settings, each part refusing what cannot work.

Lengths are in the unit of the axis (m or rad), forces in N or N*m.
"""

from dataclasses import dataclass
from enum import Enum

from sioms.protocol.flags import ControlMode

SWITCH_MINUS, SWITCH_PLUS, SWITCH_HOME = 1, 2, 4
"""Bits of an axis in the ``switches`` argument of AxisBank.tick()."""
HOME_SWITCHES = {"minus": SWITCH_MINUS, "plus": SWITCH_PLUS, "home": SWITCH_HOME}
EVERY_MODE = ControlMode(sum(ControlMode))
RESTORE = ("matching", "always")


class AxisKind(Enum):
    """What the host drives. SERVO takes a force or torque, STEPPER takes a position."""

    SERVO = "servo"
    STEPPER = "stepper"


@dataclass(frozen=True, slots=True)
class Homing:
    """How an axis finds its reference.

    Fast search towards the home switch, slow release from it; the instant of release is the
    reference. An end switch in the way turns the search round once.

    Args:
        velocity: search velocity [unit/s], > 0.
        slow_velocity: velocity of the slow pass that sets the accuracy [unit/s], > 0.
        direction: -1 or +1, where the home switch is searched first.
        offset: position of the switch's edge in the axis' coordinates [unit].
        switch: "home", "minus" or "plus": which switch is the reference.
        travel: search gives up after this distance [unit].
        required: writes are refused (EPERM) until the axis is homed.
    """

    velocity: float
    slow_velocity: float
    direction: int = -1
    offset: float = 0.0
    switch: str = "home"
    travel: float = float("inf")
    required: bool = False

    def __post_init__(self) -> None:
        """Refuse a homing that cannot work.

        Raises:
            ValueError: naming the field, its value and what would be right.
        """
        if not (self.velocity > 0 and self.slow_velocity > 0 and self.travel > 0):
            raise ValueError(
                f"homing: velocity {self.velocity:g}, slow_velocity {self.slow_velocity:g}, travel {self.travel:g}; "
                "want positive numbers"
            )
        if self.direction not in (-1, 1):
            raise ValueError(f"homing: direction {self.direction}; want -1 or 1")
        if self.switch not in HOME_SWITCHES:
            raise ValueError(f"homing: switch {self.switch!r}; want one of {', '.join(HOME_SWITCHES)}")


@dataclass(frozen=True, slots=True)
class Backlash:
    """How an axis takes up the play of its mechanics: the last stretch to a place always comes from one side.

    Holds for point moves (see arrival.py). Stops never take up.

    Args:
        distance: the last stretch, longer than the play [unit]; > 0: places are approached in the plus direction.
        velocity: in the take-up [unit/s], None: as in the move.
        acceleration: in the take-up [unit/s^2], None: as in the move.
    """

    distance: float
    velocity: float | None = None
    acceleration: float | None = None

    def __post_init__(self) -> None:
        """Refuse a take-up that cannot work.

        Raises:
            ValueError: naming the field, its value and what would be right.
        """
        if not 0 < abs(self.distance) < float("inf"):
            raise ValueError(f"backlash: distance {self.distance:g}; want a finite number other than 0")
        for name in ("velocity", "acceleration"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"backlash: {name} {value:g}; want a positive number")


@dataclass(frozen=True, slots=True)
class Arrival:
    """When a point move counts as done (see arrival.py).

    Args:
        settle_s: how long the axis stands before it is looked at, and before the command ends [s].
        tolerance: measured distance to the target above which the axis has missed it [unit], None: not looked at.
        retries: how often a missed target is tried again; not for servos that the host closes.
    """

    settle_s: float = 0.0
    tolerance: float | None = None
    retries: int = 0

    def __post_init__(self) -> None:
        """Refuse an arrival that means nothing.

        Raises:
            ValueError: naming the field, its value and what would be right.
        """
        if not 0 <= self.settle_s <= 3600:
            raise ValueError(f"arrival: settle_s {self.settle_s:g}; want 0 to 3600")
        if self.tolerance is not None and not self.tolerance > 0:
            raise ValueError(f"arrival: tolerance {self.tolerance:g}; want a positive number")
        if not 0 <= self.retries <= 1000:
            raise ValueError(f"arrival: retries {self.retries}; want 0 to 1000")
        if self.retries and self.tolerance is None:
            raise ValueError(f"arrival: retries {self.retries} without a tolerance; want both or neither")


@dataclass(frozen=True, slots=True)
class Restore:
    """When the position of an axis is taken over from the driver process before this one.

    In any case it must have been at rest when it was saved last.

    Args:
        when: "matching": the device reads the same as before, because it counts on by itself and was not moved;
            "always": whatever it reads, because its count begins anew with each start.
        tolerance: how far the readings may differ for "matching" [unit].
    """

    when: str
    tolerance: float = 1e-5

    def __post_init__(self) -> None:
        """Refuse what means nothing.

        Raises:
            ValueError: naming the field, its value and what would be right.
        """
        if self.when not in RESTORE:
            raise ValueError(f"restore: when = {self.when!r}; want one of {', '.join(RESTORE)}")
        if not self.tolerance >= 0:
            raise ValueError(f"restore: tolerance {self.tolerance:g}; want 0 or more")


@dataclass(frozen=True, slots=True)
class Watch:
    """What motion of an axis is a fault (see watch.py, and host_watch.py for loops that the host closes).

    Args:
        uncommanded: motion that nobody commanded is one; false for an axis that is guided by hand or moved by others.
        tolerance: how far an axis that is to hold may be pushed [unit], None: what velocity_max covers in 10 ms.
        speed_margin: part of velocity_max by which it may be exceeded.
    """

    uncommanded: bool = True
    tolerance: float | None = None
    speed_margin: float = 0.2

    def __post_init__(self) -> None:
        """Refuse what means nothing.

        Raises:
            ValueError: naming the field, its value and what would be right.
        """
        if self.tolerance is not None and not self.tolerance > 0:
            raise ValueError(f"watch: tolerance {self.tolerance:g}; want a positive number")
        if not 0.05 <= self.speed_margin <= 10:
            raise ValueError(f"watch: speed_margin {self.speed_margin:g}; want 0.05 to 10")


@dataclass(frozen=True, slots=True)
class AxisSettings:
    """One axis as configured. Lengths in ``unit`` (m or rad), forces in N or N*m.

    The gains are those of the servo law, dissertation section F.2.4:
    ``u[n] = k (e[n] + kz e[n-1]) - kp tau[n-1] + kb v[n] + tau_o``. Note the sign: damping is
    ``kb < 0``. A stepper's gains default to dead-beat slewing, k = 1/tick, the rest 0.

    Args:
        name: name for messages.
        kind: servo or stepper.
        unit: "m" or "rad".
        position_min: lower soft limit, None when there is none.
        position_max: upper soft limit, None when there is none.
        velocity_max: > 0 [unit/s].
        acceleration_max: > 0 [unit/s^2].
        jerk_max: > 0 [unit/s^3], None when unlimited.
        force_max: > 0 [N or N*m]; servo only.
        ki: integral gain beside that law [N/(m s) or N*m/(rad s)]; servo only.
        velocity_filter_s: time constant of the velocity filter [s].
        following_error_max: [unit], None: what velocity_max covers in 0.5 s for servos that may use all their force,
            not watched for others.
        homing: None when the axis cannot be homed.
        backlash: take-up of play at the end of point moves, None when there is none.
        arrival: when point moves count as done, None: when the set-point has arrived.
        deadband: a point move of an axis at rest that is shorter than this is not carried out [unit].
        start_velocity: speed that is taken up and given up at once [unit/s]; steppers only.
        restore: when the position is taken over from the process before, None: never.
        watch: what motion is a fault.
        modes: control-mode flags that a drive offers (drives that close their own loop).
    """

    name: str
    kind: AxisKind = AxisKind.SERVO
    unit: str = "m"
    position_min: float | None = None
    position_max: float | None = None
    velocity_max: float = 1.0
    acceleration_max: float = 10.0
    jerk_max: float | None = None
    force_max: float = 1.0
    k: float | None = None
    kz: float = 0.0
    kp: float = 0.0
    kb: float = 0.0
    ki: float = 0.0
    force_offset: float = 0.0
    velocity_filter_s: float = 0.0
    following_error_max: float | None = None
    homing: Homing | None = None
    backlash: Backlash | None = None
    arrival: Arrival | None = None
    deadband: float = 0.0
    start_velocity: float = 0.0
    restore: Restore | None = None
    watch: Watch = Watch()
    modes: ControlMode = EVERY_MODE

    def __post_init__(self) -> None:
        """Refuse settings that no axis can have.

        Raises:
            ValueError: naming the field, its value and what would be right.
        """
        low, high = self.position_min, self.position_max
        if low is not None and high is not None and not low < high:
            raise ValueError(f"axis {self.name}: position_min {low:g} is not below position_max {high:g}")
        for name in ("velocity_max", "acceleration_max", "jerk_max", "force_max", "following_error_max"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"axis {self.name}: {name} {value:g}; want a positive number")
            if value == float("inf") and name != "following_error_max":
                raise ValueError(f"axis {self.name}: {name} {value:g}; want what the axis can do")
        if not self.velocity_filter_s >= 0:
            raise ValueError(f"axis {self.name}: velocity_filter_s {self.velocity_filter_s:g}; want 0 or more")
        if not -1 < self.kp < 1:
            raise ValueError(f"axis {self.name}: kp {self.kp:g} makes the law unstable; want between -1 and 1")
        if not 0 <= self.ki < float("inf"):
            raise ValueError(f"axis {self.name}: ki {self.ki:g}; want 0 or more")
        for name in ("kz", "kb", "force_offset"):
            if not abs(getattr(self, name)) < float("inf"):
                raise ValueError(f"axis {self.name}: {name} {getattr(self, name):g}; want a finite number")
        self._check_arrival()

    def _check_arrival(self) -> None:
        for name in ("deadband", "start_velocity"):
            value = getattr(self, name)
            if not 0 <= value < float("inf"):
                raise ValueError(f"axis {self.name}: {name} {value:g}; want 0 or more")
        if self.backlash is not None and self.position_min is not None and self.position_max is not None:
            range_, distance = self.position_max - self.position_min, abs(self.backlash.distance)
            if distance >= range_:
                raise ValueError(
                    f"axis {self.name}: backlash: distance {distance:g} does not fit between the soft limits; want "
                    f"below {range_:g}"
                )
        if self.kind is AxisKind.STEPPER and self.ki:
            raise ValueError(f"axis {self.name}: ki {self.ki:g}; want 0: a stepper goes where it is told")
        if self.kind is AxisKind.STEPPER or self.k is None:
            return
        if self.arrival is not None and self.arrival.retries:
            raise ValueError(
                f"axis {self.name}: arrival: retries {self.arrival.retries}; want 0: the loop of a servo tries all the "
                "time"
            )
        if self.start_velocity:
            raise ValueError(
                f"axis {self.name}: start_velocity {self.start_velocity:g}; want 0: only a stepper has one"
            )

    @property
    def force_unit(self) -> str:
        """Unit of force that belongs to ``unit``."""
        return "N*m" if self.unit == "rad" else "N"
