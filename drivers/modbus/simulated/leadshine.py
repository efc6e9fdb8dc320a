"""A Leadshine / StepperOnline RS-485 drive on a pty: ``python -m sioms.drivers.modbus.simulated.leadshine --link
PATH``.

Behaves as the vendor's manuals say: paths 0 to 15 from 0x6200 on, trigger word 0x6002, jog by the control word
that must come again within 50 ms, status 0x1003, alarms 0x2203, functions 03, 06 and 10 only, exception 8 for a
damaged request. Parameters are in RAM until 0x1801 = 0x2211 saves them; the encoder is incremental, so switched off it
forgets its place, its reference and its alarm; with bit 2 of 0x6000 saved it homes by itself when it is switched on.
Commands on standard
input: those of the line (``mute``, ``noise``, ``unplug``, ``power_cycle`` ...) and of drives (``state``, ``alarm``,
    ``shove`` ...).
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from pymodbus.constants import ExcCodes

from sioms.simulation.control import serve
from sioms.simulation.drive import Mover, Stepper, drive_handlers
from sioms.simulation.faults import Faults

from .lines import ILLEGAL_FUNCTION, ILLEGAL_VALUE, RtuLine, serial_parser, simulated, unit_list

JOG_DEAD_MAN_S = 0.05
PR_CONTROL, HOME_AT_POWER_ON = 0x6000, 0x04
MAX_WORDS = 97
"""Messages have at most 200 bytes."""
RANGES = (
    (0x0001, 15), (0x0145, 14), (0x0157, 6), (0x0191, 1), (0x01BD, 5), (0x01E1, 1), (0x1003, 1), (0x1014, 2),
    (0x1044, 4), (0x1801, 1), (0x1901, 1), (0x2203, 1), (0x6000, 1), (0x6002, 1), (0x600A, 1), (0x600F, 2),
    (0x602C, 2), (0x6200, 128),
)  # fmt: skip
FAULT, ENABLED, RUNNING, COMMAND_DONE, PATH_DONE, HOMED = 0x01, 0x02, 0x04, 0x10, 0x20, 0x40


class Drive:
    """One drive; times in seconds of the given clock."""

    def __init__(self, clock: Callable[[], float] = time.monotonic, pulses_per_turn: int = 10000) -> None:
        self.mover = Mover()
        self.words = {
            0x0001: pulses_per_turn,
            0x0003: 2,
            0x000F: 1,
            0x0191: 32,
            0x01BD: 4,
            0x01BF: 1,
            0x01C1: 3,
        }
        self.words |= {0x01E1: 100, 0x600F: 200, 0x6010: 50}
        self.saved = dict(self.words)
        self.alarm = 0
        self.done = 0
        self.homing = False
        self.jog_until_s = 0.0
        self.time = Stepper(self._step, lambda: not self.mover.busy and not self.mover.shoved, clock)

    # -- supply ----------------------------------------------------------------------------------

    def power_off(self) -> None:
        """Let go of the motor; the place is forgotten."""
        self.time.catch_up()
        self.mover.halt()

    def power_on(self) -> None:
        """Boot with what was saved, counting from zero where it stands."""
        self.time.catch_up()
        self.mover.halt()
        self.mover.count_from(0.0)
        self.words = dict(self.saved)
        self.alarm = self.done = 0
        self.homing, self.jog_until_s = False, 0.0
        if self.words.get(PR_CONTROL, 0) & HOME_AT_POWER_ON:
            self.trigger(0x20)

    # -- motion ----------------------------------------------------------------------------------

    def _step(self, now_s: float, dt: float) -> None:
        mover = self.mover
        if self.jog_until_s and now_s >= self.jog_until_s:
            self.jog_until_s = 0.0
            mover.stop()
        was_going = mover.target is not None
        mover.step(dt)
        if was_going and mover.target is None and not self.alarm:
            self.done |= COMMAND_DONE | PATH_DONE
            if self.homing:
                self.homing = False
                mover.count_from(0.0)
                self.done |= HOMED

    def _rpm(self, rpm: float) -> float:
        return rpm / 60 * self.words[0x0001]

    def _ramp(self, ms_per_1000_rpm: int) -> float:
        return self._rpm(1000) / (max(1, ms_per_1000_rpm) / 1000)

    def _may_move(self) -> bool:
        return self.alarm == 0 and self.words[0x000F] == 1

    def run_path(self, path: int) -> ExcCodes | None:
        """Start path 0 to 15; refuses a mode word that the drive does not know."""
        mode, high, low, speed, up, down = (self.words.get(0x6200 + 8 * path + i, 0) for i in range(6))
        position = (high << 16 | low) - (1 << 32 if high & 0x8000 else 0)
        if mode not in (0x0001, 0x0041, 0x0002):
            return ILLEGAL_VALUE
        if not self._may_move():
            return None
        self.done, self.homing, self.jog_until_s = self.done & HOMED, False, 0.0
        up_rate, down_rate = self._ramp(up), self._ramp(down)
        if mode == 0x0002:
            self.mover.run(self._rpm(speed - 0x10000 if speed & 0x8000 else speed), up_rate, down_rate)
        else:
            start = self.mover.position if mode == 0x0041 else 0.0
            self.mover.go_to(start + position, self._rpm(speed), up_rate, down_rate)
        return None

    def trigger(self, word: int) -> ExcCodes | None:
        """Obey the trigger register 0x6002."""
        match word:
            case 0x40:
                self.homing, self.jog_until_s = False, 0.0
                self.mover.stop()
            case 0x20 if self._may_move():
                self.done, self.homing = 0, True
                rate = self._ramp(100)
                self.mover.go_to(self.mover.home, self._rpm(self.words[0x600F]), rate, rate)
            case 0x21 if not self.mover.busy:
                self.mover.count_from(0.0)
            case word if 0x10 <= word <= 0x1F:
                return self.run_path(word - 0x10)
            case 0 | 0x20 | 0x21:
                return None
            case _:
                return ILLEGAL_VALUE
        return None

    def control(self, word: int, now_s: float) -> ExcCodes | None:
        """Obey the control word 0x1801."""
        match word:
            case 0x1111:
                self.alarm = 0
            case 0x4001 | 0x4002:
                if self._may_move():
                    self.done &= HOMED
                    self.jog_until_s = now_s + JOG_DEAD_MAN_S
                    sign = 1 if word == 0x4001 else -1
                    self.mover.run(sign * self._rpm(self.words[0x01E1]), self._ramp(100), self._ramp(100))
            case 0x2211:
                self.words[0x1901] = 0x5555
                self.saved = dict(self.words)
            case _:
                return ILLEGAL_VALUE
        return None

    def raise_alarm(self, code: int) -> None:
        """Go into fault: the motion ends with the drive's own deceleration."""
        self.time.catch_up()
        self.alarm, self.homing, self.jog_until_s = code, False, 0.0
        self.mover.stop()

    def foreign(self, kind: str, value: float) -> None:
        """Run path 0 at a velocity [pulses/s], which is reached already, or start it to a position [pulses]."""
        self.time.catch_up()
        match kind:
            case "velocity":
                rpm = round(value / self.words[0x0001] * 60)
                self.write(16, 0x6200, [2, 0, 0, rpm & 0xFFFF, 100, 100, 0, 0x10])
                self.mover.velocity = self.mover.top_speed
            case "position":
                pulses = round(value)
                self.write(16, 0x6200, [1, pulses >> 16 & 0xFFFF, pulses & 0xFFFF, 100, 100, 100, 0, 0x10])
            case _:
                raise ValueError(f"kind {kind}: want velocity or position")

    def shove(self, velocity: float) -> None:
        """Turn by itself [pulses/s]."""
        self.time.catch_up()
        self.mover.shoved = velocity

    # -- registers -------------------------------------------------------------------------------

    def read(self, function: int, address: int, count: int) -> list[int] | ExcCodes:
        """Return holding registers."""
        if function != 3:
            return ILLEGAL_FUNCTION
        if count > MAX_WORDS:
            return ILLEGAL_VALUE
        self.time.catch_up()
        mover = self.mover
        live = {0x1003: self.status(), 0x2203: self.alarm, 0x6002: 0, 0x1801: 0}
        rpm = round(mover.turns / self.words[0x0001] * 60)
        pairs = {0x1014: mover.feedback, 0x602C: mover.feedback, 0x1044: rpm, 0x1046: rpm}
        for first, value in pairs.items():
            live[first], live[first + 1] = value >> 16 & 0xFFFF, value & 0xFFFF
        return [live.get(a, self.words.get(a, 0)) for a in range(address, address + count)]

    def status(self) -> int:
        """Return the status word."""
        if self.alarm:
            return FAULT | (self.done & HOMED) | (RUNNING if self.mover.busy else 0)
        word = self.done | (ENABLED if self.words[0x000F] else 0)
        return (word & HOMED) | ENABLED | RUNNING if self.mover.busy else word

    def write(self, function: int, address: int, values: list[int]) -> ExcCodes | None:
        """Take holding registers; side effects in the order of the addresses."""
        if function not in (6, 16):
            return ILLEGAL_FUNCTION
        if len(values) > MAX_WORDS:
            return ILLEGAL_VALUE
        now_s = self.time.catch_up()
        refused: ExcCodes | None = None
        for at, value in enumerate(values, address):
            self.words[at] = value
            if at in (0x6002, 0x6207):
                refused = self.trigger(value)
            elif at == 0x1801:
                refused = self.control(value, now_s)
            elif at == 0x000F and value == 0:
                self.mover.halt()
        return refused

    def state(self) -> dict[str, float]:
        """Return what a bystander sees."""
        self.time.catch_up()
        return {**self.mover.seen(), "alarm": self.alarm, "status": self.status()}


async def run() -> None:
    """Serve until told to end."""
    parser = serial_parser("simulated Leadshine RS-485 drive")
    parser.add_argument("--pulses-per-turn", type=int, default=10000)
    parser.add_argument("--ends", type=float, nargs=2, metavar=("LOW", "HIGH"), help="hard ends [pulses]")
    options = parser.parse_args()
    drives = {unit: Drive(pulses_per_turn=options.pulses_per_turn) for unit in unit_list(options.units)}
    devices = [simulated(unit, drive, RANGES) for unit, drive in drives.items()]
    line = RtuLine(devices, options.link, Faults(), baud=options.baud, answers_damage=True, powered=drives.values())
    for drive in drives.values():
        if options.ends:
            drive.mover.low, drive.mover.high = options.ends
    await line.start()
    handlers = {**line.handlers(), **drive_handlers(drives)}
    await serve(str(options.link or line.port.name), handlers, line.close)


if __name__ == "__main__":
    asyncio.run(run())
