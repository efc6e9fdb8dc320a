"""A Grbl controller on a pty or TCP port: ``python -m sioms.drivers.grbl.simulator --link PATH``.

Behaves as the sources of Grbl 1.1h say (gnea/grbl, v1.1h.20190825, 40eb439b;
``grbl/{main,protocol,serial,system,motion_control}.c``): one ``ok`` or ``error:N`` a line, real-time bytes, a planner
that looks ahead over 15 blocks and lets a line wait for its ``ok`` when it is full (a jog cancel empties it, and the
line that waited goes out after it), holds, alarms with half a second in which nothing is heard, of which 1 and 2 leave
it deaf until a reset after that, homing (``simulated.homing``), whose end answers all ``?`` of its time with one
``<Home``, a position that is wrong after a reset in motion and 0 after the supply was off. Commands on standard input,
beside those of the line: ``state``, ``alarm N`` (motion ends, position lost), ``door``, ``program DISTANCE FEED``
(somebody else's move in X), ``power_cycle [SECONDS]``, ``refuse COUNT``, ``freeze [COUNT]``, ``foreign KIND VALUE``
(velocity: a jog in X; position; mode: a G word), ``reference [off]`` (the switches are 5 mm away, or nowhere).
"""

from __future__ import annotations

import asyncio
import math
import re
import time
from collections import deque
from collections.abc import Callable

from sioms.simulation import wire
from sioms.simulation.drive import Stepper

from .simulated.gcode import Parser
from .simulated.homing import Homing
from .simulated.planner import BLOCKS, Planner

RX_BYTES = 128
LINE_BYTES = 80
CRITICAL = (1, 2)
"""Alarms that wait for a reset: nothing else is heard meanwhile, not even ``?``."""
RESETTING = (3, 6, 7, 8, 9)
"""Alarms that end with a reset of its own."""
ALARM_S = 0.5
"""How long it hears nothing once it has told an alarm (``report_alarm_message``)."""
FACTORY = {10: 1, 110: 500, 120: 10}
"""Mask of the reports, speeds [mm/min] and accelerations [mm/s^2] of ``defaults.h``, DEFAULTS_GENERIC."""
FOREVER = 1 << 30
NEAR_MM = 5.0
REALTIME = set(b"?!~\x18\x84\x85") | set(range(0x90, 0xA2))


