"""One axis of a simulated ODrive board with its rotor, after the firmware's own sources (fw-v0.5.6, a308314e).

What is ported, function by function, from ``Firmware/MotorControl``: ``Controller::update``, ``reset`` and
``control_mode_updated`` (controller.cpp), ``planTrapezoidal`` and ``eval`` (trapTraj.cpp), the state machine, homing
and watchdog (axis.cpp), the order of the control loop (main.cpp). The loop runs at 1 kHz here, at 8 kHz there. Left
out: calibration, step/direction, circular set-points, anticogging, the filter, ramp and mirror modes of the input,
currents.

Units: turns, seconds, Nm.
"""

from __future__ import annotations

import math

UNDEFINED, IDLE, CLOSED_LOOP, HOMING = 0, 1, 8, 11
TORQUE, VELOCITY, POSITION = 1, 2, 3
INACTIVE, PASSTHROUGH, VEL_RAMP, TRAP_TRAJ = 0, 1, 2, 5
INVALID_STATE, CONTROLLER_FAILED, WATCHDOG, MIN_ENDSTOP, NO_ENDSTOP = 1, 1 << 9, 1 << 11, 1 << 12, 1 << 17
OVERSPEED, INVALID_INPUT_MODE = 1, 1 << 1
INERTIA, FRICTION = 0.02, 0.1
"""Of the rotor [kg m^2] and of its bearings [Nm s/turn]."""

VOLATILE: dict[str, float] = {
    "error": 0,
    "current_state": IDLE,
    "requested_state": UNDEFINED,
    "is_homed": 0,
    "motor.error": 0,
    "motor.is_armed": 0,
    "motor.is_calibrated": 1,
    "encoder.error": 0,
    "encoder.pos_estimate": 0,
    "encoder.vel_estimate": 0,
    "controller.error": 0,
    "controller.input_pos": 0,
    "controller.input_vel": 0,
    "controller.input_torque": 0,
    "controller.pos_setpoint": 0,
    "controller.vel_setpoint": 0,
    "controller.torque_setpoint": 0,
    "controller.vel_integrator_torque": 0,
    "controller.trajectory_done": 1,
    "min_endstop.endstop_state": 0,
}
STORED: dict[str, float] = {
    "controller.config.control_mode": POSITION, "controller.config.input_mode": PASSTHROUGH,
    "controller.config.vel_limit": 20, "controller.config.vel_limit_tolerance": 1.2,
    "controller.config.enable_vel_limit": 1, "controller.config.enable_overspeed_error": 1,
    "controller.config.enable_torque_mode_vel_limit": 1, "controller.config.vel_ramp_rate": 1,
    "controller.config.pos_gain": 20, "controller.config.vel_gain": 31.4, "controller.config.vel_integrator_gain": 100,
    "controller.config.inertia": 0, "controller.config.homing_speed": 5, "trap_traj.config.vel_limit": 2,
    "trap_traj.config.accel_limit": 0.5, "trap_traj.config.decel_limit": 0.5, "config.enable_watchdog": 0,
    "config.watchdog_timeout": 0, "config.startup_closed_loop_control": 0, "motor.config.torque_lim": 10.0,
    "min_endstop.config.enabled": 0, "min_endstop.config.offset": 0.25,
}  # fmt: skip
"""The configuration as somebody has tuned and stored it; the firmware's own defaults of gains and limits are lower."""
UNSIGNED = (
    "error", "current_state", "requested_state", "motor.error", "encoder.error", "controller.error",
    "controller.config.control_mode", "controller.config.input_mode",
)  # fmt: skip
FLAGS = (
    "is_homed",
    "motor.is_armed",
    "motor.is_calibrated",
    "controller.trajectory_done",
    "controller.config.enable_vel_limit",
    "controller.config.enable_overspeed_error",
    "controller.config.enable_torque_mode_vel_limit",
    "config.enable_watchdog",
    "config.startup_closed_loop_control",
    "min_endstop.config.enabled",
    "min_endstop.endstop_state",
)
READ_ONLY = (
    "min_endstop.endstop_state",
    "current_state", "motor.is_armed", "motor.is_calibrated", "encoder.pos_estimate", "encoder.vel_estimate",
    "controller.pos_setpoint", "controller.vel_setpoint", "controller.torque_setpoint", "controller.trajectory_done",
)  # fmt: skip


