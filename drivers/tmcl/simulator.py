"""A Trinamic TMCL module on a pty: ``python -m sioms.drivers.tmcl.simulator --link PATH``.

Behaves as the firmware manuals and the vendor's TMC-EvalSystem say (``tmc/TMCL.c``, ``boards/TMC5130_eval.c``;
drivers/tmcl/README.md names the commit). The receiver waits for nine bytes without a time-out. Nine with a wrong
checksum draw status 1, whatever their address, with module and command of the last good telegram; a good one for
another address draws nothing. The ramp generator is that of
the TMC5130: a stop is velocity mode with target 0 and leaves the target position; "reached" compares places in any
mode; setting the actual position in position mode starts the motor. A restart forgets all but the EEPROM, and counts
from 0 where the motor stands.

Commands on standard input, beside those of the line: ``state [MOTOR]``, ``flags VALUE [MOTOR]`` (driver errors), ``ends
LOW HIGH [MOTOR]``, ``reference [off]`` (the left switch near motor 0, or none), ``store`` (what was written to the
EEPROM), ``power_cycle [SECONDS]``, ``refuse COUNT``, ``freeze [COUNT]``, ``foreign velocity|position VALUE [MOTOR]``,
``shove VELOCITY [MOTOR]``, ``brown_out`` (of an evaluation board's motor supply).
"""

from __future__ import annotations

import asyncio
import struct
import time
from collections.abc import Callable

from sioms.simulation import wire
from sioms.simulation.control import number
from sioms.simulation.drive import Mover, Stepper
from sioms.simulation.faults import FOREVER

TELEGRAM = struct.Struct(">BBBBi")
OK, WRONG_CHECKSUM, INVALID_COMMAND, WRONG_TYPE, INVALID_VALUE, NOT_AVAILABLE = 100, 1, 2, 3, 4, 6
SETTABLE = {4, 5, 6, 7, 12, 13, 130, 140, 149, 193, 194, 195, 204, 214}
READABLE = SETTABLE | {0, 1, 2, 3, 8, 9, 10, 11, 135, 138, 196, 197, 206, 207, 208, 209}
STARTUP = {4: 512_000, 5: 512_000, 6: 128, 7: 8, 140: 8, 194: 20000, 195: 2000, 193: 1}
"""Axis parameters after a start: other than any driver's limits."""
READS = (6, 10, 136)
REFERENCE_STEPS = 20000
"""How far away the left switch is put."""


class Motor:
    """One motor and its ramp generator; the mover knows where the shaft is, the module counts from ``origin``."""

    def __init__(self) -> None:
        self.mover = Mover(acceleration=51200.0, deceleration=51200.0)
        self.flags = 0
        self.shoved = 0.0
        self.start()

    def start(self) -> None:
        """Be as after power-up: the count begins at 0 here, in position mode."""
        self.parameters = dict(STARTUP)
        self.origin = self.mover.position
        self.target = 0
        self.positioning = True
        self.searching, self.wanted = 0, 0.0
        self.mover.halt()

    @property
    def count(self) -> int:
        """The actual position as the module counts it."""
        return round(self.mover.position - self.origin)

    @property
    def reached(self) -> bool:
        """The flag of parameter 8: the actual position is the target position, in any mode."""
        return self.count == self.target

    @property
    def ramp(self) -> float:
        return float(self.parameters[5])

    def go(self) -> None:
        """Move to the target."""
        self.mover.go_to(self.origin + self.target, self.parameters[4], self.ramp, self.ramp)

    def rotate(self, velocity: float) -> None:
        """Velocity mode: the target position stays what it was."""
        self.positioning, self.searching, self.wanted = False, 0, velocity
        self.mover.run(velocity, self.ramp, self.ramp)

    def brown_out(self) -> None:
        """Lose the count, and take up again what the registers said: the board writes back what it wrote before."""
        self.mover.halt()
        self.origin = self.mover.position
        if self.positioning:
            self.go()
        else:
            self.rotate(self.wanted)

    def step(self, dt: float) -> None:
        """Go on; a search finds the left switch as the hard end that it runs into."""
        if self.shoved:
            self.mover.target, self.mover.top_speed, self.mover.velocity = None, self.shoved, self.shoved
        hit = self.mover.step(dt)
        if self.searching == 1 and (hit or self.mover.position <= self.mover.low):
            self.searching = 2  # back off by 1000 microsteps, then zero
            self.mover.go_to(self.mover.low + 1000, self.parameters[195], self.ramp, self.ramp)
        elif self.searching == 2 and not self.mover.busy:
            self.searching = 0
            self.origin, self.target, self.positioning = self.mover.position, 0, True


