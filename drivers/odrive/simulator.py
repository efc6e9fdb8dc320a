"""An ODrive board (firmware 0.5.6) on a pty: ``python -m sioms.drivers.odrive.simulator --link PATH``.

Its parser is that of the firmware's ``communication/ascii_protocol.cpp`` (fw-v0.5.6, a308314e), line for line: lines
end at LF, CR or ``!`` and an empty one is an unknown command; ``;`` begins a comment; a wrong checksum is silence, but
a line without one is obeyed; 256 bytes without an end are dropped, and the next line with them; there is no time-out;
only the first letter tells the command; numbers are read as far as they go; set commands are not answered; values are
cut to nine characters. What hangs behind it is in ``odrive_axis``. Commands on standard input, beside those of the
line:

``state [AXIS]``, ``error BITS [AXIS]``, ``switch TURNS [AXIS]`` (end switch for homing), ``reference [off]`` (an end
switch near axis 0, or none), ``set PATH VALUE`` (and keep
it without supply), ``power_cycle [SECONDS]``, ``refuse COUNT``, ``freeze [COUNT]``, ``foreign KIND VALUE [AXIS]``
(velocity, torque, position, mode), ``shove V [AXIS]``.
"""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Callable

from sioms.simulation import wire
from sioms.simulation.control import number
from sioms.simulation.drive import STEP_S, Stepper

from .simulated.axis import CLOSED_LOOP, FLAGS, IDLE, READ_ONLY, STORED, UNSIGNED, Axis

__all__ = ["CLOSED_LOOP", "IDLE", "Axis", "Board"]

MAX_LINE, MAX_REPLY = 256, 64
REFERENCE_TURNS = 3.0
"""How far away the end switch is put."""
FOREVER = 1 << 30
_INTEGER = r"\s*([+-]?\d+)"
_FLOAT = r"\s*([+-]?(?:\d+\.?\d*(?:e[+-]?\d+)?|\.\d+(?:e[+-]?\d+)?|nan|inf(?:inity)?))"
HELP = (
    "Please see documentation for more details",
    "",
    "Available commands syntax reference:",
    "Position: q axis pos vel-lim I-lim",
    "Position: p axis pos vel-ff I-ff",
    "Velocity: v axis vel I-ff",
    "Torque: c axis T",
    "",
    "Properties start at odrive root, such as axis0.requested_state",
    "Read: r property",
    "Write: w property value",
    "",
    "Save config: ss",
    "Erase config: se",
    "Reboot: sr",
)


