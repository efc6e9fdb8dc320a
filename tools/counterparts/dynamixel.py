"""Dynamixel X servos on a pty: ``python -m sioms.tools.counterparts.dynamixel --link PATH --ids 1,2``.

Behaves as ROBOTIS' e-Manual says of the XM430-W350: control table with an EEPROM that is locked while the torque is on,
position, velocity and current modes with profiles, bus watchdog, shutdown that only a reboot clears, silence on a wrong CRC. Commands
on standard input, beside those of the line: ``state [ID]``, ``hardware BITS [ID]`` (error 70), ``put ADDRESS VALUE SIZE [ID]``.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable

from . import wire
from .control import number
from .drive import Mover, Stepper

HEADER = b"\xff\xff\xfd\x00"
STEPS, RPM, RPM2, REBOOT_S = 4096, 0.229, 214.577, 0.3
EEPROM_END = 64
READ_ONLY = {*range(0, 7), 70, *range(120, 147)} - {68}
RESULT, INSTRUCTION, RANGE, LENGTH, ACCESS = 1, 2, 4, 5, 7
COAST = 12_000.0
"""What friction takes from a servo without torque [steps/s^2]."""
GOALS = {100, 102, 104, 108, 112, 116}


def crc(data: bytes) -> int:
    """Return CRC-16 with polynomial 0x8005, bit by bit."""
    value = 0
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ (0x8005 if value & 0x8000 else 0)) & 0xFFFF
    return value


class Servo:
    """One servo; times in seconds of the given clock, positions in steps."""

    def __init__(self, id_: int, model: int, clock: Callable[[], float]) -> None:
        self.id, self.model, self._clock = id_, model, clock
        self.table = bytearray(147)
        for address, value, size in (
            (0, model, 2), (6, 45, 1), (7, id_, 1), (8, 1, 1), (9, 250, 1), (11, 3, 1), (36, 885, 2), (38, 1193, 2),
            (44, 400, 4), (48, 4095, 4), (63, 52, 1), (68, 2, 1), (116, 2048, 4), (144, 120, 2), (146, 30, 1),
        ):  # fmt: skip
            self.put(address, value, size)
        self.mover = Mover(position=2048.0)
        self.current_ma = 0.0
        self.heard_s = self.back_s = clock()

    def get(self, address: int, size: int, signed: bool = False) -> int:
        """Return a register."""
        return int.from_bytes(self.table[address : address + size], "little", signed=signed)

    def put(self, address: int, value: int, size: int) -> None:
        """Set a register."""
        self.table[address : address + size] = (value & (1 << 8 * size) - 1).to_bytes(size, "little")

    @property
    def rate(self) -> float:
        """Acceleration in steps/s^2; 0 in the profile is without limit."""
        return (self.get(108, 4) or 4000) * RPM2 / 3600 * STEPS

    def step(self, now_s: float, dt: float) -> None:
        """Go on by dt."""
        ticks = self.get(98, 1)
        if 1 <= ticks <= 127 and self.table[64] and now_s - self.heard_s > 0.02 * ticks:
            self.table[98] = 0xFF
            self.current_ma = 0.0
            self.mover.stop(self.rate)
        if self.get(11, 1) == 0:  # current: a rotor with friction
            force = self.current_ma * 40 - self.mover.velocity * 3
            self.mover.velocity += force * dt
            self.mover.position += self.mover.velocity * dt
            if abs(self.mover.velocity) < 1 and not self.current_ma:
                self.mover.velocity = 0.0
        else:
            self.mover.step(dt)

    def refresh(self) -> None:
        """Bring the present values up to date."""
        mover = self.mover
        rests = mover.target is None and mover.velocity == 0
        goal = self.get(116, 4, signed=True)
        self.table[122] = int(abs(mover.velocity) > 20)
        self.table[123] = int(rests and round(mover.position) == goal) | (0 if rests else 2)
        self.put(126, round(self.current_ma / 2.69), 2)
        self.put(128, round(mover.velocity / STEPS * 60 / RPM), 4)
        self.put(132, round(mover.position), 4)

    def write(self, address: int, data: bytes) -> int:
        """Take registers; return the error."""
        if address + len(data) > len(self.table):
            return RANGE
        if address in READ_ONLY or (address < EEPROM_END and self.table[64]):
            return ACCESS
        if address in GOALS and self.table[98] == 0xFF:
            return RANGE
        value = int.from_bytes(data, "little", signed=True)
        if address == 11 and value not in (0, 1, 3, 4, 5, 16):
            return RANGE
        if address == 116 and self.get(11, 1) == 3 and not 0 <= value <= 4095:
            return RANGE
        if address == 98 and data[0] > 127:
            return RANGE
        if address == 64 and data[0] and self.table[70]:
            return ACCESS
        self.table[address : address + len(data)] = data
        self._effect(address, value)
        return 0

    def _effect(self, address: int, value: int) -> None:
        mover = self.mover
        if address == 64 and not value:
            mover.stop(COAST)
            self.current_ma = 0.0
        if not self.table[64]:
            return
        mode = self.get(11, 1)
        if address in (64, 116) and mode in (3, 4):  # switched on it takes up the goal that it has
            speed = (self.get(112, 4) or 400) * RPM / 60 * STEPS
            mover.go_to(float(self.get(116, 4, signed=True)), speed, self.rate, self.rate)
        elif address == 104 and mode == 1:
            mover.run(value * RPM / 60 * STEPS, self.rate, self.rate)
        elif address == 102 and mode == 0:
            self.current_ma = max(-1193, min(1193, value)) * 2.69

    def shut_down(self, bits: int) -> None:
        """Go into a hardware error: torque off until it is restarted."""
        self.table[70] = bits
        self.table[64] = 0
        self.mover.stop(COAST)

    def reboot(self) -> None:
        """Restart: RAM as after power-up, deaf meanwhile."""
        self.table[64:] = bytes(len(self.table) - 64)
        self.put(68, 2, 1)
        self.put(116, round(self.mover.position), 4)
        self.mover.halt()
        self.current_ma = 0.0
        self.back_s = self._clock() + REBOOT_S


class Bus:
    """The servos on their line."""

    def __init__(
        self, ids: list[int], model: int = 1020, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._clock = clock
        self.servos = {id_: Servo(id_, model, clock) for id_ in ids}
        self._bytes = b""
        self.time = Stepper(self._step, lambda: False, clock)

    def _step(self, now_s: float, dt: float) -> None:
        for servo in self.servos.values():
            servo.step(now_s, dt)

    def connected(self) -> list[bytes]:
        """Say nothing."""
        return []

    def due(self) -> list[bytes]:
        """Let time pass."""
        self.time.catch_up()
        return []

    def take(self, data: bytes) -> list[bytes]:
        """Take bytes, cut anywhere; answer good packets."""
        self.time.catch_up()
        self._bytes += data
        replies: list[bytes] = []
        while (start := self._bytes.find(HEADER)) >= 0:
            self._bytes = self._bytes[start:]
            if len(self._bytes) < 7:
                return replies
            size = 7 + int.from_bytes(self._bytes[5:7], "little")
            if size > 600:
                self._bytes = self._bytes[4:]
                continue
            if len(self._bytes) < size:
                return replies
            whole, self._bytes = self._bytes[:size], self._bytes[size:]
            if size >= 10 and crc(whole[:-2]) == int.from_bytes(whole[-2:], "little"):
                replies += self._obey(whole[4], whole[7:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"))
        self._bytes = self._bytes[-3:]
        return replies

    def _obey(self, id_: int, content: bytes) -> list[bytes]:
        op, rest = content[0], content[1:]
        awake = {k: s for k, s in self.servos.items() if self._clock() >= s.back_s}
        for servo in awake.values():
            servo.heard_s = self._clock()
        if op == 0x82:
            address, size = int.from_bytes(rest[:2], "little"), int.from_bytes(rest[2:4], "little")
            return [self._read(awake[each], address, size) for each in rest[4:] if each in awake]
        if op == 0x83:
            address, size = int.from_bytes(rest[:2], "little"), int.from_bytes(rest[2:4], "little")
            for at in range(4, len(rest), size + 1):
                if rest[at] in awake:
                    awake[rest[at]].write(address, rest[at + 1 : at + 1 + size])
            return []
        chosen = awake.values() if id_ == 0xFE else [awake[id_]] if id_ in awake else []
        replies = [self._single(servo, op, rest) for servo in chosen]
        return [reply for reply in replies if reply and (id_ != 0xFE or op == 1)]

    def _single(self, servo: Servo, op: int, rest: bytes) -> bytes:
        match op:
            case 0x01:
                return self._status(servo, 0, servo.model.to_bytes(2, "little") + servo.table[6:7])
            case 0x02 if len(rest) == 4:
                return self._read(
                    servo, int.from_bytes(rest[:2], "little"), int.from_bytes(rest[2:], "little")
                )
            case 0x03 if len(rest) > 2:
                error = servo.write(int.from_bytes(rest[:2], "little"), rest[2:])
                return self._status(servo, error) if servo.table[68] == 2 else b""
            case 0x08:
                reply = self._status(servo, 0)
                servo.reboot()
                return reply
            case 0x02 | 0x03:
                return self._status(servo, LENGTH)
        return self._status(servo, INSTRUCTION)

    def _read(self, servo: Servo, address: int, size: int) -> bytes:
        if address + size > len(servo.table):
            return self._status(servo, RANGE)
        servo.refresh()
        return self._status(servo, 0, bytes(servo.table[address : address + size]))

    def _status(self, servo: Servo, error: int, data: bytes = b"") -> bytes:
        error |= 0x80 if servo.table[70] else 0
        content = (bytes((0x55, error)) + data).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
        body = HEADER + bytes((servo.id,)) + (len(content) + 2).to_bytes(2, "little") + content
        return body + crc(body).to_bytes(2, "little")

    def handlers(self) -> dict[str, Callable[..., object]]:
        """Return the commands on standard input."""
        first = str(next(iter(self.servos)))

        def state(id_: str = first) -> dict[str, float]:
            self.time.catch_up()
            servo = self.servos[int(id_)]
            return {
                "position": servo.mover.position, "velocity": servo.mover.velocity, "torque": servo.table[64],
                "mode": servo.table[11], "watchdog": servo.table[98], "turns": servo.mover.position / STEPS,
                "radians": servo.mover.position / STEPS * 2 * math.pi,
            }  # fmt: skip

        def hardware(bits: str, id_: str = first) -> None:
            self.servos[int(id_)].shut_down(int(number(bits)))

        def put(address: str, value: str, size: str, id_: str = first) -> None:
            self.servos[int(id_)].put(int(address), int(number(value)), int(size))

        return {"state": state, "hardware": hardware, "put": put}


async def main() -> None:
    """Serve until told to end."""
    parser = wire.parser("simulated Dynamixel X servos")
    parser.add_argument("--ids", default="1")
    parser.add_argument("--model", type=int, default=1020)
    options = parser.parse_args()
    bus = Bus([int(part) for part in options.ids.split(",")], options.model)
    await wire.run(bus, options, bus.handlers())


if __name__ == "__main__":
    asyncio.run(main())
