"""A bank of DC motors with their mechanics, encoders, switches and stops.

The force of the drive is the command of the tick, changed by the effects of the drive, then limited
by the drive and by what the supply can push against the back-EMF. Mass, friction and stiction are
integrated exactly (``friction``). Where a force depends on position or velocity, the tick is cut
into substeps, of second order; while nothing does (no wall within reach of this tick, the supply not
at its limit) one step over the whole tick is exact and no substeps are spent.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from .drive import build_drive
from .effects import Effect, Place
from .encoder import Encoder
from .forces import DRAGS, DRY, FORCES, FrictionVariation, Motion, middle_velocity
from .foreign import Laws
from .friction import FrictionStep
from .motor_step import Motors, bound, coast, hold_at_stops, is_free, sense
from .parameters import Motor, Supply, build_walls, check_motors, choose_substeps, column, mechanics
from .transmission import Transmission

Array = NDArray[np.float64]


class MotorBank:
    """Steps n motors by one tick at a time.

    Args:
        motors: their parameters.
        tick_s: duration of a tick [s].
        effects: what they have beyond these parameters.
        substeps: substeps of a tick where any are needed; raised where stiffness demands it.
        laws: of motion, from elsewhere.

    Raises:
        ValueError: a parameter out of its range, or a stiffness that cannot be followed.

    Attributes (shape (n,), overwritten by each tick):
        position, velocity: true motion of the motor [m, m/s].
        load_position, load_velocity: of the load; the motor's where the transmission is rigid.
        drive_force: force of the drive at the end of the tick, what its current shows [N].
        contact_force: force with which the axis presses on its wall [N], at least 0.
        encoder: the reading, see Encoder.
        at_limit_minus, at_limit_plus, at_home: switches.
    """

    def __init__(
        self,
        motors: Sequence[Motor],
        tick_s: float,
        effects: Sequence[Effect] = (),
        substeps: int = 4,
        laws: Laws = Laws(),  # noqa: B008 (frozen)
    ) -> None:
        check_motors(motors, tick_s)
        self._tick_s, self._laws = tick_s, laws
        self._by_place = {place: tuple(e for e in effects if e.place is place) for place in Place}
        self._build_state(motors)
        body = mechanics(motors, self._by_place[Place.PARAMETER])
        self._load_constant = body.load_force
        couplings = self._by_place[Place.TRANSMISSION]
        self._transmission = Transmission(couplings, body.mass, self.position) if couplings else None
        self._supply, self._walls = Supply(motors), build_walls(motors)
        self.substeps = self._count_substeps(substeps, tick_s, body.mass)
        self._substep_s = tick_s / self.substeps
        mass = self._transmission.motor_mass if self._transmission else body.mass
        friction = (self._state, mass, body.viscous, body.sliding, body.breakaway)
        self._friction = FrictionStep(*friction, self._substep_s)
        self._whole_tick = FrictionStep(*friction, tick_s)
        self._has_brakes = False
        self._speed_per_force = tick_s / body.mass
        self._build_forces(tick_s)
        self._build_sensors(motors)

    @property
    def wall_position(self) -> Array | None:
        """Positions of the walls [m], which may be changed between ticks; None when no axis has one."""
        return None if self._walls is None else self._walls.position

    @property
    def load_force(self) -> Array:
        """Constant forces on the loads [N], which may be changed between ticks."""
        return self._load_constant

    @property
    def has_drive_effects(self) -> bool:
        """Whether a drive changes its command."""
        return bool(self._drive)

    def brake(self, force: Array) -> None:
        """Have brakes press from now on, dry friction of these forces [N], shape (n,); 0 for none."""
        np.copyto(self._whole_tick.resistance, force)
        self._has_brakes = True

    def advance(self, force: Array) -> None:
        """Step all motors by one tick under a commanded force [N], shape (n,), finite."""
        command = self._command
        np.copyto(command, force)
        for effect in self._drive:
            effect.apply(command)
        bound(self.record)
        if is_free(self.record):
            coast(self.record)
            return
        for _ in range(self.substeps):
            self._substep()
        sense(self.record)
        if self._walls is not None:
            self._walls.press(self.load_position, self.load_velocity, self.contact_force)

    def _build_state(self, motors: Sequence[Motor]) -> None:
        n = len(motors)
        self._state = np.zeros((2, n))
        self.velocity, self.position = self._state
        self.position[:] = column(motors, "start")
        self.drive_force, self.contact_force = np.zeros((2, n))
        self._command, self._force, self._load_force, self._resistance, self._work = np.zeros((5, n))
        self._last_velocity = np.zeros(n)
        self._flag = np.zeros(n, dtype=np.bool_)

    def _count_substeps(self, wanted: int, tick_s: float, mass: Array) -> int:
        """Return 1 where the exact step covers everything, else what the fastest motion needs."""
        places = (Place.MOTOR, Place.LOAD, Place.RESISTANCE, Place.VARIATION, Place.TRANSMISSION)
        effects = [effect for place in places for effect in self._by_place[place]]
        self._nonlinear = bool(effects or self._laws.motor or self._laws.resistance)
        self._bounded = self._walls is not None or self._supply.limits
        if not self._nonlinear and not self._bounded:
            return 1
        return choose_substeps(wanted, tick_s, mass, self._supply, self._walls, self._transmission, effects)

    def _build_forces(self, tick_s: float) -> None:
        self._drive = [*build_drive(self._by_place[Place.DRIVE], tick_s), *self._laws.drive]
        h = self._substep_s
        self._motor_forces = [FORCES[e.name](e, h) for e in self._by_place[Place.MOTOR]]
        self._motor_forces += self._laws.motor
        self._load_forces = [FORCES[e.name](e, h) for e in self._by_place[Place.LOAD]]
        resistances = self._by_place[Place.RESISTANCE]
        self._dry = [DRY[e.name](e, h) for e in resistances if e.name in DRY]
        self._dry += self._laws.resistance
        self._drags = [DRAGS[e.name](e, h) for e in resistances if e.name in DRAGS]
        self._variations = [FrictionVariation(e) for e in self._by_place[Place.VARIATION]]
        rigid, n = self._transmission is None, self.position.size
        middle, rate = np.zeros(n), np.zeros(n)
        self._motion = Motion(
            middle,
            rate,
            middle if rigid else np.zeros(n),
            rate if rigid else np.zeros(n),
            self.drive_force,
            np.ones(n) if self._variations else None,
        )

    def _build_sensors(self, motors: Sequence[Motor]) -> None:
        coupling = self._transmission
        self.load_position = coupling.position if coupling else self.position
        self.load_velocity = coupling.velocity if coupling else self.velocity
        n = self.position.size
        self.at_limit_minus, self.at_limit_plus, self.at_home = np.zeros((3, n), dtype=np.bool_)
        self.switches = np.zeros(n, dtype=np.int64)
        switches, stops = (
            {name: column(motors, name) for name in names}
            for names in (("limit_minus", "limit_plus", "home"), ("stop_minus", "stop_plus"))
        )
        self.encoder = Encoder(
            column(motors, "encoder_step"), column(motors, "index_pitch"), self._by_place[Place.ENCODER]
        )
        walls, supply = self._walls, self._supply
        none = np.zeros(n)
        self.record = Motors(
            n=n, free=not self._nonlinear, bounded=self._bounded, supplied=supply.limits,
            has_stops=_any_finite(stops), has_switches=_any_finite(switches), tick_s=self._tick_s,
            friction=self._whole_tick.record, encoders=self.encoder.record, command=self._command,
            force_max=column(motors, "force_max"), drive_force=self.drive_force, load_force=self._load_constant,
            position=self.position, velocity=self.velocity, speed_per_force=self._speed_per_force,
            wall_position=walls.position if walls else none, wall_stiffness=walls.stiffness if walls else none,
            wall_side=walls.side if walls else none, contact_force=self.contact_force,
            stall=supply.stall, loss=supply.loss, at_minus=self.at_limit_minus, at_plus=self.at_limit_plus,
            at_home=self.at_home, switches=self.switches, **stops, **switches,
        )  # fmt: skip
        self.encoder.start(self.position)
        sense(self.record)

    def _substep(self) -> None:
        """Evaluate all forces at the mid-point and step motor and load."""
        motion, force, h = self._motion, self._force, self._substep_s
        coupling = self._transmission
        self._predict()
        if self._supply.limits:
            np.copyto(self.drive_force, self._command)
            self._supply.clip(motion.velocity, self.drive_force)
        # Without a transmission the load's forces go straight to the motor.
        load = force if coupling is None else self._load_force
        if coupling is None:
            np.add(self.drive_force, self._load_constant, out=force)
        else:
            np.copyto(force, self.drive_force)
            np.copyto(load, self._load_constant)
        if motion.variation is not None:
            motion.variation.fill(1.0)
            for factor in self._variations:
                factor.scale(motion, motion.variation)
        for effect in self._motor_forces:
            effect.add(motion, force)
        for effect in self._load_forces:
            effect.add(motion, load)
        if self._walls is not None:
            self._walls.add(motion.load_position, motion.load_velocity, load, self.contact_force)
        if coupling is not None:
            coupling.couple(motion, force, load)
        self._friction.step(force, self._sum_resistance(), motion.variation)
        if coupling is not None:
            coupling.kick(load, self._state, h)
        hold_at_stops(self.record)

    def _predict(self) -> None:
        """Set the motion at the mid-point: positions by the velocity, velocities by the last change."""
        motion, velocity = self._motion, self.velocity
        np.multiply(velocity, self._substep_s / 2, out=motion.position)
        np.add(motion.position, self.position, out=motion.position)
        middle_velocity(velocity, self._last_velocity, self._flag, motion.velocity)
        np.copyto(self._last_velocity, velocity)
        if self._transmission is not None:
            self._transmission.predict(motion, self._substep_s)

    def _sum_resistance(self) -> Array | None:
        if not self._dry and not self._drags and not self._has_brakes:
            return None
        total, motion = self._resistance, self._motion
        total.fill(0.0)
        for effect in self._dry:
            effect.add(motion, total)
        if motion.variation is not None:
            np.multiply(total, motion.variation, out=total)
        for effect in self._drags:
            effect.add(motion, total)
        np.add(total, self._whole_tick.resistance, out=total)  # of the brakes
        return total


def _any_finite(columns: Mapping[str, Array]) -> bool:
    """Tell whether any axis has any of these."""
    return bool(np.isfinite(list(columns.values())).any())
