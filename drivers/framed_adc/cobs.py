"""Consistent overhead byte stuffing with a CRC, and an incremental receiver.

A frame on the wire is COBS(payload + CRC-16/CCITT-FALSE, low byte first) followed by one zero byte.
Stuffing removes every zero from the content, so a receiver that starts anywhere, or that lost
bytes, is in step again at the next zero. Source: Cheshire and Baker, "Consistent Overhead Byte
Stuffing", IEEE/ACM Transactions on Networking 7(2), 1999.
"""

from __future__ import annotations

from dataclasses import dataclass

from sioms.sdk.codec.checksum import crc16_ccitt_false

MAX_PAYLOAD_BYTES = 252
MAX_WIRE_BYTES = MAX_PAYLOAD_BYTES + 2 + 2
"""Longest stuffed frame without its closing zero: payload, CRC and at most 2 code bytes."""


def stuff(data: bytes) -> bytes:
    """Return ``data`` without zeros: each code byte tells the distance to the next zero.

    Example:
        >>> stuff(bytes.fromhex("11 22 00 33")).hex(" ")
        '03 11 22 02 33'
    """
    out = bytearray()
    runs = data.split(b"\0")
    for i, run in enumerate(runs):
        while len(run) >= 254:
            out.append(255)
            out += run[:254]
            run = run[254:]
            if not run and i == len(runs) - 1:
                return bytes(out)
        out.append(len(run) + 1)
        out += run
    return bytes(out)


def unstuff(data: bytes) -> bytes | None:
    """Return what was stuffed, or None when ``data`` (without its closing zero) is no stuffing.

    Example:
        >>> unstuff(bytes.fromhex("03 11 22 02 33")).hex(" ")
        '11 22 00 33'
    """
    if not data or 0 in data:
        return None
    out = bytearray()
    at, end = 0, len(data)
    while True:
        code = data[at]
        after = at + code
        if after > end:
            return None
        out += data[at + 1 : after]
        if after == end:
            return bytes(out)
        if code != 255:
            out.append(0)
        at = after


def frame(payload: bytes) -> bytes:
    """Return the wire bytes of a payload of 1 to 252 bytes.

    Example:
        >>> frame(b"\\x10").hex(" ")
        '04 10 c1 f3 00'
    """
    if not 1 <= len(payload) <= MAX_PAYLOAD_BYTES:
        raise ValueError(f"frame a payload of {len(payload)} bytes: want 1 to {MAX_PAYLOAD_BYTES}")
    return stuff(payload + crc16_ccitt_false(payload).to_bytes(2, "little")) + b"\0"


@dataclass(slots=True)
class FrameCounters:
    """What a receiver saw since it started."""

    frames: int = 0
    bad_crc: int = 0
    malformed: int = 0
    oversized: int = 0


class FrameReceiver:
    """Turns any cut of the wire stream into payloads. Keeps at most one unfinished frame.

    Damaged frames are counted and dropped. Empty frames (runs of zeros, used to force a
    resynchronisation) are ignored. The piece before the first zero is taken as a frame: when the
    line was entered in the middle of one it fails its CRC and counts as bad.
    """

    def __init__(self) -> None:
        self.counters = FrameCounters()
        self._rest = b""
        self._skipping = False

    def feed(self, data: bytes) -> list[bytes]:
        """Return the payloads that ``data`` completes, in order."""
        pieces = (self._rest + data).split(b"\0")
        self._rest = pieces.pop()
        payloads = []
        for piece in pieces:
            if self._skipping:
                self._skipping = False
            elif piece and (payload := self._open(piece)) is not None:
                payloads.append(payload)
        if len(self._rest) > MAX_WIRE_BYTES:
            if not self._skipping:
                self.counters.oversized += 1
            self._skipping = True
        if self._skipping:
            self._rest = b""
        return payloads

    def _open(self, piece: bytes) -> bytes | None:
        if len(piece) > MAX_WIRE_BYTES:
            self.counters.oversized += 1
            return None
        content = unstuff(piece)
        if content is None or len(content) < 3:
            self.counters.malformed += 1
            return None
        payload = content[:-2]
        if crc16_ccitt_false(payload) != content[-2] | content[-1] << 8:
            self.counters.bad_crc += 1
            return None
        self.counters.frames += 1
        return payload
