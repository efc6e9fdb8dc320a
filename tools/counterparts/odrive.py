"""An ODrive board (firmware 0.5.6) on a pty: ``python -m sioms.tools.counterparts.odrive --link PATH``.

Behaves as the documentation and the firmware's parser say: lines end at LF, CR or ``!``, ``;`` begins a comment, a wrong
checksum is silence, replies carry a checksum when the request did, set commands are not answered, values are cut to nine
characters. A rotor with inertia and friction hangs on each axis. Commands on standard input, beside those of the line:
``state [AXIS]``, ``error BITS [AXIS]``, ``switch TURNS [AXIS]`` (end switch for homing), ``set PATH VALUE``.
"""

from __future__ import annotations

import asyncio
import math
import re
import time
from collections.abc import Callable

from . import wire
from .control import number
from .drive import Stepper

MAX_LINE = 256
DRY = 0.05
"""Dry friction [Nm]: what is pushed less than that sticks."""
IDLE, CLOSED_LOOP, HOMING = 1, 8, 11
WATCHDOG, NO_SWITCH = 1 << 11, 1 << 17


class Axis:
    """One axis with its rotor; turns, seconds, Nm."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self.p: dict[str, float] = {
            "error": 0, "current_state": IDLE, "requested_state": 0, "motor.error": 0, "encoder.error": 0,
            "controller.error": 0, "controller.input_pos": 0, "controller.input_vel": 0, "controller.input_torque": 0,
            "controller.config.control_mode": 3, "controller.config.input_mode": 1, "controller.config.vel_limit": 20,
            "controller.config.vel_ramp_rate": 1, "controller.trajectory_done": 1, "trap_traj.config.vel_limit": 2,
            "trap_traj.config.accel_limit": 0.5, "trap_traj.config.decel_limit": 0.5, "config.enable_watchdog": 0,
            "config.watchdog_timeout": 0, "motor.config.torque_lim": 5.0,
        }  # fmt: skip
        self.position = self.velocity = self.setpoint = 0.0
        self.inertia, self.friction = 0.02, 0.1
        self.switch: float | None = None
        self.trajectory: float | None = None
        self._clock = clock
        self.fed_s = clock()

    def feed(self) -> None:
        """Feed the watchdog."""
        self.fed_s = self._clock()

    def fail(self, bits: int) -> None:
        """Disarm with an error."""
        self.p["error"] = int(self.p["error"]) | bits
        self.p["current_state"] = IDLE

    def request(self, state: int) -> None:
        """Go into a state."""
        if state in (CLOSED_LOOP, HOMING) and self.p["error"]:
            return
        if state == HOMING and self.switch is None:
            self.fail(NO_SWITCH)
            return
        if state == CLOSED_LOOP and self.p["current_state"] != CLOSED_LOOP:
            self.p["controller.input_pos"] = self.position
            self.setpoint = self.velocity
            self.trajectory = None
            self.p["controller.input_vel"] = self.p["controller.input_torque"] = 0.0
        if state in (IDLE, CLOSED_LOOP, HOMING):
            self.p["current_state"] = state

    def step(self, now_s: float, dt: float) -> None:
        """Go on by dt."""
        p = self.p
        if p["config.enable_watchdog"] and now_s - self.fed_s > p["config.watchdog_timeout"]:
            self.fail(WATCHDOG)
        if abs(self.velocity) > 1.2 * p["controller.config.vel_limit"] and p["current_state"] == CLOSED_LOOP:
            p["controller.error"] = int(p["controller.error"]) | 1
            self.fail(1 << 9)
        state = int(p["current_state"])
        if state == CLOSED_LOOP:
            torque = self._control(dt)
        elif state == HOMING:
            torque = self._servo(-5.0)
            if self.switch is not None and self.position <= self.switch:
                self.position, self.switch = 0.0, 0.0
                p["current_state"], p["controller.input_pos"] = IDLE, 0.0
        else:
            torque = 0.0
        limit = p["motor.config.torque_lim"]
        torque = max(-limit, min(limit, torque))
        way = self.velocity or torque  # dry friction is against the motion, at rest against what pushes
        drag = self.friction * self.velocity + math.copysign(DRY, way)
        change = (torque - drag) / self.inertia / (2 * math.pi) * dt
        stops = abs(torque) <= DRY and abs(self.velocity) <= abs(change)
        self.velocity = 0.0 if stops else self.velocity + change
        self.position += self.velocity * dt

    def _servo(self, wanted: float) -> float:
        return (wanted - self.velocity) * 2 * math.pi * self.inertia / 0.004

    def _control(self, dt: float) -> float:
        p = self.p
        mode = int(p["controller.config.control_mode"])
        if mode == 1:
            return p["controller.input_torque"]
        if mode == 2:
            self.setpoint = self._ramped(p["controller.input_vel"], dt)
        elif self.trajectory is not None:
            self.setpoint = self._trapezoid(dt)
        else:
            self.setpoint = 20.0 * (p["controller.input_pos"] - self.position)
        return self._servo(self.setpoint)

    def _ramped(self, wanted: float, dt: float) -> float:
        if int(self.p["controller.config.input_mode"]) != 2:
            return wanted
        change = self.p["controller.config.vel_ramp_rate"] * dt
        return self.setpoint + max(-change, min(change, wanted - self.setpoint))

    def _trapezoid(self, dt: float) -> float:
        p = self.p
        rate, top = p["trap_traj.config.decel_limit"], p["trap_traj.config.vel_limit"]
        way = (self.trajectory or 0.0) - self.position
        if abs(way) < 2e-3 and abs(self.velocity) < 4 * rate * dt + 0.05:
            self.trajectory, p["controller.trajectory_done"] = None, 1
            return 20.0 * way
        # keep a little behind the braking parabola for the lag of the velocity loop
        reach = math.sqrt(2 * rate * abs(way)) - 0.004 * rate
        wanted = math.copysign(min(top, max(reach, 20.0 * min(abs(way), 0.002))), way)
        change = max(p["trap_traj.config.accel_limit"], rate) * dt * 1.2
        return self.setpoint + max(-change, min(change, wanted - self.setpoint))


class Board:
    """The board; times in seconds of the given clock."""

    def __init__(self, version: str = "0.5.6", clock: Callable[[], float] = time.monotonic) -> None:
        major, minor, revision = (int(part) for part in version.split("."))
        self.axes = [Axis(clock), Axis(clock)]
        self.properties: dict[str, float] = {
            "vbus_voltage": 24.087744, "fw_version_major": major, "fw_version_minor": minor,
            "fw_version_revision": revision, "serial_number": 35601883739976,
        }  # fmt: skip
        self._line = bytearray()
        self.time = Stepper(self._step, lambda: False, clock)

    def _step(self, now_s: float, dt: float) -> None:
        for axis in self.axes:
            axis.step(now_s, dt)

    def connected(self) -> list[bytes]:
        """Say nothing."""
        return []

    def due(self) -> list[bytes]:
        """Let time pass."""
        self.time.catch_up()
        return []

    def take(self, data: bytes) -> list[bytes]:
        """Take bytes; obey complete lines."""
        self.time.catch_up()
        replies = []
        for byte in data:
            if byte in b"\r\n!":
                if len(self._line) <= MAX_LINE and (reply := self._checked(bytes(self._line))):
                    replies.append(reply)
                self._line.clear()
            else:
                self._line.append(byte)
        return replies

    def _checked(self, raw: bytes) -> bytes:
        text = raw.split(b";")[0]
        body, star, digits = text.partition(b"*")
        if star:
            total = 0
            for byte in body:
                total ^= byte
            if not digits.strip().isdigit() or int(digits) != total:
                return b""
        reply = self._obey(body.decode("ascii", "replace").split())
        if not reply:
            return b""
        total = 0
        for byte in reply.encode():
            total ^= byte
        return reply.encode() + (f"*{total}".encode() if star else b"") + b"\r\n"

    def _obey(self, words: list[str]) -> str:
        if not words:
            return ""
        name, rest = words[0], words[1:]
        if name in ("p", "q", "v", "c", "t", "f", "u"):
            return self._motion(name, rest)
        if name == "r" and len(rest) == 1:
            found = self._find(rest[0])
            return "invalid property" if found is None else _shown(found[0][found[1]])
        if name == "w" and len(rest) == 2:
            return self._write(*rest)
        if name == "sc":
            for axis in self.axes:
                for key in ("error", "motor.error", "encoder.error", "controller.error"):
                    axis.p[key] = 0
            return ""
        if name in ("i", "h", "ss", "se", "sr"):
            return "Hardware version: 3.6-24V" if name == "i" else ""
        return "invalid command format" if name in ("r", "w") else "unknown command"

    def _motion(self, name: str, rest: list[str]) -> str:
        try:
            index, values = int(rest[0]), [float(word) for word in rest[1:]]
        except (IndexError, ValueError):
            return "invalid command format"
        if not values and name not in "fu":
            return "invalid command format"
        if not 0 <= index < len(self.axes):
            return f"invalid motor {index}"
        axis = self.axes[index]
        p = axis.p
        if name == "f":
            return f"{axis.position:f} {axis.velocity:f}"
        axis.feed()
        if name in "pqt":
            p["controller.config.control_mode"], p["controller.input_pos"] = 3, values[0]
            axis.trajectory = values[0] if name == "t" else None
            if name == "t":
                p["controller.config.input_mode"], p["controller.trajectory_done"] = 5, 0
        elif name == "v":
            p["controller.config.control_mode"], p["controller.input_vel"] = 2, values[0]
        elif name == "c":
            p["controller.config.control_mode"], p["controller.input_torque"] = 1, values[0]
        return ""

    def _find(self, path: str) -> tuple[dict[str, float], str] | None:
        if path in self.properties:
            return self.properties, path
        match = re.fullmatch(r"axis([01])\.(.+)", path)
        if match is None or match[2] not in self.axes[int(match[1])].p:
            return None
        return self.axes[int(match[1])].p, match[2]

    def _write(self, path: str, text: str) -> str:
        found = self._find(path)
        if found is None or found[0] is self.properties:
            return "invalid property"
        try:
            value = float(text)
        except ValueError:
            return "invalid value"
        if found[1] == "requested_state":
            self.axes[int(path[4])].request(int(value))
        else:
            found[0][found[1]] = value
        return ""

    def handlers(self) -> dict[str, Callable[..., object]]:
        """Return the commands on standard input."""

        def state(index: str = "0") -> dict[str, float]:
            self.time.catch_up()
            axis = self.axes[int(index)]
            return {"position": axis.position, "velocity": axis.velocity, "state": axis.p["current_state"],
                    "error": axis.p["error"], "torque": axis.p["controller.input_torque"]}  # fmt: skip

        def error(bits: str, index: str = "0") -> None:
            self.axes[int(index)].p["motor.error"] = 0x10
            self.axes[int(index)].fail(int(number(bits)))

        def switch(turns: str, index: str = "0") -> None:
            self.axes[int(index)].switch = float(turns)

        def set_(path: str, value: str) -> None:
            found = self._find(path)
            if found is None:
                raise ValueError(f"no property {path}")
            found[0][found[1]] = float(value)

        return {"state": state, "error": error, "switch": switch, "set": set_}


def _shown(value: float) -> str:
    text = str(int(value)) if float(value).is_integer() and abs(value) < 1e15 else f"{value:f}"
    return text[:9]


async def main() -> None:
    """Serve until told to end."""
    parser = wire.parser("simulated ODrive board")
    parser.add_argument("--version", default="0.5.6")
    options = parser.parse_args()
    board = Board(options.version)
    await wire.run(board, options, board.handlers())


if __name__ == "__main__":
    asyncio.run(main())
