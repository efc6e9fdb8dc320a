"""ODrive's ASCII protocol (firmware 0.5.4 to 0.5.6), without I/O: lines with a checksum each, replies to reads alone.

Set commands draw no reply, and one whose checksum is damaged is dropped without a word. So every set goes out together
with
reads behind it, in one exchange: an error line in front of their replies is the refusal, and reading back what was set
tells that it arrived. Sources: ODrive documentation, "ASCII protocol", and the firmware's ``ascii_protocol.cpp``.
"""

from __future__ import annotations

import errno
import math
import re
from collections.abc import Callable, Sequence
from itertools import chain, repeat

from sioms.sdk.codec.checksum import xor8
from sioms.sdk.exchange import DeviceError, Exchange, LinkError

MAX_LINE = 256
IDLE, CLOSED_LOOP, HOMING = 1, 8, 11
TORQUE, VELOCITY, POSITION = 1, 2, 3
PASSTHROUGH, VELOCITY_RAMP, TRAPEZOID = 1, 2, 5
WATCHDOG_EXPIRED = 1 << 11
AXIS_ERRORS = {
    0: "invalid state",
    6: "motor failed",
    7: "sensorless estimator failed",
    8: "encoder failed",
    9: "controller failed",
    11: "watchdog expired",
    12: "lower end switch",
    13: "upper end switch",
    14: "emergency stop was requested",
    17: "homing without an end switch",
    18: "over-temperature",
    19: "the position is not known",
}
_REFUSAL = re.compile(rb"invalid|unknown|not implemented")
_TOLERANCE = 1e-4
"""Values that are read back are cut to nine characters."""


def line(text: str) -> bytes:
    """Return a line with its checksum.

    Raises:
        ValueError: it is too long or holds what would end or cut it.

    Example:
        >>> line("f 0")
        b'f 0*118\\n'
    """
    data = text.encode("ascii")
    if len(data) > MAX_LINE - 6 or any(c in data for c in b"\r\n!;*"):
        raise ValueError(f"line {text[:60]!r}: {len(data)} characters; want up to {MAX_LINE - 6} without ! ; *")
    return data + f"*{xor8(data)}\n".encode()


def unwrap(raw: bytes, what: str) -> str:
    """Return the text of a reply line whose checksum is right; raises LinkError otherwise.

    Example:
        >>> unwrap(b"24.087744*32", "read")
        '24.087744'
    """
    body, star, digits = raw.strip().rpartition(b"*")
    if not star or not digits.isdigit() or int(digits) != xor8(body):
        raise LinkError(f"{what}: the checksum of the reply is wrong ({raw[:60]!r})")
    return body.decode("ascii", "replace")


