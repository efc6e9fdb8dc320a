"""A Trinamic TMCL module on a pty: ``python -m sioms.tools.counterparts.tmcl --link PATH``.

Behaves as the firmware manuals and the vendor's ``TMCL.c`` say: nine bytes each way, status 1 with a stale command byte for
a wrong checksum, silence for another address, status 3 for an unknown axis, ROR/ROL/MST/MVP, axis and global parameters,
reference search to the left switch, heartbeat. Commands on standard input, beside those of the line: ``state [MOTOR]``,
``flags VALUE [MOTOR]`` (driver errors), ``ends LOW HIGH [MOTOR]``, ``store`` (what was written to the EEPROM).
"""

from __future__ import annotations

import asyncio
import struct
import time
from collections.abc import Callable

from . import wire
from .control import number
from .drive import Mover, Stepper

TELEGRAM = struct.Struct(">BBBBi")
BYTE_TIMEOUT_S = 0.01
OK, WRONG_CHECKSUM, INVALID_COMMAND, WRONG_TYPE, INVALID_VALUE = 100, 1, 2, 3, 4
SETTABLE = {4, 5, 6, 7, 12, 13, 130, 140, 149, 193, 194, 195, 204, 214}
READABLE = SETTABLE | {0, 1, 2, 3, 8, 9, 10, 11, 135, 138, 196, 197, 206, 207, 208, 209}


class Motor:
    """One motor and its ramp generator."""

    def __init__(self) -> None:
        self.mover = Mover(acceleration=51200.0, deceleration=51200.0)
        self.parameters = {4: 51200, 5: 51200, 6: 128, 7: 8, 140: 8, 194: 20000, 195: 2000, 193: 1}
        self.target = 0
        self.positioning = True
        self.searching = 0
        self.flags = 0
        self.search_speed = 0.0

    @property
    def reached(self) -> bool:
        """The flag of parameter 8: it stands on its target."""
        return self.positioning and not self.mover.busy and round(self.mover.position) == self.target

    def step(self, now_s: float, dt: float) -> None:
        """Go on; a search finds the left switch as the hard end that it runs into."""
        hit = self.mover.step(dt)
        if self.searching == 1 and (hit or self.mover.position <= self.mover.low):
            self.searching = 2  # back off by 1000 microsteps, then zero
            self.mover.go_to(self.mover.low + 1000, self.parameters[195], self.ramp, self.ramp)
        elif self.searching == 2 and not self.mover.busy:
            self.searching = 0
            shift = self.mover.position
            self.mover.low, self.mover.high = self.mover.low - shift, self.mover.high - shift
            self.mover.position, self.target, self.positioning = 0.0, 0, True

    @property
    def ramp(self) -> float:
        return float(self.parameters[5])


