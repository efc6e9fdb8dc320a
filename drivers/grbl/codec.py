"""Grbl 1.1, grblHAL and FluidNC as text, without I/O: lines answered by one ``ok`` or ``error:N``, and single real-time
bytes.

Lines end in LF alone: CR LF would draw two answers. Whatever else the controller says meanwhile (messages, alarms)
    stands
before the answer and is returned with it. Sources: grbl ``doc/markdown/{interface,commands,jogging,settings}.md`` of
    1.1h.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from sioms.sdk.exchange import DeviceError, Exchange, LinkError, StateLost

STATUS, HOLD, RESUME, RESET, JOG_CANCEL = b"?", b"!", b"~", b"\x18", b"\x85"
LINE_LIMIT = 80
"""Longest line with its end; longer ones draw error 11."""
END_CUT_LINE = b"@\n"
"""Ends a line that was cut off without its being obeyed: no line with this letter is right."""
LETTERS = "XYZABCUVW"
_FLOOD = 16384
"""More bytes than this without an answer are no controller."""
_REPORT = re.compile(r"<([A-Za-z]+)(?::(\d+))?((?:\|[^|<>]*)*)>")

ERRORS = {
    1: "a letter was expected",
    2: "bad number",
    3: "unknown $ statement",
    4: "negative value",
    5: "homing is disabled ($22)",
    6: "step pulse below 3 us",
    7: "EEPROM read failed, defaults restored",
    8: "only allowed when idle",
    9: "locked by alarm or jog",
    10: "soft limits need homing",
    11: "line too long",
    12: "step rate above 30 kHz",
    13: "safety door is open",
    14: "start-up line too long",
    15: "jog target outside the machine's travel",
    16: "bad jog command",
    17: "laser mode needs PWM",
    20: "unsupported command",
    21: "modal group conflict",
    22: "feed rate undefined",
    23: "integer required",
    24: "two commands use axis words",
    25: "repeated word",
    26: "axis words missing",
    27: "bad line number",
    28: "value word missing",
    29: "G59.x is not supported",
    30: "G53 needs G0 or G1",
    31: "unused axis words",
    32: "arc without axis words",
    33: "invalid target",
    34: "invalid arc radius",
    35: "arc without offset",
    36: "unused words",
    37: "tool length offset on a wrong axis",
    38: "tool number too large",
}
ALARMS = {
    1: "hard limit switch",
    2: "target beyond the soft limits",
    3: "reset in motion",
    4: "probe already triggered",
    5: "probe found no contact",
    6: "homing ended by a reset",
    7: "safety door opened while homing",
    8: "homing did not clear the switch",
    9: "homing found no switch",
    10: "homing found no second switch of a dual axis",
}
POSITION_KEPT = (2, 4, 5)
"""Alarms after which the position is still true; of all others, unknown ones too, it is not."""

DEAF = (1, 2)
"""Alarms after which the controller hears nothing but a reset, not even ``?``."""

RESETTING = (3, 6, 7, 8, 9)
"""Alarms behind which it resets itself and greets: resets in motion and homings that failed."""

ALARM_S = 0.6
"""After an alarm it hears nothing for half a second, no reset either (``report_alarm_message``)."""


def alarm_text(number: int) -> str:
    """Return an alarm in words.

    Example:
        >>> alarm_text(3)
        'ALARM:3, reset in motion; the position is lost'
    """
    lost = "" if number in POSITION_KEPT else "; the position is lost"
    return f"ALARM:{number}, {ALARMS.get(number, 'unknown to this driver')}{lost}"


@dataclass(frozen=True, slots=True)
class Report:
    """A status report.

    Args:
        state: ``Idle``, ``Run``, ``Hold``, ``Jog``, ``Alarm``, ``Door``, ``Check``, ``Home``, ``Sleep`` ...
        sub: number behind the state (``Hold:0`` = hold complete), -1 without.
        machine: machine position in the controller's unit, or None when it tells the work position.
        work: work position, or None.
        offset: work coordinate offset when it is told.
        free_blocks: free places in the planner, -1 when not told.
        inputs: letters of the asserted inputs.
    """

    state: str
    sub: int = -1
    machine: tuple[float, ...] | None = None
    work: tuple[float, ...] | None = None
    offset: tuple[float, ...] | None = None
    free_blocks: int = -1
    inputs: str = ""


@dataclass(frozen=True, slots=True)
class Answer:
    """What the controller said up to its ``ok``.

    Args:
        lines: all lines before it.
    """

    lines: tuple[str, ...] = field(default=())

    def tagged(self, tag: str) -> str:
        """Return the text of ``[TAG:text]``, '' when there is none."""
        for line in self.lines:
            if line.startswith(f"[{tag}:"):
                return line[len(tag) + 2 :].rstrip("]")
        return ""

    def settings(self) -> dict[int, float]:
        """Return the numbers of ``$n=value`` lines."""
        found = (re.fullmatch(r"\$(\d+)=(-?[\d.]+)(?:\s.*)?", line) for line in self.lines)
        return {int(match[1]): float(match[2]) for match in found if match}


def alarm_of(lines: Iterable[str]) -> int:
    """Return the number of the last ``ALARM:n`` among lines, 0 when there is none.

    What was heard between two exchanges may begin with a piece of a line the rest of which a reply has taken.

    Example:
        >>> alarm_of(["ok", "[MSG:'$HALARM:1"])
        1
    """
    numbers = [int(found[1]) for line in lines if (found := re.search(r"ALARM:(\d+)$", line))]
    return numbers[-1] if numbers else 0


def lines_of(data: bytes) -> list[str]:
    """Return the complete lines in bytes, stripped and without empty ones."""
    whole = data[: data.rfind(b"\n") + 1]
    return [line for raw in whole.split(b"\n") if (line := raw.decode("ascii", "replace").strip())]


def parse_report(line: str) -> Report:
    """Return a status report.

    Raises:
        LinkError: it is none, or a number in it is damaged.

    Example:
        >>> parse_report("<Jog|MPos:1.000,0.000,0.000|FS:100,0>").machine
        (1.0, 0.0, 0.0)
    """
    match = _REPORT.fullmatch(line)
    if match is None:
        raise LinkError(f"read the status: {line[:100]!r} is not a status report")
    fields = dict(part.partition(":")[::2] for part in match[3].split("|")[1:])
    try:
        blocks = int(fields["Bf"].split(",")[0]) if "Bf" in fields else -1
        machine, work, offset = (_vector(fields, key) for key in ("MPos", "WPos", "WCO"))
    except ValueError:
        raise LinkError(f"read the status: {line[:100]!r} has a damaged number") from None
    sub = int(match[2]) if match[2] else -1
    return Report(match[1], sub, machine, work, offset, blocks, fields.get("Pn", ""))


def _vector(fields: Mapping[str, str], key: str) -> tuple[float, ...] | None:
    return tuple(float(word) for word in fields[key].split(",")) if key in fields else None


def _end_of(data: bytes, is_end: re.Pattern[bytes]) -> int | None:
    if len(data) > _FLOOD:
        raise LinkError(f"{len(data)} bytes without an answer; is this a Grbl controller at this baud rate")
    match = is_end.search(data)
    return match.end() if match else None


_OK = re.compile(rb"(?:^|\n)\s*(?:ok|error:[^\r\n]*)\r?\n")
_HELLO = re.compile(rb"(?:^|\n)\s*(?:Grbl|GrblHAL|grblHAL|FluidNC)\b[^\r\n]*\[[^\n]*\n")
_ANGLE = re.compile(rb"<[^\r\n]*>\r?\n")


def greets(lines: Iterable[str]) -> bool:
    """Tell whether the controller has started anew, by its greeting among lines.

    Example:
        >>> greets(["", "Grbl 1.1h ['$' for help]"])
        True
    """
    return any(_HELLO.search(line.encode() + b"\n") for line in lines)


def command(line: str, timeout_s: float, *, repeatable: bool = False) -> Exchange:
    """Return the exchange of a line; its value is an :class:`Answer`.

    Raises:
        ValueError: a line that is too long or not ASCII.
    """
    data = line.encode("ascii") + b"\n"
    if len(data) > LINE_LIMIT or b"\n" in data[:-1]:
        raise ValueError(f"line {line!r} has {len(data)} characters; want one line of up to {LINE_LIMIT}")
    what = f"send {line!r}" if line else "ask for an ok"

    def want(reply: bytes) -> int | None:
        hello = _HELLO.search(reply)
        return hello.end() if hello else _end_of(reply, _OK)

    def decode(reply: bytes) -> Answer:
        if _HELLO.search(reply):
            raise StateLost(f"{what}: the controller has started anew meanwhile")
        *before, last = lines_of(reply)
        if last == "ok":
            return Answer(tuple(before))
        number = int(last[6:]) if last[6:].isdigit() else 0
        errno_ = errno.EPERM if number in (8, 9, 13) else errno.EINVAL
        raise DeviceError(errno_, f"{what}: {last}, {ERRORS.get(number, 'unknown to this driver')}")

    return Exchange(data, want, decode, timeout_s, repeatable, what)


def status(timeout_s: float) -> Exchange:
    """Return the exchange of ``?``; its value is the report and the lines that came before it.

    A greeting without a report ends it, as StateLost: the ``?`` went to a controller that was starting, which does not
        answer it.
    """

    def want(reply: bytes) -> int | None:
        end, hello = _end_of(reply, _ANGLE), _HELLO.search(reply)
        return hello.end() if end is None and hello else end

    def decode(reply: bytes) -> tuple[Report, tuple[str, ...]]:
        if not _ANGLE.search(reply):
            raise StateLost("read the status: the controller has started anew meanwhile")
        *before, last = lines_of(reply)
        return parse_report(last[last.find("<") :]), tuple(before)

    return Exchange(STATUS, want, decode, timeout_s, True, "read the status")


def reset(timeout_s: float) -> Exchange:
    """Return the exchange of a soft reset; its value is the lines up to the banner. It may be sent again: it is a
    stop.
    """
    return Exchange(
        RESET,
        lambda reply: _end_of(reply, _HELLO),
        lambda reply: tuple(lines_of(reply)),
        timeout_s,
        True,
        "reset the controller",
    )


def jog(targets: Mapping[str, float], feed: float) -> str:
    """Return the line that jogs to machine positions.

    Args:
        targets: letter to position [mm or degrees].
        feed: along the line [mm/min or degrees/min].

    Example:
        >>> jog({"X": 10.0, "Y": -0.5}, 600.0)
        '$J=G53G90G21X10Y-0.5F600'
    """
    speed = _number(max(feed, 0.001), 3 if feed < 100 else 0)
    for digits in (4, 3):  # six axes with four digits can be too long
        words = "".join(f"{letter}{_number(value, digits)}" for letter, value in targets.items())
        if len(words) + len(speed) + 15 <= LINE_LIMIT:
            break
    return f"$J=G53G90G21{words}F{speed}"


def _number(value: float, digits: int) -> str:
    text = f"{value:.{digits}f}"
    text = text.rstrip("0").rstrip(".") if digits else text
    return "0" if text == "-0" else text
