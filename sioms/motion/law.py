"""The arrays of the host-closed loops of a bank, and what is done to them between ticks; the laws: axis_step.py."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sioms.native.language import ARRAYS

from .axis_step import FORCE, REST, REST_NS, Loop
from .force_end import ForceEnds
from .settings import AxisKind, AxisSettings
from .store import NEVER_NS

Vector = NDArray[np.float64]
Gains = tuple[float, float, float, float]
FORCE_ROW = 4
"""Of what commands may set: the gains k, kz, kp, kb, and the greatest force."""
FOLLOWS_S = 0.5
"""What its velocity limit covers in this time, an axis may be behind that has no following_error_max of its own [s]."""


class ControlLaw:
    """State and gains of the laws of n axes. Gains and limits are arrays (n,), free to change between ticks.

    Commands may set gains and the greatest force. They hold for what commands do; whatever stops or holds an axis
    otherwise does so with what is configured (``brace``), which is in force until a command begins (``recall``).

    Args:
        settings: one per axis.
        tick_s: nominal period [s].
        shared: arrays of the loop that others own, too, by the name of its field.

    Attributes:
        loop: what the steps of a tick work on.
        arrays: its arrays by name.
        output: tau[n-1] of servos, w[n-1] of steppers.
        slewed: output position of steppers.
        anchor: what output positions count from: the raw output is slewed - anchor.
        kind, guard, begun, event_status: the sequencer's.
        limp: axes that are let go.
        speed_most: speed at which a force command ends.
        tuned: gains or greatest force in force are not the configured ones.
        any_braced: there are axes on which commands have set others than are in force.
        actuator: what the actuators shall do.
    """

    def __init__(self, settings: Sequence[AxisSettings], tick_s: float, **shared: NDArray[Any]) -> None:
        for given in settings:
            if given.kind is AxisKind.SERVO and given.k is None:
                raise ValueError(f"axis {given.name}: a servo needs the gain k; without it nothing holds its position")
        n = len(settings)
        self.force_ends = ForceEnds(n)
        arrays: dict[str, Any] = {
            field: np.zeros(6 * n if field == "present" else n, kind.dtype)
            for field, kind in Loop.kinds.items()
            if kind in ARRAYS
        }
        arrays |= shared | self.force_ends.arrays()
        default = [1.0 / tick_s if s.kind is AxisKind.STEPPER else 0.0 for s in settings]
        arrays["stepper"][:] = [s.kind is AxisKind.STEPPER for s in settings]
        arrays["k"][:] = [d if s.k is None else s.k for s, d in zip(settings, default, strict=True)]
        for field in ("kz", "kp", "kb", "ki", "force_offset", "start_velocity"):
            arrays[field][:] = [getattr(s, field) for s in settings]
        for field, name in (("force", "force_max"), ("velocity", "velocity_max"), ("acceleration", "acceleration_max")):
            arrays[f"{field}_limit"][:] = [getattr(s, name) for s in settings]
        arrays["filter_s"][:] = [s.velocity_filter_s for s in settings]
        told = [s.following_error_max for s in settings]
        self._told_error = np.array([np.nan if most is None else most for most in told])
        self._usual_error = np.array([FOLLOWS_S * s.velocity_max for s in settings])
        self._force_max = np.array([s.force_max for s in settings])
        numbers = dict.fromkeys((f for f, kind in Loop.kinds.items() if kind is int), 0)
        numbers |= {"n": n, "next_ns": NEVER_NS, "any_integral": int(arrays["ki"].any())}
        self.loop = Loop(**arrays, **numbers, tick_s=tick_s, dt=tick_s, bound=np.inf)
        self.arrays = arrays
        self.k: Vector = arrays["k"]
        self.kz: Vector = arrays["kz"]
        self.kp: Vector = arrays["kp"]
        self.kb: Vector = arrays["kb"]
        self.offset: Vector = arrays["force_offset"]
        self.force_limit: Vector = arrays["force_limit"]
        self.velocity_limit: Vector = arrays["velocity_limit"]
        self.acceleration_limit: Vector = arrays["acceleration_limit"]
        self.speed_most: Vector = arrays["speed_most"]
        self.speed_most[:] = self.velocity_limit
        self.output: Vector = arrays["output"]
        self.slewed: Vector = arrays["slewed"]
        self.anchor: Vector = arrays["anchor"]
        self.saturated: NDArray[np.bool_] = arrays["saturated"]
        self.stepper: NDArray[np.bool_] = arrays["stepper"]
        self.kind: NDArray[np.int64] = arrays["kind"]
        self.guard: NDArray[np.bool_] = arrays["guard"]
        self.begun: NDArray[np.int64] = arrays["begun"]
        self.event_status: NDArray[np.int64] = arrays["event_status"]
        self.limp: NDArray[np.bool_] = arrays["limp"]
        self.actuator: Vector = arrays["actuator"]
        self.moved_ns: NDArray[np.int64] = arrays["moved_ns"]
        self.settled: NDArray[np.bool_] = arrays["settled"]
        self._position: Vector = arrays["position"]
        self._velocity: Vector = arrays["velocity"]
        self._tolerance: Vector = arrays["tolerance"]
        self._error_max: Vector = arrays["error_max"]
        self._error: Vector = arrays["error"]
        self._integral: Vector = arrays["integral"]
        self._ki: Vector = arrays["ki"]
        self.tuned: NDArray[np.bool_] = arrays["tuned"]
        self._in_force = (self.k, self.kz, self.kp, self.kb, self.force_limit)
        self._configured = np.array(self._in_force)
        self._commanded = self._configured.copy()
        self._braced = np.zeros(n, dtype=bool)
        self.any_braced = False
        self._limit_force(np.arange(n))

    def anchor_at(self, axis: int, position: float) -> None:
        """Call the place at which a stepper stands ``position``; the raw output does not change."""
        self.anchor[axis] += position - self.slewed[axis]
        self.slewed[axis] = position

    def shift(self, axis: int, by: float) -> None:
        """Add to the coordinate of an axis; the raw output does not change."""
        self.slewed[axis] += by
        self.anchor[axis] += by

    def configure_force(self, axes: NDArray[np.int64], most: Vector) -> None:
        """Set the greatest force of axes anew, for commands and stops [N or N*m]."""
        self._configured[FORCE_ROW, axes] = self._commanded[FORCE_ROW, axes] = most
        braced = self._braced[axes]
        self._put(axes, np.where(braced, self._configured[:, axes], self._commanded[:, axes]), braced)

    def command_force(self, axis: int, most: float) -> None:
        """Put the greatest force of a command in force [N or N*m]."""
        self._command(np.array([axis]), FORCE_ROW, most)

    def command_gains(self, axis: int, gains: Gains) -> None:
        """Put the gains k, kz, kp, kb of a command in force."""
        self._command(np.array([axis]), slice(FORCE_ROW), np.array(gains)[:, None])

    def commanded_force(self, axis: int) -> float:
        """Return the greatest force of commands that do not say another."""
        return float(self._commanded[FORCE_ROW, axis])

    def _command(self, axes: NDArray[np.int64], rows: int | slice, values: Vector | float) -> None:
        self._commanded[rows, axes] = values
        self._put(axes, self._commanded[:, axes])

    def _put(self, axes: NDArray[np.int64], values: Vector, braced: NDArray[np.bool_] | bool = False) -> None:
        for array, row in zip(self._in_force, values, strict=True):
            array[axes] = row
        self.tuned[axes] = (values != self._configured[:, axes]).any(axis=0)
        self._braced[axes] = braced
        self.any_braced = bool(self._braced.any())
        self._limit_force(axes)

    def recall(self, axes: NDArray[np.int64], places: Vector, now_ns: int) -> NDArray[np.int64]:
        """Put in force again what commands have set: one begins now on each of these axes, at its place (m,); return
        the axes for which something was.
        """
        braced = self._braced[axes]
        chosen = axes[braced]
        if chosen.size:
            self._error[chosen] = places[braced] - self.actual(chosen, now_ns)[0]
            self._put(chosen, self._commanded[:, chosen])
        return chosen

    def is_braced(self, axes: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Tell on which axes what is configured is in force until a command begins (m,)."""
        braced: NDArray[np.bool_] = self._braced[axes]
        return braced

    def recalled(self, axis: int, place: float, now_ns: int, gains: Gains | None, offset: float | None) -> float:
        """Return the set-point at which a braced servo goes on with its force, by gains that come into force.

        A motion is not force to be kept: then the set-point comes no farther from the axis than it is. Gains that would
        need it farther away than an axis may be behind carry nothing: it stays.

        Args:
            axis: which.
            place: its set-point [unit].
            now_ns: when [ns].
            gains: k, kz, kp, kb of a command; None: those of commands before it.
            offset: force_offset of the command; None: that of before.
        """
        if self.stepper[axis] or self.limp[axis]:
            return place
        k, kz, kp, kb = self._commanded[:FORCE_ROW, axis].tolist() if gains is None else gains
        velocity = self._velocity.item(axis)
        at = self._position.item(axis) + velocity * self._since_tick(now_ns)
        lead = place - at
        gain, output, moves = k * (1.0 + kz), self.output.item(axis), abs(velocity) > REST * self.velocity_limit[axis]
        if gain > 0.0 and (moves or not self._ki[axis] > 0.0):
            carried = (self.offset.item(axis) if offset is None else offset) + self._integral.item(axis)
            keeps = (output * (1.0 + kp) - carried - kb * velocity) / gain
        else:
            keeps = 0.0
        if moves:
            keeps = min(max(keeps, min(lead, 0.0)), max(lead, 0.0))
        if not abs(keeps) <= self._usual_error[axis]:
            return place
        return at + keeps

    def forget(self, axes: NDArray[np.int64]) -> None:
        """Commands have set nothing on these axes, which have been halted."""
        self._commanded[:, axes] = self._configured[:, axes]
        self._put(axes, self._configured[:, axes])

    def brace(self, axes: NDArray[np.int64], now_ns: int) -> Vector:
        """Put what is configured in force, until a command begins; return where the axes are to be held or braked from.

        That is where a servo is, and as far beside it as has the law go on with the force that it has put out; but for
        force that drives an axis on. In the direction of its motion, or of the force when it stands, it presses no
        harder than it was allowed before, until it has come to rest.
        """
        position, velocity = self.actual(axes, now_ns)
        tuned = self.tuned[axes]
        if not tuned.any():
            return position
        chosen, velocity = axes[tuned], velocity[tuned]
        moves, allowed = self.moves(chosen), self.force_limit[chosen].copy()
        self._put(chosen, self._configured[:, chosen], True)
        in_force = self.kind[chosen] == FORCE  # which is bounded by what was asked, when it ends
        toward = np.where(moves, velocity, self.output[chosen])
        held_back = (allowed < self.force_limit[chosen]) & (toward != 0.0) & ~in_force
        for i in np.flatnonzero(held_back).tolist():
            self.force_ends.hold_back(int(chosen[i]), float(toward[i]), float(allowed[i]))
        self.give_way(chosen)
        servo = ~self.stepper[chosen] & (moves | ~in_force)
        chosen, velocity, moves = chosen[servo], velocity[servo], moves[servo]
        output, offset = self.output[chosen], self.offset[chosen]
        limit = self.force_limit[chosen]
        along = (output - offset) * velocity
        output = np.where(moves & (along > 0.0), offset, np.clip(output, -limit, limit))
        opposes = moves & (along < 0.0)
        self.force_ends.keep(chosen[opposes], -np.sign(velocity[opposes]))
        position[np.flatnonzero(tuned)[servo]] += self._go_on(chosen, output, velocity)
        return position

    def hold_load(self, axes: NDArray[np.int64]) -> Vector:
        """Have servos that leave force mode at rest go on with their force, which may carry something; return how far
        beside the axes their set-points are then (m,).

        Others hold with none. So do those that have not been at rest for a while: nothing need bear a force that has
        just begun.
        """
        lead = np.zeros(len(axes))
        bears = self.loop.seen_ns - self.moved_ns[axes] > REST_NS
        rests = np.flatnonzero(bears & ~self.moves(axes) & ~self.stepper[axes] & ~self.limp[axes])
        chosen = axes[rests]
        lead[rests] = self._go_on(chosen, self.output[chosen], self._velocity[chosen])
        return lead

    def drive(self, desired: Vector) -> Vector:
        """Return how far axes are from set-points to which their outputs drive them (n,); 0: near, or driven away."""
        reach = desired - self._position
        driven = ((self.output - self.offset) * reach > 0.0) & (np.abs(reach) > self._tolerance)
        return np.where(driven, reach, 0.0)

    def relieve(self, axes: NDArray[np.int64], part: Vector) -> Vector:
        """Have servos go on with a part (m,) of the force beside their offset; return how far beside them their
        set-points are then (m,).
        """
        self.give_way(axes)
        offset = self.offset[axes]
        return self._go_on(axes, offset + part * (self.output[axes] - offset), self._velocity[axes])

    def _go_on(self, axes: NDArray[np.int64], output: Vector, velocity: Vector) -> Vector:
        """Have servos go on with an output at their velocities; return how far beside them set-points are then (m,).

        Those that would need it farther away than an axis may be behind hold with none.
        """
        gain = self.k[axes] * (1.0 + self.kz[axes])
        wish = output * (1.0 + self.kp[axes]) - self.offset[axes] - self.kb[axes] * velocity
        carries = self._carries(axes)
        self._integral[axes[carries]] = wish[carries]
        lead: Vector = np.divide(wish, gain, out=np.zeros(len(axes)), where=(gain > 0.0) & ~carries)
        lead[np.abs(lead) > self._error_max[axes]] = 0.0
        self._error[axes] = lead
        return lead

    def _carries(self, axes: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Tell which axes hold their load by the integral of their error, which would lead them to their set-points."""
        carries: NDArray[np.bool_] = (self._ki[axes] > 0.0) & ~self.moves(axes) & ~self.stepper[axes]
        return carries

    def carry_on(self, axes: NDArray[np.int64]) -> None:
        """Have the integrals of axes at rest, for which a command has begun, go on with the force that holds them."""
        axes = axes[self._carries(axes) & (self.kind[axes] != FORCE) & ~self.limp[axes]]
        with np.errstate(over="ignore", invalid="ignore"):
            wish = self.output[axes] * (1.0 + self.kp[axes]) - self.offset[axes] - self.kb[axes] * self._velocity[axes]
            wish -= self.k[axes] * (1.0 + self.kz[axes]) * self._error[axes]
        integral = np.clip(wish, -self.force_limit[axes], self.force_limit[axes])
        self._integral[axes] = np.where(np.isfinite(integral), integral, 0.0)

    def _limit_force(self, axes: NDArray[np.int64]) -> None:
        """Judge how far axes may be behind.

        A servo that may use all its force has to follow; one that is held back on purpose may meet something.
        """
        follows = ~self.stepper[axes] & (self.force_limit[axes] >= self._force_max[axes])
        usual = np.where(follows, self._usual_error[axes], np.inf)
        told = self._told_error[axes]
        self._error_max[axes] = np.where(np.isnan(told), usual, told)

    def actual(self, axes: NDArray[np.int64], now_ns: int = 0) -> tuple[Vector, Vector]:
        """Return where axes are and how fast they go: measured of servos, put out of steppers (m,) each.

        That was so in the last tick; at now_ns, if that is later, they have gone on at their velocity.
        """
        stepper = self.stepper[axes]
        position = np.where(stepper, self.slewed[axes], self._position[axes])
        velocity = np.where(stepper, self.output[axes], self._velocity[axes])
        return position + velocity * self._since_tick(now_ns), velocity

    def place_at(self, axes: NDArray[np.int64], at_ns: NDArray[np.int64]) -> Vector:
        """Return where axes are at instants (m,) near the last tick, also just before its readings: of steppers where
        they were put by then.
        """
        beside_s = (at_ns - max(self.loop.last_ns, self.loop.seen_ns)) * 1e-9
        moved: Vector = self._position[axes] + self._velocity[axes] * beside_s
        return np.where(self.stepper[axes], self.slewed[axes], moved)

    def begin_at(self, axes: NDArray[np.int64], places: Vector, at_ns: NDArray[np.int64]) -> None:
        """Note that axes that could not follow begin at places (m,): how far they were behind must not push back."""
        servos = ~self.stepper[axes]
        self._error[axes[servos]] = (places - self.place_at(axes, at_ns))[servos]

    def _since_tick(self, now_ns: int) -> float:
        """Return how long the last tick is past at now_ns [s]; its readings may have come with none yet done."""
        return max(0, now_ns - max(self.loop.last_ns, self.loop.seen_ns)) * 1e-9

    def is_on_its_way(self, axes: NDArray[np.int64], rest: Vector) -> NDArray[np.bool_]:
        """Tell which axes (m,) move and are still far from their final setpoints, or have been released."""
        error = np.where(self.stepper[axes], self._error[axes], rest - self._position[axes])
        on_its_way: NDArray[np.bool_] = (np.abs(error) > self._tolerance[axes]) | self.limp[axes]
        return on_its_way & self.moves(axes)

    def moves(self, axes: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Tell which axes move."""
        moving: NDArray[np.bool_] = np.abs(self.actual(axes)[1]) > REST * self.velocity_limit[axes]
        return moving

    def is_behind(self, axes: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Tell which axes cannot follow: all their force does not bring them to the set-points that have run ahead.

        An axis that runs ahead of its set-point is braked by its error, and is not behind.
        """
        error, (_, velocity) = self._error[axes], self.actual(axes)
        behind: NDArray[np.bool_] = (np.abs(error) > self._tolerance[axes]) & (self.kind[axes] != FORCE)
        behind &= self.saturated[axes] | (np.abs(error) > self.full_error(axes))
        behind &= (error * velocity >= 0.0) | ~self.moves(axes)
        return behind

    def full_error(self, axes: NDArray[np.int64]) -> Vector:
        """Return the error at which the law asks for all the force of a servo, at its velocity; inf of a stepper."""
        error: Vector = np.full(len(axes), np.inf)
        with np.errstate(over="ignore", invalid="ignore"):  # a gain of next to nothing asks for all the force nowhere
            gain = self.k[axes] * (1.0 + self.kz[axes])
            force = self.force_limit[axes] * (1.0 + np.abs(self.kp[axes]))
            force += np.abs(self.kb[axes] * self._velocity[axes])
            np.divide(force, gain, out=error, where=(gain > 0.0) & ~self.stepper[axes])
        return error

    def come_nearer(self, axes: NDArray[np.int64], by: Vector) -> None:
        """Note by how much set-points have been put nearer to their axes: that is no motion."""
        self._error[axes] -= by

    def give_way(self, axes: NDArray[np.int64]) -> None:
        """Forget the error of axes whose set-point has yielded: what it was before must not push back."""
        self._error[axes] = self._integral[axes] = 0.0
