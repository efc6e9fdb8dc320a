"""A bank of DC motors with their mechanics, encoders, switches and stops.

The force of the drive is the command of the tick, changed by the effects of the drive, then limited
by the drive and by what the supply can push against the back-EMF. Mass, friction and stiction are
integrated exactly (``friction``). Where a force depends on position or velocity, the tick is cut
into substeps, of second order; while nothing does (no wall within reach of this tick, the supply not
at its limit) one step over the whole tick is exact and no substeps are spent.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .drive import build_drive
from .effects import Effect, Place
from .encoder import Encoder
from .forces import DRAGS, DRY, FORCES, FrictionVariation, Motion, middle_velocity
from .foreign import Laws
from .friction import FrictionStep
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
        self._speed_per_force = tick_s / body.mass
        self._build_forces(tick_s)
        self._build_sensors(motors)

    @property
    def wall_position(self) -> Array | None:
        """Positions of the walls [m], which may be changed between ticks; None when no axis has one."""
        return None if self._walls is None else self._walls.position

    def advance(self, force: Array) -> None:
        """Step all motors by one tick under a commanded force [N], shape (n,), finite."""
        command = self._command
        np.copyto(command, force)
        for effect in self._drive:
            effect.apply(command)
        np.minimum(command, self._force_max, out=command)
        np.maximum(command, self._force_min, out=command)
        np.copyto(self.drive_force, command)
        if not self._nonlinear and self._is_free():
            np.add(command, self._load_constant, out=self._force)
            self._whole_tick.step(self._force)
            self._hold_at_stops()
        else:
            for _ in range(self.substeps):
                self._substep()
        self._sense()

    def _build_state(self, motors: Sequence[Motor]) -> None:
        n = len(motors)
        self._state = np.zeros((2, n))
        self.velocity, self.position = self._state
        self.position[:] = column(motors, "start")
        self.drive_force, self.contact_force = np.zeros((2, n))
        self._command, self._force, self._load_force, self._resistance, self._work = np.zeros((5, n))
        self._last_velocity = np.zeros(n)
        self._flag = np.zeros(n, dtype=np.bool_)
        self._force_max = column(motors, "force_max")
        self._force_min = -self._force_max
        self._stop_minus, self._stop_plus = column(motors, "stop_minus"), column(motors, "stop_plus")
        self._has_stops = bool(np.isfinite([self._stop_minus, self._stop_plus]).any())

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
        self._switches = (column(motors, "limit_minus"), column(motors, "limit_plus"), column(motors, "home"))
        self._has_switches = bool(np.isfinite(self._switches).any())
        self.encoder = Encoder(
            column(motors, "encoder_step"), column(motors, "index_pitch"), self._by_place[Place.ENCODER]
        )
        self.encoder.start(self.position)
        self._sense()

    def _is_free(self) -> bool:
        """Return whether no axis can come to its wall or to the limit of its supply within this tick."""
        if not self._bounded:
            return True
        # Friction only slows: |v| stays below |v0| + |F| t/m.
        fastest, force = self._work, self._load_force
        np.add(self._command, self._load_constant, out=force)
        np.abs(force, out=force)
        np.multiply(force, self._speed_per_force, out=fastest)
        np.abs(self.velocity, out=force)
        np.add(fastest, force, out=fastest)
        if self._walls is not None and self._walls.within(self.load_position, fastest, self._tick_s):
            return False
        return not (self._supply.limits and self._supply.binds(fastest, self._command))

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
        self._hold_at_stops()

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
        if not self._dry and not self._drags:
            return None
        total, motion = self._resistance, self._motion
        total.fill(0.0)
        for effect in self._dry:
            effect.add(motion, total)
        if motion.variation is not None:
            np.multiply(total, motion.variation, out=total)
        for effect in self._drags:
            effect.add(motion, total)
        return total

    def _hold_at_stops(self) -> None:
        """Put motors that passed an end stop back onto it, at rest."""
        if not self._has_stops:
            return
        np.minimum(self.position, self._stop_plus, out=self._work)
        np.maximum(self._work, self._stop_minus, out=self._work)
        np.not_equal(self._work, self.position, out=self._flag)
        if np.count_nonzero(self._flag):
            np.copyto(self.position, self._work)
            np.copyto(self.velocity, 0.0, where=self._flag)

    def _sense(self) -> None:
        """Set readings, switches and contact force."""
        self.encoder.read(self.position)
        if self._walls is not None:
            self._walls.press(self.load_position, self.load_velocity, self.contact_force)
        if self._has_switches:
            minus, plus, home = self._switches
            np.less_equal(self.position, minus, out=self.at_limit_minus)
            np.greater_equal(self.position, plus, out=self.at_limit_plus)
            np.less_equal(self.position, home, out=self.at_home)