class Board:
    """The board; times in seconds of the given clock."""

    def __init__(self, version: str = "0.5.6", dry: float = 0.05, clock: Callable[[], float] = time.monotonic) -> None:
        self.version = [int(part) for part in version.split(".")]
        self.axes = [Axis(dry), Axis(dry)]
        self.time = Stepper(self._step, lambda: False, clock)
        self._clock = clock
        self._booted_s = self._off_until_s = clock()
        self._refusals = self._frozen = 0
        self._image: dict[str, str] = {}
        self._forget_line()

    def _step(self, now_s: float, dt: float) -> None:
        powered = now_s >= self._off_until_s
        if powered and self._booted_s < self._off_until_s:
            self.boot(self._off_until_s)
        for axis in self.axes:
            axis.step(dt, powered)

    def boot(self, now_s: float | None = None) -> None:
        """Begin anew, as after a reset or when the supply comes."""
        self._booted_s = self._clock() if now_s is None else now_s
        self._forget_line()
        for axis in self.axes:
            axis.boot()

    def _forget_line(self) -> None:
        self._line, self._active = bytearray(), True

    def connected(self) -> list[bytes]:
        """Say nothing."""
        return []

    def due(self) -> list[bytes]:
        """Let time pass."""
        self.time.catch_up()
        return []

    def take(self, data: bytes) -> list[bytes]:
        """Take bytes; obey complete lines."""
        if self.time.catch_up() < self._off_until_s:
            return []
        replies: list[bytes] = []
        for byte in data:
            if byte in b"\r\n!":
                line, is_whole = bytes(self._line), self._active
                self._forget_line()
                if is_whole:  # else it did not begin at its beginning
                    replies += self._process(line)
            else:
                self._line.append(byte)
                if len(self._line) >= MAX_LINE:
                    self._line, self._active = bytearray(), False
        return replies

    def _process(self, raw: bytes) -> list[bytes]:
        raw = raw.partition(b";")[0]
        body, star, digits = raw.partition(b"*")
        has_checksum = bool(star and digits)
        if has_checksum:
            found = re.match(_INTEGER, digits.decode("latin-1"))
            if found is None or int(found[1]) % 2**32 != _xor(body):
                return []
        text = (body if has_checksum else raw).partition(b"\0")[0].decode("latin-1")
        replies = [reply.encode("latin-1") for reply in self._obey(text)]
        lines = [r + (f"*{_xor(r)}".encode() if has_checksum else b"") + b"\r\n" for r in replies]
        return [line if len(line) < MAX_REPLY else line[: MAX_REPLY - 1] + b"\0" for line in lines]

    def _obey(self, text: str) -> list[str]:
        letter = text[:1]
        if letter in ("p", "q", "v", "c", "t", "w") and self._refusals > 0:
            self._refusals -= 1
            return ["not implemented" if letter == "w" else "invalid command format"]
        match letter:
            case "f" | "r":
                return [self._kept(text, self._feedback if letter == "f" else self._read)]
            case "p" | "q" | "v" | "c" | "t" | "u":
                return self._motion(letter, text)
            case "w":
                return self._write(text)
            case "s":
                self._system(text[1:2])
                return []
            case "e":
                return [self._encoder(text)]
            case "h":
                return list(HELP)
            case "i":
                version = ".".join(map(str, self.version))
                return [
                    "Hardware version: 3.6-56V",
                    f"Firmware version: {version}",
                    "Serial number: 20AD34913548",
                ]
        return ["unknown command"]

    def _kept(self, text: str, ask: Callable[[str], str]) -> str:
        """Return what a read says, or said last when readings stand still."""
        if self._frozen > 0 and text in self._image:
            self._frozen -= 1
        else:
            self._image[text] = ask(text)
        return self._image[text]

    def _feedback(self, text: str) -> str:
        found = _scan(text, "f", "u")
        if not found:
            return "invalid command format"
        if found[0] >= len(self.axes):
            return f"invalid motor {int(found[0])}"
        p = self.axes[int(found[0])].p
        return f"{p['encoder.pos_estimate']:f} {p['encoder.vel_estimate']:f}"

    def _motion(self, letter: str, text: str) -> list[str]:
        shapes = {"p": "ufff", "q": "ufff", "v": "uff", "c": "uf", "t": "uf", "u": "u"}
        found = _scan(text, letter, shapes[letter])
        if len(found) < min(2, len(shapes[letter])):
            return ["invalid command format"]
        if not 0 <= found[0] < len(self.axes):
            return [f"invalid motor {int(found[0])}"]
        axis, values = self.axes[int(found[0])], found[1:]
        if letter in "pqt":
            axis.move(values[0], trapezoid=letter == "t")
        elif letter in "vc":
            axis.p["controller.config.control_mode"] = 2 if letter == "v" else 1
        beside = {
            "p": ("", "controller.input_vel", "controller.input_torque"),
            "q": ("", "controller.config.vel_limit", "motor.config.torque_lim"),
            "v": ("controller.input_vel", "controller.input_torque"), "c": ("controller.input_torque",),
        }  # fmt: skip
        for path, value in zip(beside.get(letter, ()), values, strict=False):
            if path:
                axis.p[path] = value
        axis.feed()
        return []

    def _encoder(self, text: str) -> str:
        found = _scan(text[2:], "l", "ui") if text[1:2] == "s" else []
        if len(found) < 2:
            return "invalid command format"
        if not 0 <= found[0] < len(self.axes):
            return f"invalid motor {int(found[0])}"
        axis = self.axes[int(found[0])]
        axis.origin = axis.place - found[1] / 8192
        axis.feed()
        return f"encoder set to {int(found[1]) % 2**32}"

    def _system(self, letter: str) -> None:
        armed = any(axis.p["motor.is_armed"] for axis in self.axes)
        if letter == "c":
            for axis in self.axes:
                axis.clear()
            return
        for axis in self.axes:
            if letter == "s" and not armed:
                axis.stored.update((path, axis.p[path]) for path in axis.stored)
            elif letter == "e":
                axis.stored = dict(STORED)
        if letter in ("r", "e") or (letter == "s" and not armed):
            self.boot()

    def _read(self, text: str) -> str:
        words = text[1:].split()
        if not words:
            return "invalid command format"
        found = self._find(words[0])
        if found is not None:
            axis, path = found
            return _shown(path, axis.p[path])
        own = {
            "vbus_voltage": "24.087744", "serial_number": "35601883739976"[:9],
            "system_stats.uptime": str(int(1000 * (self._clock() - self._booted_s)) % 2**32)[:9],
            **{f"fw_version_{n}": str(v) for n, v in zip(("major", "minor", "revision"), self.version, strict=True)},
        }  # fmt: skip
        return own.get(words[0], "invalid property")

    def _find(self, path: str) -> tuple[Axis, str] | None:
        match = re.fullmatch(r"axis([01])\.(.+)", path)
        if match is None or match[2] not in self.axes[int(match[1])].p:
            return None
        return self.axes[int(match[1])], match[2]

    def _write(self, text: str) -> list[str]:
        words = text[1:].split()
        if not words:
            return ["invalid command format"]
        found = self._find(words[0])
        if found is None:
            return ["not implemented" if self._read(f"r {words[0]}") != "invalid property" else "invalid property"]
        axis, path = found
        kind = _INTEGER if path in UNSIGNED or path in FLAGS else _FLOAT
        value = re.match(kind, words[1] if len(words) > 1 else "", re.IGNORECASE)
        if path in READ_ONLY or value is None:
            return ["not implemented"]
        axis.write(path, float(bool(int(value[1]))) if path in FLAGS else float(value[1]))
        return []

    # --- standard input ---------------------------------------------------------------------------

    def state(self, index: str = "") -> dict[str, object]:
        """Return what a bystander sees; without an index of axis 0, and the speed of the fastest."""
        self.time.catch_up()
        axis = self.axes[int(index or 0)]
        speed = axis.velocity if index else max((a.velocity for a in self.axes), key=abs)
        return {"position": axis.position, "place": axis.place, "velocity": speed, "state": axis.p["current_state"],
                "error": axis.p["error"], "torque": axis.p["controller.input_torque"],
                "armed": any(a.p["config.enable_watchdog"] for a in self.axes)}  # fmt: skip

    def power_cycle(self, seconds: str = "0.2") -> None:
        """Take the supply away for a time."""
        self._off_until_s = self.time.catch_up() + float(seconds)

    def foreign(self, kind: str, value: str, index: str = "0") -> None:
        """Obey another master, who also closes the loop."""
        self.time.catch_up()
        path = f"axis{index}.controller.config."
        lines = {
            "velocity": (f"w {path}input_mode 1", f"v {index} {value}"),
            "torque": (f"w {path}input_mode 1", f"c {index} {value}"),
            "position": (f"w {path}input_mode 1", f"p {index} {value}"), "mode": (f"w {path}control_mode {value}",),
        }  # fmt: skip
        if kind not in lines:
            raise ValueError(f"kind {kind}: want one of {', '.join(lines)}")
        axis = self.axes[int(index)]
        if kind != "mode" and axis.p["current_state"] != CLOSED_LOOP:
            axis.clear()
            self._obey(f"w axis{index}.requested_state {CLOSED_LOOP}")
            axis.step(STEP_S)
        for line in lines[kind]:
            self._obey(line)

    def handlers(self) -> dict[str, Callable[..., object]]:
        """Return the commands on standard input."""

        def error(bits: str, index: str = "0") -> None:
            self.axes[int(index)].p["motor.error"] = 0x10
            self.axes[int(index)].fail(int(number(bits)))

        def switch(turns: str, index: str = "0") -> None:
            axis = self.axes[int(index)]
            axis.switch = axis.origin + float(turns)
            axis.p["min_endstop.config.enabled"] = axis.stored["min_endstop.config.enabled"] = 1

        def reference(off: str = "") -> None:
            axis = self.axes[0]
            axis.switch = None if off else axis.place - REFERENCE_TURNS
            axis.p["min_endstop.config.enabled"] = axis.stored["min_endstop.config.enabled"] = not off

        def set_(path: str, value: str) -> None:
            found = self._find(path)
            if found is None:
                raise ValueError(f"no property {path}")
            axis, name = found
            axis.write(name, float(value))
            if name in axis.stored:
                axis.stored[name] = float(value)

        def refuse(count: str) -> None:
            self._refusals = int(count)

        def freeze(count: str = str(FOREVER)) -> None:
            self._frozen = int(count)

        def shove(speed: str, index: str = "0") -> None:
            self.axes[int(index)].shoved = float(speed)

        return {"state": self.state, "error": error, "switch": switch, "reference": reference, "set": set_,
                "power_cycle": self.power_cycle, "refuse": refuse, "freeze": freeze,
                "foreign": self.foreign, "shove": shove}  # fmt: skip


def _xor(data: bytes) -> int:
    total = 0
    for byte in data:
        total ^= byte
    return total


def _scan(text: str, letter: str, kinds: str) -> list[float]:
    """Return the numbers behind a letter, as far as they can be read, as ``sscanf`` does."""
    if not text.startswith(letter):
        return []
    values, at = [], len(letter)
    for kind in kinds:
        match = re.compile(_FLOAT if kind == "f" else _INTEGER, re.IGNORECASE).match(text, at)
        if match is None:
            break
        values.append(float(match[1]) if kind != "u" else int(match[1]) % 2**32)
        at = match.end()
    return values


def _shown(path: str, value: float) -> str:
    if path in UNSIGNED or path in FLAGS:
        return str(int(value))[:9]
    return f"{value:f}"[:9]


async def main() -> None:
    """Serve until told to end."""
    parser = wire.parser("simulated ODrive board")
    parser.add_argument("--version", default="0.5.6")
    parser.add_argument("--friction", type=float, default=0.05, help="dry friction of the rotors [Nm]")
    options = parser.parse_args()
    board = Board(options.version, options.friction)
    await wire.run(board, options, board.handlers(), wire.QUIET_S)


if __name__ == "__main__":
    asyncio.run(main())