class Controller:
    """The controller; times in seconds of the given clock, lengths in mm."""

    def __init__(
        self,
        axes: int = 3,
        hal: bool = False,
        homing: bool = True,
        factory: bool = False,
        locked: bool | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.letters = "XYZABCUVW"[:axes]
        self.hal = hal
        self.settings: dict[int, float] = {
            0: 10,
            1: 25,
            2: 0,
            3: 0,
            4: 0,
            5: 0,
            6: 0,
            10: 3,
            11: 0.01,
            12: 0.002,
            13: 0,
            20: 0,
            21: 0,
            22: int(homing),
            23: 0,
            24: 100,
            25: 1500,
            26: 25,
            27: 1,
            30: 1000,
            31: 0,
            32: 0,
        }
        for i in range(axes):
            self.settings |= {100 + i: 250, 110 + i: 6000, 120 + i: 500, 130 + i: 200}
        if factory:
            for key, value in FACTORY.items():
                self.settings |= {key + i: value for i in range(axes if key > 100 else 1)}
        self.planner = Planner(axes, self.settings, self._admit)
        self.homing = Homing(self.planner, self.settings)
        self._locked = homing if locked is None else locked
        self.state = "Alarm" if self._locked else "Idle"
        self.parser = Parser(self.letters)
        self.reports = 0
        self._line = bytearray()
        self._lines: deque[str] = deque()
        self._pending: list[bytes] = []
        self._clock = clock
        self._off_until_s = self._mute_until_s = 0.0
        self._deaf = self._asked = False
        self._then: Callable[[], None] = self._greet
        self._refusals = self._frozen = 0
        self._image = ""
        self.time = Stepper(self._step, lambda: not self.planner.blocks and not self.homing.is_on, clock)

    # -- motion ----------------------------------------------------------------------------------

    def _step(self, now_s: float, dt: float) -> None:
        if self.homing.is_on:
            alarm = self.homing.step(dt)
            if alarm is not None:
                self._end_homing(alarm)
        elif self.state not in ("Alarm", "Sleep") and self.planner.step(dt) and self.state in ("Run", "Jog"):
            self.state = "Idle"

    def _end_homing(self, alarm: int) -> None:
        if alarm:
            self.crash(alarm)
            return
        if self._asked:  # answered once, before the state changes
            self._say(self.report())
        self.state, self._asked = "Idle", False
        self._say("ok")
        self._admit()

    def crash(self, number: int) -> None:
        """End all motion at once, in alarm; nothing is heard for a time, and some alarms reset it then."""
        self.planner.end_at_once()
        self._lines.clear()
        self.homing.end()
        self.state, self._asked = "Alarm", False
        self._say(f"ALARM:{number}")
        if number in CRITICAL:
            self._hush(lambda: self._say("[MSG:Reset to continue]"))
            self._deaf = True
        elif number in RESETTING:
            self._hush(self._start_anew)

    def _hush(self, then: Callable[[], None]) -> None:
        self._mute_until_s, self._then = self._clock() + ALARM_S, then

    def _is_mute(self) -> bool:
        """Tell whether it waits for an alarm to have been sent, and hears nothing; go on when it has waited."""
        if self._mute_until_s and self.time.catch_up() >= self._mute_until_s:
            self._mute_until_s = 0.0
            self._then()
        return self._mute_until_s > 0

    def power_cycle(self, seconds: str = "0.2") -> None:
        """Take the supply away for a time: the motors stop where they are, and nothing is heard or said."""
        self._off_until_s = self.time.catch_up() + float(seconds)
        self.planner.end_at_once()
        self._pending.clear()

    def _is_off(self) -> bool:
        """Tell whether there is no supply; boot when it has come."""
        now_s = self.time.catch_up()
        if self._off_until_s and now_s >= self._off_until_s:
            self._off_until_s = 0.0
            planner = self.planner
            planner.slip = [s + p for s, p in zip(planner.slip, planner.position, strict=True)]
            planner.position = [0.0] * len(planner.position)
            self.homing.end()
            self._mute_until_s, self._deaf, self._asked = 0.0, False, False
            self.state = "Alarm" if self._locked else "Idle"
            self._start_anew()
        return self._off_until_s > 0

    # -- line ------------------------------------------------------------------------------------

    def _say(self, text: str) -> None:
        self._pending.append(f"{text}\r\n".encode())

    def _spoken(self) -> list[bytes]:
        said, self._pending = self._pending, []
        return said

    def connected(self) -> list[bytes]:
        """Greet."""
        self._greet()
        return self._spoken()

    def due(self) -> list[bytes]:
        """Let time pass."""
        if self._is_off() or self._is_mute():
            return self._spoken()
        self._admit()
        return self._spoken()

    def take(self, data: bytes) -> list[bytes]:
        """Take bytes: real-time ones at once, the rest by lines that end in LF or CR."""
        if self._is_off() or self._is_mute():
            return self._spoken()
        for byte in data:
            if byte in REALTIME or (self.hal and byte in (0x80, 0x81, 0x82, 0x83, 0x87, 0x19)):
                self._realtime(byte)
            elif byte >= 0x80 or len(self._line) + sum(map(len, self._lines)) >= RX_BYTES:
                continue  # no character, or no room for it
            elif byte in b"\r\n":
                self._lines.append(_stripped(self._line.decode("latin-1")))
                self._line.clear()
            else:
                self._line.append(byte)
        self._admit()
        return self._spoken()

    def _admit(self) -> None:
        """Take lines while the planner has room; a full one lets the line wait for its ok."""
        while self._lines and len(self.planner.blocks) < BLOCKS and not self.homing.is_on and not self._deaf:
            line = self._lines.popleft()
            if self._refusals > 0 and line:
                self._refusals -= 1
                error = 8
            else:
                error = self._obey(line) if len(line) < LINE_BYTES else 11
            if not self.homing.is_on or error:
                self._say(f"error:{error}" if error else "ok")

    def _greet(self) -> None:
        name = "GrblHAL 1.1f ['$' or '$HELP' for help]" if self.hal else "Grbl 1.1h ['$' for help]"
        self._pending.append(f"\r\n{name}\r\n".encode())
        if self.state == "Alarm":
            self._say("[MSG:'$H'|'$X' to unlock]")

    def _realtime(self, byte: int) -> None:
        match byte:
            case 0x3F | 0x80 if self.homing.is_on and not self.hal:
                self._asked = True
            case 0x3F | 0x80 if not self._deaf:
                self._frozen -= self._frozen > 0
                self._image = self._image if self._frozen and self._image else self.report()
                self._say(self._image)
            case 0x18:
                self._reset()
            case 0x85 if self.state == "Jog":
                self.planner.cancelling = True
            case 0x21 if self.state in ("Run", "Jog", "Idle"):
                if self.state == "Jog":
                    self.planner.cancelling = True
                else:
                    self.state, self.planner.holding = "Hold", True
            case 0x7E if self.state in ("Hold", "Door"):
                self.planner.holding = False
                self.state = "Run" if self.planner.blocks else "Idle"
            case 0x84 if self.state in ("Idle", "Run", "Jog"):
                self.planner.holding, self.state = True, "Door"

    def _reset(self) -> None:
        if self.homing.is_on:
            self.crash(6)
        elif self.planner.speed > 0:
            self.crash(3)
        else:
            self._start_anew()

    def _start_anew(self) -> None:
        self.state = "Alarm" if self.state in ("Alarm", "Sleep") else "Idle"
        self._deaf = False
        self.planner.clear()
        self._lines.clear()
        self._line.clear()
        self.parser.reset()
        self._greet()

    def report(self) -> str:
        """Return a status report."""
        state = self.state
        if state in ("Hold", "Door"):
            state += ":1" if self.planner.speed and state == "Hold" else ":0"
        scale, digits = (25.4, 4) if self.settings[13] else (1.0, 3)
        work = not int(self.settings[10]) & 1
        offset = self.parser.offset
        shown = [(p - (o if work else 0.0)) / scale for p, o in zip(self.planner.position, offset, strict=True)]
        fields = [state, f"{'WPos' if work else 'MPos'}:" + ",".join(f"{v:.{digits}f}" for v in shown)]
        if int(self.settings[10]) & 2:
            fields.append(f"Bf:{BLOCKS - len(self.planner.blocks)},{RX_BYTES}")
        fields.append(f"FS:{self.planner.speed * 60:.0f},0")
        if self.reports % 10 == 0:
            fields.append("WCO:" + ",".join(f"{o / scale:.{digits}f}" for o in offset))
        elif self.reports % 10 == 1:
            fields.append("Ov:100,100,100")
        if self.hal and self.reports % 7 == 0:
            fields.append("FW:grblHAL|H:0,0")
        self.reports += 1
        return "<" + "|".join(fields) + ">"

    # -- lines -----------------------------------------------------------------------------------

    def _obey(self, line: str) -> int:
        """Obey a line and return the error, 0 for none."""
        if not line:
            return 0
        if line.startswith("$J="):
            return self._jog(line[3:]) if self.state in ("Idle", "Jog") else 8
        if line.startswith("$"):
            return self._system(line)
        if self.state in ("Alarm", "Jog", "Sleep"):
            return 9
        return self._gcode(line)

    def _system(self, line: str) -> int:
        moving = self.state not in ("Idle", "Alarm", "Check")
        match line:
            case "$":
                self._say("[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]")
            case "$G":
                self._say("[GC:" + self.parser.modes() + " G54 G17 G94 M5 M9 T0 F0 S0]")
            case "$X":
                if self.state == "Alarm":
                    self.state = "Idle"
                    self._say("[MSG:Caution: Unlocked]")
            case "$$" if self.state not in ("Run", "Hold"):
                for key, value in sorted(self.settings.items()):
                    self._say(f"${key}={value:.3f}" if key >= 100 or value % 1 else f"${key}={int(value)}")
            case "$C" if self.state == "Check":
                self._reset()
                self._say("[MSG:Disabled]")
            case "$C":
                if self.state != "Idle":
                    return 8
                self.state = "Check"
            case _ if moving:
                return 8
            case "$I":
                self._say("[VER:1.1f.20260801:]" if self.hal else "[VER:1.1h.20190830:]")
                self._say("[OPT:VNML+,100,1024,3,0]" if self.hal else f"[OPT:V,{BLOCKS},{RX_BYTES}]")
            case "$H":
                if not self.settings[22]:
                    return 5
                self.state = "Home"
                self.homing.begin()
            case "$SLP":
                self.state = "Sleep"
            case _:
                return self._set(line)
        return 0

    def _set(self, line: str) -> int:
        match = re.fullmatch(r"\$(\d+)=(-?[\d.]+)", line)
        if match is None or int(match[1]) not in self.settings:
            return 3
        if float(match[2]) < 0:
            return 4
        self.settings[int(match[1])] = float(match[2])
        return 0

    def _jog(self, text: str) -> int:
        found = self.parser.jog(text, self.planner.end)
        if isinstance(found, int):
            return found
        if self.settings[20] and any(not -self.settings[130 + i] <= t <= 0 for i, t in enumerate(found.target)):
            return 15
        self.planner.add(found.target, found.feed, jog=True)
        self.state = "Jog"
        return 0

    def _gcode(self, line: str) -> int:
        found = self.parser.line(line, self.planner.end)
        if isinstance(found, int):
            return found
        self.planner.add(found.target, found.feed, jog=False)
        self.state = "Run" if self.state == "Idle" else self.state
        return 0

    def foreign(self, kind: str, value: str) -> int:
        """Obey another sender; return the error."""
        number = float(value)
        lines = {
            "velocity": f"$J=G91G21X{1000 if number > 0 else -1000}F{abs(number) * 60:g}",
            "position": f"G90G21G1X{number:g}F1000", "mode": f"G{value}",
        }  # fmt: skip
        if kind not in lines:
            raise ValueError(f"kind {kind}: want one of {', '.join(lines)}")
        if self.state == "Alarm":
            self._obey("$X")
        return self._obey(lines[kind])

    def handlers(self) -> dict[str, Callable[..., object]]:
        """Return the commands on standard input."""

        def state() -> dict[str, object]:
            self.time.catch_up()
            real = [p + s for p, s in zip(self.planner.position, self.planner.slip, strict=True)]
            return {
                "state": self.state, "position": self.planner.position, "real": real, "velocity": self.planner.speed,
                "blocks": len(self.planner.blocks),
            }  # fmt: skip

        def alarm(number: str) -> None:
            self.crash(int(number))

        def program(distance: str, feed: str) -> int:
            return self._obey(f"G91G1X{distance}F{feed}")

        def setting(key: str, value: str) -> None:
            self.settings[int(key)] = float(value)

        def reference(where: str = "") -> None:
            self.time.catch_up()
            self.homing.put_near(math.inf if where == "off" else NEAR_MM)

        def refuse(count: str) -> None:
            self._refusals = int(count)

        def freeze(count: str = str(FOREVER)) -> None:
            self._frozen, self._image = int(count), ""

        return {
            "state": state, "alarm": alarm, "program": program, "set": setting, "power_cycle": self.power_cycle,
            "refuse": refuse, "freeze": freeze, "foreign": self.foreign, "reference": reference,
            "door": lambda: self._realtime(0x84), "hold": lambda: self._realtime(0x21),
        }  # fmt: skip


def _stripped(line: str) -> str:
    """Return a line as it is kept: without blanks, comments and slashes, in capitals."""
    line = re.sub(r"\([^)]*\)?|;.*", "", line)
    return "".join(c for c in line if c > " " and c != "/").upper()


async def main() -> None:
    """Serve until told to end."""
    parser = wire.parser("simulated Grbl controller", tcp=True)
    parser.add_argument("--axes", type=int, default=3)
    parser.add_argument("--hal", action="store_true", help="grblHAL")
    parser.add_argument("--no-homing", action="store_true", help="$22=0: starts unlocked")
    parser.add_argument("--unlocked", action="store_true", help="built without HOMING_INIT_LOCK: starts unlocked")
    parser.add_argument("--factory", action="store_true", help="$10, $110.. and $120.. as Grbl ships")
    options = parser.parse_args()
    homing = not options.no_homing
    locked = homing and not options.unlocked
    controller = Controller(options.axes, options.hal, homing, options.factory, locked)
    await wire.run(controller, options, controller.handlers())


if __name__ == "__main__":
    asyncio.run(main())