class Module:
    """The module; times in seconds of the given clock.

    Args:
        address: that it listens to.
        motors: how many it has.
        number_, firmware: that it tells.
        heartbeat: it has global parameter 68.
        ticks: it has global parameter 132.
        keeps_heartbeat: the heartbeat lies in the EEPROM.
        silent: it passes over a wrong checksum.
        clock: the present [s].
    """

    def __init__(
        self, address: int = 1, motors: int = 1, number_: int = 1140, firmware: int = 0x0128, *,
        heartbeat: bool = True, ticks: bool = True, keeps_heartbeat: bool = False, silent: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        self.address, self.host = address, 2
        self.number, self.firmware = number_, firmware
        self.motors = [Motor() for _ in range(motors)]
        self._without = {kind for kind, has in ((68, heartbeat), (132, ticks)) if not has}
        self.globals = {65: 0, 66: address, 68: 0, 75: 0, 76: 2, 77: 0, 128: 0, 132: 0}
        self.stored: list[int] = []
        self._keeps_heartbeat, self._silent = keeps_heartbeat, silent
        self._clock = clock
        self._off_until_s = -1.0
        self._refuse = 0
        self._frozen: dict[bytes, tuple[int, int]] = {}
        self._freeze = 0
        self._start(clock())
        self.time = Stepper(
            self._step, lambda: not any(m.mover.busy or m.searching or m.shoved for m in self.motors), clock
        )

    def _start(self, now_s: float) -> None:
        """Be as after power-up."""
        self._began_s = self._heard_s = now_s
        self._bytes = b""
        self._last = (0, 0)
        if not self._keeps_heartbeat:
            self.globals[68] = 0
        for motor in self.motors:
            motor.start()

    def power_cycle(self, duration_s: float = 0.2) -> None:
        """Take the supply away for a time: mute, deaf, without torque; then start."""
        now_s = self.time.catch_up()
        self._off_until_s = now_s + duration_s
        self._start(self._off_until_s)

    @property
    def is_off(self) -> bool:
        """Whether it has no supply."""
        return self._clock() < self._off_until_s

    def _step(self, now_s: float, dt: float) -> None:
        limit_ms = self.globals[68]
        silent = limit_ms and now_s - self._heard_s > limit_ms / 1000
        for motor in self.motors:
            if silent and (motor.mover.target is not None or motor.mover.top_speed):
                motor.rotate(0)
            motor.step(dt)

    def connected(self) -> list[bytes]:
        """Say nothing."""
        return []

    def due(self) -> list[bytes]:
        """Let time pass."""
        self.time.catch_up()
        return []

    def take(self, data: bytes) -> list[bytes]:
        """Gather nine bytes, however long they take to come."""
        now_s = self.time.catch_up()
        if self.is_off:
            return []
        self._bytes += data
        replies = []
        while len(self._bytes) >= 9:
            telegram, self._bytes = self._bytes[:9], self._bytes[9:]
            self._heard_s = now_s
            replies += self._answer(telegram)
        return replies

    def _answer(self, telegram: bytes) -> list[bytes]:
        module, command, kind, axis, value = TELEGRAM.unpack(telegram[:8])
        if sum(telegram[:8]) % 256 != telegram[8]:
            return [] if self._silent else [self._reply(WRONG_CHECKSUM, 0)]
        self._last = (module, command)
        if module != self.address:
            return []
        if command == 136 and kind == 0:
            text = f"{self.number:04d}V{self.firmware >> 8}{self.firmware & 0xFF:02d}"
            return [bytes((self.host,)) + text.encode()[:8]]
        if command not in READS and self._refuse:
            self._refuse -= 1
            return [self._reply(NOT_AVAILABLE, value)]
        status, result = self._image(telegram) or self._obey(command, kind, axis, value)
        if self._freeze and command in READS:
            self._frozen.setdefault(telegram, (status, result))
        return [self._reply(status, result if status == OK else value)]

    def _image(self, telegram: bytes) -> tuple[int, int] | None:
        """Return what it answered to this before it froze."""
        if not self._freeze:
            return None
        self._freeze -= 1
        return self._frozen.get(telegram)

    def _reply(self, status: int, value: int) -> bytes:
        value = (value + 2**31) % 2**32 - 2**31
        module, command = self._last
        head = TELEGRAM.pack(self.host, module, status, command, value)
        return head + bytes((sum(head) % 256,))

    def _obey(self, command: int, kind: int, axis: int, value: int) -> tuple[int, int]:
        if command == 136:
            return (OK, self.number << 16 | self.firmware) if kind == 1 else (WRONG_TYPE, value)
        if command in (9, 10):
            return self._global(command, kind, axis, value)
        if command == 128:
            return OK, value
        if command not in (1, 2, 3, 4, 5, 6, 13):
            return INVALID_COMMAND, value
        if axis >= len(self.motors):
            return WRONG_TYPE, value
        motor = self.motors[axis]
        match command:
            case 1 | 2 | 3:
                motor.rotate((value, -value, 0)[command - 1])
            case 4:
                return self._move(motor, kind, value)
            case 5:
                return self._set(motor, kind, value)
            case 6:
                return self._get(motor, kind)
            case 13:
                return self._search(motor, kind)
        return OK, value

    def _move(self, motor: Motor, kind: int, value: int) -> tuple[int, int]:
        if kind not in (0, 1):
            return WRONG_TYPE, value
        motor.target = value if kind == 0 else motor.count + value
        motor.positioning, motor.searching = True, 0
        motor.go()
        return OK, motor.target

    def _set(self, motor: Motor, kind: int, value: int) -> tuple[int, int]:
        if kind in (0, 1):
            if kind == 0:
                motor.target = value
            else:
                motor.origin = motor.mover.position - value
            if motor.positioning:
                motor.go()
            return OK, value
        if kind not in SETTABLE:
            return WRONG_TYPE, value
        if value < 0 or (kind in (6, 7) and value > 255) or (kind == 140 and value > 8):
            return INVALID_VALUE, value
        motor.parameters[kind] = value
        if kind == 4 and motor.mover.target is not None:
            motor.mover.top_speed = abs(value)
        elif kind == 5:
            motor.mover.acceleration = motor.mover.deceleration = motor.ramp
        return OK, value

    def _get(self, motor: Motor, kind: int) -> tuple[int, int]:
        if kind not in READABLE:
            return WRONG_TYPE, 0
        mover = motor.mover
        live = {
            0: motor.target, 1: motor.count, 3: round(mover.velocity), 8: int(motor.reached),
            10: int(mover.position >= mover.high), 11: int(mover.position <= mover.low), 208: motor.flags,
        }  # fmt: skip
        return OK, live.get(kind, motor.parameters.get(kind, 0))

    def _search(self, motor: Motor, kind: int) -> tuple[int, int]:
        if kind == 0:
            motor.searching, motor.positioning = 1, False
            motor.mover.run(-float(motor.parameters[194]), motor.ramp, motor.ramp)
        elif kind == 1:
            motor.searching = 0
            motor.mover.stop(motor.ramp)
        elif kind != 2:
            return WRONG_TYPE, 0
        return OK, motor.searching

    def _global(self, command: int, kind: int, bank: int, value: int) -> tuple[int, int]:
        if bank != 0 or kind not in self.globals or kind in self._without:
            return WRONG_TYPE, value
        if command == 10:
            return OK, round((self._clock() - self._began_s) * 1000) if kind == 132 else self.globals[kind]
        if value < 0:
            return INVALID_VALUE, value
        self.globals[kind] = value
        self.stored.append(kind)
        return OK, value

    def handlers(self) -> dict[str, Callable[..., object]]:
        """Return the commands on standard input."""

        def state(axis: str = "") -> dict[str, float]:
            self.time.catch_up()
            motor = self.motors[int(axis or 0)]
            speeds = [each.mover.velocity for each in ([motor] if axis else self.motors)]
            return {
                "position": motor.mover.position, "velocity": max(speeds, key=abs), "count": motor.count,
                "moving": int(motor.mover.busy), "heartbeat_ms": self.globals[68], "armed": int(self.globals[68] > 0),
                "searching": motor.searching, "acceleration": motor.parameters[5], "speed": motor.parameters[4],
            }  # fmt: skip

        def flags(value: str, axis: str = "0") -> None:
            self.motors[int(axis)].flags = int(number(value))
            if int(number(value)) & 0x1A:
                self.motors[int(axis)].mover.halt()

        def ends(low: str, high: str, axis: str = "0") -> None:
            mover = self.motors[int(axis)].mover
            mover.low, mover.high = number(low), number(high)

        def reference(off: str = "") -> None:
            self.time.catch_up()
            mover = self.motors[0].mover
            mover.low = -1e12 if off else mover.position - REFERENCE_STEPS

        def power_cycle(seconds: str = "0.2") -> None:
            self.power_cycle(number(seconds))

        def refuse(count: str) -> None:
            self._refuse = int(count)

        def freeze(count: str = "") -> None:
            self._freeze, self._frozen = int(count) if count else FOREVER, {}

        def foreign(kind: str, value: str, axis: str = "0") -> None:
            self.time.catch_up()
            motor = self.motors[int(axis)]
            if kind == "velocity":
                motor.rotate(number(value))
            elif kind == "position":
                self._move(motor, 0, int(number(value)))
            else:
                raise ValueError(f"{kind}; want velocity or position")

        def brown_out() -> None:
            self.time.catch_up()
            for motor in self.motors:
                motor.brown_out()

        def shove(velocity: str, axis: str = "0") -> None:
            self.time.catch_up()
            motor = self.motors[int(axis)]
            motor.shoved = number(velocity)
            if not motor.shoved:
                motor.mover.halt()

        return {
            "state": state, "flags": flags, "ends": ends, "reference": reference, "store": lambda: self.stored,
            "power_cycle": power_cycle, "refuse": refuse, "freeze": freeze, "foreign": foreign, "shove": shove,
            "brown_out": brown_out,
        }  # fmt: skip


async def main() -> None:
    """Serve until told to end."""
    parser = wire.parser("simulated TMCL module")
    parser.add_argument("--address", type=int, default=1)
    parser.add_argument("--motors", type=int, default=1)
    parser.add_argument("--module", type=int, default=1140)
    parser.add_argument("--no-heartbeat", action="store_true", help="a module without global parameter 68")
    parser.add_argument("--no-ticks", action="store_true", help="a module without global parameter 132")
    parser.add_argument("--keeps-heartbeat", action="store_true", help="the heartbeat lies in its EEPROM")
    parser.add_argument("--silent", action="store_true", help="a wrong checksum draws no reply")
    options = parser.parse_args()
    module = Module(
        options.address, options.motors, options.module, heartbeat=not options.no_heartbeat,
        ticks=not options.no_ticks, keeps_heartbeat=options.keeps_heartbeat, silent=options.silent,
    )  # fmt: skip
    await wire.run(module, options, module.handlers(), wire.QUIET_S)


if __name__ == "__main__":
    asyncio.run(main())