def number(text: str, what: str, *, is_limit: bool = False) -> float:
    """Return a finite number, or inf of a limit that is none; raises LinkError otherwise."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) and not (is_limit and value > 0):
        raise LinkError(f"{what}: {text[:60]!r} is not a number")
    return value


def exchange(
    sets: Sequence[str], reads: Sequence[str], timeout_s: float, *, repeatable: bool = False,
    check: Callable[[list[list[float]]], None] | None = None, urgent: bool = False,
) -> Exchange:  # fmt: skip
    """Return set commands and the reads behind them; the value is the numbers of each reply.

    The last line is always a feedback (``f``), the only one with two numbers: a reply too many or too few in between is
    seen by it.

    Args:
        sets: lines that draw no reply unless they are refused.
        reads: lines that draw one reply each, at least one.
        timeout_s: longest time for all of them [s].
        repeatable: the sets may be sent again.
        check: looks at the replies, raises LinkError.
        urgent: stray bytes on the line must not damage the first line: an empty one goes ahead and ends them.

    Raises:
        ValueError: a line that cannot be sent.
    """
    asked = [*reads] if reads[-1].startswith("f ") else [*reads, "f 0"]
    widths = [2 if text.startswith("f ") else 1 for text in asked]
    data = (b"\n" if urgent else b"") + b"".join(line(text) for text in (*sets, *asked))
    what = f"send {', '.join(sets) or ', '.join(reads)}"

    def want(reply: bytes) -> int | None:
        lines = _answers(reply)
        # a refused set speaks before the replies; a refused read speaks instead of its reply
        extra = sum(bool(_REFUSAL.match(each)) for each in lines) if sets else 0
        if len(reply) > MAX_LINE * (len(sets) + len(asked) + 1):
            raise LinkError(f"{what}: {len(reply)} bytes without an end")
        needed = len(asked) + min(extra, len(sets))
        return _end_of(reply, needed) if len(lines) >= needed else None

    def decode(reply: bytes) -> list[list[float]]:
        texts = [unwrap(each, what) for each in _answers(reply)]
        for text in texts:
            if _REFUSAL.match(text.encode("ascii", "replace")):
                raise DeviceError(errno.EINVAL, f"{what}: refused, {text}")
        limits = chain((text.endswith(("_lim", "_limit")) for text in asked), repeat(False))
        values = [
            [number(word, what, is_limit=limit) for word in text.split()]
            for text, limit in zip(texts, limits, strict=False)
        ]
        if [len(each) for each in values] != widths:
            raise LinkError(f"{what}: replies of {[len(each) for each in values]} numbers; want {widths}")
        del values[len(reads) :]
        if check is not None:
            check(values)
        return values

    return Exchange(data, want, decode, timeout_s, repeatable, what)


def _answers(reply: bytes) -> list[bytes]:
    """Return the complete lines that answer ours; one without a checksum answers stray bytes that have ended as a
    line.
    """
    return [each for each in reply.split(b"\n")[:-1] if b"*" in each]


def _end_of(reply: bytes, answers: int) -> int:
    """Return where so many answers end."""
    end = 0
    for _ in range(answers):
        end = reply.index(b"\n", reply.index(b"*", end)) + 1
    return end


def read(paths: Sequence[str], timeout_s: float) -> Exchange:
    """Return the exchange that reads properties; the value is one number each, as lists of one."""
    return exchange((), [f"r {path}" for path in paths], timeout_s, repeatable=True)


def confirmed(
    sets: Sequence[str],
    back: Sequence[tuple[str, float]],
    timeout_s: float,
    *,
    also: Sequence[str] = (),
    repeatable: bool = False,
    urgent: bool = False,
) -> Exchange:
    """Return sets and the check that these properties hold these values afterwards.

    A mismatch is a LinkError: a line was lost on its way. The value is the numbers of each reply, those of ``also``
        last.

    Args:
        sets: lines that draw no reply.
        back: properties and the values that they must have then.
        timeout_s: longest time for all of it [s].
        also: further lines that draw a reply.
        repeatable, urgent: as of ``exchange``.
    """

    def check(values: list[list[float]]) -> None:
        for (path, wanted), (got, *_) in zip(back, values, strict=False):
            if not agrees(got, wanted):
                raise LinkError(f"send {', '.join(sets)}: {path} reads {got:g} afterwards; {wanted:g} was sent")

    reads = [*(f"r {path}" for path, _ in back), *also]
    return exchange(sets, reads, timeout_s, check=check, repeatable=repeatable, urgent=urgent)


def agrees(got: float, wanted: float) -> bool:
    """Tell whether a property that was read holds a value that was sent."""
    return abs(got - wanted) <= _TOLERANCE * max(1.0, abs(wanted))


def error_text(axis: int, bits: int, details: Sequence[tuple[str, int]]) -> str:
    """Return the errors of an axis in words, '' for none.

    Args:
        axis: number of the axis.
        bits: of ``axisN.error``.
        details: name and bits of the errors of its parts.
    """
    if not bits:
        return ""
    names = [AXIS_ERRORS.get(bit, f"bit {bit}") for bit in range(32) if bits >> bit & 1]
    parts = "".join(f"; {name} {value:#x}" for name, value in details if value)
    return f"axis{axis}.error {bits:#x}, {', '.join(names)}{parts}"