class Trapezoid:
    """A trajectory, ``TrapezoidalTrajectory``.

    Args:
        goal, begin, speed: where it ends, where and how fast it begins.
        top, rate, brake: its speed, acceleration and deceleration.
    """

    def __init__(self, goal: float, begin: float, speed: float, top: float, rate: float, brake: float) -> None:
        way = goal - begin
        side = math.copysign(1.0, way - math.copysign(speed * speed / (2 * brake), speed))
        self._up, self._down, self._top = side * rate, -side * brake, side * top
        if side * speed > side * self._top:
            self._up = -side * rate
        self._up_s = (self._top - speed) / self._up
        down_s = -self._top / self._down
        least = 0.5 * self._up_s * (self._top + speed) + 0.5 * down_s * self._top
        self._flat_s = 0.0
        if side * way < side * least:
            square = (self._down * speed**2 + 2 * self._up * self._down * way) / (self._down - self._up)
            self._top = side * math.sqrt(max(square, 0.0))
            self._up_s = max(0.0, (self._top - speed) / self._up)
            down_s = max(0.0, -self._top / self._down)
        else:
            self._flat_s = (way - least) / self._top
        self.end_s = self._up_s + self._flat_s + down_s
        self.goal, self._begin, self._speed = goal, begin, speed
        self._flat_at = begin + speed * self._up_s + 0.5 * self._up * self._up_s**2

    def at(self, t: float) -> tuple[float, float, float]:
        """Return position, speed and acceleration at a time."""
        if t < self._up_s:
            return (
                self._begin + self._speed * t + 0.5 * self._up * t * t,
                self._speed + self._up * t,
                self._up,
            )
        if t < self._up_s + self._flat_s:
            return self._flat_at + self._top * (t - self._up_s), self._top, 0.0
        if t < self.end_s:
            left = t - self.end_s
            return self.goal + 0.5 * self._down * left * left, self._down * left, self._down
        return self.goal, 0.0, 0.0