class Module:
    """The module; times in seconds of the given clock."""

    def __init__(
        self, address: int = 1, motors: int = 1, number_: int = 1140, firmware: int = 0x0128,
        heartbeat: bool = True, clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        self.address, self.host = address, 2
        self.number, self.firmware, self.has_heartbeat = number_, firmware, heartbeat
        self.motors = [Motor() for _ in range(motors)]
        self.globals = {65: 0, 66: address, 68: 0, 75: 0, 76: 2, 77: 0, 128: 0, 132: 0}
        self.stored: list[int] = []
        self._clock = clock
        self._heard_s = clock()
        self._bytes = b""
        self._byte_s = 0.0
        self._last_command = 0
        self.time = Stepper(
            self._step, lambda: not any(m.mover.busy or m.searching for m in self.motors), clock
        )

    def _step(self, now_s: float, dt: float) -> None:
        limit_ms = self.globals[68]
        silent = limit_ms and now_s - self._heard_s > limit_ms / 1000
        for motor in self.motors:
            if silent and (motor.mover.target is not None or motor.mover.top_speed):
                motor.searching = 0
                motor.positioning = False
                motor.mover.stop(motor.ramp)
            motor.step(now_s, dt)

    def connected(self) -> list[bytes]:
        """Say nothing."""
        return []

    def due(self) -> list[bytes]:
        """Let time pass."""
        self.time.catch_up()
        return []

    def take(self, data: bytes) -> list[bytes]:
        """Gather nine bytes; a gap between them begins anew."""
        now_s = self.time.catch_up()
        if now_s - self._byte_s > BYTE_TIMEOUT_S:
            self._bytes = b""
        self._byte_s = now_s
        self._bytes += data
        replies = []
        while len(self._bytes) >= 9:
            telegram, self._bytes = self._bytes[:9], self._bytes[9:]
            if telegram[0] == self.address:
                replies.append(self._answer(telegram))
        return replies

    def _answer(self, telegram: bytes) -> bytes:
        _, command, kind, axis, value = TELEGRAM.unpack(telegram[:8])
        if sum(telegram[:8]) % 256 != telegram[8]:
            return self._reply(WRONG_CHECKSUM, self._last_command, value)
        self._heard_s = self._clock()
        self._last_command = command
        if command == 136 and kind == 0:
            return (
                bytes((self.host,))
                + f"{self.number:04d}V{self.firmware >> 8}{self.firmware & 0xFF:02d}".encode()[:8]
            )
        status, result = self._obey(command, kind, axis, value)
        return self._reply(status, command, result if status == OK else value)

    def _reply(self, status: int, command: int, value: int) -> bytes:
        value = (value + 2**31) % 2**32 - 2**31
        head = TELEGRAM.pack(self.host, self.address, status, command, value)
        return head + bytes((sum(head) % 256,))

    def _obey(self, command: int, kind: int, axis: int, value: int) -> tuple[int, int]:
        if command == 136:
            return (OK, self.number << 16 | self.firmware) if kind == 1 else (WRONG_TYPE, value)
        if command in (9, 10):
            return self._global(command, kind, axis, value)
        if command not in (1, 2, 3, 4, 5, 6, 13):
            return INVALID_COMMAND, value
        if axis >= len(self.motors):
            return WRONG_TYPE, value
        motor = self.motors[axis]
        match command:
            case 1 | 2:
                motor.positioning, motor.searching = False, 0
                motor.mover.run(value if command == 1 else -value, motor.ramp, motor.ramp)
            case 3:
                motor.positioning, motor.searching = False, 0
                motor.mover.stop(motor.ramp)
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
        motor.target = value if kind == 0 else round(motor.mover.position) + value
        motor.positioning, motor.searching = True, 0
        motor.mover.go_to(motor.target, motor.parameters[4], motor.ramp, motor.ramp)
        return OK, motor.target

    def _set(self, motor: Motor, kind: int, value: int) -> tuple[int, int]:
        if kind in (0, 1):
            if kind == 1:
                motor.mover.position = float(value)
            else:
                return self._move(motor, 0, value)
            return OK, value
        if kind not in SETTABLE:
            return WRONG_TYPE, value
        if value < 0 or (kind in (6, 7) and value > 255) or (kind == 140 and value > 8):
            return INVALID_VALUE, value
        motor.parameters[kind] = value
        return OK, value

    def _get(self, motor: Motor, kind: int) -> tuple[int, int]:
        if kind not in READABLE:
            return WRONG_TYPE, 0
        mover = motor.mover
        live = {
            0: motor.target, 1: round(mover.position), 3: round(mover.velocity), 8: int(motor.reached),
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
        if bank != 0 or kind not in self.globals or (kind == 68 and not self.has_heartbeat):
            return WRONG_TYPE, value
        if command == 10:
            return OK, self.globals[kind]
        if value < 0:
            return INVALID_VALUE, value
        self.globals[kind] = value
        self.stored.append(kind)
        return OK, value

    def handlers(self) -> dict[str, Callable[..., object]]:
        """Return the commands on standard input."""

        def state(axis: str = "0") -> dict[str, float]:
            self.time.catch_up()
            motor = self.motors[int(axis)]
            return {
                "position": motor.mover.position, "velocity": motor.mover.velocity,
                "moving": int(motor.mover.busy), "heartbeat_ms": self.globals[68],
                "searching": motor.searching, "acceleration": motor.parameters[5],
            }  # fmt: skip

        def flags(value: str, axis: str = "0") -> None:
            self.motors[int(axis)].flags = int(number(value))
            if int(number(value)) & 0x1A:
                self.motors[int(axis)].mover.halt()

        def ends(low: str, high: str, axis: str = "0") -> None:
            mover = self.motors[int(axis)].mover
            mover.low, mover.high = number(low), number(high)

        return {"state": state, "flags": flags, "ends": ends, "store": lambda: self.stored}


async def main() -> None:
    """Serve until told to end."""
    parser = wire.parser("simulated TMCL module")
    parser.add_argument("--address", type=int, default=1)
    parser.add_argument("--motors", type=int, default=1)
    parser.add_argument("--module", type=int, default=1140)
    parser.add_argument("--no-heartbeat", action="store_true", help="a module without global parameter 68")
    options = parser.parse_args()
    module = Module(options.address, options.motors, options.module, heartbeat=not options.no_heartbeat)
    await wire.run(module, options, module.handlers())


if __name__ == "__main__":
    asyncio.run(main())
