"""An Oriental Motor AZ driver on a pty: ``python -m sioms.drivers.modbus.simulated.oriental_az --link PATH``.

Behaves as the manual's facts say: direct data operation from 0x0058 with its trigger, input command word 0x007C
(levels and edges), output word 0x007E in its default assignment, alarms with those that a reset does not clear, and the
RS-485 communication time-out that ends motion with alarm 0x85 when it is set (``--communication-timeout-s``, off as
delivered). What Modbus writes is in RAM; the absolute encoder keeps the place without supply, unless ``alarm 0x33``
says that it has lost it; switched on while the motor turns it goes into alarm 0x43. Commands on standard input: those
of the line (``power_cycle`` ...) and of drives (``state``, ``alarm``, ``shove`` ...).
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from pymodbus.constants import ExcCodes

from sioms.simulation.control import serve
from sioms.simulation.drive import Mover, Stepper, drive_handlers
from sioms.simulation.faults import Faults

from .lines import ILLEGAL_FUNCTION, RtuLine, serial_parser, simulated, unit_list

OPERATION_255 = 0x57C0
RANGES = (
    (OPERATION_255, 64),
    (0x0058, 18),
    (0x0078, 10),
    (0x00AC, 2),
    (0x00C6, 12),
    (0x00F8, 4),
    (0x0120, 4),
    (0x0180, 16),
)
STOP, FREE, ALARM_RESET, HOME, FORWARD, REVERSE = 1 << 5, 1 << 6, 1 << 7, 1 << 4, 1 << 14, 1 << 15
READY, ALARM, BUSY, MOVE, IN_POSITION = 1 << 5, 1 << 7, 1 << 8, 1 << 13, 1 << 14
LASTING = {0x20, 0x28, 0x2A, 0x33, 0x41, 0x42, 0x43, 0x44, 0x45, 0x53, 0x71, 0x72, 0xF0}
OPERATION_DATA, HARD_OVER_TRAVEL, COMMUNICATION_TIMEOUT = 0x70, 0x66, 0x85
PLACE_LOST, TURNS_AT_POWER_ON = 0x33, 0x43
DEFAULTS = dict.fromkeys(range(0x58, 0x6A, 2), 0) | {0x60: 1_000_000, 0x62: 1_000_000, 0x64: 1000}
# trigger value -> the pair whose writing starts the motion
TRIGGERS = {-7: 0x58, -6: 0x5A, -5: 0x5C, -4: 0x5E, -3: 0x60, -2: 0x62, -1: 0x64, 1: 0x66}


class Drive:
    """One driver; times in seconds of the given clock."""

    def __init__(self, clock: Callable[[], float] = time.monotonic, communication_timeout_s: float = 0.0) -> None:
        self.mover = Mover()
        # pair address -> 32-bit value
        self.pairs = dict(DEFAULTS)
        self.inputs = 0
        self.alarm = 0
        self.timeout_s = communication_timeout_s
        self.heard_s = 0.0  # the time-out is watched from the first message on
        self.time = Stepper(self._step, lambda: not self.mover.busy and not self.mover.shoved, clock)

    # -- supply ----------------------------------------------------------------------------------

    def power_off(self) -> None:
        """Let go of the motor."""
        self.time.catch_up()
        self.mover.halt()

    def power_on(self) -> None:
        """Boot: the inputs are off, the direct data as delivered, the place is the encoder's."""
        self.time.catch_up()
        self.heard_s = 0.0
        self.mover.halt()
        self.mover.count_from(self.mover.position + self.mover.slip)
        self.pairs, self.inputs = dict(DEFAULTS), 0
        self.alarm = self.alarm if self.alarm == PLACE_LOST else TURNS_AT_POWER_ON if self.mover.shoved else 0

    # -- motion ----------------------------------------------------------------------------------

    def _step(self, now_s: float, dt: float) -> None:
        self._look_at_silence(now_s)
        if self.mover.step(dt):
            self._fail(HARD_OVER_TRAVEL)

    def _look_at_silence(self, now_s: float) -> None:
        """Go into alarm, at rest too, when no message came for the communication time-out."""
        if self.timeout_s and self.heard_s and not self.alarm and now_s - self.heard_s > self.timeout_s:
            self._fail(COMMUNICATION_TIMEOUT)

    def _hear(self) -> None:
        now_s = self.time.catch_up()
        self._look_at_silence(now_s)
        self.heard_s = now_s

    def _fail(self, code: int) -> None:
        self.alarm = code
        self.mover.stop()

    def raise_alarm(self, code: int) -> None:
        """Go into alarm; the motion ends with the present deceleration."""
        self.time.catch_up()
        self._fail(code)
        if code == PLACE_LOST:
            self.mover.count_from(0.0)

    def foreign(self, kind: str, value: float) -> None:
        """Run at a velocity [Hz], which is reached already, or go to a position [steps], by direct data operation."""
        self.time.catch_up()
        kinds = {"velocity": (16, 0, value), "position": (1, value, 1000.0)}
        if kind not in kinds:
            raise ValueError(f"kind {kind}: want velocity or position")
        what, position, speed = kinds[kind]
        pairs = [0, what, round(position), round(speed), 100_000, 100_000, 1000, 1]
        words = [word for pair in pairs for word in (pair >> 16 & 0xFFFF, pair & 0xFFFF)]
        self.write(16, 0x58, words)
        if kind == "velocity":
            self.mover.velocity = self.mover.top_speed

    def shove(self, velocity: float) -> None:
        """Turn by itself [steps/s]."""
        self.time.catch_up()
        self.mover.shoved = velocity

    def _signed(self, pair: int) -> int:
        value = self.pairs[pair]
        return value - (1 << 32) if value & 0x8000_0000 else value

    def _may_move(self) -> bool:
        return self.alarm == 0 and not self.inputs & (STOP | FREE)

    def operate(self) -> None:
        """Start the motion in the direct data area."""
        if not self._may_move():
            return
        kind, position, speed = self._signed(0x5A), self._signed(0x5C), self._signed(0x5E)
        up, down = (max(1, self._signed(pair)) for pair in (0x60, 0x62))
        mover = self.mover
        match kind:
            case 1 | 2 | 3 if speed > 0:
                start = {
                    1: 0.0,
                    2: mover.position if mover.target is None else mover.target,
                    3: mover.feedback,
                }[kind]
                mover.go_to(start + position, speed, up, down)
            case 7 | 16:
                mover.run(speed, up, down)
            case _:
                self._fail(OPERATION_DATA)

    def _take_inputs(self, word: int) -> None:
        rising = word & ~self.inputs
        self.inputs = word
        mover = self.mover
        if word & FREE:
            mover.halt()
        if word & STOP:
            mover.stop()
        if rising & ALARM_RESET:
            self._reset()
        if rising & HOME and self._may_move():
            mover.go_to(0.0, 2000, 1_000_000, 1_000_000)
        for bit, sign in ((FORWARD, 1), (REVERSE, -1)):
            if rising & bit and self._may_move():
                mover.run(sign * abs(self._signed(0x5E)), self._signed(0x60), self._signed(0x62))

    def _reset(self) -> None:
        if self.alarm not in LASTING and not self.mover.busy:
            self.alarm = 0

    # -- registers -------------------------------------------------------------------------------

    def outputs(self) -> int:
        """Return the output word."""
        word = ALARM if self.alarm else 0
        if self.mover.busy:
            return word | MOVE
        in_position = 0 if self.inputs & FREE else IN_POSITION
        return word | in_position | (READY if self._may_move() else 0)

    def read(self, function: int, address: int, count: int) -> list[int] | ExcCodes:
        """Return holding registers."""
        if function != 3:
            return ILLEGAL_FUNCTION
        self._hear()
        mover = self.mover
        live = {
            0x7C: self.inputs,
            0x7E: self.outputs(),
            0x80: self.alarm,
            0xC6: round(mover.position),
            0xCC: mover.feedback,
            0xCE: round(mover.turns * 60 / 1000),
            0xD0: round(mover.turns),
            0xF8: 352,
            0xFA: 401,
            0x120: mover.feedback,
            0x122: round(mover.position),
        }
        values = self.pairs | live
        words = []
        for at in range(address, address + count):
            value = values.get(at & ~1, 0)
            words.append(value & 0xFFFF if at & 1 else value >> 16 & 0xFFFF)
        return words

    def write(self, function: int, address: int, values: list[int]) -> ExcCodes | None:
        """Take holding registers; a pair, or its low word alone."""
        if function not in (6, 16):
            return ILLEGAL_FUNCTION
        self._hear()
        written = set()
        for at, value in enumerate(values, address):
            pair = at & ~1
            old = self.inputs if pair == 0x7C else self.pairs.get(pair, 0)
            self.pairs[pair] = old & 0xFFFF_0000 | value if at & 1 else old & 0xFFFF | value << 16
            written.add(pair)
        for pair in sorted(written):
            self._act(pair)
        if TRIGGERS.get(self._signed(0x66)) in written:
            self.operate()
            if self.pairs[0x66] == 1:
                self.pairs[0x66] = 0
        return None

    def _act(self, pair: int) -> None:
        value = self.pairs[pair]
        match pair:
            case 0x7C:
                self._take_inputs(value & 0xFFFF)
            case 0x78:
                self._take_inputs(self.inputs | value & 0xFFFF)
                self._take_inputs(self.inputs & ~value)
            case 0x180 if value == 1:
                self._reset()
            case 0x18A if value == 1 and not self.mover.busy:
                self.mover.count_from(0.0)
                if self.alarm == PLACE_LOST:
                    self.alarm = 0

    def state(self) -> dict[str, float]:
        """Return what a bystander sees."""
        self._look_at_silence(self.time.catch_up())
        return {
            **self.mover.seen(), "alarm": self.alarm, "word": self.outputs(), "armed": int(self.timeout_s > 0),
        }  # fmt: skip


async def run() -> None:
    """Serve until told to end."""
    parser = serial_parser("simulated Oriental Motor AZ driver")
    parser.add_argument("--communication-timeout-s", type=float, default=0.0)
    options = parser.parse_args()
    drives = {unit: Drive(communication_timeout_s=options.communication_timeout_s) for unit in unit_list(options.units)}
    devices = [simulated(unit, drive, RANGES) for unit, drive in drives.items()]
    line = RtuLine(devices, options.link, Faults(), baud=options.baud, bits=11, powered=drives.values())
    await line.start()
    handlers = {**line.handlers(), **drive_handlers(drives)}
    await serve(str(options.link or line.port.name), handlers, line.close)


if __name__ == "__main__":
    asyncio.run(run())
