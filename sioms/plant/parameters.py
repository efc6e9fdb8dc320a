"""What a motor is, as numbers, and the arrays of a bank made of them.

Force is N or N m, position m or rad, mass kg or kg m^2, as the axis has it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .effects import Effect
from .forces import Walls
from .friction import Directed
from .transmission import Transmission

Array = NDArray[np.float64]

MAX_SUBSTEPS = 64
# A substep turns the fastest oscillation by at most this angle [rad]; the limit of stability is 2.
_PHASE_STEP = 0.5


@dataclass(frozen=True, slots=True)
class Wall:
    """What an axis may run into.

    Args:
        position: where it is touched [m or rad].
        stiffness: [N/m or N m/rad], positive.
        damping: [N s/m or N m s/rad].
        side: +1 at greater positions than the axis, -1 at smaller.
    """

    position: float
    stiffness: float
    damping: float = 0.0
    side: int = 1


@dataclass(frozen=True, slots=True)
class Motor:
    """One motor and its axis.

    Args:
        mass: moving mass or inertia [kg or kg m^2].
        viscous: viscous friction [N s/m].
        coulomb: dry friction while moving [N].
        stiction: force that the resting axis withstands [N]; the sliding friction when None.
        load_force: constant force, as of gravity on a vertical axis [N].
        force_max: limit of the drive [N].
        force_constant: force per ampere, which is also back-EMF per velocity [N/A = V s/m].
        resistance_ohm, supply_v: winding and supply; the supply is no limit unless all three are given.
        encoder_step: resolution [m or rad]; 0 for an ideal encoder.
        index_pitch: distance of index marks [m or rad]; infinite for none.
        stop_minus, stop_plus: hard, inelastic end stops.
        limit_minus, limit_plus: the limit switches are on at and beyond these.
        home: the home switch is on at positions at and below this.
        start: position at the start.
        wall: what the axis may touch.
    """

    mass: float
    viscous: float = 0.0
    coulomb: float = 0.0
    stiction: float | None = None
    load_force: float = 0.0
    force_max: float = math.inf
    force_constant: float = 0.0
    resistance_ohm: float = 0.0
    supply_v: float = math.inf
    encoder_step: float = 0.0
    index_pitch: float = math.inf
    stop_minus: float = -math.inf
    stop_plus: float = math.inf
    limit_minus: float = -math.inf
    limit_plus: float = math.inf
    home: float = -math.inf
    start: float = 0.0
    wall: Wall | None = None

    @property
    def breakaway(self) -> float:
        """Force that the resting axis withstands [N]."""
        return self.coulomb if self.stiction is None else self.stiction


@dataclass(frozen=True, slots=True)
class Mechanics:
    """Mass, friction and constant force of n axes, shape (n,) each."""

    mass: Array
    load_force: Array
    viscous: Directed
    sliding: Directed
    breakaway: Directed


def check_motors(motors: Sequence[Motor], tick_s: float) -> None:
    """Refuse what no motor can be.

    Raises:
        ValueError: names motor, number and what would be right.
    """
    if not motors or not 0 < tick_s < 1:
        raise ValueError(f"build motors: {len(motors)} motors, tick {tick_s:g} s; want 1 or more, and 0 to 1 s")
    for axis, motor in enumerate(motors):
        where = f"build motor {axis}"
        if not 0 < motor.mass < math.inf:
            raise ValueError(f"{where}: mass {motor.mass:g} kg or kg m^2; must be positive and finite")
        if not (0 <= motor.viscous < math.inf and 0 <= motor.coulomb <= motor.breakaway < math.inf):
            raise ValueError(
                f"{where}: viscous {motor.viscous:g}, coulomb {motor.coulomb:g}, stiction {motor.breakaway:g}; "
                "want viscous >= 0 and stiction >= coulomb >= 0"
            )
        if not motor.stop_minus <= motor.start <= motor.stop_plus:
            raise ValueError(
                f"{where}: start {motor.start:g} m or rad; must lie between the stops "
                f"{motor.stop_minus:g} and {motor.stop_plus:g}"
            )
        if not (motor.force_max > 0 and motor.encoder_step >= 0 and motor.index_pitch > 0):
            raise ValueError(
                f"{where}: force_max {motor.force_max:g}, encoder_step {motor.encoder_step:g}, "
                f"index_pitch {motor.index_pitch:g}; want positive, at least 0, positive"
            )
        if not (math.isfinite(motor.start) and math.isfinite(motor.load_force) and motor.encoder_step < math.inf):
            raise ValueError(
                f"{where}: start {motor.start:g}, load_force {motor.load_force:g}, encoder_step "
                f"{motor.encoder_step:g}; want finite numbers"
            )
        if not (0 <= motor.force_constant < math.inf and 0 <= motor.resistance_ohm < math.inf and motor.supply_v > 0):
            raise ValueError(
                f"{where}: force_constant {motor.force_constant:g} N/A, resistance_ohm {motor.resistance_ohm:g}, "
                f"supply_v {motor.supply_v:g}; want at least 0, at least 0, positive"
            )
        wall = motor.wall
        if wall is not None and not (wall.stiffness > 0 and wall.damping >= 0 and abs(wall.side) == 1):
            raise ValueError(
                f"{where}: wall of stiffness {wall.stiffness:g} N/m, damping {wall.damping:g} N s/m, "
                f"side {wall.side}; want positive, at least 0, +1 or -1"
            )


def column(motors: Sequence[Motor], name: str) -> Array:
    """Return one number of all motors, shape (n,)."""
    return np.array([getattr(motor, name) for motor in motors], dtype=np.float64)


def mechanics(motors: Sequence[Motor], effects: Sequence[Effect]) -> Mechanics:
    """Return the mechanics with the effects of place PARAMETER in them."""
    mass, load = column(motors, "mass"), column(motors, "load_force")
    viscous = Directed(column(motors, "viscous"), column(motors, "viscous"))
    sliding = Directed(column(motors, "coulomb"), column(motors, "coulomb"))
    rise = column(motors, "breakaway") - sliding.plus
    for effect in effects:
        values = effect.values
        match effect.name:
            case "viscous":
                viscous = Directed(viscous.plus + values["coefficient"], viscous.minus + values["coefficient_minus"])
            case "coulomb":
                sliding = Directed(sliding.plus + values["level"], sliding.minus + values["level_minus"])
            case "payload":
                mass = mass + values["mass"]
            case "offset":
                load = load + values["force"]
    return Mechanics(mass, load, viscous, sliding, Directed(sliding.plus + rise, sliding.minus + rise))


def build_walls(motors: Sequence[Motor]) -> Walls | None:
    """Return the walls of the bank, None when no axis has one."""
    if all(motor.wall is None for motor in motors):
        return None
    walls = [motor.wall or Wall(0.0, 0.0) for motor in motors]
    names = ("position", "stiffness", "damping", "side")
    return Walls(*(np.array([getattr(wall, name) for wall in walls], dtype=np.float64) for name in names))


class Supply:
    """Limit of the force by supply and back-EMF: |F| <= Kt (V - Kt v sgn F)/R.

    Args:
        motors: their force constant, resistance and supply.
    """

    def __init__(self, motors: Sequence[Motor]) -> None:
        kt, ohm, volt = (column(motors, name) for name in ("force_constant", "resistance_ohm", "supply_v"))
        known = (kt > 0) & (ohm > 0) & np.isfinite(volt)
        per_ohm = np.divide(kt, ohm, out=np.zeros_like(kt), where=known)
        self.limits = bool(known.any())
        self.loss = per_ohm * kt
        self.stall = np.where(known, per_ohm * np.where(known, volt, 0.0), np.inf)
        self._work, self._bound = np.zeros((2, kt.size))

    def clip(self, velocity: Array, force: Array) -> None:
        """Limit force [N] in place at a velocity [m/s]."""
        np.multiply(velocity, self.loss, out=self._work)
        np.subtract(self.stall, self._work, out=self._bound)
        np.minimum(force, self._bound, out=force)
        np.add(self.stall, self._work, out=self._bound)
        np.negative(self._bound, out=self._bound)
        np.maximum(force, self._bound, out=force)


def choose_substeps(
    wanted: int,
    tick_s: float,
    mass: Array,
    supply: Supply,
    walls: Walls | None,
    transmission: Transmission | None,
    effects: Sequence[Effect],
) -> int:
    """Return the substeps of a tick: enough for the fastest oscillation and the fastest decay.

    Raises:
        ValueError: more than MAX_SUBSTEPS would be needed.
    """
    stiffness, damping = np.zeros_like(mass), supply.loss
    if walls is not None:
        stiffness, damping = stiffness + walls.stiffness, damping + walls.damping
    for effect in effects:
        if "stiffness" in effect.values:
            stiffness = stiffness + np.where(effect.active, effect.values["stiffness"], 0.0)
    if transmission is not None:
        mass = np.where(transmission.elastic, np.minimum(transmission.motor_mass, transmission.load_mass), mass)
        stiffness, damping = stiffness + transmission.stiffness, damping + transmission.damping
    rate = float(np.max(np.maximum(np.sqrt(stiffness / mass), damping / mass)))
    needed = max(wanted, math.ceil(rate * tick_s / _PHASE_STEP))
    if needed > MAX_SUBSTEPS:
        raise ValueError(
            f"build motors: fastest rate {rate:.3g} 1/s needs {needed} substeps of a {tick_s:g} s tick; must be at "
            f"most {MAX_SUBSTEPS}: less stiffness or damping, more mass, or a shorter tick"
        )
    return needed
