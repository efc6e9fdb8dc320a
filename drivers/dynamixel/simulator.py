"""Dynamixel X servos on a pty: ``python -m sioms.drivers.dynamixel.simulator --link PATH --ids 1,2``.

Behaves as ROBOTIS' e-Manual says of the XM430-W350, and where that is silent in the way that is worst for a master
(README.md names page and commit of each): control table with an EEPROM that is locked while the torque is on,
goals that outlive the torque and are taken up when it is switched on, a mode change that clears the profile and sets
the goal current to its limit, a bus watchdog that makes the goals read-only, a count of turns that a restart forgets,
shutdown that only
a reboot clears. The receiver is that of Dynamixel2Arduino (``dxl_c/protocol.cpp``): no time-out, silence on a wrong
    CRC.

Commands on standard input, beside those of the line: ``state [ID]``, ``hardware BITS [ID]`` (error 70), ``put ADDRESS
VALUE SIZE [ID]``, ``power_cycle [SECONDS]``, ``refuse COUNT``, ``freeze [COUNT]``, ``foreign
velocity|position|torque|mode VALUE [ID]`` (steps/s, steps, 0 or 1, number), ``shove STEPS_PER_S [ID]``.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable

from sioms.simulation import wire
from sioms.simulation.control import number
from sioms.simulation.drive import Mover, Stepper
from sioms.simulation.faults import FOREVER

HEADER = b"\xff\xff\xfd\x00"
STEPS, RPM, RPM2, REBOOT_S = 4096, 0.229, 214.577, 0.3
EEPROM_END = 64
SIZES = {
    **dict.fromkeys((7, 8, 9, 10, 11, 12, 13, 31, 60, 63, 64, 65, 68, 98), 1),
    **dict.fromkeys((32, 34, 36, 38, 76, 78, 80, 82, 84, 88, 90, 100, 102), 2),
    **dict.fromkeys((20, 24, 40, 44, 48, 52, 104, 108, 112, 116), 4),
}
"""Registers that can be written, and their bytes."""
RESULT, INSTRUCTION, RANGE, LENGTH, LIMIT, ACCESS = 1, 2, 4, 5, 6, 7
COAST = 12_000.0
"""What friction takes from a servo without torque [steps/s^2]."""
GOALS = {100, 102, 104, 116}
CAPACITY = 192
"""Bytes of parameters that the receiver holds."""


def crc(data: bytes) -> int:
    """Return CRC-16 with polynomial 0x8005, bit by bit."""
    value = 0
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = (value << 1 ^ (0x8005 if value & 0x8000 else 0)) & 0xFFFF
    return value


class Servo:
    """One servo; times in seconds of the given clock, positions in steps. The mover knows the turns, the register may
    not.
    """

    def __init__(self, id_: int, model: int, clock: Callable[[], float]) -> None:
        self.id, self.model, self._clock = id_, model, clock
        self.table = bytearray(147)
        for address, value, size in (
            (0, model, 2), (6, 45, 1), (7, id_, 1), (8, 1, 1), (9, 250, 1), (11, 3, 1), (36, 885, 2), (38, 1193, 2),
            (44, 400, 4), (48, 4095, 4), (63, 52, 1),
        ):  # fmt: skip
            self.put(address, value, size)
        self.mover = Mover(position=2048.0)
        self.shoved = 0.0
        self.start(clock())

    def start(self, at_s: float) -> None:
        """Be as after power-up at a time, deaf until then: no torque, all RAM as from the factory, the place within one
        turn.
        """
        self.table[EEPROM_END:] = bytes(len(self.table) - EEPROM_END)
        self.current_ma = 0.0
        self.heard_s = self.back_s = at_s
        self.forget_turns()
        for address, value, size in (
            (68, 2, 1),
            (100, self.get(36, 2), 2),
            (102, self.get(38, 2), 2),
            (116, self.place, 4),
            (144, 120, 2),
            (146, 30, 1),
        ):
            self.put(address, value, size)
        self.mover.stop(COAST)

    def forget_turns(self) -> None:
        """Count the place within one turn."""
        self.turns = math.floor(self.mover.position / STEPS)

    @property
    def place(self) -> int:
        """The present position as it reads."""
        return round(self.mover.position - self.turns * STEPS)

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
            self.put(108, 0, 4)
            self.put(112, 0, 4)
            self.current_ma = 0.0
            self.mover.stop(self.rate)
        if self.shoved:
            self.mover.run(self.shoved, 1e9, 1e9)
        if self.get(11, 1) == 0 and not self.shoved:  # current: a rotor with friction
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
        self.table[123] = int(rests and self.place == goal) | (0 if rests else 2)
        self.put(120, round((self._clock() - self.back_s) * 1000) % 32768, 2)
        self.put(126, round(self.current_ma / 2.69), 2)
        self.put(128, round(mover.velocity / STEPS * 60 / RPM), 4)
        self.put(132, self.place, 4)

    def write(self, address: int, data: bytes) -> int:
        """Take registers one after the other, as far as they are right; return the error."""
        while data:
            size = SIZES.get(address)
            if size is None or len(data) < size:
                return ACCESS if address + len(data) <= len(self.table) else RANGE
            error = self._refusal(address, data[:size])
            if error:
                return error
            before = self.get(address, size)
            self.table[address : address + size] = data[:size]
            self._effect(address, int.from_bytes(data[:size], "little", signed=True), before)
            address, data = address + size, data[size:]
        return 0

    def _refusal(self, address: int, data: bytes) -> int:
        value = int.from_bytes(data, "little", signed=True)
        if address < EEPROM_END and self.table[64]:
            return ACCESS
        if address in GOALS and self.table[98] == 0xFF:
            return RANGE
        if address == 11 and value not in (0, 1, 3, 4, 5, 16):
            return RANGE
        if address == 116 and not self._reaches(value):
            return LIMIT
        if address == 104 and abs(value) > self.get(44, 4):
            return LIMIT
        if address == 102 and abs(value) > self.get(38, 2):
            return LIMIT
        if address == 98 and data[0] > 127:
            return RANGE
        return ACCESS if address == 64 and data[0] and self.table[70] else 0

    def _reaches(self, goal: int) -> bool:
        if self.get(11, 1) == 3:
            return self.get(52, 4) <= goal <= self.get(48, 4)
        return abs(goal) <= 1_048_575

    def _effect(self, address: int, value: int, before: int) -> None:
        mover, mode = self.mover, self.get(11, 1)
        if address == 64 and not value:
            mover.stop(COAST)
            self.current_ma = 0.0
        if address == 11 and value != before:
            for register, start, size in (
                (108, 0, 4), (112, 0, 4), (100, self.get(36, 2), 2), (102, self.get(38, 2), 2),
            ):  # fmt: skip
                self.put(register, start, size)
        if (address == 11 and value != before and mode in (3, 4)) or (address == 64 and value and mode == 3):
            self.forget_turns()
        if not self.table[64]:
            return
        if address in (64, 116) and mode in (3, 4):  # switched on it takes up the goal that it has
            speed = (self.get(112, 4) or 400) * RPM / 60 * STEPS
            goal = self.get(116, 4, signed=True) + self.turns * STEPS
            mover.go_to(float(goal), speed, self.rate, self.rate)
        elif address in (64, 104) and mode == 1:
            mover.run(self.get(104, 4, signed=True) * RPM / 60 * STEPS, self.rate, self.rate)
        elif address in (64, 102) and mode == 0:
            self.current_ma = self.get(102, 2, signed=True) * 2.69

    def shut_down(self, bits: int) -> None:
        """Go into a hardware error: torque off until it is restarted."""
        self.table[70] = bits
        self.table[64] = 0
        self.mover.stop(COAST)

    def foreign(self, kind: str, value: float) -> None:
        """Do what another master does."""
        if kind == "torque":
            self.write(64, bytes((int(bool(value)),)))
            return
        modes = {"velocity": 1, "position": 4, "mode": int(value)}
        if kind not in modes:
            raise ValueError(f"{kind}; want velocity, position, torque or mode")
        if self.get(11, 1) != modes[kind]:
            self.write(64, b"\0")
            self.write(11, bytes((modes[kind],)))
        if kind == "mode":
            return
        self.table[98] = 0
        goal, count = (104, value / STEPS * 60 / RPM) if kind == "velocity" else (116, value)
        self.write(goal, round(count).to_bytes(4, "little", signed=True))
        self.write(64, b"\1")


class Receiver:
    """The vendor's receiver of one port: byte by byte, without a time-out; what does not fit or has a wrong CRC is
    dropped.
    """

    def __init__(self) -> None:
        self._bytes = b""

    def take(self, data: bytes) -> list[tuple[int, int, bytes]]:
        """Return the good packets in what has come: ID, instruction, parameters."""
        packets = []
        for each in data:
            self._bytes += bytes((each,))
            found = self._look()
            if found is not None:
                packets.append(found)
        return packets

    def _look(self) -> tuple[int, int, bytes] | None:
        held = self._bytes
        if len(held) <= 3:
            if len(held) == 3 and held != HEADER[:3]:
                self._bytes = held[1:]
            return None
        if len(held) < 7 and not (held[3] == 0xFD or (len(held) > 4 and held[4] in (0xFD, 0xFF))):
            return None
        if len(held) < 7:
            self._bytes = b""
            return None
        length = int.from_bytes(held[5:7], "little")
        if length < 3 or len(held) > CAPACITY + 9:
            self._bytes = b""
            return None
        if len(held) < 7 + length:
            return None
        self._bytes = b""
        if crc(held[:-2]) != int.from_bytes(held[-2:], "little"):
            return None
        content = held[7:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
        return held[4], content[0], content[1:]


class Bus:
    """The servos on their line."""

    def __init__(self, ids: list[int], model: int = 1020, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self.servos = {id_: Servo(id_, model, clock) for id_ in ids}
        self._receiver = Receiver()
        self._refuse = self._freeze = 0
        self._frozen: dict[int, bytes] = {}
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
        if all(self._clock() < servo.back_s for servo in self.servos.values()):
            return []
        replies: list[bytes] = []
        for id_, op, rest in self._receiver.take(data):
            if op != 0x55:
                replies += self._obey(id_, op, rest)
        return replies

    def power_cycle(self, duration_s: float) -> None:
        """Take the supply of all away for a time."""
        now_s = self.time.catch_up()
        self._receiver = Receiver()
        for servo in self.servos.values():
            servo.start(now_s + duration_s)

    def _obey(self, id_: int, op: int, rest: bytes) -> list[bytes]:
        awake = {id_: s for id_, s in self.servos.items() if self._clock() >= s.back_s}
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
                return self._read(servo, int.from_bytes(rest[:2], "little"), int.from_bytes(rest[2:], "little"))
            case 0x03 | 0x08 if self._refuse:
                self._refuse -= 1
                return self._answer(servo, RESULT)
            case 0x03 if len(rest) > 2:
                return self._answer(servo, servo.write(int.from_bytes(rest[:2], "little"), rest[2:]))
            case 0x08:
                reply = self._answer(servo, 0)
                servo.start(self._clock() + REBOOT_S)
                return reply
            case 0x02 | 0x03:
                return self._answer(servo, LENGTH)
        return self._answer(servo, INSTRUCTION)

    def _answer(self, servo: Servo, error: int) -> bytes:
        """Return the status of what is neither ping nor read: at a low return level none."""
        return self._status(servo, error) if servo.table[68] == 2 else b""

    def _read(self, servo: Servo, address: int, size: int) -> bytes:
        if address + size > len(servo.table):
            return self._status(servo, RANGE)
        if servo.table[68] == 0:
            return b""
        servo.refresh()
        table = bytes(servo.table)
        if self._freeze:
            self._freeze -= 1
            table = self._frozen.setdefault(servo.id, table)
        return self._status(servo, 0, table[address : address + size])

    def _status(self, servo: Servo, error: int, data: bytes = b"") -> bytes:
        error |= 0x80 if servo.table[70] else 0
        content = (bytes((0x55, error)) + data).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
        body = HEADER + bytes((servo.id,)) + (len(content) + 2).to_bytes(2, "little") + content
        return body + crc(body).to_bytes(2, "little")

    def handlers(self) -> dict[str, Callable[..., object]]:
        """Return the commands on standard input."""
        first = str(next(iter(self.servos)))

        def state(id_: str = "") -> dict[str, float]:
            self.time.catch_up()
            servo = self.servos[int(id_ or first)]
            speeds = [each.mover.velocity for each in ([servo] if id_ else self.servos.values())]
            return {
                "position": servo.mover.position, "velocity": max(speeds, key=abs), "torque": servo.table[64],
                "mode": servo.table[11], "watchdog": servo.table[98], "turns": servo.mover.position / STEPS,
                "radians": servo.mover.position / STEPS * 2 * math.pi, "place": servo.place,
                "armed": int(1 <= servo.table[98] <= 127),
            }  # fmt: skip

        def hardware(bits: str, id_: str = first) -> None:
            self.servos[int(id_)].shut_down(int(number(bits)))

        def put(address: str, value: str, size: str, id_: str = first) -> None:
            self.servos[int(id_)].put(int(address), int(number(value)), int(size))

        def power_cycle(seconds: str = "0.2") -> None:
            self.power_cycle(number(seconds))

        def refuse(count: str) -> None:
            self._refuse = int(count)

        def freeze(count: str = "") -> None:
            self._freeze, self._frozen = int(count) if count else FOREVER, {}

        def foreign(kind: str, value: str, id_: str = first) -> None:
            self.time.catch_up()
            self.servos[int(id_)].foreign(kind, number(value))

        def shove(velocity: str, id_: str = first) -> None:
            self.time.catch_up()
            servo = self.servos[int(id_)]
            servo.shoved = number(velocity)
            if not servo.shoved:
                servo.mover.halt()

        return {
            "state": state, "hardware": hardware, "put": put, "power_cycle": power_cycle, "refuse": refuse,
            "freeze": freeze, "foreign": foreign, "shove": shove,
        }  # fmt: skip


async def main() -> None:
    """Serve until told to end."""
    parser = wire.parser("simulated Dynamixel X servos")
    parser.add_argument("--ids", default="1")
    parser.add_argument("--model", type=int, default=1020)
    options = parser.parse_args()
    bus = Bus([int(part) for part in options.ids.split(",")], options.model)
    await wire.run(bus, options, bus.handlers(), wire.QUIET_S)


if __name__ == "__main__":
    asyncio.run(main())