class Axis:
    """One axis with its rotor.

    Attributes:
        p: its properties in the board's memory, by path behind ``axisN.``.
        stored: those of them that the board keeps without supply.
        place: where the rotor is; the encoder counts from ``origin``, which is where it was when the board got its
            supply.
        velocity: of the rotor.
        shoved: speed at which something else turns the rotor, 0 for none.
        switch: place of the end switch, None without.
        dry: dry friction [Nm]: what is pushed less than that sticks.
    """

    def __init__(self, dry: float = 0.05) -> None:
        self.dry = dry
        self.stored = dict(STORED)
        self.place = self.velocity = self.origin = self.shoved = 0.0
        self.switch: float | None = None
        self.boot()

    def boot(self) -> None:
        """Start as after a reset of the processor: memory as stored, the encoder at 0."""
        self.p: dict[str, float] = {**VOLATILE, **self.stored}
        self.origin = self.place
        self.left_s = 0.0
        self.feed()
        self._connected = False
        self._pos_updated = False
        self._trajectory: Trapezoid | None = None
        self._since_s = 0.0
        self._was_pressed = self._pressed
        self._homes: tuple[float, float] | None = None
        self._homes_back = self._done = self._arms = False
        self._switched_at = 0.0
        if self.p["config.startup_closed_loop_control"]:
            self.p["requested_state"] = CLOSED_LOOP

    @property
    def position(self) -> float:
        """What the encoder reads."""
        return self.place - self.origin

    @property
    def _pressed(self) -> bool:
        return self.switch is not None and self.place <= self.switch

    def feed(self) -> None:
        """Feed the watchdog: only now a new time-out counts."""
        self.left_s = max(0.0, self.p["config.watchdog_timeout"])

    # --- properties with a setter, and commands ---------------------------------------------------

    def write(self, path: str, value: float) -> None:
        """Write a property, with what its setter does."""
        self.p[path] = value
        if path == "controller.config.control_mode":
            self._control_mode_updated()
        elif path == "controller.input_pos":
            self._pos_updated = True

    def move(self, goal: float, *, trapezoid: bool) -> None:
        """Take ``p`` and ``q``, or ``t``; none of them calls the setter of the control mode."""
        if trapezoid:
            self.p["controller.config.input_mode"] = TRAP_TRAJ
        self.p["controller.config.control_mode"] = POSITION
        self.p["controller.input_pos"] = goal
        self._pos_updated = True
        self.feed()

    def clear(self) -> None:
        """Clear all errors; nothing begins to move by that."""
        for key in ("error", "motor.error", "encoder.error", "controller.error"):
            self.p[key] = 0

    def fail(self, bits: int) -> None:
        """Raise an error; the next turn of the control loop lets go."""
        self.p["error"] = int(self.p["error"]) | bits

    # --- time -------------------------------------------------------------------------------------

    def step(self, dt: float, powered: bool = True) -> None:
        """Go on by dt: checks, encoder, controller, state machine, rotor."""
        torque = 0.0
        if powered:
            self._check(dt)
            self.p["encoder.pos_estimate"], self.p["encoder.vel_estimate"] = self.position, self.velocity
            wanted = self._update(dt)  # runs armed or not
            self._run_state()
            torque = wanted if self.p["motor.is_armed"] and not self.p["error"] else 0.0
        self._turn(torque, dt)

    def _check(self, dt: float) -> None:
        p = self.p
        pressed = self._pressed and bool(p["min_endstop.config.enabled"])
        if pressed and not self._was_pressed and p["current_state"] != HOMING:
            self.fail(MIN_ENDSTOP)
        self._was_pressed = pressed
        p["min_endstop.endstop_state"] = int(pressed)
        if p["config.enable_watchdog"]:
            if self.left_s > 0:
                self.left_s -= dt
            else:
                self.fail(WATCHDOG)
        if p["error"]:
            p["motor.is_armed"] = 0

    def _control_mode_updated(self) -> None:
        if self.p["controller.config.control_mode"] >= POSITION:
            # an input that was never connected reads 0
            here = self.position if self._connected else 0.0
            self.p["controller.pos_setpoint"] = self.p["controller.input_pos"] = here

    def _start_closed_loop(self) -> None:
        self._connected = True
        self._control_mode_updated()
        self._pos_updated = self._arms = True

    def _arm(self) -> None:
        """Arm the motor, a turn of the loop later: a trajectory is planned before that, from the old speed."""
        self._arms = False
        for name in ("vel_setpoint", "torque_setpoint", "vel_integrator_torque"):
            self.p[f"controller.{name}"] = 0.0
        self.p["motor.is_armed"] = 1

    def _run_state(self) -> None:
        p = self.p
        wanted, state = int(p["requested_state"]), int(p["current_state"])
        if self._arms:
            self._arm()
            if state == HOMING and self._homes_back:
                self._turn_back()
        elif wanted == UNDEFINED:
            if state == CLOSED_LOOP and not p["motor.is_armed"]:
                p["current_state"] = IDLE
            elif state == HOMING:
                self._home()
        else:
            self._enter(wanted, state)

    def _enter(self, wanted: int, state: int) -> None:
        p = self.p
        if state == HOMING:
            self._end_homing()
        p["requested_state"], p["motor.is_armed"] = UNDEFINED, 0
        p["error"] = int(p["error"]) & ~INVALID_STATE
        p["current_state"] = wanted if wanted in (CLOSED_LOOP, HOMING) else IDLE
        if wanted == CLOSED_LOOP:
            self.feed()
            self._start_closed_loop()
        elif wanted == HOMING:
            self._begin_homing()
        elif wanted != IDLE:
            self.fail(INVALID_STATE)

    def _begin_homing(self) -> None:
        p = self.p
        self._homes = p["controller.config.control_mode"], p["controller.config.input_mode"]
        self._homes_back = self._done = False
        if not p["min_endstop.config.enabled"]:
            self.fail(NO_ENDSTOP)
            self._homes, p["current_state"] = None, IDLE
            return
        p["controller.config.control_mode"], p["controller.config.input_mode"] = VELOCITY, VEL_RAMP
        p["controller.input_pos"] = p["controller.input_torque"] = p["is_homed"] = 0
        p["controller.input_vel"] = -p["controller.config.homing_speed"]
        p["error"] = int(p["error"]) & ~MIN_ENDSTOP
        self._start_closed_loop()

    def _home(self) -> None:
        p = self.p
        if p["motor.is_armed"]:
            self._done = bool(p["controller.trajectory_done"]) if self._homes_back else self._pressed
        if not p["motor.is_armed"] or (self._homes_back and self._done):  # an error has let go, or it is there
            self._end_homing()
        elif self._done:
            p["controller.input_vel"], p["motor.is_armed"], self._homes_back = 0.0, 0, True
            p["controller.config.control_mode"], p["controller.config.input_mode"] = POSITION, TRAP_TRAJ
            self._switched_at = self.position
            self._start_closed_loop()

    def _turn_back(self) -> None:
        p, here = self.p, self._switched_at
        p["controller.input_pos"], p["controller.pos_setpoint"] = here + p["min_endstop.config.offset"], here
        p["controller.vel_setpoint"], p["controller.trajectory_done"], self._pos_updated = 0.0, 0, True

    def _end_homing(self) -> None:
        """Let go, at whatever speed the rotor has; the modes are as before, and the axis is idle.

        ``done`` is still true from the switch until the board has looked at its trajectory for the first time: what
        ends the homing in between sets the zero as well. The estimate counts from it a turn of the loop later, and that
        turn may come behind the word that the axis is homed.
        """
        p = self.p
        if self._homes_back and self._done:
            self.origin = self.place
            for name in ("input_pos", "pos_setpoint", "vel_setpoint"):
                p[f"controller.{name}"] = 0.0
            self._pos_updated, p["is_homed"] = True, 1
        if p["controller.config.input_mode"] == VEL_RAMP:  # on its way to the switch
            p["controller.input_vel"] = 0.0
        if self._homes is not None:
            p["controller.config.control_mode"], p["controller.config.input_mode"] = self._homes
        self._homes, self._arms = None, False
        p["motor.is_armed"], p["current_state"] = 0, IDLE

    # --- the controller ---------------------------------------------------------------------------

    def _update(self, dt: float) -> float:
        """Return the torque; an error of the controller is one of the axis, also when it is idle."""
        p = self.p
        if not self._take_inputs(dt):
            p["controller.error"] = int(p["controller.error"]) | INVALID_INPUT_MODE
            self.fail(CONTROLLER_FAILED)
            return 0.0
        place, speed = (self.position, self.velocity) if self._connected else (0.0, 0.0)
        limit, most = p["controller.config.vel_limit"], p["motor.config.torque_lim"]
        mode, gain = p["controller.config.control_mode"], p["controller.config.vel_gain"]
        bounded = bool(p["controller.config.enable_vel_limit"])
        if bounded:
            p["controller.vel_setpoint"] = _clamp(p["controller.vel_setpoint"], limit)
        p["controller.torque_setpoint"] = _clamp(p["controller.torque_setpoint"], most)
        wanted = p["controller.vel_setpoint"]
        if mode >= POSITION:
            wanted += p["controller.config.pos_gain"] * (p["controller.pos_setpoint"] - place)
        if bounded:
            wanted = _clamp(wanted, limit)
        tolerated = p["controller.config.vel_limit_tolerance"] * limit
        if p["controller.config.enable_overspeed_error"] and abs(speed) > tolerated:
            p["controller.error"] = int(p["controller.error"]) | OVERSPEED
            self.fail(CONTROLLER_FAILED)
            return 0.0
        torque = p["controller.torque_setpoint"]
        if mode >= VELOCITY:
            torque += gain * (wanted - speed) + p["controller.vel_integrator_torque"]
        elif p["controller.config.enable_torque_mode_vel_limit"]:
            torque = max((-limit - speed) * gain, min((limit - speed) * gain, torque))
        self._integrate(mode, abs(torque) > most, wanted - speed, dt)
        return _clamp(torque, most)

    def _integrate(self, mode: float, limited: bool, error: float, dt: float) -> None:
        key = "controller.vel_integrator_torque"
        if mode < VELOCITY:
            self.p[key] = 0.0
        elif limited:
            self.p[key] *= 0.99 ** (8000 * dt)
        else:
            self.p[key] += self.p["controller.config.vel_integrator_gain"] * dt * error

    def _take_inputs(self, dt: float) -> bool:
        p = self.p
        mode = int(p["controller.config.input_mode"])
        if mode == PASSTHROUGH:
            for name in ("pos", "vel", "torque"):
                p[f"controller.{name}_setpoint"] = p[f"controller.input_{name}"]
        elif mode == VEL_RAMP:
            most = abs(dt * p["controller.config.vel_ramp_rate"])
            change = _clamp(p["controller.input_vel"] - p["controller.vel_setpoint"], most)
            p["controller.vel_setpoint"] += change
            p["controller.torque_setpoint"] = change / dt * p["controller.config.inertia"]
        elif mode == TRAP_TRAJ:
            self._follow_trajectory(dt)
        return mode in (INACTIVE, PASSTHROUGH, VEL_RAMP, TRAP_TRAJ)

    def _follow_trajectory(self, dt: float) -> None:
        p = self.p
        if self._pos_updated:  # planned from the set-points, wherever the rotor is
            self._trajectory = Trapezoid(
                p["controller.input_pos"], p["controller.pos_setpoint"], p["controller.vel_setpoint"],
                *(p[f"trap_traj.config.{name}_limit"] for name in ("vel", "accel", "decel")),
            )  # fmt: skip
            self._since_s, self._pos_updated, p["controller.trajectory_done"] = 0.0, False, 0
        if p["controller.trajectory_done"] or self._trajectory is None:
            return
        place, speed, rate = self._trajectory.at(self._since_s)
        p["controller.pos_setpoint"], p["controller.vel_setpoint"] = place, speed
        p["controller.torque_setpoint"] = rate * p["controller.config.inertia"]
        if self._since_s > self._trajectory.end_s:
            p["controller.config.control_mode"], p["controller.trajectory_done"] = POSITION, 1
        self._since_s += dt

    # --- the rotor --------------------------------------------------------------------------------

    def _turn(self, torque: float, dt: float) -> None:
        way = self.velocity or torque  # dry friction is against the motion, at rest against what pushes
        drag = FRICTION * self.velocity + math.copysign(self.dry, way)
        change = (torque - drag) / INERTIA / (2 * math.pi) * dt
        stops = abs(torque) <= self.dry and abs(self.velocity) <= abs(change)
        self.velocity = self.shoved or (0.0 if stops else self.velocity + change)
        self.place += self.velocity * dt


def _clamp(value: float, most: float) -> float:
    return max(-most, min(most, value))
