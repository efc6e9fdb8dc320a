"""Decoders of the messages that must be quick, for a process that has loaded msgspec anyway.

They accept less than ``verbs.take`` does without them, and what they accept means the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from msgspec import DecodeError
from msgspec.msgpack import Decoder

from .verbs import FLAG, INTEGER, KINDS, NUMBER, SECONDS, Message, Socket

_TYPES: dict[Any, Any] = {
    INTEGER: int, NUMBER: float | int, SECONDS: float | int | None, FLAG: bool, KINDS["Records"]: bytes,
}  # fmt: skip


def add_decoders(socket: Socket) -> None:
    """Decode messages that hold only numbers, flags and bytes by compiled code from now on."""
    for verb, message in socket.items():
        if verb < 0x80 and all(kind in _TYPES for kind in message.fields.values()):
            socket.decoders[verb] = _decoder(verb, message)


def _decoder(verb: int, message: type[Message]) -> Callable[[bytes], Sequence[Any] | None]:
    types = [_TYPES[kind] for kind in message.fields.values()]
    decode = Decoder(tuple[int, int, *types]).decode  # type: ignore[valid-type]

    def decoded(packet: bytes) -> Sequence[Any] | None:
        try:
            parts: Sequence[Any] = decode(packet)
        except (DecodeError, UnicodeDecodeError):
            return None
        if parts[0] != verb or not 0 <= parts[1] < 1 << 53:
            return None
        return None if any(part != part for part in parts) else parts

    return decoded
